"""Live measures on the recording page: surface, trends, limits, alarms, control software."""

from __future__ import annotations

import csv
import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QPalette
from PySide6.QtWidgets import QAbstractButton, QLabel
from pytestqt.qtbot import QtBot

from labapp.core.dynamics.penetration import ModelSettings, PenetrationModel
from labapp.core.dynamics.static_maps import LinearMap
from labapp.core.dynamics.weld_series import Orders
from labapp.core.images.exposure import Exposure
from labapp.core.pipeline import Measurement
from labapp.core.quality import Quality, Remark
from labapp.core.surface.measures import Measures
from labapp.export.penetration import write_model
from labapp.export.rendering.scene import HEIGHT, Scene
from labapp.gui.live import penetration as live_penetration
from labapp.gui.live import view as live_view
from labapp.gui.live.camera_fields import PART_WORDS
from labapp.gui.live.figures import (
    FIRST,
    NO_FRAMES,
    NO_SETUP,
    OLD_S,
    alarms_text,
    figures,
    live_setup_words,
    pace_text,
)
from labapp.gui.live.surface import steady_limits
from labapp.gui.live.trends import LOW_PX, LiveTrends, trend_curves
from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.shell.window import MainWindow
from labapp.gui.theme import RED, is_dark
from labapp.gui.workspace import Workspace
from labapp.media.cameras import CameraFrame, SimulatedDevice
from labapp.run import live_watch
from labapp.run.alarms import Alarm
from labapp.run.limits import Limits
from labapp.run.live_measuring import LiveMeasuringEnded, LiveResult
from labapp.run.live_trend import LiveSizes, Pace
from labapp.session.session import Session
from labapp.text import SETUP_MARKS
from tests.gui.conftest import SAMPLES, let_draw
from tests.gui.hand import Hand
from tests.gui.test_accessibility import check_round
from tests.waiting import PATIENCE_S, connect

MEASURES = Measures(*[0.0] * 4, 6.7, 7.5, 0.30, -0.01, *[0.0] * 6, *[0.03, 0.04, 0.003] * 2)
QUALITY = Quality(
    Exposure(0.4, 0.0, 0.5, 20.0, 0.5, "good"),
    (Remark("exposure", "good", "The dots stand out well."),),
)
OK = Measurement("ok", "", "fit", measures=MEASURES)
DARK = Measurement("no-dots", "it is dark", "fit")


def live_result(measurement: Measurement = OK) -> LiveResult:
    return LiveResult(
        frame=7, time_s=0.7, arrived_s=time.monotonic(), measurement=measurement, quality=QUALITY
    )


# --- texts ----------------------------------------------------------------------------------------


def test_figures_show_their_verdict_and_unknown_if_not_measured():
    limits = Limits(width_mm=(6.0, 6.6), length_mm=(7.0, 8.0), height_mm=(0.301, None))
    shown = figures(live_result(), limits)
    assert [(f.value, f.sigma, f.verdict, f.look) for f in shown] == [
        ("6.700", "± 0.030", "▲ above 6.6 mm", "alarm"),
        ("7.500", "± 0.040", "✓ within limits", "plain"),
        ("0.300", "± 0.003", "◆ at its limit", "plain"),
    ]
    for unknown in (
        figures(None, limits),
        figures(live_result(DARK), limits),
        figures(live_result(), limits, age_s=OLD_S + 0.1),
    ):
        assert [figure.verdict for figure in unknown] == ["? not known"] * 3
        assert "alarm" not in [figure.look for figure in unknown]
    assert [figure.value for figure in figures(live_result(DARK), limits)] == ["–"] * 3
    assert [figure.verdict for figure in figures(live_result())] == [""] * 3


def test_pace_text_explains_missing_figures_and_the_rate():
    assert pace_text(None, Pace(0.0, 0, 0), 60.0, 0.0, 0) == FIRST
    assert pace_text(None, Pace(0.0, 0, 0), None, 0.0, 0) == FIRST
    assert pace_text(None, Pace(0.0, 0, 0), 0.0, 0.0, 0) == NO_FRAMES
    assert (
        pace_text(live_result(), Pace(38.0, 76, 0), 60.0, 0.04, 0)
        == "38.0 of 60.0 frames/s measured; 0.04 s old"
    )
    assert pace_text(live_result(), Pace(38.0, 76, 2), None, 0.0, 0).startswith(
        "◆ 2 of the last 76 frames could not be measured. 38.0 frames/s measured"
    )
    dark = pace_text(live_result(DARK), Pace(0.0, 3, 3), 60.0, 5.2, 1)
    assert dark.startswith("▲ Not measured (no-dots): it is dark. ▲ The figures are 5 s old.")
    assert dark.endswith("1 frame skipped to keep up")


@pytest.mark.parametrize(
    ("measured_hz", "came_hz", "words"),
    [
        (12.0, 58.9, "Measuring lags behind the camera: 12.0 of 58.9 frames/s"),
        (0.0, 58.9, "None of 58.9 frames/s measured"),
        (0.0, 0.0, "No frames arrive at present"),
        (0.0, None, "No frame was measured since"),
    ],
)
def test_pace_text_of_old_figures_does_not_claim_that_frames_are_measured_now(
    measured_hz: float, came_hz: float | None, words: str
):
    pace = Pace(measured_hz, round(2 * measured_hz), 0)
    found = pace_text(live_result(), pace, came_hz, 4.0, 0)
    assert found == f"▲ The figures are 4 s old. {words}"


def test_live_figures_show_the_status_of_the_setup():
    assert live_setup_words(None, "") == live_setup_words(live_result(), "") == ""
    checked = live_result(replace(OK, setup_status="checked"))
    assert live_setup_words(checked, "2026-01-31T12:00:00+00:00").startswith(SETUP_MARKS["checked"])
    assert "2026-01-31" in live_setup_words(checked, "2026-01-31T12:00:00+00:00")
    doubtful = replace(live_result(replace(OK, setup_status="doubtful")), setup_doubt="it moved")
    assert "it moved" in live_setup_words(doubtful, "")


def test_alarm_text():
    alarm = Alarm("width-high", "Width 7.100 mm is above 6.9 mm", 312, 5.2)
    lines = alarms_text([alarm, replace(alarm, holds=False, acknowledged=True)]).split("\n")
    assert lines[0] == f"▲ ALARM: Width 7.100 mm is above 6.9 mm (frame 312, {alarm.at:%H:%M:%S})"
    assert lines[1].startswith("△ over: Width")
    assert lines[1].endswith(", acknowledged")


def test_colour_limits_stay_while_the_surface_fills_them():
    limits = steady_limits(None, (0.0, 0.4))
    assert limits == (-0.05, 0.45)
    assert steady_limits(limits, (0.02, 0.38)) == limits
    higher = steady_limits(limits, (0.0, 0.5))
    assert higher[1] > 0.5
    assert steady_limits(limits, (0.0, 0.2)) == (-0.025, 0.225)


def test_trends_show_limits_and_mark_values_beyond_them():
    values = np.array([[6.7, np.nan, 7.0], [7.5] * 3, [-0.3] * 3])
    trend = LiveSizes(
        ("width", "length", "depth"),
        np.array([4, 8, 10]),
        np.array([-2.0, -1.6, -0.1]),
        values,
        np.full((3, 3), 0.03),
        np.array([[False, False, True], [False] * 3, [False] * 3]),
    )
    limits = Limits(width_mm=(6.0, 6.9), height_mm=(-0.4, None))
    width, length, depth = trend_curves(trend, limits)
    assert (width.limits, length.limits, depth.limits) == ((6.0, 6.9), (None, None), (-0.4, None))
    assert width.mark.tolist() == [0, 0, 0, 1]
    assert depth.title == "Depth (mm)"
    # The values between frames far apart in time are unknown.
    assert width.key.tolist() == [4, 8, 9, 10]
    assert np.array_equal(length.y, [7.5, 7.5, np.nan, 7.5], equal_nan=True)


# --- on the page ----------------------------------------------------------------------------------


def surface() -> Scene:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.2]], float)
    return Scene(corners, np.array([[0, 1, 2]]), corners[:, 2], HEIGHT, (0.0, 0.2))


class Prepared:
    """Returns the measurement set by the test, within milliseconds."""

    found, quality = OK, QUALITY
    gate = threading.Event()

    def __init__(self, *_: object) -> None:
        pass

    def measure(self, frame: CameraFrame, drawn: bool) -> LiveResult:
        Prepared.gate.wait(PATIENCE_S)
        measurement = Prepared.found
        return LiveResult(
            frame=frame.number,
            time_s=frame.time_s,
            arrived_s=frame.arrived_s,
            measurement=measurement,
            track_lost=None if measurement.status == "ok" else measurement.reason,
            quality=Prepared.quality,
            scene=surface() if drawn and measurement.measures is not None else None,
        )

    def close(self) -> None:
        pass


@pytest.fixture
def page(
    window: MainWindow, tmp_path: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> Iterator[CapturePage]:
    image = np.random.default_rng(1).integers(0, 200, (48, 64)).astype(np.uint8)
    device = SimulatedDevice("test", lambda _: image, rate_hz=100)
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: device)
    monkeypatch.setattr(live_watch, "LiveMeasuring", Prepared)
    monkeypatch.setattr(Prepared, "found", OK)
    monkeypatch.setattr(Prepared, "quality", QUALITY)
    Prepared.gate.set()
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    setup = (SAMPLES / "gtaw" / "setup.toml").read_text("utf-8")
    window.workspace.attempt(lambda session: session.set_setup(setup))
    window.show_step("capture")
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    capture_page = window.page
    assert isinstance(capture_page, CapturePage)
    capture_page.live_view.plan_fields.measured.setChecked(False)  # the recorded frames are noise
    yield capture_page
    capture_page.live_view.stop()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def start(page: CapturePage, qtbot: QtBot) -> None:
    view = page.live_view
    view.measured_s = 0.0
    qtbot.waitUntil(view.start_button.isEnabled)  # the previous camera is released first
    view.start_button.click()
    qtbot.waitUntil(lambda: view.measured_s > 0)


def choose(page: CapturePage, part: str) -> None:
    tabs = page.live_view.canvas.tabs
    tabs.setCurrentIndex([tabs.tabText(k) for k in range(tabs.count())].index(part))


def figure(page: CapturePage, row: int, column: int) -> QLabel:
    return page.live_view.figures._label(row, column)


def log_of(window: MainWindow) -> str:
    return "\n".join(window.log_panel.texts())


def test_only_the_picture_is_shown_without_a_setup(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    window.workspace.undo()
    assert window.workspace.session.setup_text == ""
    page.live_view.start_button.click()
    qtbot.waitUntil(lambda: page.live_view.updates > 2)
    assert not page.live_view.canvas.tabs.isVisible()
    words = page.live_view.figures.words.text()
    assert words.startswith(NO_SETUP)
    assert "the laser" in words


def test_alarm_that_lowers_the_canvas_does_not_hide_the_limit_being_entered(qtbot: QtBot):
    trends = LiveTrends(Workspace())
    qtbot.addWidget(trends)
    trends.resize(900, 600)
    trends.show()
    field = trends.fields["height", 1].editor
    field.setFocus()
    trends.resize(900, LOW_PX - 20)
    let_draw()
    assert field.isVisible()
    assert not trends.plots.isVisible()
    trends.resize(900, 600)
    let_draw()
    assert field.isVisible()
    assert trends.plots.isVisible()


@pytest.mark.parametrize("old_s", [-1.0, 60.0])
def test_verdict_is_that_of_the_last_measured_frame_unless_old(
    page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, old_s: float
):
    monkeypatch.setattr(live_view, "OLD_S", old_s)
    hidden = Remark("rows", "doubtful", "The torch hides dots in a row.")
    monkeypatch.setattr(Prepared, "quality", replace(QUALITY, remarks=(hidden,)))
    start(page, qtbot)
    verdicts: set[str] = set()

    def seen_enough() -> bool:
        verdicts.add(page.exposure.verdict.text())
        return page.live_view.updates > 40 and page.exposure.isVisible()

    qtbot.waitUntil(seen_enough)
    assert any("torch" in words for words in verdicts) == (old_s > 0)


def test_alarm_is_shown_logged_recorded_and_acknowledged(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    hand, view = Hand(window), page.live_view
    start(page, qtbot)
    choose(page, "Trends and limits")
    session = window.workspace.session
    hand.enter(view.canvas.trends.fields["width", 1], "6.9")
    assert session.limits == Limits(width_mm=(None, 6.9))
    qtbot.waitUntil(lambda: figure(page, 0, 0).text() == "Width\n✓ within limits")
    assert not view.canvas.alarms.isVisible()
    Prepared.found = replace(OK, measures=replace(MEASURES, width_mm=7.1))
    qtbot.waitUntil(view.canvas.alarms.isVisible)
    qtbot.waitUntil(lambda: figure(page, 0, 0).text() == "Width\n▲ above 6.9 mm")
    for column in (0, 1):
        colour = figure(page, 0, column).palette().color(QPalette.ColorRole.WindowText)
        assert colour == RED[is_dark(window.palette())]
    assert figure(page, 1, 1).palette().color(QPalette.ColorRole.WindowText) not in RED
    text = view.canvas.alarms.words.text()
    assert text.startswith("▲ ALARM: Width 7.100 ± 0.030 mm is above 6.9 mm (frame ")
    qtbot.waitUntil(lambda: "ALARM: Width 7.100" in log_of(window))
    assert "ALARM" in " ".join(map(str, window.status_line.unread))
    qtbot.waitUntil(lambda: 1 in view.canvas.trends.plots.curves[0].mark)
    assert view.canvas.trends.plots.curves[0].limits == (None, 6.9)
    # The notes contain an alarm active at the start of recording and each new alarm.
    view.trigger()
    Prepared.found = replace(OK, measures=replace(MEASURES, width_mm=6.8))
    qtbot.waitUntil(lambda: view.canvas.alarms.words.text().startswith("△ over: Width"))
    page.setFocus()
    hand.press(Qt.Key.Key_A)
    assert not view.canvas.alarms.isVisible()
    assert window.status_line.unread == []
    Prepared.found = DARK
    qtbot.waitUntil(view.canvas.alarms.isVisible)
    assert "3 frames in a row could not be measured: it is dark" in view.canvas.alarms.words.text()
    hand.button("Acknowledge")
    assert view.canvas.alarms.isVisible()
    assert not view.canvas.alarms.button.isEnabled()
    view.trigger()
    take = view.live.takes[0]
    qtbot.waitUntil(take.finished.is_set)
    with take.notes.open() as file:
        notes = [(row["kind"], row["what"]) for row in csv.DictReader(file)]
    assert ("note", "limits: width to 6.9 mm") in notes
    words = [(kind, what.partition(":")[0]) for kind, what in notes if "larm" in what.lower()]
    assert words == [
        ("warning", "ALARM"),
        ("note", "alarm over"),
        ("note", "alarm acknowledged"),
        ("warning", "ALARM"),
        ("note", "alarm acknowledged"),
    ]


def test_unacknowledged_alarm_stays_after_the_camera_is_stopped(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    hand, view = Hand(window), page.live_view
    start(page, qtbot)
    choose(page, "Trends and limits")
    hand.enter(view.canvas.trends.fields["width", 1], "6.6")
    qtbot.waitUntil(view.canvas.alarms.isVisible)
    hand.button("Stop camera")
    qtbot.waitUntil(lambda: view.live is None)
    assert view.canvas.alarms.words.text().startswith("△ over: Width")
    # It also stays when the next camera starts, beside the alarms of that one.
    start(page, qtbot)
    qtbot.waitUntil(lambda: "ALARM" in view.canvas.alarms.words.text())
    assert view.canvas.alarms.words.text().startswith("△ over: Width")
    hand.button("Acknowledge")
    assert "over" not in view.canvas.alarms.words.text()


def test_invalid_limits_are_rejected_and_valid_ones_undone(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    hand, view = Hand(window), page.live_view
    start(page, qtbot)
    choose(page, "Trends and limits")
    fields = view.canvas.trends.fields
    hand.enter(fields["length", 0], "7")
    hand.enter(fields["length", 1], "6.5")
    session = window.workspace.session
    assert session.limits == Limits(length_mm=(7.0, None))
    assert "a minimum below the maximum" in fields["length", 1].problem.text()
    assert fields["length", 1].value() is None
    hand.enter(view.canvas.trends.unmeasured, "12")
    assert session.limits.unmeasured == 12
    assert "a minimum below the maximum" in fields["length", 1].problem.text()
    assert view.live.watch.alarms.limits == session.limits
    window.workspace.undo()
    window.workspace.undo()
    assert fields["length", 0].value() is None
    assert view.live.watch.alarms.limits == Limits()


def test_unmeasured_frame_shows_the_reason_beside_the_figures(page: CapturePage, qtbot: QtBot):
    start(page, qtbot)
    choose(page, "Surface")
    view, surface_view = page.live_view, page.live_view.canvas.surface
    qtbot.waitUntil(lambda: surface_view.view.scene is not None)
    updates = view.updates
    qtbot.waitUntil(lambda: view.updates > updates + 3)
    assert not page.picture_view.isVisible()
    Prepared.found = DARK
    qtbot.waitUntil(lambda: figure(page, 0, 1).text() == "–")
    qtbot.waitUntil(lambda: "Not measured (no-dots): it is dark" in view.figures.words.text())
    qtbot.waitUntil(lambda: surface_view.view.scene is None)
    assert "No surface (no-dots): it is dark" in surface_view.view.accessibleDescription()
    Prepared.found = OK
    qtbot.waitUntil(lambda: surface_view.view.scene is not None)
    choose(page, "Picture")
    qtbot.waitUntil(page.picture_view.isVisible)
    assert surface_view.view.scene is None


def test_outdated_results_are_marked_as_unknown(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    view, surface_view = page.live_view, page.live_view.canvas.surface
    window.workspace.attempt(lambda session: session.set_limits(Limits(width_mm=(None, 6.9))))
    start(page, qtbot)
    choose(page, "Surface")
    qtbot.waitUntil(lambda: surface_view.view.scene is not None)
    qtbot.waitUntil(lambda: figure(page, 0, 0).text() == "Width\n✓ within limits")
    Prepared.gate.clear()  # measuring the next frame takes long
    try:
        qtbot.waitUntil(lambda: figure(page, 0, 0).text() == "Width\n? not known")
        qtbot.waitUntil(lambda: "The figures are" in view.figures.words.text())
        qtbot.waitUntil(lambda: surface_view.view.scene is None)
    finally:
        Prepared.gate.set()
    qtbot.waitUntil(lambda: surface_view.view.scene is not None)
    qtbot.waitUntil(lambda: figure(page, 0, 0).text() == "Width\n✓ within limits")


def change_setup(window: MainWindow, distance_mm: float) -> None:
    text = (SAMPLES / "gtaw" / "setup.toml").read_text("utf-8")
    text = text.replace("distance_mm = 50.0", f"distance_mm = {distance_mm}")
    window.workspace.attempt(lambda session: session.set_setup(text))


def test_surface_of_a_former_setup_disappears_at_once(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    start(page, qtbot)
    choose(page, "Surface")
    surface_view = page.live_view.canvas.surface.view
    qtbot.waitUntil(lambda: surface_view.scene is not None)
    Prepared.gate.clear()
    try:
        change_setup(window, 50.5)
        assert surface_view.scene is None
    finally:
        Prepared.gate.set()
    qtbot.waitUntil(lambda: surface_view.scene is not None)


def test_frames_unlike_the_calibration_are_marked_beside_the_sizes(
    page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(live_view, "live_setup_words", lambda *_: "set-up doubtful")
    start(page, qtbot)
    view = page.live_view
    view.camera_fields.fields["region"].edited.emit("0, 8, 64, 32")
    qtbot.waitUntil(lambda: PART_WORDS in view.figures.setup_words.text())
    assert "set-up doubtful" in view.figures.setup_words.text()
    view.camera_fields.whole_button.click()
    qtbot.waitUntil(lambda: PART_WORDS not in view.figures.setup_words.text())


def test_ended_measuring_is_shown_with_a_remedy(
    window: MainWindow, page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    start(page, qtbot)
    view = page.live_view

    def killed(*_: object) -> LiveResult:
        raise LiveMeasuringEnded("the measuring process has ended")

    with monkeypatch.context() as patched:
        patched.setattr(Prepared, "measure", killed)
        qtbot.waitUntil(lambda: live_watch.REMEDY in view.figures.words.text())
        assert "process has ended" in log_of(window)
    change_setup(window, 50.5)
    qtbot.waitUntil(lambda: view._result is not None)
    qtbot.waitUntil(lambda: "frames/s measured" in view.figures.words.text())


def test_control_software_stays_connected_when_the_setup_changes(
    window: MainWindow, page: CapturePage, qtbot: QtBot, port: int
):
    hand, view = Hand(window), page.live_view
    start(page, qtbot)
    choose(page, "Control software")
    hand.enter(view.canvas.streams.ports["lines"], str(port))
    view.canvas.streams.boxes["lines"].click()
    qtbot.waitUntil(lambda: view.live.watch.stream("lines") is not None)
    stream = view.live.watch.stream("lines")
    with connect(port) as connected, connected.makefile("rb") as file:
        file.readline()
        for distance_mm in (50.5, 51.0):
            change_setup(window, distance_mm)
            qtbot.waitUntil(lambda: view._result is not None)
            qtbot.waitUntil(lambda: not window.workspace.tasks.active)
            assert view.live.watch.stream("lines") is stream
            while json.loads(file.readline())["status"] != "silent":
                pass  # of the former set-up
            assert json.loads(file.readline())["status"] == "ok"


def test_stream_with_a_fault_is_switched_off_and_says_why(
    window: MainWindow,
    page: CapturePage,
    qtbot: QtBot,
    port: int,
    monkeypatch: pytest.MonkeyPatch,
):
    hand, streams = Hand(window), page.live_view.canvas.streams
    start(page, qtbot)
    choose(page, "Control software")
    hand.enter(streams.ports["lines"], str(port))
    streams.boxes["lines"].click()
    watch = page.live_view.live.watch
    qtbot.waitUntil(lambda: watch.stream("lines") is not None)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)

    def broken(*_: object) -> None:
        raise RuntimeError("the loop is closed")

    monkeypatch.setattr(watch.stream("lines"), "publish", broken)
    qtbot.waitUntil(lambda: "the loop is closed" in streams.words["lines"].text())
    assert not streams.boxes["lines"].isChecked()
    assert f"127.0.0.1:{port} is closed" in log_of(window)
    streams.boxes["lines"].click()
    qtbot.waitUntil(lambda: streams.words["lines"].text().startswith(f"● 127.0.0.1:{port}"))


def test_problem_of_a_port_ends_when_the_stream_is_open(
    window: MainWindow, page: CapturePage, qtbot: QtBot, port: int
):
    hand, streams = Hand(window), page.live_view.canvas.streams
    start(page, qtbot)
    choose(page, "Control software")
    hand.enter(streams.ports["lines"], str(port))
    with socket.create_server(("127.0.0.1", port)):
        streams.boxes["lines"].click()
        qtbot.waitUntil(lambda: any(str(port) in each for each in window.status_line.unread))
    assert not streams.boxes["lines"].isChecked()
    streams.boxes["lines"].click()
    qtbot.waitUntil(lambda: streams.words["lines"].text().startswith(f"● 127.0.0.1:{port}"))
    qtbot.waitUntil(lambda: window.status_line.unread == [])


def test_control_software_receives_results_while_live(
    window: MainWindow, page: CapturePage, qtbot: QtBot, port: int
):
    hand, view = Hand(window), page.live_view
    streams = view.canvas.streams
    start(page, qtbot)
    choose(page, "Control software")
    assert streams.words["lines"].text() == "○ Off"
    hand.enter(streams.ports["lines"], str(port))
    streams.boxes["lines"].click()
    qtbot.waitUntil(
        lambda: streams.words["lines"].text().startswith(f"● 127.0.0.1:{port}: 0 clients")
    )
    connected = connect(port)
    file = connected.makefile("rb")
    connected.close()
    assert "labapp" in json.loads(file.readline())
    message = json.loads(file.readline())
    assert (message["width_mm"], message["alarm"], message["status"]) == (6.7, "", "ok")
    qtbot.waitUntil(lambda: "1 client connected" in streams.words["lines"].text())
    # Other machines may connect only if that is checked; then a warning is shown.
    assert not streams.warning.isVisible()
    streams.anywhere.click()
    assert "Any machine that reaches this one" in streams.warning.text()
    qtbot.waitUntil(lambda: "every address of this machine" in streams.words["lines"].text())
    for _ in range(7):  # the last choice counts, whatever is in progress
        streams.anywhere.click()
    assert not streams.warning.isVisible()
    qtbot.waitUntil(lambda: streams.words["lines"].text().startswith("● 127.0.0.1"))
    file.close()
    # The stream ends and starts again with the camera.
    watch = view.live.watch
    hand.button("Stop camera")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert watch.stream("lines") is None
    start(page, qtbot)
    qtbot.waitUntil(lambda: view.live.watch.stream("lines") is not None)
    choose(page, "Control software")
    streams.boxes["lines"].click()
    qtbot.waitUntil(lambda: streams.words["lines"].text() == "○ Off")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    with pytest.raises(OSError, match="refused"):
        connect(port)


def test_penetration_model_is_shown_and_marked_as_a_model(
    page: CapturePage, qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    settings = ModelSettings(("width_mm",), "back_width_mm", orders=Orders(0, 1, 0))
    one, half = np.ones(1), LinearMap(np.array([0.5, 0.0]), np.zeros((2, 2)))
    parameters = 0 * one, one, 0 * one, 9 * one, 0.0, half, 0.1
    path = tmp_path / "bench.json"
    write_model(path, PenetrationModel("arx", settings, (), *parameters, rmse_mm=0.12))
    monkeypatch.setattr(live_penetration, "ask_file", lambda *_: path)
    view = page.live_view
    start(page, qtbot)
    assert not view.penetration.none_button.isVisible()
    view.penetration.choose_button.click()
    qtbot.waitUntil(lambda: figure(page, 3, 1).text() == "3.350")
    assert figure(page, 3, 0).text() == "Back width\nmodel"
    assert "bench" in view.penetration.words.text()
    # An unreadable file is reported and changes nothing.
    path.write_text("{}")
    view.penetration.choose_button.click()
    qtbot.waitUntil(lambda: "bench.json" in view.penetration.words.text())
    assert figure(page, 3, 1).isVisible()
    view.penetration.none_button.click()
    qtbot.waitUntil(lambda: not figure(page, 3, 1).isVisible())


def test_occupied_port_is_reported_with_a_remedy(
    window: MainWindow, page: CapturePage, qtbot: QtBot, port: int
):
    hand, streams = Hand(window), page.live_view.canvas.streams
    start(page, qtbot)
    choose(page, "Control software")
    with socket.create_server(("127.0.0.1", 0)) as server:
        occupied_port = server.getsockname()[1]
        for kind in ("lines", "opcua"):
            hand.enter(streams.ports[kind], str(occupied_port))
            streams.boxes[kind].click()
            qtbot.waitUntil(lambda kind=kind: not streams.boxes[kind].isChecked())
            assert "Choose another port" in streams.words[kind].text()
    assert log_of(window).count("Choose another port") == 2
    streams.boxes["lines"].click()
    qtbot.waitUntil(lambda: streams.words["lines"].text().startswith("● 127.0.0.1"))
    assert page.live_view.live.watch.stream("opcua") is None
    hand.enter(streams.ports["opcua"], str(port))
    streams.boxes["opcua"].click()
    place = f"● opc.tcp://127.0.0.1:{port}/labapp: 0 "
    qtbot.waitUntil(lambda: streams.words["opcua"].text().startswith(place))


@pytest.mark.parametrize("part", ["Picture", "Surface", "Trends and limits", "Control software"])
def test_every_part_is_accessible_on_a_small_screen(
    window: MainWindow, page: CapturePage, qtbot: QtBot, part: str
):
    window.workspace.attempt(lambda session: session.set_limits(Limits(width_mm=(7.0, None))))
    start(page, qtbot)
    choose(page, part)
    qtbot.waitUntil(page.live_view.canvas.alarms.isVisible)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    reached = check_round(window)
    assert page.live_view.canvas.tabs in reached
    assert page.live_view.canvas.alarms.button in reached
    window.resize(911, 512)  # 1366 × 768 at 150 %
    qtbot.waitUntil(lambda: (window.width(), window.height()) == (911, 512))
    for button in window.findChildren(QAbstractButton):
        if button.isVisible() and button.text():
            assert button.width() >= button.sizeHint().width() - 1, button.text()
    assert page.live_view.bar.record_button.isVisible()
