"""Foot switches and 3-D controllers: recorded reports, and devices that fail."""

from __future__ import annotations

import json
import re
import subprocess
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from labapp.errors import InputError
from labapp.media.devices import foot_switch, hid, space_mouse
from labapp.media.devices.foot_switch import (
    FootSwitch,
    Learned,
    PedalAction,
    PedalMap,
    Pedals,
    learn,
)
from labapp.media.devices.hid import (
    HidError,
    HidInfo,
    commands,
    find_hid,
    has_numbers,
    open_hid,
    why_closed,
)
from labapp.media.devices.space_mouse import SixAxes, SpaceMouse
from tests.media.cameras.watching import Events
from tests.media.pedals import AXES, INFINITY, KEYBOARD, MOUSE_3D, PCSENSOR, THREE, Device
from tests.waiting import wait_until

ROOT = Path(__file__).parents[2]

NUMBERED = KEYBOARD[:6] + b"\x85\x01" + KEYBOARD[6:]  # with a report number


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time between retries."""
    monkeypatch.setattr(hid, "RETRY_S", 0.01)
    monkeypatch.setattr(hid, "WAIT_MS", 10)
    monkeypatch.setattr(space_mouse, "RETRY_S", 0.01)


def switch(device: Device, info: HidInfo, do, report, **actions: int) -> FootSwitch:
    pedals = PedalMap(info.key, info.name, info.is_keyboard, {v: k for k, v in actions.items()})
    return FootSwitch(pedals, do, report, lambda: [info] if device.plugged else [], device.open)


# --- reports ------------------------------------------------------------------------------------


def test_report_number_is_detected_from_the_descriptor() -> None:
    assert not has_numbers(KEYBOARD)
    assert has_numbers(NUMBERED)
    assert not has_numbers(THREE)
    # 0x85 within the data of another item, short and long.
    assert not has_numbers(bytes.fromhex("268501") + KEYBOARD)
    assert not has_numbers(bytes.fromhex("fe020085 85") + KEYBOARD)
    assert not has_numbers(b"\x27\x85")  # truncated


def test_pedals_of_an_infinity_are_decoded() -> None:
    pedals = Pedals(keyboard=False)
    pressed = [pedals.pressed(0, bytes.fromhex(r)) for r in "0100 0100 0000 0200 0600 0400".split()]
    assert [sorted(new) for new in pressed] == [[0], [], [], [1], [2], []]


def test_pedals_of_a_keyboard_are_decoded() -> None:
    pedals = Pedals(keyboard=True)
    reports = (
        "0000050000000000",  # b
        "0000050600000000",  # b and c
        "0000060000000000",  # c, in place of b: not pressed again
        "0000000000000000",
        "0100050000000000",  # Ctrl+b
        "0000010101010101",  # too many keys: an error, no key
    )
    pressed = [sorted(pedals.pressed(0, bytes.fromhex(report))) for report in reports]
    assert pressed == [[5], [6], [], [], [5, 0xE0], []]


def test_constant_bits_of_a_report_count_once() -> None:
    joystick = Pedals(keyboard=False)
    assert joystick.pressed(2, bytes.fromhex("7f7f00"))  # axes at rest, seen first
    assert not joystick.pressed(2, bytes.fromhex("7f7f00"))
    (pedal,) = joystick.pressed(2, bytes.fromhex("7f7f01"))
    joystick.pressed(3, bytes.fromhex("00"))  # a report of another number does not change it
    assert not joystick.pressed(2, bytes.fromhex("7f7f01"))
    joystick.pressed(-1, b"")
    assert pedal in joystick.pressed(2, bytes.fromhex("7f7f01"))


# --- in use -------------------------------------------------------------------------------------


def test_pedals_trigger_their_actions() -> None:
    device, actions, events = Device(), [], Events()
    with switch(
        device, INFINITY, actions.append, events.append, trigger=1, mark=0, next=2
    ) as running:
        wait_until(lambda: running.connected)
        device.send("0200", "0000", "0100", "0000", "0400", "0000", "0800", "0000")
        wait_until(lambda: len(actions) == 3)
    assert actions == ["trigger", "mark", "next"]
    assert events.words() == "note: VEC Infinity foot pedal: connected"


def test_bouncing_pedal_is_pressed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foot_switch, "time", SimpleNamespace(monotonic=lambda: 100.0))
    device, actions = Device(), []
    with switch(device, INFINITY, actions.append, lambda _: None, mark=0, next=1):
        device.send("0100", "0000", "0100", "0000", "0200")
        wait_until(lambda: "next" in actions)
    assert actions == ["mark", "next"]


def test_pedal_that_bounces_on_release_is_pressed_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, actions = 100.0, []
    monkeypatch.setattr(foot_switch, "time", SimpleNamespace(monotonic=lambda: now_s))
    device = Device()
    with switch(device, INFINITY, actions.append, lambda _: None, mark=0, next=1) as running:
        running.stop()  # the test itself sends reports at defined times
        for pause_s, report in (
            (0.0, "0100"),
            (0.5, "0000"),
            (0.004, "0100"),
            (0.004, "0000"),
            (0.06, "0100"),
            (0.5, "0200"),
        ):
            now_s += pause_s
            running.on_report(0, bytes.fromhex(report))
    assert actions == ["mark", "mark", "next"]


def test_numbered_keyboard_report_is_decoded() -> None:
    device, actions = Device(NUMBERED), []
    with switch(device, PCSENSOR, actions.append, lambda _: None, trigger=5):
        device.send("010000050000000000", "010000000000000000")
        wait_until(lambda: actions == ["trigger"])


def test_foot_switch_reconnects_and_reports_it() -> None:
    device, actions, events = Device(), [], Events()
    with switch(device, INFINITY, actions.append, events.append, trigger=0) as running:
        for count in range(1, 6):
            wait_until(lambda: running.connected)
            device.send("0100")  # unplugged while it is pressed
            wait_until(lambda count=count: len(actions) == count)
            device.plugged = False
            wait_until(lambda: not running.connected)
            device.plugged = True
    assert actions == ["trigger"] * 5
    assert device.opened >= 5
    assert events.words().count("it was unplugged") == 5
    assert events.words().count("connected after") >= 4


def test_failed_action_does_not_stop_the_foot_switch() -> None:
    device, actions, events = Device(), [], Events()

    def do(action: PedalAction) -> None:
        actions.append(action)
        if action == "trigger":
            raise OSError("no room")  # not an error of the pedal
        raise InputError("run.nut", "recording", "is there already", "another name")

    with switch(device, INFINITY, do, events.append, trigger=0, mark=1):
        device.send("0100", "0200", "0000")
        wait_until(lambda: len(events) == 3)
    assert actions == ["trigger", "mark"]
    assert device.opened == 1
    assert "failed: no room" in events.words()
    assert "failed: run.nut: recording: is there already" in events.words()


def test_missing_foot_switch_is_reported_once_and_awaited() -> None:
    device, actions, events = Device(), [], Events()
    device.plugged = False
    with switch(device, INFINITY, actions.append, events.append, trigger=0) as running:
        wait_until(lambda: len(events) == 1)
        device.plugged = True
        wait_until(lambda: running.connected)
        device.send("0100")
        wait_until(lambda: actions == ["trigger"])
    assert [event.words.partition(" after")[0] for event in events] == [
        "it is not connected",
        "connected",
    ]


# --- learning -----------------------------------------------------------------------------------


def test_pedal_is_learned_by_pressing_it() -> None:
    infinity, keys = Device(), Device(KEYBOARD)
    devices = {INFINITY.path: infinity, PCSENSOR.path: keys}
    keys.send("0000050000000000")
    learned = learn(
        threading.Event(), lambda: [MOUSE_3D, INFINITY, PCSENSOR], lambda i: devices[i.path]
    )
    assert learned == Learned(PCSENSOR, 5)
    pedals = learned.mapped("trigger").with_action(6, "mark").with_action(7, "trigger")
    assert pedals.actions == {5: "trigger", 6: "mark", 7: "trigger"}
    assert pedals.with_action(5, "next").with_action(6, None).actions == {5: "next", 7: "trigger"}
    assert (pedals.device, pedals.keyboard) == ("3553:b001:0", True)


def test_mouse_is_ignored_unless_it_is_a_known_pedal() -> None:
    mouse = HidInfo("/dev/hidraw1", 0x046D, 0xC077, 0, (1, 2), "Some mouse")
    clicking = replace(PCSENSOR, usage=(1, 2))
    moved, pressed = Device(), Device()
    moved.send("0102", "0104")
    pressed.send("01000000")
    devices = {mouse.path: moved, PCSENSOR.path: pressed}
    learned = learn(threading.Event(), lambda: [mouse, clicking], lambda i: devices[i.path])
    assert learned == Learned(clicking, 0)
    assert moved.opened == 0


def test_learning_can_be_cancelled_and_reports_unreadable_devices() -> None:
    device, ending, reported = Device(), threading.Event(), []

    def open_device(info: HidInfo) -> Device:
        if info is PCSENSOR:
            raise HidError("may not be read")
        return device

    def report(problems: list[str]) -> None:
        reported.extend(problems)
        ending.set()

    assert learn(ending, lambda: [INFINITY, PCSENSOR], open_device, report) is None
    assert reported == ["may not be read"]


def test_learning_skips_a_device_without_a_descriptor() -> None:
    class NoDescriptor(Device):
        def get_report_descriptor(self) -> list[int]:
            raise OSError("get_report_descriptor failed")

    device, problems = Device(), []
    device.send("0200")
    devices = {INFINITY.path: device, PCSENSOR.path: NoDescriptor()}
    learned = learn(
        threading.Event(), lambda: [PCSENSOR, INFINITY], lambda i: devices[i.path], problems.extend
    )
    assert learned == Learned(INFINITY, 1)
    assert problems == ["PCsensor FootSwitch cannot be read: get_report_descriptor failed"]


def test_reason_why_nothing_can_be_learned() -> None:
    device = Device()
    with pytest.raises(HidError, match="no foot switch is connected"):
        learn(threading.Event(), list)
    device.plugged = False
    with pytest.raises(HidError, match="Infinity foot pedal is not connected"):
        learn(threading.Event(), lambda: [INFINITY], device.open)
    with pytest.raises(HidError, match="was unplugged"):
        learn(threading.Event(), lambda: [INFINITY], lambda _: device)


def test_map_of_pedals_is_restored_from_json() -> None:
    pedals = PedalMap("05f3:00ff:0", "A pedal", False, {0: "trigger", 1: "mark"})
    assert PedalMap.from_dict(json.loads(json.dumps(pedals.as_dict()))) == pedals
    for wrong in (None, [], {}, {**pedals.as_dict(), "actions": {"x": "mark"}}):
        with pytest.raises(InputError, match="foot switch"):
            PedalMap.from_dict(wrong)
    with pytest.raises(InputError, match="one of trigger, mark, next"):
        PedalMap.from_dict({**pedals.as_dict(), "actions": {"0": "explode"}})


# --- the system -----------------------------------------------------------------------------------


def test_devices_listed_by_hidapi_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Listing:
        @staticmethod
        def enumerate() -> list[dict[str, object]]:
            mouse: dict[str, object] = {
                "path": b"/dev/hidraw0",
                "vendor_id": 0x046D,
                "product_id": 0xC077,
                "interface_number": 0,
                "usage_page": 1,
                "usage": 2,
                "manufacturer_string": "Logitech",
                "product_string": "USB Optical Mouse",
            }
            pedal = mouse | {"path": b"/dev/hidraw4", "vendor_id": 0x05F3, "product_id": 0xFF}
            pedal["usage"] = 6
            nameless = mouse | {"manufacturer_string": None, "product_string": None}
            return [mouse, nameless, pedal]

    monkeypatch.setattr(hid, "_hidraw", Listing)
    names = [info.name for info in find_hid()]
    assert names == ["VEC Infinity foot pedal", "Logitech USB Optical Mouse", "046d:c077"]
    assert find_hid()[0].is_keyboard


def test_devices_of_this_system_are_listed_without_errors() -> None:
    pytest.importorskip("hidraw")
    assert isinstance(find_hid(), list)
    with pytest.raises(HidError, match="is not connected"):
        open_hid(HidInfo("/dev/hidraw-none", 1, 2, 0, (1, 6), "No pedal"))


def test_missing_udev_rule_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = tmp_path / "hidraw7"
    node.touch()
    monkeypatch.setattr("os.access", lambda *_: False)
    known = HidInfo(str(node), 0x05F3, 0x00FF, 0, (12, 3), "VEC Infinity foot pedal")
    assert "resources/udev/70-labapp.rules /etc/udev/rules.d/" in why_closed(known)
    other = HidInfo(str(node), 0x1234, 0x00AB, 0, (1, 6), "Some pedal")
    rule = 'KERNEL=="hidraw*", ATTRS{idVendor}=="1234", ATTRS{idProduct}=="00ab", TAG+="uaccess"'
    assert f"echo '{rule}' | sudo tee -a /etc/udev/rules.d/70-labapp.rules" in why_closed(other)
    # Without the file of rules, the rule is written instead of copied.
    monkeypatch.setattr(hid, "bundled", tmp_path.joinpath)
    assert 'ATTRS{idVendor}=="05f3"' in commands(known)
    assert commands(known).startswith("echo '")


def test_commands_for_the_rules_run_in_a_shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With replacements for sudo and udevadm."""
    folder = tmp_path / "a folder"
    (folder / "resources" / "udev").mkdir(parents=True)
    (folder / hid.RULES).write_text("a rule\n")
    monkeypatch.setattr(hid, "bundled", folder.joinpath)
    monkeypatch.setattr(hid, "RULES_FOLDER", f"{tmp_path}/")
    for info in (INFINITY, replace(INFINITY, vendor=0x1234)):
        subprocess.run(
            ["/bin/sh", "-ec", f'sudo() {{ [ "$1" = udevadm ] || "$@"; }}; {commands(info)}'],
            check=True,
            capture_output=True,
        )
    lines = (tmp_path / "70-labapp.rules").read_text().splitlines()
    assert lines == [
        "a rule",
        'KERNEL=="hidraw*", ATTRS{idVendor}=="1234", ATTRS{idProduct}=="00ff", TAG+="uaccess"',
    ]


def test_rules_allow_every_known_device() -> None:
    text = (ROOT / hid.RULES).read_text("utf-8")
    rule = re.compile(
        r'^KERNEL=="hidraw\*", ATTRS\{idVendor\}=="(\w{4})", '
        r'(?:ATTRS\{idProduct\}=="([\w\[\]-]+)", )?TAG\+="uaccess"$'
    )
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    allowed = {matched.groups() for line in lines if (matched := rule.match(line))}
    assert len(allowed) == len(lines)
    assert {(f"{vendor:04x}", f"{product:04x}") for vendor, product in hid.KNOWN} <= allowed
    assert ("256f", None) in allowed


# --- six axes -------------------------------------------------------------------------------------


def test_six_axes_in_two_reports_are_decoded() -> None:
    axes = SixAxes().after(1, bytes.fromhex("5e01 51ff 0000"))
    assert (axes.right, axes.near, axes.down) == (1.0, -0.5, 0.0)
    axes = axes.after(2, bytes.fromhex("0000 a2fe af00"))
    assert (axes.pitch, axes.roll, axes.yaw) == (0.0, -1.0, 0.5)
    assert axes.right == 1.0
    axes = axes.after(3, bytes.fromhex("0200"))
    assert axes.buttons == {1}
    assert axes.after(3, b"\0\0").buttons == frozenset()
    assert axes.after(-1, b"") == SixAxes()


def test_six_axes_in_one_report_and_truncated_reports() -> None:
    axes = SixAxes().after(1, bytes.fromhex("000000000000 af00 0000 ff7f"))
    assert (axes.pitch, axes.yaw) == (0.5, 1.0)
    assert axes.after(1, b"\1\2") == axes
    assert axes.after(23, b"\x64") == axes  # the battery


def test_3d_controller_is_read_when_it_is_plugged_in() -> None:
    mouse, received, events = Device(AXES), [], Events()
    mouse.plugged = False
    reader = SpaceMouse(
        received.append, events.append, lambda: [MOUSE_3D] if mouse.plugged else [], mouse.open
    )
    wait_until(lambda: reader._reported == hid.AWAY)
    assert not events  # most benches do not have one
    mouse.plugged = True
    wait_until(lambda: reader.connected)
    mouse.send("01 5e01 0000 0000", "01 5e01 0000 0000", "01 0000 0000 0000", "03 01")
    wait_until(lambda: len(received) == 3)
    assert [(axes.right, axes.buttons) for axes in received] == [(1, set()), (0, set()), (0, {0})]
    mouse.plugged = False  # unplugged while it is deflected
    wait_until(lambda: received[-1] == SixAxes())
    reader.stop()
    assert "it was unplugged" in events.words()


def test_actions_agree_with_their_type() -> None:
    from typing import get_args

    from labapp.media.devices.foot_switch import ACTIONS

    assert get_args(PedalAction) == ACTIONS
