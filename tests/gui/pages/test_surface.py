from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import av
import numpy as np
import pytest
from PySide6.QtCore import QPointF, Qt
from PySide6.QtGui import QAccessible, QGuiApplication, QImage
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QFileDialog,
    QLabel,
    QScrollArea,
    QSplitter,
    QStyle,
    QStyleOptionComboBox,
    QWidget,
)
from pytestqt.qtbot import QtBot

from labapp.errors import InputError
from labapp.export.rendering.heights import profile, sigma_at
from labapp.export.rendering.paper import Paper
from labapp.export.rendering.scene import DIFFERENCE_MAP
from labapp.export.rendering.studio import Studio
from labapp.gui.pages.surface.page import FILM_PX, SurfacePage
from labapp.gui.shell.window import MainWindow
from labapp.gui.views.picture_files import PaperDialog, write_plot
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from labapp.text import SETUP_MARKS
from tests.gui.conftest import KEPT, CopySample, let_draw
from tests.waiting import PATIENCE_S


class OneThread(ThreadPoolExecutor):
    """Replaces the pool of processes, which takes seconds to start."""

    _processes: ClassVar[dict[int, object]] = {}


@pytest.fixture
def page(qapp: QApplication, copy_sample: CopySample) -> SurfacePage:
    """The page beside its panel, as in the window, with the GTAW sample."""
    workspace = Workspace()
    workspace._pool = OneThread(1)
    surface_page = SurfacePage(workspace)
    splitter, panel = QSplitter(), QScrollArea()
    panel.setWidgetResizable(True)
    panel.setWidget(surface_page.panel)
    for widget in (surface_page, panel):
        splitter.addWidget(widget)
    splitter.resize(1180, 560)
    splitter.setSizes([880, 300])
    KEPT.append(splitter)
    workspace.changed.connect(lambda: surface_page.refresh() if workspace.session else None)
    workspace.frame_changed.connect(lambda _: surface_page.refresh())
    workspace.show(Session.open(copy_sample("gtaw")))
    splitter.show()
    yield surface_page
    surface_page.leave()
    splitter.close()
    workspace.close()


def record_messages(page: SurfacePage) -> list[tuple[str, bool]]:
    messages: list[tuple[str, bool]] = []
    page.workspace.notified.connect(lambda words, bad: messages.append((words, bad)))
    return messages


def test_current_frame_is_shown(page: SurfacePage, qtbot: QtBot) -> None:
    first = page.side.sizes.item(0, 1).text()
    assert page.side.status.text().startswith("✓ Measured.")
    page.workspace.show_frame(7)
    assert page.side.sizes.item(0, 1).text() != first
    assert page.side.provenance.text().startswith("Frame 7 · Fit")
    boundary = page.workspace.session.result(7).measurement.reconstruction.boundary
    # Charts are updated after the last of rapid frame changes.
    x = boundary.points_mm[:, 0]
    qtbot.waitUntil(lambda: np.array_equal(page.plan._outline.getData()[0][:-1], x))


def test_choice_of_scheme_can_be_undone(page: SurfacePage) -> None:
    session = page.workspace.session
    page.side.scheme.edited.emit("irs-epa-r")
    assert (session.settings.scheme, session.settings.algorithm) == ("irs", "epa-r")
    assert session.history[-1].label == "scheme IRS, edge points, rows (EPA-R)"
    assert page.side.scheme.value() == "irs-epa-r"
    assert page.side.status.text().startswith("○ Frame 0 is not measured by IRS")
    assert page.view.scene is None
    assert page.side.sizes.isHidden()
    page.workspace.undo()
    assert page.side.scheme.value() == "fit"
    assert page.view.scene is not None


def test_choices_are_not_cut_off_in_the_smallest_window(
    window: MainWindow, copy_sample: CopySample
) -> None:
    assert window.files.open(copy_sample("gtaw"))
    window.show_step("surface")
    window.resize(680, 492)
    let_draw()
    for field in (window.page.side.scheme, window.page.side.correspondence):
        combo = field.editor
        option, part = QStyleOptionComboBox(), QStyle.SubControl.SC_ComboBoxEditField
        combo.initStyleOption(option)
        kind = QStyle.ComplexControl.CC_ComboBox
        room = combo.style().subControlRect(kind, option, part, combo).width()
        widths = combo.fontMetrics().horizontalAdvance
        assert room >= max(widths(combo.itemText(k)) for k in range(combo.count()))
        combo.showPopup()
        let_draw()
        assert combo.view().viewport().width() >= combo.view().sizeHintForColumn(0)
        combo.hidePopup()


def test_refused_scheme_is_not_shown(page: SurfacePage, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise InputError("a.labsession", "file", "no space left", "enough of it")

    monkeypatch.setattr(Session, "set_settings", full)
    page.side.scheme.set_value("ers")
    page.side.scheme.edited.emit("ers")
    assert page.side.scheme.value() == "fit"  # the figures below are of this one


def test_outdated_frame_can_be_measured_again(page: SurfacePage, qtbot: QtBot) -> None:
    assert page.side.again.isHidden()
    page.side.correspondence.edited.emit("S/S")
    assert page.side.status.text().startswith("⟳ These figures are out of date")
    assert page.view.scene.stamp == "out of date"
    assert not page.side.again.isHidden()
    page.side.again.click()
    assert not page.side.one.isEnabled()
    assert "under way" in page.side.one.toolTip()
    assert not page.side.progress.isHidden()
    with qtbot.waitSignal(page.workspace.notified):
        pass
    assert page.side.status.text().startswith("✓ Measured.")
    assert page.side.one.isEnabled()
    assert page.side.progress.isHidden()
    assert page.workspace.session.result(0).settings.correspondence == "S/S"
    assert page.workspace.session.result(1).stale


def test_measuring_shows_progress_and_can_be_cancelled(
    page: SurfacePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    cancelled = threading.Event()

    def slowly(numbers: list[int], pool: object) -> Iterator[tuple[int, None]]:
        assert numbers == list(range(30))
        for number in numbers:
            if number == 3:
                cancelled.wait(PATIENCE_S)
            yield number, None

    monkeypatch.setattr(page.workspace.session, "measure", slowly)
    page.side.all.click()
    qtbot.waitUntil(lambda: page.side.progress.value() >= 2)
    assert page.side.progress.text().endswith(" of 30 frames")
    page.side.cancel.click()
    cancelled.set()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.side.progress.value() < 30
    assert page.side.progress.isHidden()
    assert page.side.all.isEnabled()


def test_disabled_buttons_give_the_reason(page: SurfacePage) -> None:
    page.workspace.attempt(lambda session: session.update_setup({"laser": {"distance_mm": None}}))
    assert not page.side.one.isEnabled()
    assert "The set-up is not complete. Enter distance of the laser" in page.side.one.toolTip()
    page.workspace.undo()
    assert page.side.one.isEnabled()


def test_section_line_can_be_dragged(page: SurfacePage) -> None:
    line = page.plan._line
    a, b = line.getHandles()
    line.movePoint(a, QPointF(-3.0, 1.0), coords="parent")
    line.movePoint(b, QPointF(3.0, 1.0), coords="parent")
    assert page.options.section == (0.0, 1.0)
    assert (page.angle.value(), page.offset.value()) == (0.0, 1.0)
    cut = profile(page.surface_state.reconstruction, 0.0, 1.0)
    along, height = page.profile._height.getData()
    known = np.isfinite(cut.height_mm)
    np.testing.assert_array_equal(along, cut.along_mm[known])
    np.testing.assert_array_equal(height, cut.height_mm[known])
    # The ends stay where they were dragged to.
    ends = [line.mapToParent(handle.pos()) for handle in line.getHandles()]
    assert [(end.x(), end.y()) for end in ends] == [(-3.0, 1.0), (3.0, 1.0)]


def test_section_can_be_typed(page: SurfacePage) -> None:
    page.angle.edited.emit(page.angle.set_value(30.0))
    assert page.options.section == (30.0, 0.0)
    a, b = (page.plan._line.mapToParent(handle.pos()) for handle in page.plan._line.getHandles())
    assert np.degrees(np.arctan2(b.y() - a.y(), b.x() - a.x())) == pytest.approx(30.0)
    page.offset.edited.emit(page.offset.set_value(20.0))
    assert page.profile.title.text() == "The section line misses the pool"
    button(page, "Along X").click()
    assert page.options.section == (0.0, 0.0)
    assert "◆ boundary; band: ±" in page.profile.title.text()


def button(page: QWidget, words: str) -> QAbstractButton:
    (match,) = [each for each in page.findChildren(QAbstractButton) if each.text() == words]
    return match


def test_parts_of_the_view_can_be_toggled(page: SurfacePage) -> None:
    assert page.view.scene.rays_mm == {}
    page.drawn_items["rays"].trigger()
    assert len(page.view.scene.rays_mm["reflected"]) == len(page.view.scene.points_mm)
    page.drawn_items["points"].trigger()
    assert len(page.view.scene.points_mm) == 0
    frame_limits = page.view.scene.limits
    page.drawn_items["same_colours"].trigger()
    assert page.view.scene.limits[1] > frame_limits[1]
    page.colour.edited.emit("sigma")
    assert page.view.scene.label == "± height (mm)"
    page.high.edited.emit(5.0)
    assert page.view.scene.exaggeration == 5.0
    page.workspace.show_frame(3)
    assert page.view.scene.exaggeration == 5.0


@pytest.mark.usefixtures("opengl")
def test_picture_is_copied_and_saved(page: SurfacePage, tmp_path: Path) -> None:
    messages = record_messages(page)
    page.grab()
    button(page, "Top").click()
    page.view.copy_picture()
    copied = QGuiApplication.clipboard().image()
    assert copied.size() == page.view.size() == page.picture().size()
    page.write_picture(tmp_path / "pool")
    page.write_picture(tmp_path / "pool.tif", Paper(60, 150))
    page.write_picture(tmp_path / "pool.jpg", Paper(60, 150))
    assert QImage(str(tmp_path / "pool.png")).width() == Paper().width_px
    for name in ("pool.tif", "pool.jpg"):
        written = QImage(str(tmp_path / name))
        assert written.width() == round(60 / 25.4 * 150)
        assert written.dotsPerMeterX() == pytest.approx(150 / 0.0254, rel=0.01)
    page.write_picture(tmp_path / "nowhere" / "pool.png")
    assert [bad for _, bad in messages] == [False, False, False, True]


@pytest.mark.usefixtures("opengl")
def test_film_uses_the_camera_of_the_view(page: SurfacePage, tmp_path: Path, qtbot: QtBot) -> None:
    page.grab()
    page.view.turn(40, 10)
    page.write_film(tmp_path / "pool")
    qtbot.waitUntil(lambda: not page.workspace.tasks.active, timeout=round(1000 * PATIENCE_S))
    with av.open(tmp_path / "pool.mp4") as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == len(page.session.frames)
    turned = Studio(FILM_PX, page.view.camera).draw(page.view.scene)
    default_view = Studio(FILM_PX, "free").draw(page.view.scene)
    first = frames[0][..., ::-1].astype(int)
    foregrounds = [
        (picture.astype(int) != picture[0, -1]).any(axis=2) for picture in (turned, default_view)
    ]
    drawn = (np.abs(first - 255) > 60).any(axis=2)
    overlaps = [(drawn & one).sum() / (drawn | one).sum() for one in foregrounds]
    assert overlaps[0] > overlaps[1]


def test_true_scale_toggles_the_exaggeration(page: SurfacePage) -> None:
    page.high.set_value(5.0)
    page.high.edited.emit(5.0)
    page.true_scale.click()
    assert page.view.scene.exaggeration == 1.0
    {each.text(): each for each in page.view.actions()}["True scale, or exaggerated"].trigger()
    assert page.view.scene.exaggeration == 5.0
    assert not page.true_scale.isChecked()


@pytest.mark.usefixtures("opengl")
def test_point_reading_has_height_and_sigma(page: SurfacePage) -> None:
    page.grab()
    page.view.look("top")
    page.grab()
    at = page.view._drawing.overlay.project(np.zeros((1, 3)))[0]
    page.view.read_point(QPointF(at[0], page.view.height() - at[1]))
    x, y, z = page.view.scene.mark_mm[0]
    pool = page.surface_state.reconstruction
    assert z == pytest.approx(
        float(pool.surface.height(np.array([x]), np.array([y]))[0]), abs=0.002
    )
    sigma = float(sigma_at(pool, np.array([x]), np.array([y]))[0])
    assert f"± {sigma:.4f} mm" in page.view.read_off


@pytest.mark.usefixtures("opengl")
def test_shortcut_saves_the_picture(
    page: SurfacePage, qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = str(tmp_path / "pool.png")
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *args: (chosen, "PNG"))
    monkeypatch.setattr(PaperDialog, "exec", lambda _: PaperDialog.DialogCode.Accepted)
    page.activateWindow()
    qtbot.waitUntil(page.isActiveWindow)
    keys = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    QTest.keyClick(page, Qt.Key.Key_P, keys)
    qtbot.waitUntil(Path(chosen).exists)
    assert QImage(chosen).width() == PaperDialog.paper.width_px


def test_lines_are_neither_compared_nor_filmed(
    page: SurfacePage, copy_sample: CopySample, tmp_path: Path, qtbot: QtBot
) -> None:
    page.comparing.click()
    page.workspace.show(Session.open(copy_sample("five_lines")))
    assert page.stack.currentWidget() is not page.compare
    assert not page.comparing.isChecked()
    assert not page.comparing.isEnabled()
    assert not page.film.isEnabled()
    page.write_film(tmp_path / "lines.mp4")  # from the menu of the view
    qtbot.waitUntil(lambda: "is of lines" in page.saved.text())
    page.workspace.show(Session.open(copy_sample("concave")))
    assert page.comparing.isEnabled()


@pytest.mark.usefixtures("opengl")
def test_two_schemes_are_shown_side_by_side(page: SurfacePage, qtbot: QtBot) -> None:
    page.comparing.click()
    compare = page.compare
    assert (compare.first.choice.value(), compare.second.choice.value()) == ("fit", "ers")
    qtbot.waitUntil(lambda: compare.table.rowCount() == 11)  # ERS also gives its own ARE
    page.grab()
    first, second, difference = compare.views
    assert difference.scene.colour_map == DIFFERENCE_MAP
    assert first.scene.limits == second.scene.limits
    first.turn(40, 10)
    assert second.camera == first.camera == difference.camera
    second.look("side")
    assert first.camera == second.camera
    difference.zoom(1.5)
    assert first.camera == second.camera == difference.camera
    before = compare.words.text()
    compare.second.choice.set_value("irs-opa")
    compare.second.choice.edited.emit("irs-opa")
    assert not compare.table.isEnabled()  # these are the former figures
    qtbot.waitUntil(lambda: "IRS" in compare.words.text())
    assert compare.table.isEnabled()
    assert compare.words.text() != before
    page.workspace.show_frame(5)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert "IRS" in compare.words.text()
    page.comparing.click()
    assert page.view.scene is not None


def test_narrow_canvas_shows_one_part_at_a_time(page: SurfacePage) -> None:
    page.resize(420, 500)
    assert page.canvas_parts.isVisibleTo(page)
    assert page.view.isVisibleTo(page)
    assert not page.plan.isVisibleTo(page)
    page.canvas_parts.setCurrentIndex(1)
    assert not page.view.isVisibleTo(page)
    assert page.plan.isVisibleTo(page)
    page.comparing.click()
    compare = page.compare
    assert compare.first.view.isVisibleTo(page)
    assert not compare.second.view.isVisibleTo(page)
    compare.parts.setCurrentIndex(3)
    assert compare.table.isVisibleTo(page)
    assert not any(view.isVisibleTo(page) for view in compare.views)
    page.comparing.click()
    page.resize(1400, 900)
    assert not page.canvas_parts.isVisibleTo(page)
    assert page.view.isVisibleTo(page)
    assert page.dots.isVisibleTo(page)


def test_every_control_has_a_name_and_can_be_focused(page: SurfacePage) -> None:
    for each in (*page.findChildren(QAbstractButton), *page.panel.findChildren(QAbstractButton)):
        if each.isVisibleTo(page) or each.isVisibleTo(page.panel):
            if not each.text():
                continue  # part of a spin box or a header
            assert each.toolTip(), each.text()
            interface = QAccessible.queryAccessibleInterface(each)
            for part in (QAccessible.Text.Name, QAccessible.Text.Description):
                assert interface.text(part), each.text()
            assert each.focusPolicy() & Qt.FocusPolicy.TabFocus, each.text()


def test_doubt_of_the_setup_is_shown_above_the_sizes(page: SurfacePage) -> None:
    doubt = f"{SETUP_MARKS['doubtful']} The set-up is doubtful."
    page.side.show(replace(page.surface_state, setup_words=doubt))
    let_draw()
    labels = [each for each in page.panel.findChildren(QLabel) if doubt in each.text()]
    assert len(labels) == 1
    assert labels[0].isVisibleTo(page.panel)
    assert labels[0].y() < page.side.sizes.y()


def test_panel_fits_300_px(page: SurfacePage) -> None:
    page.side.again.show()
    assert page.panel.minimumSizeHint().width() <= 300


def test_chart_shows_values_at_the_pointer_and_can_be_saved(
    page: SurfacePage, qtbot: QtBot, tmp_path: Path
) -> None:
    chart = page.profile
    qtbot.waitUntil(lambda: len(chart._height.getData()[0]) > 0)
    box = chart.plot.getViewBox()
    chart.plot.scene().sigMouseMoved.emit(box.mapViewToScene(QPointF(-1.5, 0.1)))
    assert chart._at.text() == "−1.5, 0.1 mm"
    assert {"Copy picture", "Save picture…", "Show all"} <= {a.text() for a in chart.actions()}
    dark = chart.palette()
    for name in ("chart.svg", "chart.png", "chart.tif"):
        assert write_plot(tmp_path / name, chart, chart.plot, Paper(80, 150))
    assert chart.palette() == dark
    svg = (tmp_path / "chart.svg").read_text("utf-8")
    width = re.search(r'<svg width="([\d.]+)mm"', svg)
    assert width is not None
    assert float(width[1]) == pytest.approx(80, abs=0.3)  # within a pixel
    assert "<path" in svg
    assert "<image" not in svg
    assert QImage(str(tmp_path / "chart.png")).width() == Paper(80, 150).width_px
    assert not write_plot(tmp_path / "nowhere" / "chart.png", chart, chart.plot, Paper())


def test_damaged_result_can_be_measured_again(page: SurfacePage, qtbot: QtBot) -> None:
    with page.session._database.transaction() as connection:
        connection.execute("UPDATE detail SET content = substr(content, 1, 900) WHERE result = 1")
    page.refresh()
    assert page.surface_state.state == "failed"
    assert "Measure the frame again" in page.side.status.text()
    assert "step Dots" not in page.side.status.text()
    page.side.one.click()
    qtbot.waitUntil(lambda: page.surface_state.state == "measured")
