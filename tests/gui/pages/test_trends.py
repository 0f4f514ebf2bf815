"""The trends page and its presenter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from labapp.gui.pages.trends.page import TrendsPage
from labapp.gui.pages.trends.presenter import CORRECTED, SIGNALS, STALE, TrendOptions, show
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from labapp.session.signals import Signals
from labapp.text import with_sigma
from tests.gui.conftest import KEPT, let_draw


@pytest.fixture
def gtaw(copy_sample) -> Path:
    return copy_sample("gtaw")


def logged(start_s: float = 0.0) -> Signals:
    time_s = np.arange(-1.0, 2.0, 0.01)
    return Signals("log.csv", time_s, 75 + time_s, np.full(len(time_s), np.nan), start_s)


def test_trends_of_the_sample(gtaw: Path) -> None:
    with Session.open(gtaw) as session:
        shown = show(session, TrendOptions())
    assert [curve.name for curve in shown.curves] == ["Width", "Length", "Height", "ARE"]
    assert shown.axis.unit == "s"
    assert all(len(curve.key) == 30 for curve in shown.curves)
    mean, span, sure = shown.rows[6:9]
    assert mean.texts == ("Height", "0.293", "0.019", "mm")  # §7.3: 0.294 ± 0.019
    assert span.texts[1] == "0.256 … 0.323"
    assert sure.value is not None
    assert 0.0 < sure.value < 0.019
    assert sure.texts[1] == with_sigma(0.293, sure.value).partition(" ± ")[2]  # two digits
    assert shown.words == "Fit: 30 of 30 frames count"
    assert shown.spectrum == ()
    assert shown.signals_words.startswith("None.")


def test_trends_name_the_scheme_of_their_values(gtaw: Path) -> None:
    with Session.open(gtaw) as session:
        session.set_settings(replace(session.settings, scheme="ers"))
        assert show(session, TrendOptions()).words.startswith("ERS: 0 of 30 frames count")


def test_trends_of_a_concave_pool_show_its_depth(copy_sample) -> None:
    with Session.open(copy_sample("concave")) as session:
        names = [curve.name for curve in show(session, TrendOptions()).curves]
        assert names == ["Width", "Length", "Depth", "ARE"]
        chosen = show(session, TrendOptions(shown=("height_mm",))).curves
        assert [curve.name for curve in chosen] == ["Height"]


def test_marks_show_the_status_of_frames(copy_sample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        curve = show(session, TrendOptions()).curves[0]
        assert dict(zip(curve.key.tolist(), curve.mark.tolist(), strict=True))[2] == CORRECTED
        words = show(session, TrendOptions()).words
        assert words == "Fit: 3 of 6 frames count, 3 without a surface"
        without = show(session, TrendOptions()).without
        assert list(without) == [3, 4, 5]
        assert without[3] == "Frame 3: no surface (ambiguous-rows)"
        fit = replace(session.settings.fit, jerk=0.06)
        session.set_settings(replace(session.settings, fit=fit))
        shown = show(session, TrendOptions())
        assert (shown.curves[0].mark == STALE).all()
        assert shown.rows[0].texts[1:3] == ("–", "")
        assert "3 out of date" in shown.words


def test_spectrum_is_shown_or_its_absence_explained(gtaw: Path, copy_sample) -> None:
    with Session.open(gtaw) as session:
        shown = show(session, TrendOptions(spectrum_of="height_mm"))
        assert len(shown.spectrum[0].x) == 15
        assert shown.spectrum_axis.unit == "Hz"
        assert shown.spectrum_words.startswith("No oscillation stands out")  # one period: a drift
        shown = show(session, TrendOptions(spectrum_of="length_mm"))
        assert shown.spectrum_words.startswith("Strongest at 4.0 Hz: 0.47 mm. Frames 0 to 29 (30)")
        flat = show(session, TrendOptions(spectrum_of="depth_mm"))  # 0 in all frames
        assert flat.spectrum == ()
        assert flat.spectrum_words.startswith("There is no oscillation")
    with Session.open(copy_sample("concave")) as session:
        shown = show(session, TrendOptions(spectrum_of="depth_mm"))
        assert shown.spectrum == ()
        assert shown.spectrum_words.startswith("A spectrum needs 8 frames in a row")
        assert shown.axis.unit == ""  # a folder of pictures has no times


def test_current_is_limited_to_the_time_of_the_recording(gtaw: Path, copy_sample) -> None:
    with Session.open(gtaw) as session:
        session.set_signals(logged())
        current = show(session, TrendOptions()).curves[-1]
        assert (current.name, current.unit) == ("Current", "A")
        assert current.x.min() >= -0.03
        assert current.x.max() <= 0.52
        assert [
            curve.name for curve in show(session, TrendOptions(shown=("voltage",))).curves
        ] == []
        session.set_signals(logged(start_s=0.25))
        moved = show(session, TrendOptions()).curves[-1]
        assert np.interp(0.25, moved.x, moved.y) == pytest.approx(75.0)
        session.set_signals(logged(start_s=50))
        shown = show(session, TrendOptions())
        assert "None of it falls into" in shown.signals_words
        assert len(shown.curves) == 4
        session.set_signals(Signals("a.csv", np.zeros(1), np.zeros(1), np.zeros(1), 0.0))
        assert "1 sample," in show(session, TrendOptions()).signals_words
    with Session.open(copy_sample("concave")) as session:
        session.set_signals(logged())
        assert "no time base" in show(session, TrendOptions()).signals_words


@pytest.fixture
def page(qtbot: QtBot, gtaw: Path) -> TrendsPage:
    workspace = Workspace()
    workspace.show(Session.open(gtaw))
    page = TrendsPage(workspace)
    KEPT.extend((workspace, page))
    workspace.changed.connect(lambda: page.refresh() if workspace.session else None)
    workspace.frame_changed.connect(page.refresh)
    for widget in (page, page.panel):
        widget.resize(800, 600)
        widget.show()
    page.refresh()
    let_draw()
    yield page
    for widget in (page, page.panel):
        widget.hide()
    workspace.close()


def test_keys_on_the_plots_select_frames(page: TrendsPage) -> None:
    page.plots.setFocus()
    QTest.keyClick(page.plots, Qt.Key.Key_Right)
    QTest.keyClick(page.plots, Qt.Key.Key_Right)
    assert page.workspace.frame == 2
    assert page.plots.read_out.text().startswith("Frame 2, 0.0333 s: Width")


def test_checked_measures_are_shown(page: TrendsPage) -> None:
    assert len(page.plots.curves) == 4
    QTest.keyClick(page._boxes["volume_mm3"], Qt.Key.Key_Space)
    assert [curve.name for curve in page.plots.curves][-2:] == ["Volume", "ARE"]
    for box in page._boxes.values():
        box.setChecked(False)
    assert page.nothing.isVisibleTo(page)


def test_boxes_follow_the_kind_of_pool_until_one_is_clicked(page: TrendsPage, copy_sample) -> None:
    def ticked() -> set[str]:
        return {key for key, box in page._boxes.items() if box.isChecked()}

    assert {"height_mm", "current"} <= ticked()
    assert "depth_mm" not in ticked()
    page.workspace.show(Session.open(copy_sample("concave")))
    page.refresh()
    assert "depth_mm" in ticked()
    assert "height_mm" not in ticked()
    page._boxes["depth_mm"].click()
    page.refresh()
    assert not {"height_mm", "depth_mm"} & ticked()


def test_spectrum_can_be_shown_and_hidden(page: TrendsPage) -> None:
    page.of.set_value("height_mm")
    page.of.edited.emit("height_mm")
    assert page.spectrum.isVisibleTo(page)
    page.of.edited.emit("")
    assert not page.spectrum.isVisibleTo(page)


def test_table_is_loaded_stored_shifted_and_undone(
    page: TrendsPage, qtbot: QtBot, tmp_path: Path
) -> None:
    messages: list[tuple[str, bool]] = []
    page.workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    table = tmp_path / "log.csv"
    table.write_text("time_s,current_a\n0,75\n0.2,x\n")
    page.read_signals(table)
    qtbot.waitUntil(lambda: bool(messages))
    assert "line 3, current_a: x" in messages[0][0]
    assert messages[0][1]
    table.write_text("time_s,current_a\n0,75\n0.2,80\n0.4,70\n")
    page.read_signals(table)
    qtbot.waitUntil(lambda: len(page.plots.curves) == 5)
    offered = {key for key in SIGNALS if page._boxes[key].isVisibleTo(page.panel)}
    assert offered == {"current"}  # the table has no other channel
    page.start.edited.emit(0.1)
    session = page.workspace.session
    assert session is not None
    qtbot.waitUntil(lambda: page.start.value() == 0.1)
    assert session.signals is not None
    assert session.signals.start_s == 0.1
    page.workspace.undo()
    page.workspace.undo()
    assert session.signals is None
    assert len(page.plots.curves) == 4


def test_every_control_has_a_tooltip(page: TrendsPage) -> None:
    from PySide6.QtWidgets import QAbstractButton

    for button in page.panel.findChildren(QAbstractButton):
        if button.text():
            assert button.toolTip(), button.text()


def test_axis_includes_frames_without_a_surface(copy_sample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        shown = show(session, TrendOptions())
    assert shown.curves[0].x.max() < shown.places[5] == 5.0
    assert shown.axis.span == (0.0, 5.0)
