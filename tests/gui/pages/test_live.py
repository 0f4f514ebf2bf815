"""A live camera on the recording page: display, settings, recording, faults."""

from __future__ import annotations

import csv
import errno
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QCloseEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QAbstractButton, QApplication, QLabel, QMessageBox
from pytestqt.qtbot import QtBot

from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings
from labapp.gui.live import view as live_view
from labapp.gui.live.figures import LINES, NO_SETUP, Figure, figures
from labapp.gui.live.live import SIMULATED, STATES, WAITS, Live, choices
from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.shell.steps import Mark
from labapp.gui.shell.window import MainWindow
from labapp.gui.theme import RED
from labapp.gui.widgets.exposure import LINES_NOT_JUDGED
from labapp.media import GreyImage, open_source
from labapp.media.cameras import (
    CameraInfo,
    CameraKind,
    CameraSettings,
    SimulatedDevice,
)
from labapp.media.recording.nut import NutWriter
from labapp.media.recording.recorder import Plan
from labapp.media.recording.take_files import TakeFiles
from labapp.run import live_watch
from labapp.run.limits import Limits
from labapp.run.live_measuring import LiveResult
from labapp.session.session import Session
from labapp.simulated.simulated_pool import camera_pool, pool_camera, simulated_pool
from tests.gui.conftest import SAMPLES, let_draw
from tests.gui.hand import Hand
from tests.gui.test_accessibility import check_round
from tests.media.cameras.faulty import Faults, FaultyDevice
from tests.waiting import PATIENCE_S, wait_until

SHAPE = (48, 64)


def numbered(k: int) -> GreyImage:
    """Frame k: its number in the first four pixels, over a pattern from dark to bright."""
    image = np.add.outer(np.arange(SHAPE[0]), 2 * np.arange(SHAPE[1])).astype(np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(k).tobytes(), np.uint8)
    return image


def number_in(image: GreyImage) -> int:
    return int(np.frombuffer(image[0, :4].astype(np.uint8).tobytes(), np.uint32)[0])


# --- without widgets ------------------------------------------------------------------------------


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    names = iter(range(100))
    camera = Live(
        "test camera",
        lambda: tmp_path / f"run{next(names)}.nut",
        Plan(before_s=0.2),
        CameraSettings(rate_hz=200.0),
        Settings(),
    )
    yield camera
    camera.close()


def test_recording_has_the_frames_of_the_camera(live: Live):
    device = SimulatedDevice("test", numbered)
    live.open(device.open)
    assert live.feed is not None
    wait_until(lambda: live.feed.counts.frames > 60)
    frames_before = live.feed.counts.frames
    live.trigger()
    assert live.running is live.takes[0]
    live.mark()
    wait_until(lambda: live.takes[0].frames > 80)
    live.trigger()
    assert live.running is None
    wait_until(live.takes[0].finished.is_set)
    take = live.takes[0]
    with open_source(take.path) as video:
        images = [frame.image for frame in video]
    numbers = [number_in(image) for image in images]
    assert len(numbers) == take.frames
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    # 0.2 s at 200 frames/s are from before the trigger.
    assert numbers[0] < frames_before - 20
    for number, image in zip(numbers, images, strict=True):
        assert np.array_equal(image, numbered(number))
    assert "marked by hand" in take.notes.read_text()
    assert live.ended_takes() == [take]
    assert live.ended_takes() == []


def test_newest_frame_is_returned_once_and_assessed(live: Live):
    gate = threading.Event()

    def picture(k: int) -> GreyImage:
        if k == 20:
            gate.wait(PATIENCE_S)
        return numbered(k)

    live.open(SimulatedDevice("test", picture).open)
    wait_until(lambda: live.feed.counts.frames == 20)

    def is_last() -> bool:
        shown = live.newest()
        return shown is not None and number_in(shown.frame.image) == 19

    wait_until(is_last)
    assert live.newest() is None
    results = []
    wait_until(lambda: bool(results.append(live.looked()) or results[-1]))
    gate.set()
    assert results[-1].quality.exposure.verdict in ("no dots", "too dark", "good", "dots merge")
    assert live.room_byte > 0
    assert "room for" in live.recording_text().lower() or live.rate_hz() is None


def test_camera_faults_are_reported_and_no_recorded_frame_is_lost(live: Live):
    device = FaultyDevice("test", numbered, faults=Faults(garbage=0.1, dropped=0.05, seed=3))
    live.open(device.open)
    wait_until(lambda: live.feed.counts.frames > 20)
    live.trigger()
    device.unplug()
    wait_until(lambda: live.feed.state == "lost")
    assert live.state_text().startswith("▲ Not connected")
    recorded = live.takes[0].frames
    device.plug()
    wait_until(lambda: live.feed.state == "running" and live.takes[0].frames > recorded + 40)
    assert live.state_text().startswith("● Live")
    live.close()
    counts = live.feed.counts
    assert (counts.lost, live.takes[0].lost) == (1, 0)
    assert counts.broken > 0
    assert counts.dropped > 0
    assert "lost 1 time" in live.counts_text()
    messages = [str(event) for event in live.events()]
    assert any("unplugged" in each for each in messages)
    assert any("it is back" in each for each in messages)
    assert any("incomplete" in each for each in messages)
    with open_source(live.takes[0].path) as video:
        numbers = [number_in(frame.image) for frame in video]
    assert len(numbers) == live.takes[0].frames
    assert numbers == sorted(set(numbers))


def test_closing_while_opening_leaves_no_camera_open(live: Live):
    device, started, gate = SimulatedDevice("test", numbered), threading.Event(), threading.Event()

    def slow():
        started.set()
        gate.wait(PATIENCE_S)
        return device.open()

    opening = threading.Thread(target=live.open, args=(slow,))
    opening.start()
    started.wait(PATIENCE_S)
    live.close()
    gate.set()
    opening.join()
    assert live.feed is None
    assert not live.is_open
    live.trigger()
    assert live.takes == []


def test_new_plan_applies_to_the_next_recording(live: Live):
    live.open(SimulatedDevice("test", numbered).open)
    live.set_plan(Plan(before_s=0, after_s=0.1, every=3))
    assert live.before_trigger() == (0.0, "nothing before the trigger")
    live.trigger()
    wait_until(live.takes[0].finished.is_set)
    with open_source(live.takes[0].path) as video:
        numbers = [number_in(frame.image) for frame in video]
    assert set(np.diff(numbers)) == {3}
    assert 4 <= len(numbers) <= 8


def test_plan_set_while_recording_applies_to_the_next_one(live: Live):
    live.open(SimulatedDevice("test", numbered).open)
    wait_until(lambda: live.before_trigger()[0] > 0.9)
    live.trigger()
    live.set_plan(Plan(before_s=0, after_s=0.1, every=3))
    assert live.before_trigger() == (0.0, "0.0 of 0.2 s")
    wait_until(lambda: live.takes[0].frames > 60)
    live.trigger()
    wait_until(lambda: live.before_trigger() == (0.0, "nothing before the trigger"))
    live.trigger()
    wait_until(live.takes[1].finished.is_set)
    steps = []
    for take in live.takes:
        with open_source(take.path) as video:
            steps.append(set(np.diff([number_in(frame.image) for frame in video]).tolist()))
    assert steps == [{1}, {3}]


def test_ring_buffer_is_empty_after_a_trigger(live: Live):
    device = FaultyDevice("test", numbered)
    live.set_plan(Plan(before_s=0.5, after_s=0.1))
    live.open(device.open)
    wait_until(lambda: live.before_trigger()[0] > 0.9)
    device.unplug()
    live.trigger()
    assert live.before_trigger() == (0.0, "0.0 of 0.5 s")


def test_frames_are_measured_if_the_setup_is_complete(live: Live):
    assert live.watch is None
    assert figures(None)[0] == Figure("Width", "–", "")
    folder = SAMPLES / "gtaw"
    with open_source(folder / "recording.avi") as video:
        image = video.frame(0).image
    setup = read_setup(folder / "setup.toml")
    with_setup = Live("test", live._place, Plan(), CameraSettings(), Settings(), setup)
    device = SimulatedDevice("test", lambda _: image, rate_hz=4)
    try:
        with_setup.open(device.open)
        watch = with_setup.watch
        assert watch is not None
        results: list[LiveResult | None] = []
        wait_until(lambda: bool(results.append(watch.newest()) or results[-1]))
        # The first frame is measured alone, the next with a prediction from the previous one.
        wait_until(lambda: bool(results.append(watch.newest()) or results[-1]))
    finally:
        with_setup.close()
    first, measured = [each for each in results if each is not None]
    assert (first.measurement.status, measured.measurement.status) == ("ok", "ok")
    assert (first.track_lost is None, measured.track_lost is None) == (False, True)
    grades = {remark.about: remark.grade for remark in measured.quality.remarks}
    assert grades["reference"] == "good"
    width, length, height = figures(measured)
    with (folder / "truth.csv").open() as file:
        truth = next(csv.DictReader(file))
    for row, name in ((width, "width_mm"), (length, "length_mm"), (height, "height_mm")):
        value, sigma = float(row.value), float(row.sigma.removeprefix("± "))
        assert abs(value - float(truth[name])) < max(5 * sigma, 0.02 * value), row


def test_measuring_begins_anew_after_its_process_was_killed(tmp_path: Path):
    with open_source(SAMPLES / "gtaw" / "recording.avi") as video:
        image = video.frame(0).image
    setup = read_setup(SAMPLES / "gtaw" / "setup.toml")
    live = Live("t", lambda: tmp_path / "a.nut", Plan(), CameraSettings(), Settings(), setup)
    try:
        live.open(SimulatedDevice("test", lambda _: image, rate_hz=4).open)
        watch = live.watch
        assert watch is not None
        wait_until(lambda: watch.newest() is not None)
        for process in watch._measuring._pool._processes.values():
            process.kill()
        wait_until(lambda: any(live_watch.REMEDY in event.words for event in live.events()))
        assert live_watch.REMEDY in watch.stopped
        watch.newest()
        live.set_setup(setup, Settings())
        assert not watch.stopped
        wait_until(lambda: watch.newest() is not None)
    finally:
        live.close()


def test_camera_choices():
    cameras = [CameraInfo("uvc:0", "Microscope", "USB video")]
    assert choices(cameras) == [
        ("uvc:0", "Microscope (USB video)"),
        (SIMULATED, "Simulated camera"),
    ]


def test_simulated_camera_shows_a_pool_on_the_bench_of_the_session(tmp_path: Path):
    with Session.create(tmp_path / "a.labsession") as session:
        usual = camera_pool()
        assert tomllib.loads(simulated_pool(session)) == usual.unwrap()
        setup = (SAMPLES / "gtaw" / "setup.toml").read_text("utf-8")
        session.set_setup(setup)
        text = simulated_pool(session)
        assert text.endswith(f"\n{setup}")
        own = ("pool", "look", "recording")
        pool = tomllib.loads(text.removesuffix(f"\n{setup}"))
        assert pool == {name: usual[name].unwrap() for name in own}
    progress: list[tuple[int, int]] = []
    device = pool_camera(tomlkit.dumps(usual), lambda *args: progress.append(args))
    assert progress[-1][0] + 1 == progress[-1][1] == len(progress)
    images = [device.picture(k) for k in range(2 * len(progress))]
    assert images[0].shape == (640, 480)
    assert np.array_equal(images[0], images[2 * len(progress) - 2])
    steps = [np.abs(a.astype(float) - b).mean() for a, b in pairwise(images)]
    assert min(steps) > 0
    # With three times the frame rate, the pool oscillates at the same frequency.
    device.settings = replace(device.settings, rate_hz=3 * device.settings.rate_hz)
    faster = [device.picture(k) for k in range(3 * len(images))]
    for k in (0, 5, 2 * len(progress) - 1):
        assert all(np.array_equal(each, images[k]) for each in faster[3 * k : 3 * k + 3])


# --- on the page ----------------------------------------------------------------------------------


@pytest.fixture
def device() -> FaultyDevice:
    return FaultyDevice("test", numbered, rate_hz=100)


@pytest.fixture
def page(
    window: MainWindow,
    tmp_path: Path,
    device: FaultyDevice,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> CapturePage:
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: device)
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    window.show_step("capture")
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    page = window.page
    assert isinstance(page, CapturePage)
    return page


def start(page: CapturePage, qtbot: QtBot) -> None:
    qtbot.waitUntil(page.live_view.start_button.isEnabled)
    page.live_view.start_button.click()
    qtbot.waitUntil(lambda: page.live_view.updates > 2)


def log_of(window: MainWindow) -> str:
    return "\n".join(window.log_panel.texts())


def test_start_record_and_import_by_mouse_and_keyboard(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    hand, view = Hand(window), page.live_view
    assert not window.menus.actions["record"].isEnabled()
    hand.button("Start")
    qtbot.waitUntil(lambda: view.updates > 2)
    assert page.title.text() == "Live: Simulated camera"
    assert page.picture_view.picture.shape == SHAPE
    assert window.menus.actions["record"].isEnabled()
    qtbot.waitUntil(lambda: view.bar.state.text().startswith("● Live"))
    qtbot.waitUntil(page.exposure.isVisible)
    page.setFocus()
    hand.press(Qt.Key.Key_Space)
    assert view.live.running is not None
    assert view.bar.record_button.text() == "■ End recording"
    assert not view.plan_fields.before.isEnabled()
    hand.press(Qt.Key.Key_M)
    qtbot.waitUntil(lambda: view.live.running.frames > 20)
    hand.button("■ End recording")
    session = window.workspace.session
    qtbot.waitUntil(lambda: session.recording is not None)
    take = view.live.takes[0]
    assert take.path.parent == session.path.parent
    assert take.path.name.startswith("new-20")
    assert len(session.frames) == take.frames
    numbers = [number_in(session.frame(int(k)).image) for k in session.frames]
    assert numbers == list(range(numbers[0], numbers[0] + take.frames))
    assert "marked by hand" in take.notes.read_text()
    assert view.is_live
    # A second recording is stored as a file.
    hand.press(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: view.live.running.frames > 5)
    hand.press(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: "Other recordings" in log_of(window))
    assert len(session.frames) == take.frames
    hand.button("Stop camera")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    qtbot.waitUntil(lambda: "of the session" in page.title.text())
    assert not view.bar.isVisible()
    assert view.start_button.isVisible()
    # It is imported into a new session with the set-up of this one.
    second = session.path.with_name("second.labsession")
    hand.answer(second)
    hand.button("New session from this recording…")
    qtbot.waitUntil(lambda: window.workspace.session.path == second)
    qtbot.waitUntil(lambda: window.workspace.session.recording is not None)
    assert len(window.workspace.session.frames) > 5
    assert not page.kept.isVisible()
    with Session.open(session.path) as previous:
        assert len(previous.frames) == take.frames
        assert previous.problems() == []


def test_full_disk_is_the_prominent_message_while_frames_are_lost(
    window: MainWindow, page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    start(page, qtbot)
    view, line = page.live_view, window.status_line
    view.trigger()
    qtbot.waitUntil(lambda: view.recording.frames > 3)
    assert not view.bar.recording.font().bold()
    monkeypatch.setattr(NutWriter, "write", full)
    monkeypatch.setattr(TakeFiles, "_note", full)
    qtbot.waitUntil(lambda: view.bar.recording.text().startswith("▲"))
    assert view.recording.trouble in view.bar.recording.text()
    assert view.bar.recording.font().bold()
    shown = view.bar.recording.grab().toImage().pixelColor(1, 1)
    assert shown == RED[False]
    qtbot.waitUntil(lambda: view.recording.trouble in line.message.text())
    window.workspace.notified.emit("Not all notes can be written", True)
    assert len(line.unread) == 2
    assert view.recording.trouble in line.message.text()
    view.trigger()
    qtbot.waitUntil(lambda: not view.bar.recording.font().bold())


def test_large_figures_are_shown_if_the_setup_is_complete(
    window: MainWindow, page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    with open_source(SAMPLES / "gtaw" / "recording.avi") as video:
        image = video.frame(0).image
    window.workspace.attempt(
        lambda session: session.set_setup((SAMPLES / "gtaw" / "setup.toml").read_text("utf-8"))
    )
    camera = SimulatedDevice("pool", lambda _: image, rate_hz=4)
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: camera)
    start(page, qtbot)
    view = page.live_view
    assert view.figures.isVisible()
    labels = view.figures.findChildren(QLabel)
    qtbot.waitUntil(lambda: "Height" in [each.text() for each in labels])
    qtbot.waitUntil(lambda: any("±" in each.text() for each in labels))
    assert {"Width", "Length", "Height", "mm"} <= {each.text() for each in labels}


def test_figures_are_of_the_present_setup(
    window: MainWindow, page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    with open_source(SAMPLES / "gtaw" / "recording.avi") as video:
        image = video.frame(0).image
    camera = SimulatedDevice("pool", lambda _: image, rate_hz=4)
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: camera)
    start(page, qtbot)
    view, text = page.live_view, (SAMPLES / "gtaw" / "setup.toml").read_text("utf-8")
    assert view.live.watch is None
    limits = Limits(width_mm=(None, 99.0))
    window.workspace.attempt(lambda session: session.set_limits(limits))
    heights = []
    for setup in (text, text.replace("distance_mm = 50.0", "distance_mm = 50.5")):
        window.workspace.attempt(partial(Session.set_setup, text=setup))
        assert view._result is None
        assert view.live.watch.alarms.limits == limits
        qtbot.waitUntil(lambda: view._result is not None)
        heights.append(view._result.measurement.measures.height_mm)
    assert abs(heights[1] - heights[0]) > 1e-4
    for _ in heights:
        window.workspace.undo()
    assert view.figures.words.text().startswith(NO_SETUP)
    updates = view.updates
    qtbot.waitUntil(lambda: view.updates > updates + 3)
    assert view.figures.words.text().startswith(NO_SETUP)
    window.workspace.redo()
    qtbot.waitUntil(lambda: view._result is not None)


@pytest.mark.parametrize("sample", ["five_lines", "gmaw"])
def test_lines_are_not_judged_as_dots(
    window: MainWindow,
    page: CapturePage,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    sample: str,
):
    with Session.open(SAMPLES / sample / f"{sample}.labsession", read_only=True) as lines:
        setup, recording = lines.setup_text, lines.path.with_name(Path(lines.recording.path).name)
    with open_source(recording) as video:
        image = video.frame(0).image
    window.workspace.attempt(lambda session: session.set_setup(setup))
    view = page.live_view
    assert not view.start_button.isEnabled()  # the simulated camera films dots
    assert view.start_button.toolTip() in view.camera.problem.text()
    view.start()
    assert view.live is None
    assert view.start_button.toolTip() in view.answer.text()
    camera = SimulatedDevice("lines", lambda _: image, rate_hz=20)
    monkeypatch.setattr(live_view, "open_camera", lambda _: camera.open())
    monkeypatch.setattr(
        live_view, "find_cameras", lambda: ([CameraInfo("test:0", "Lines", "USB")], [])
    )
    view.find()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    view.camera.set_value("test:0")
    view.camera.edited.emit("test:0")
    assert view.start_button.isEnabled()
    assert not view.camera.problem.text()
    start(page, qtbot)
    qtbot.waitUntil(lambda: view.live.room_byte is not None and view.updates > 20)
    qtbot.waitUntil(page.exposure.isVisible)
    level, clipped, contrast = page.exposure.bars
    assert level.value() == round(100 * np.percentile(image, 99.9) / 255)
    assert clipped.value() == 0
    assert contrast.isHidden()  # that of dots
    assert page.exposure.verdict.text() == f"○ {LINES_NOT_JUDGED}"
    assert not len(view.picture.rings.data)
    assert view.figures.words.text() == LINES
    # Also after an edit, and when dots become lines.
    dots = (SAMPLES / "gtaw" / "setup.toml").read_text("utf-8")
    for text in (f"{setup}\n# checked", dots, setup):
        window.workspace.attempt(partial(Session.set_setup, text=text))
        if text == dots:
            qtbot.waitUntil(lambda: page.exposure.verdict.text() != f"○ {LINES_NOT_JUDGED}")
            view.picture.rings.setData(pos=np.ones((1, 2)))  # in some pictures it finds none
            continue
        updates = view.updates
        qtbot.waitUntil(lambda updates=updates: view.updates > updates + 20)
        qtbot.waitUntil(lambda: page.exposure.verdict.text() == f"○ {LINES_NOT_JUDGED}")
        qtbot.waitUntil(lambda: not len(view.picture.rings.data))
        assert view.figures.words.text() == LINES


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [True, False])
def test_recording_is_measured_afterwards_if_requested(
    window: MainWindow,
    page: CapturePage,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    wanted: bool,
):
    with open_source(SAMPLES / "gtaw" / "recording.avi") as video:
        image = video.frame(0).image
    window.workspace.attempt(
        lambda session: session.set_setup((SAMPLES / "gtaw" / "setup.toml").read_text("utf-8"))
    )
    camera = SimulatedDevice("pool", lambda _: image, rate_hz=20)
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: camera)
    page.live_view.plan_fields.measured.setChecked(wanted)
    start(page, qtbot)
    hand, view, session = Hand(window), page.live_view, window.workspace.session
    page.setFocus()
    hand.press(Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: view.live.running.frames > 3)
    hand.press(Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: session.recording is not None)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert view.is_live
    assert set(session.overview().status) == ({"ok"} if wanted else {""})


def test_space_plays_without_a_live_camera(window: MainWindow, copy_sample, qtbot: QtBot):
    window.files.open(copy_sample("gtaw"))
    window.show_step("capture")
    window.page.setFocus()
    QTest.keyClick(window.page, Qt.Key.Key_Space)
    assert window.timeline.playing
    window.timeline.set_playing(False)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_settings_show_the_actual_values(page: CapturePage, device, qtbot: QtBot):
    view = page.live_view
    start(page, qtbot)
    assert view.camera_fields.fields["rate_hz"].value() == 100
    assert view.camera_fields.fields["exposure_us"].isHidden()
    hand = Hand(page.window())
    hand.enter(view.camera_fields.fields["rate_hz"], "40")
    qtbot.waitUntil(lambda: device.settings.rate_hz == 40 and not view.camera_fields.waiting)
    hand.enter(view.camera_fields.fields["rate_hz"], "0.001")
    assert "is not from 0.1 to 10000" in view.camera_fields.fields["rate_hz"].problem.text()
    assert device.settings.rate_hz == 40
    view.plan_fields.before.set_value(0.5)
    view.plan_fields.before.edited.emit(0.5)
    assert view.live.plan.before_s == 0.5


def test_camera_faults_are_reported(window: MainWindow, page: CapturePage, device, qtbot: QtBot):
    view = page.live_view
    start(page, qtbot)
    view.trigger()
    device.unplug()
    qtbot.waitUntil(lambda: view.bar.state.text().startswith("▲ Not connected"))
    assert "unplugged. Trying to get it back" in log_of(window)
    qtbot.waitUntil(lambda: "unplugged" in window.status_line.message.text())
    device.plug()
    qtbot.waitUntil(lambda: view.bar.state.text().startswith("● Live"))
    assert "it is back after" in log_of(window)
    qtbot.waitUntil(lambda: window.status_line.unread == [])
    device.faults = Faults(garbage=1.0)
    qtbot.waitUntil(lambda: "incomplete, discarded" in log_of(window))
    device.faults = Faults()
    updates = view.updates
    qtbot.waitUntil(lambda: view.updates > updates + 2)


def test_recording_continues_on_another_page_and_is_imported(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    start(page, qtbot)
    live = page.live_view.live
    page.live_view.trigger()
    window.show_step("setup")
    frames, updates = live.takes[0].frames, page.live_view.updates
    qtbot.waitUntil(lambda: live.takes[0].frames > frames + 20)
    assert page.live_view.updates == updates  # the page is hidden
    # The only sign of it on this page:
    qtbot.waitUntil(lambda: window.step_list._states["capture"].mark is Mark.ATTENTION)
    assert window.menus.actions["record"].isEnabled()
    Hand(window).press(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
    session = window.workspace.session
    qtbot.waitUntil(lambda: session.recording is not None)
    assert len(session.frames) == live.takes[0].frames
    assert live.is_open
    qtbot.waitUntil(lambda: window.step_list._states["capture"].mark is not Mark.ATTENTION)
    window.show_step("capture")
    assert page.title.text() == "Live: Simulated camera"
    qtbot.waitUntil(lambda: page.live_view.updates > updates + 2)
    window.do("close")
    assert not live.is_open
    assert live.feed.state == "ended"


def test_closing_the_window_finishes_the_recording(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    start(page, qtbot)
    live = page.live_view.live
    page.live_view.trigger()
    qtbot.waitUntil(lambda: live.takes[0].frames > 10)
    window.close()
    take = live.takes[0]
    assert take.finished.is_set()
    with open_source(take.path) as video:
        numbers = [number_in(frame.image) for frame in video]
    assert len(numbers) == take.frames > 10
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def answer(words: str) -> None:
    """Press a button of the next message box."""

    def press() -> None:
        box = QApplication.activeModalWidget()
        if not isinstance(box, QMessageBox):
            QTimer.singleShot(20, press)
            return
        buttons = [each for each in box.buttons() if each.text().replace("&", "") == words]
        assert len(buttons) == 1, [each.text() for each in box.buttons()]
        buttons[0].click()

    QTimer.singleShot(0, press)


def close_by_hand(window: MainWindow) -> None:
    """Close the window as the button in its frame does."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(QCloseEvent, "spontaneous", lambda _: True)
        window.close()


@pytest.mark.parametrize("way", ["the frame", "quit", "close", "another"])
def test_closing_while_recording_needs_confirmation(
    window: MainWindow, page: CapturePage, qtbot: QtBot, copy_sample, way: str
):
    close = {
        "the frame": lambda: close_by_hand(window),
        "quit": lambda: window.do("quit"),
        "close": lambda: window.do("close"),
        "another": lambda: window.files.open(other),
    }[way]
    other, session = copy_sample("thumb_tack"), window.workspace.session
    start(page, qtbot)
    page.live_view.trigger()
    take = page.live_view.live.running
    answer("Go on recording")
    close()
    assert window.isVisible()
    assert window.workspace.session is session
    assert page.live_view.live.running is take
    frames = take.frames
    qtbot.waitUntil(lambda: take.frames > frames + 5)
    answer("Finish and keep")
    close()
    assert window.workspace.session is not session
    assert take.finished.is_set()
    with open_source(take.path) as video:
        assert len(video) == take.frames


def test_discarded_recording_is_deleted(window: MainWindow, page: CapturePage, qtbot: QtBot):
    start(page, qtbot)
    live = page.live_view.live
    page.live_view.trigger()
    qtbot.waitUntil(lambda: live.takes[0].frames > 10)
    folder = window.workspace.session.path.parent
    answer("Discard")
    close_by_hand(window)
    assert not window.isVisible()
    assert [path.name for path in folder.glob("new*")] == ["new.labsession"]


def test_other_recordings_are_listed_on_reopening(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    path = window.workspace.session.path
    path.with_name("new-notes.nut").write_bytes(b"")  # not a recording of the session
    start(page, qtbot)
    live = page.live_view.live
    page.live_view.trigger()
    qtbot.waitUntil(lambda: live.takes[0].frames > 10)
    assert not page.kept.isVisible()
    answer("Finish and keep")
    window.do("close")
    window.files.open(path)
    window.show_step("capture")
    hand = Hand(window)
    assert page.kept.isVisible()
    assert page.kept.choice.editor.count() == 1
    assert page.kept.choice.value() == str(live.takes[0].path)
    assert page.kept.choice.editor.currentText()[:4].isdecimal()  # begins with the year
    hand.button("Preview")
    qtbot.waitUntil(lambda: page.preview is not None)
    hand.button("Import")
    session = window.workspace.session
    qtbot.waitUntil(lambda: session.recording is not None)
    assert len(session.frames) == live.takes[0].frames
    qtbot.waitUntil(lambda: not page.kept.isVisible())


def test_camera_that_cannot_be_opened_is_reported(
    window: MainWindow, page: CapturePage, device, qtbot: QtBot
):
    device.unplug()
    page.live_view.start()
    qtbot.waitUntil(lambda: "is not connected" in log_of(window))
    assert page.live_view.live is None
    assert page.live_view.start_button.isVisible()
    assert "fault in the program" not in log_of(window)
    device.plug()
    start(page, qtbot)


def test_opening_a_camera_can_be_cancelled(
    window: MainWindow, page: CapturePage, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    started, gate = threading.Event(), threading.Event()

    def slow(_text: str, progress):
        started.set()
        gate.wait(PATIENCE_S)
        progress(1, 2)

    monkeypatch.setattr(live_view, "pool_camera", slow)
    page.live_view.start()
    qtbot.waitUntil(started.is_set)
    window.status_line.cancel()
    gate.set()
    qtbot.waitUntil(lambda: page.live_view.live is None)
    assert page.live_view.start_button.isVisible()
    assert page.camera is None


def test_choosing_a_file_ends_the_opening_of_a_camera(
    page: CapturePage, tmp_path: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    started, stopped = threading.Event(), threading.Event()

    def slow(_text: str, progress: Callable[[int, int], None]) -> None:
        started.set()
        try:
            for done in range(round(PATIENCE_S * 100)):
                progress(done, 0)
                time.sleep(0.01)
        except BaseException:  # whatever stops a task
            stopped.set()
            raise

    monkeypatch.setattr(live_view, "pool_camera", slow)
    page.live_view.start()
    qtbot.waitUntil(started.is_set)
    np.save(tmp_path / "stack.npy", np.zeros((3, 20, 30), np.uint8))
    page.take(tmp_path / "stack.npy")
    qtbot.waitUntil(lambda: page.preview is not None)
    assert stopped.wait(PATIENCE_S)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_found_cameras_can_be_chosen(
    window: MainWindow, page: CapturePage, qtbot: QtBot, monkeypatch
):
    result = [CameraInfo("uvc:0", "Microscope", "USB video")], ["Aravis is not installed"]
    monkeypatch.setattr(live_view, "find_cameras", lambda: result)
    page.live_view.find_button.click()
    qtbot.waitUntil(lambda: "1 camera found. Aravis is not installed" in log_of(window))
    assert page.live_view.camera.value() == SIMULATED
    page.live_view.camera.set_value("uvc:0")
    assert page.live_view.camera.value() == "uvc:0"


def test_added_camera_kind_can_be_used(page: CapturePage, qtbot: QtBot, monkeypatch):
    camera = SimulatedDevice("still", lambda _: np.full(SHAPE, 7, np.uint8))
    cameras = [CameraInfo("still:1", "Still picture", "a toy")]
    kind = CameraKind("still:NUMBER", lambda: cameras, lambda _: camera.open())
    monkeypatch.setattr("labapp.media.cameras.KINDS", [kind])
    page.live_view.find_button.click()
    qtbot.waitUntil(lambda: "still:1" in dict(page.live_view._choices))
    page.live_view.camera.set_value("still:1")
    assert page.live_view.camera.editor.currentText() == "Still picture (a toy)"
    page.live_view.start_button.click()
    qtbot.waitUntil(lambda: page.live_view.updates > 0)
    assert np.array_equal(page.picture_view.picture, np.full(SHAPE, 7))
    page.live_view.stop()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_choosing_a_file_stops_the_camera(page: CapturePage, tmp_path: Path, qtbot: QtBot):
    start(page, qtbot)
    path = tmp_path / "stack.npy"
    np.save(path, np.zeros((3, 20, 30), np.uint8))
    page.take(path)
    assert page.live_view.live is None
    qtbot.waitUntil(lambda: page.preview is not None)
    qtbot.waitUntil(lambda: np.shape(page.picture_view.picture) == (20, 30))


def test_live_page_is_accessible_by_keyboard_and_screen_reader(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    start(page, qtbot)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert QApplication.focusWidget() is page.live_view.bar.record_button
    reached = check_round(window)
    assert page.live_view.bar.record_button in reached
    assert page.live_view.camera_fields.fields["rate_hz"].editor in reached
    window.resize(911, 512)  # 1366 × 768 at 150 %
    let_draw()
    for button in window.findChildren(QAbstractButton):
        if button.isVisible() and button.text():
            assert button.width() >= button.sizeHint().width() - 1, button.text()
    assert window.page.live_view.bar.record_button.isVisible()
    # No state of the camera makes the window larger than the screen.
    for words in (*(words for _, words in STATES.values()), *WAITS.values()):
        page.live_view.bar.state.setText(f"▲ {words}, 1000.0 frames/s")
        let_draw()
        assert (window.width(), window.height()) == (911, 512), words


def test_record_buttons_do_not_overlap_on_a_small_screen(
    window: MainWindow, page: CapturePage, qtbot: QtBot
):
    start(page, qtbot)
    window.resize(683, 467)  # 1024 × 700 at 150 %
    let_draw()
    buttons = sorted(page.live_view.bar.findChildren(QAbstractButton), key=lambda each: each.x())
    assert len(buttons) == 3
    for left, right in pairwise(buttons):
        assert left.geometry().right() < right.x()
