"""Curves as text and tables, and the plots that show them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import QFontMetricsF, QGuiApplication, QPainter, QPixmap
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from labapp.gui.curves import Axis, Curve, Mark, as_table, nearest, next_key, point_text
from labapp.gui.theme import palette
from labapp.gui.views.axes import PlainAxis, make_plot
from labapp.gui.views.plots import MOST_POINTS, PlotStack
from tests.gui.conftest import KEPT, let_draw

TIME = Axis("Time", "s")
MARKS = (Mark("●", "measured"), Mark("○", "in doubt"))


def curve(count: int = 10, name: str = "Height", step: int = 2) -> Curve:
    """Frames 0, 2, 4 … at 10 Hz; frame 4 is in doubt."""
    key = step * np.arange(count)
    return Curve(
        name,
        "mm",
        key / 10,
        0.3 + 0.01 * np.sin(key),
        sigma=np.full(count, 0.004),
        key=key,
        mark=(key == 4).astype(np.int64),
        marks=MARKS,
        level=0.3,
    )


def current() -> Curve:
    x = np.linspace(0, 2, 500)
    return Curve("Current", "A", x, 75 + np.sin(9 * x))


def test_point_text() -> None:
    assert point_text(curve(), 0, TIME) == "Frame 0, 0.0000 s: Height 0.3000 ± 0.0040 mm"
    assert point_text(curve(), 2, TIME).startswith("Frame 4, 0.4000 s, in doubt: ")
    frames = Axis("Frame", "", decimals=0)
    assert point_text(curve(), 0, frames).startswith("Frame 0: ")
    assert point_text(current(), 0, TIME) == "Time 0.0000 s: Current 75.000 A"


def test_nearest_and_next_point() -> None:
    assert nearest(curve(), 0.29) == 1
    assert nearest(curve(), -5) == 0
    assert nearest(curve(), 99) == 9
    assert nearest(curve(0), 1) is None
    both = [curve(), curve(3, step=5), current()]  # keys 0 2 4 … 18 and 0 5 10
    assert next_key(both, 4, 1) == 5
    assert next_key(both, 5, 1) == 6
    assert next_key(both, 7, 1) == 8  # a frame without a point
    assert next_key(both, 7, -1) == 6
    assert next_key(both, 18, 1) == 18
    assert next_key(both, 8, -(10**9)) == 0
    assert next_key([current()], 3, 1) is None


@pytest.mark.parametrize(
    ("frames", "gaps"),
    [
        ([0, 1, 2, 3], []),
        ([0, 1, 3, 4], []),
        ([0, 1, 2, 500, 501], [500]),
        ([0, 5, 10, 20, 40], [40]),
        ([7], []),
        ([], []),
    ],
)
def test_line_does_not_cross_missing_frames(frames: list[int], gaps: list[int]) -> None:
    key = np.array(frames, np.int64)
    width = Curve("Width", "mm", 0.1 * key, np.ones(len(key)), key=key, mark=0 * key)
    x, y = width.line
    np.testing.assert_allclose(x[np.isnan(y)], 0.1 * np.array(gaps))
    np.testing.assert_array_equal(x[np.isfinite(y)], width.x)
    assert (np.diff(x) >= 0).all()


def test_line_is_drawn_with_its_gaps(view: PlotStack) -> None:
    key = np.array([0, 1, 2, 50, 51])
    broken = Curve("Width", "mm", 0.1 * key, np.ones(5), key=key, mark=0 * key)
    view.show_curves([broken], TIME)
    _, y = view._plots[0].line.getOriginalDataset()
    assert np.isnan(y).sum() == 1


def test_table_for_a_spreadsheet() -> None:
    lines = as_table([curve(), curve(3, "Width", 5), current()], TIME).splitlines()
    head = "frame|Time (s)|Height (mm)|Height σ (mm)|Width (mm)|Width σ (mm)|mark".split("|")
    assert lines[0].split("\t") == head
    cells = [line.split("\t") for line in lines[1:]]
    assert [row[0] for row in cells] == "0 2 4 5 6 8 10 12 14 16 18".split()
    assert cells[1] == ["2", "0.2", f"{0.3 + 0.01 * np.sin(2):.9g}", "0.004", "", "", "measured"]
    assert cells[3][:4] == ["5", "0.5", "", ""]
    assert cells[2][-1] == "in doubt"
    assert as_table([current()], TIME) == "frame\tTime (s)\n"


def test_table_of_a_quantity_without_a_unit_and_of_gaps() -> None:
    y, sigma = np.array([0.5, np.nan]), np.array([0.1, np.nan])
    plain = replace(curve(2, "Asymmetry"), unit="", y=y, sigma=sigma)
    lines = as_table([plain], TIME).splitlines()
    assert lines[0].split("\t") == ["frame", "Time (s)", "Asymmetry", "Asymmetry σ", "mark"]
    assert lines[2].split("\t") == ["2", "0.2", "", "", "measured"]


@pytest.fixture
def view(qtbot: QtBot) -> Iterator[PlotStack]:
    view = PlotStack("Trends")
    KEPT.append(view)
    view.resize(800, 600)
    view.show_curves([curve(), curve(name="Width"), current()], TIME)
    view.show()
    qtbot.waitExposed(view)
    let_draw()
    yield view
    view.hide()


def at(view: PlotStack, plot: int, x: float, y: float) -> QPoint:
    scene = view._plots[plot].getViewBox().mapViewToScene(QPointF(x, y))
    port: QPoint = view.canvas.mapFromScene(scene)
    return port


def test_clicking_near_a_point_selects_its_frame(view: PlotStack) -> None:
    chosen: list[int] = []
    view.chosen.connect(chosen.append)
    port, left = view.canvas.viewport(), Qt.MouseButton.LeftButton
    shown = view.curves[1]
    QTest.mouseClick(port, left, pos=at(view, 1, shown.x[3], shown.y[3]) + QPoint(4, -5))
    assert chosen == [6]
    QTest.mouseClick(port, left, pos=at(view, 1, shown.x[3], shown.y[3]) + QPoint(0, 40))
    QTest.mouseClick(port, left, pos=at(view, 2, 1.0, 75.0))
    assert chosen == [6]


def test_keys_step_through_the_points(view: PlotStack) -> None:
    chosen: list[int] = []
    view.chosen.connect(chosen.append)
    view.chosen.connect(view.set_current)
    view.setFocus()
    for key in (Qt.Key.Key_Right, Qt.Key.Key_Right, Qt.Key.Key_End, Qt.Key.Key_Left):
        QTest.keyClick(view, key)
    assert chosen == [0, 2, 18, 16]
    assert view.read_out.text().startswith("Frame 16, 1.6000 s: Height")
    assert "Width" in view.read_out.text()
    assert view.read_out.text() in view.accessibleDescription()


def test_readout_describes_the_point_at_the_pointer(view: PlotStack) -> None:
    place = view._plots[0].getViewBox().mapViewToScene(QPointF(0.41, 0.3))
    view.canvas.scene().sigMouseMoved.emit(place)
    assert view.read_out.text().startswith("Frame 4, 0.4000 s, in doubt: Height")
    assert "○ in doubt" in view.legend.text()


@pytest.mark.parametrize("mark", [0, 1])
def test_legend_is_shown_unless_all_points_are_usual(view: PlotStack, mark: int) -> None:
    one = replace(curve(), mark=np.full(10, mark))
    view.show_curves([one], TIME)
    assert view.legend.isVisibleTo(view) == bool(mark)


def test_zoom_is_kept_for_new_values_and_reset_for_new_curves(view: PlotStack) -> None:
    QTest.keyClick(view, Qt.Key.Key_Plus)
    zoomed = view._plots[0].viewRange()[0]
    view.show_curves([curve(), curve(name="Width"), current()], TIME)
    assert view._plots[0].viewRange()[0] == zoomed
    view.show_curves([curve()], TIME)
    assert view._plots[0].viewRange()[0] != zoomed
    view.show_curves([], TIME)
    assert view.read_out.text() == " "


def test_copy_as_table_and_picture(view: PlotStack) -> None:
    view.copy_table()
    assert QGuiApplication.clipboard().text() == as_table(view.curves, TIME)
    view.copy_picture()
    assert not QGuiApplication.clipboard().image().isNull()


def test_plots_follow_the_palette(view: PlotStack) -> None:
    for dark in (True, False):
        view.setPalette(palette(dark))
        let_draw()
        corner = view.canvas.grab().toImage().pixelColor(3, 3)
        assert (corner.lightness() < 128) == dark


def test_number_of_drawn_points_is_limited(view: PlotStack) -> None:
    many = [curve(10_000, name, 1) for name in ("Width", "Length", "Height", "ARE")]
    view.show_curves(many, TIME)
    for count in (100, 1000):
        view._plots[0].setXRange(0, count, padding=0)
        let_draw()
        assert 0 < len(view._plots[0].points.data) <= MOST_POINTS


def test_frame_without_a_point_is_marked_at_its_time(view: PlotStack) -> None:
    axis = replace(TIME, span=(-1.0, 9.0))
    view.show_curves([curve()], axis)
    view.set_current(1, 8.5, "Frame 1: no surface")
    assert view.read_out.text() == "Frame 1: no surface"
    (plot,) = view._plots
    assert plot.current.isVisible()
    assert plot.current.value() == 8.5
    low, high = plot.getViewBox().viewRange()[0]
    assert low < -1.0 < 9.0 < high
    view.set_current(16)
    assert plot.current.value() == 1.6


def test_removed_plots_leave_no_trace(view: PlotStack, qtbot: QtBot) -> None:
    """The same curves look the same in a reused and in a new view."""
    six = [curve(name=name) for name in ("Width", "Length", "Height", "Depth", "Area", "ARE")]
    for curves in (six, six[:4]):
        view.show_curves(curves, TIME)
        let_draw()
    fresh = PlotStack("Trends")
    KEPT.append(fresh)
    fresh.resize(view.size())
    fresh.show_curves(six[:4], TIME)
    fresh.show()
    qtbot.waitExposed(fresh)
    let_draw()
    assert view.grab().toImage() == fresh.grab().toImage()
    fresh.hide()


@pytest.mark.parametrize("low_high", [(6.0, 6.9), (0.25, 0.34), (0.0018, 0.0036), (0.0, 1.0)])
@pytest.mark.parametrize("length_px", [40.0, 60.0, 300.0])
def test_numbers_of_a_short_axis_do_not_overlap(
    qapp: object, low_high: tuple[float, float], length_px: float
) -> None:
    low, high = low_high
    spacing, _ = PlainAxis("left").tickSpacing(low, high, length_px)[0]
    line_px = QFontMetricsF(QGuiApplication.font()).height()
    assert spacing / (high - low) * length_px >= line_px
    assert spacing <= high - low


@pytest.mark.parametrize("low_high", [(70.9, 79.4), (70.0, 79.0), (6.1, 6.7), (-0.04, 0.21)])
def test_short_axis_has_two_numbers_that_are_not_rounded(
    qapp: object, low_high: tuple[float, float]
) -> None:
    low, high = low_high
    axis, line_px = PlainAxis("left"), QFontMetricsF(QGuiApplication.font()).height()
    length_px = 3.6 * line_px
    spacing, _ = axis.tickSpacing(low, high, length_px)[0]
    ticks = spacing * np.arange(np.ceil(low / spacing), np.floor(high / spacing) + 1)
    room = line_px / 2 / length_px * (high - low)
    assert ((ticks > low + room) & (ticks < high - room)).sum() > 1
    assert [float(text) for text in axis.tickStrings(ticks, 1.0, spacing)] == pytest.approx(ticks)


def test_numbers_of_an_axis_are_not_cut_off_at_its_ends(qtbot: QtBot):
    plot = make_plot("along (mm)", "height (mm)", equal=False)
    qtbot.addWidget(plot)
    plot.setYRange(0.0, 0.3, padding=0)
    plot.resize(300, 200)
    with qtbot.waitExposed(plot):
        plot.show()
    for side in ("left", "bottom"):
        axis, picture = plot.getAxis(side), QPixmap(10, 10)
        with QPainter(picture) as painter:
            numbers = axis.generateDrawSpecs(painter)[2]
        room = axis.mapRectFromParent(axis.geometry()).adjusted(-1, -1, 1, 1)
        assert len(numbers) > 1
        assert all(room.contains(rect) for rect, _, _ in numbers)
