"""Foot switches in the window: learning, storing, pressing, unplugging, missing permissions."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QDialog
from pytestqt.qtbot import QtBot

from labapp.gui import foot_switches
from labapp.gui.foot_switches import DOES, FootSwitches, pedal_name
from labapp.gui.live import view as live_view
from labapp.gui.pages.capture.foot_switch import FootSwitchPanel
from labapp.gui.preferences import Preferences, read_preferences
from labapp.gui.shell.commands import make_window
from labapp.gui.shell.window import MainWindow
from labapp.media import open_source
from labapp.media.cameras import SimulatedDevice
from labapp.media.devices import foot_switch, hid
from labapp.media.devices.foot_switch import PedalMap
from labapp.media.devices.hid import HidInfo
from labapp.session.session import Session
from labapp.text import capitalized
from tests.gui.conftest import KEPT, CopySample, let_draw
from tests.gui.hand import Hand
from tests.gui.test_accessibility import check_round
from tests.media.pedals import INFINITY, KEYBOARD, MOUSE_3D, PCSENSOR, Bench, Device
from tests.waiting import PATIENCE_S

LEFT, MIDDLE, RIGHT = ("0100", "0000"), ("0200", "0000"), ("0400", "0000")
"""HID reports of the Infinity's pedals, pressed and released."""

LEARNED = PedalMap(INFINITY.key, INFINITY.name, False, {0: "trigger", 1: "mark", 2: "next"})


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """An Infinity and a PCsensor, both connected and readable."""
    devices = Bench({INFINITY: Device(), PCSENSOR: Device(KEYBOARD)})
    monkeypatch.setattr(hid, "find_hid", devices.find)
    monkeypatch.setattr(hid, "open_hid", devices.open)
    monkeypatch.setattr(hid, "may_be_read", lambda info: info not in devices.closed)
    monkeypatch.setattr(hid, "RETRY_S", 0.02)
    monkeypatch.setattr(hid, "WAIT_MS", 10)
    monkeypatch.setattr(foot_switches, "DEAF_S", 0.1)
    return devices


@pytest.fixture
def start(qapp: QApplication, tmp_path: Path, state: Path) -> Iterator[Callable[..., MainWindow]]:
    """Start the app with the stored preferences."""
    file, windows = tmp_path / "config" / "preferences.json", []

    def start_app(*maps: PedalMap) -> MainWindow:
        preferences, problem = read_preferences(file)
        assert not problem
        if maps:
            preferences = Preferences(foot_switches=tuple(each.as_dict() for each in maps))
        window = make_window(preferences, file)
        windows.append(window)
        KEPT.append(window)
        window.resize(1280, 760)
        window.show()
        window.activateWindow()
        return window

    yield start_app
    for window in windows:
        window.close()


def panel_of(window: MainWindow) -> FootSwitchPanel:
    window.show_step("capture")
    return window.page.foot_switch


def log_of(window: MainWindow) -> str:
    return "\n".join(window.log_panel.texts())


def connected(window: MainWindow, info: HidInfo = INFINITY) -> Callable[[], bool]:
    switches = window.workspace.foot_switches
    return lambda: info.key in switches.in_use and switches.in_use[info.key].switch.connected


def learn(window: MainWindow, bench: Bench, info: HidInfo, *reports: str, qtbot: QtBot) -> None:
    """Press Learn, and press a pedal as soon as the devices are read."""
    readers = len(bench.readers)
    Hand(window).button("Learn a pedal")
    qtbot.waitUntil(lambda: len(bench.readers) == readers + len(bench.devices))
    bench.press(info, *reports)
    qtbot.waitUntil(lambda: window.workspace.foot_switches.learned is not None)


# --- learning and storing -------------------------------------------------------------------------


def test_pedal_is_learned_by_pressing_it_and_stored(
    start, bench: Bench, copy_sample: CopySample, qtbot: QtBot
):
    window = start()
    window.files.open(copy_sample("thumb_tack"))
    panel, hand = panel_of(window), Hand(window)
    qtbot.waitUntil(window.isActiveWindow)
    assert panel.words.text().startswith("No foot switch is in use")
    learn(window, bench, INFINITY, *MIDDLE, qtbot=qtbot)
    assert panel.learned_words.text() == "VEC Infinity foot pedal: pedal 2 was pressed."
    assert panel.action.value() == "trigger"  # no pedal has this action yet
    hand.choose(panel.action, DOES["next"])
    hand.button("Apply")
    assert panel.learned.isHidden()
    qtbot.waitUntil(connected(window))
    qtbot.waitUntil(lambda: panel.words.text() == "● VEC Infinity foot pedal: connected")
    learn(window, bench, PCSENSOR, "0000050000000000", "0000000000000000", qtbot=qtbot)
    assert panel.learned_words.text() == "PCsensor FootSwitch: key B was pressed."
    hand.button("Apply")
    qtbot.waitUntil(connected(window, PCSENSOR))
    assert [field.value() for field in panel.pedals.values()] == ["next", "trigger"]
    stored = read_preferences(window.preferences.path)[0].foot_switches
    maps = [PedalMap.from_dict(each) for each in stored]
    assert maps == [
        PedalMap("05f3:00ff:0", "VEC Infinity foot pedal", False, {1: "next"}),
        PedalMap("3553:b001:0", "PCsensor FootSwitch", True, {5: "trigger"}),
    ]
    window.close()
    # At the next start it is in use at once.
    again = start()
    again.files.open(copy_sample("concave"))
    qtbot.waitUntil(connected(again))
    again.show_step("setup")
    bench.press(INFINITY, *MIDDLE)
    qtbot.waitUntil(lambda: again.page.key == "laser")


def test_press_while_learning_triggers_no_action(
    start, bench: Bench, copy_sample: CopySample, qtbot: QtBot
):
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel = panel_of(window)
    qtbot.waitUntil(connected(window))
    learn(window, bench, INFINITY, *RIGHT, qtbot=qtbot)
    assert panel.action.value() == "next"  # its present action
    qtbot.wait(150)
    assert window.page.key == "capture"
    Hand(window).button("Discard")
    bench.press(INFINITY, *RIGHT)
    qtbot.waitUntil(lambda: window.page.key == "dots")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_pedal_actions_can_be_changed_and_removed(start, bench: Bench, copy_sample, qtbot):
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel, hand = panel_of(window), Hand(window)
    qtbot.waitUntil(connected(window))
    key = INFINITY.key
    hand.choose(panel.pedals[key, 0], DOES["next"])
    assert [field.value() for field in panel.pedals.values()] == ["next", "mark", "next"]
    bench.press(INFINITY, *LEFT)
    qtbot.waitUntil(lambda: window.page.key == "dots")
    window.show_step("capture")
    for pedal in (0, 1, 2):
        hand.choose(panel.pedals[key, pedal], "no action")
        qtbot.waitUntil(lambda pedal=pedal: (key, pedal) not in panel.pedals)
    assert window.workspace.foot_switches.in_use == {}
    assert read_preferences(window.preferences.path)[0].foot_switches == ()
    assert panel.words.text().startswith("No foot switch is in use")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_learning_a_pedal_can_be_cancelled(start, bench: Bench, copy_sample, qtbot: QtBot):
    window = start()
    window.files.open(copy_sample("thumb_tack"))
    panel, hand = panel_of(window), Hand(window)
    hand.button("Learn a pedal")
    assert "Step on the pedal" in panel.learned_words.text()
    hand.button("Stop waiting")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert panel.learned_words.isHidden()
    hand.button("Learn a pedal")
    window.do("close")  # closes the session and cancels its tasks
    assert not window.workspace.foot_switches.learns


# --- pressing -------------------------------------------------------------------------------------


def test_pedals_control_the_live_recording_on_any_page(
    start, bench: Bench, tmp_path: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    film = SimulatedDevice("test", lambda k: np.full((24, 32), k % 200, np.uint8), rate_hz=100)
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: film)
    window = start(LEARNED)
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    qtbot.waitUntil(connected(window))
    window.show_step("capture")
    view = window.page.live_view
    view.start()
    qtbot.waitUntil(lambda: view.updates > 2)
    window.show_step("setup")
    bench.press(INFINITY, *LEFT)
    qtbot.waitUntil(lambda: view.live.running is not None)
    take = view.live.running
    bench.press(INFINITY, *MIDDLE)
    qtbot.waitUntil(lambda: take.frames > 20)
    bench.press(INFINITY, *RIGHT)
    qtbot.waitUntil(lambda: window.page.key == "laser")
    assert view.live.running is take
    bench.press(INFINITY, *LEFT)
    session = window.workspace.session
    qtbot.waitUntil(lambda: session.recording is not None)
    assert "marked by hand" in take.notes.read_text()
    assert len(session.frames) == take.frames
    assert window.page.key == "laser"
    with open_source(take.path) as video:
        levels = [int(frame.image[0, 0]) for frame in video]
    assert set(np.diff(levels) % 200) == {1}
    # Ctrl+K marks as well, but there is nothing to mark now.
    Hand(window).press(Qt.Key.Key_K, Qt.KeyboardModifier.ControlModifier)
    assert "Nothing is being recorded" in log_of(window)
    view.stop()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    bench.press(INFINITY, *LEFT)
    qtbot.waitUntil(lambda: "No camera is live: start one in the step" in log_of(window))


def test_pedals_wait_while_a_dialog_is_open(
    start, bench: Bench, copy_sample, qtbot, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(foot_switch, "BOUNCE_S", 0.0)  # pressed twice in quick succession
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel_of(window)
    qtbot.waitUntil(connected(window))
    question = QDialog(window)
    question.open()
    bench.press(INFINITY, *RIGHT)
    qtbot.waitUntil(lambda: "when the question is answered" in log_of(window))
    assert window.page.key == "capture"
    question.close()
    bench.press(INFINITY, *RIGHT)
    qtbot.waitUntil(lambda: window.page.key == "dots")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_unplugging_is_reported_and_reconnecting_is_automatic(
    start, bench: Bench, copy_sample, qtbot
):
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel = panel_of(window)
    qtbot.waitUntil(connected(window))
    unplugged = "▲ VEC Infinity foot pedal: not connected. It works again once it is plugged in"
    for count in (1, 2):
        bench.devices[INFINITY].plugged = False
        qtbot.waitUntil(lambda: panel.words.text() == unplugged)
        assert window.status_line.unread == ["VEC Infinity foot pedal: it was unplugged"]
        bench.devices[INFINITY].plugged = True
        qtbot.waitUntil(lambda: panel.words.text().startswith("● VEC"))
        window.status_line.mark_read()
        window.show_step("capture")
        bench.press(INFINITY, *RIGHT)
        qtbot.waitUntil(lambda: window.page.key == "dots")
        assert log_of(window).count("connected after") == count
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_foot_switch_missing_at_start_is_no_problem(start, bench: Bench, qtbot: QtBot):
    bench.devices[INFINITY].plugged = False
    window = start(LEARNED)
    qtbot.waitUntil(lambda: "VEC Infinity foot pedal: it is not connected" in log_of(window))
    assert window.status_line.unread == []
    bench.devices[INFINITY].plugged = True
    qtbot.waitUntil(connected(window))


# --- errors ---------------------------------------------------------------------------------------


def test_missing_permission_offers_the_udev_rule_to_copy(
    start, bench: Bench, copy_sample: CopySample, qtbot: QtBot
):
    other = replace(PCSENSOR, path="/dev/hidraw9", vendor=0x1234, product=0xAB, name="Odd pedal")
    bench.devices[other] = Device()
    bench.closed = {other, INFINITY}
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel, hand = panel_of(window), Hand(window)
    # Missing permission is a problem, and the remedy is shown without a request.
    qtbot.waitUntil(lambda: bool(window.status_line.unread))
    qtbot.waitUntil(panel.rights.isVisible)
    assert "▲ No permission to read: VEC Infinity foot pedal." in panel.words.text()
    assert "Found: PCsensor FootSwitch." in panel.words.text()
    hand.button("Copy the commands")
    copied = QApplication.clipboard().text()
    assert copied.startswith("sudo cp ")
    assert copied.endswith(
        "resources/udev/70-labapp.rules /etc/udev/rules.d/ && sudo udevadm control --reload"
    )
    hand.choose(panel.closed, "Odd pedal")
    hand.button("Copy the commands")
    assert 'ATTRS{idVendor}=="1234", ATTRS{idProduct}=="00ab"' in QApplication.clipboard().text()
    bench.closed.clear()  # the rule is installed, and the device was plugged in again
    qtbot.waitUntil(connected(window))
    hand.button("Find devices")
    qtbot.waitUntil(panel.rights.isHidden)


def test_missing_foot_switch_is_reported(start, bench: Bench, copy_sample, qtbot: QtBot):
    bench.devices.clear()
    window = start()
    window.files.open(copy_sample("thumb_tack"))
    panel, hand = panel_of(window), Hand(window)
    hand.button("Find devices")
    qtbot.waitUntil(lambda: "No known foot switch" in panel.words.text())
    hand.button("Learn a pedal")
    with pytest.raises(hid.HidError) as why:
        foot_switch.learn(threading.Event(), list)
    qtbot.waitUntil(lambda: window.status_line.unread == [capitalized(str(why.value))])
    assert window.status_line.unread[0][0].isupper()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert panel.learn_button.text() == "Learn a pedal"


def test_missing_hidapi_is_reported(start, copy_sample: CopySample, qtbot: QtBot, monkeypatch):
    def missing() -> None:
        raise hid.HidError(hid.MISSING)

    monkeypatch.setattr(hid, "find_hid", missing)
    window = start()
    window.files.open(copy_sample("thumb_tack"))
    panel = panel_of(window)
    Hand(window).button("Find devices")
    qtbot.waitUntil(lambda: "hidapi is needed" in panel.words.text())


def test_devices_are_not_searched_before_a_pedal_is_learned(start, copy_sample, monkeypatch, qtbot):
    searches = []
    monkeypatch.setattr(hid, "find_hid", lambda: searches.append(1) or [])
    threads = {thread.name for thread in threading.enumerate()}
    window = start()
    window.files.open(copy_sample("thumb_tack"))
    panel_of(window)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert not searches
    assert not window.workspace.foot_switches._timer.isActive()
    assert {thread.name for thread in threading.enumerate()} <= threads


def test_damaged_pedal_preferences_are_reported(start, bench: Bench, qtbot: QtBot):
    window = start(LEARNED)
    window.close()
    file = window.preferences.path
    stored = json.loads(file.read_text())
    assert [each["device"] for each in stored["foot_switches"]] == [INFINITY.key]
    stored["foot_switches"].insert(0, {"device": "x", "actions": {"0": "explode"}})
    file.write_text(json.dumps(stored))
    again = start()
    assert "A foot switch must be learned again" in log_of(again)
    qtbot.waitUntil(connected(again))


def test_slow_device_search_does_not_block_the_window(
    start, bench: Bench, copy_sample: CopySample, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    answer = threading.Event()

    def slow() -> list[HidInfo]:
        answer.wait(PATIENCE_S)
        return list(bench.find())

    monkeypatch.setattr(hid, "find_hid", slow)
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel = panel_of(window)
    panel.look_button.click()
    panel.learn_button.click()
    assert panel.words.text().startswith("○ VEC Infinity foot pedal: being looked for")
    assert panel.learn_button.text() == "Stop waiting"
    window.show_step("setup")
    assert window.page.key == "setup"
    panel.learn_button.click()
    answer.set()
    qtbot.waitUntil(connected(window))
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


# --- display --------------------------------------------------------------------------------------


def test_panel_is_accessible_by_keyboard_and_screen_reader(
    start, bench: Bench, copy_sample: CopySample, qtbot: QtBot
):
    bench.devices[MOUSE_3D] = Device()
    bench.closed = {MOUSE_3D}
    window = start(LEARNED)
    window.files.open(copy_sample("thumb_tack"))
    panel = panel_of(window)
    qtbot.waitUntil(connected(window))
    panel.look_button.click()
    qtbot.waitUntil(panel.rights.isVisible)
    bench.devices.pop(MOUSE_3D)
    learn(window, bench, PCSENSOR, "0000050000000000", "0000000000000000", qtbot=qtbot)
    qtbot.waitUntil(lambda: window.isActiveWindow() and not window.workspace.tasks.active)
    reached = check_round(window)
    expected = [each.editor for each in panel.pedals.values()]
    expected += [panel.action.editor, panel.use_button, panel.copy_button, panel.commands]
    assert set(expected) <= set(reached)
    window.resize(911, 512)  # 1366 × 768 at 150 %
    let_draw()
    area = window.side_panel.stack.currentWidget()
    assert area.horizontalScrollBar().maximum() == 0


@pytest.mark.parametrize(
    ("number", "keyboard", "name"),
    [
        (0, False, "pedal 1"),
        (2, False, "pedal 3"),
        (512, False, "pedal 1"),
        (5, True, "key B"),
        (30, True, "key 1"),
        (58, True, "key F1"),
        (104, True, "key F13"),
        (0xE0, True, "key number 224"),
    ],
)
def test_pedal_names(number: int, keyboard: bool, name: str):
    assert pedal_name(number, keyboard) == name


def test_proposed_action_is_one_not_yet_used(qapp: QApplication):
    from labapp.gui.tasks import Tasks
    from labapp.media.devices.foot_switch import Learned

    tasks = Tasks()
    switches = FootSwitches(tasks)
    switches.learned = Learned(PCSENSOR, 5)
    assert switches.proposed == "trigger"
    switches.stop()
