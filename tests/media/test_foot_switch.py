"""Foot switches and 3-D controllers: reports as devices send them, and devices that fail."""

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
from labapp.media.devices.foot_switch import Action, FootSwitch, Learned, PedalMap, Pedals, learn
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
from tests.media.cameras.watching import Heard
from tests.media.pedals import AXES, INFINITY, KEYBOARD, MOUSE_3D, PCSENSOR, THREE, Device
from tests.waiting import wait_until

ROOT = Path(__file__).parents[2]

NUMBERED = KEYBOARD[:6] + b"\x85\x01" + KEYBOARD[6:]  # with a report number


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try again at once."""
    monkeypatch.setattr(hid, "RETRY_S", 0.01)
    monkeypatch.setattr(hid, "WAIT_MS", 10)
    monkeypatch.setattr(space_mouse, "RETRY_S", 0.01)


def switch(device: Device, info: HidInfo, do, say, **actions: int) -> FootSwitch:
    pedals = PedalMap(info.key, info.name, info.is_keyboard, {v: k for k, v in actions.items()})
    return FootSwitch(pedals, do, say, lambda: [info] if device.plugged else [], device.open)


# --- reports ------------------------------------------------------------------------------------


def test_a_report_begins_with_a_number_only_where_the_device_says_so() -> None:
    assert not has_numbers(KEYBOARD)
    assert has_numbers(NUMBERED)
    assert not has_numbers(THREE)
    # 0x85 amid the data of another item, short and long.
    assert not has_numbers(bytes.fromhex("268501") + KEYBOARD)
    assert not has_numbers(bytes.fromhex("fe020085 85") + KEYBOARD)
    assert not has_numbers(b"\x27\x85")  # cut off


def test_pedals_of_an_infinity() -> None:
    pedals = Pedals(keyboard=False)
    told = [pedals.pressed(0, bytes.fromhex(r)) for r in "0100 0100 0000 0200 0600 0400".split()]
    assert [sorted(new) for new in told] == [[0], [], [], [1], [2], []]


def test_pedals_that_are_keys() -> None:
    pedals = Pedals(keyboard=True)
    reports = (
        "0000050000000000",  # b
        "0000050600000000",  # b and c
        "0000060000000000",  # c, in b's place: not pressed anew
        "0000000000000000",
        "0100050000000000",  # Ctrl+b
        "0000010101010101",  # too many keys: an error, no key
    )
    told = [sorted(pedals.pressed(0, bytes.fromhex(report))) for report in reports]
    assert told == [[5], [6], [], [], [5, 0xE0], []]


def test_what_is_set_by_no_pedal_counts_once_and_no_more() -> None:
    joystick = Pedals(keyboard=False)
    assert joystick.pressed(2, bytes.fromhex("7f7f00"))  # axes at rest, seen first
    assert not joystick.pressed(2, bytes.fromhex("7f7f00"))
    (pedal,) = joystick.pressed(2, bytes.fromhex("7f7f01"))
    joystick.pressed(3, bytes.fromhex("00"))  # another kind of report tells nothing of it
    assert not joystick.pressed(2, bytes.fromhex("7f7f01"))
    joystick.pressed(-1, b"")
    assert pedal in joystick.pressed(2, bytes.fromhex("7f7f01"))


# --- in use -------------------------------------------------------------------------------------


def test_pedals_do_what_they_are_mapped_to() -> None:
    device, done, heard = Device(), [], Heard()
    with switch(device, INFINITY, done.append, heard.append, trigger=1, mark=0, next=2) as running:
        wait_until(lambda: running.connected)
        device.send("0200", "0000", "0100", "0000", "0400", "0000", "0800", "0000")
        wait_until(lambda: len(done) == 3)
    assert done == ["trigger", "mark", "next"]
    assert heard.words() == "note: VEC Infinity foot pedal: connected"


def test_a_pedal_that_bounces_was_pressed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foot_switch, "time", SimpleNamespace(monotonic=lambda: 100.0))
    device, done = Device(), []
    with switch(device, INFINITY, done.append, lambda _: None, mark=0, next=1):
        device.send("0100", "0000", "0100", "0000", "0200")
        wait_until(lambda: "next" in done)
    assert done == ["mark", "next"]


def test_a_pedal_that_bounces_when_it_is_let_go_was_pressed_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, done = 100.0, []
    monkeypatch.setattr(foot_switch, "time", SimpleNamespace(monotonic=lambda: now_s))
    device = Device()
    with switch(device, INFINITY, done.append, lambda _: None, mark=0, next=1) as running:
        running.stop()  # reports come from the test, at times of its own
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
    assert done == ["mark", "mark", "next"]


def test_a_numbered_keyboard_is_read_behind_its_number() -> None:
    device, done = Device(NUMBERED), []
    with switch(device, PCSENSOR, done.append, lambda _: None, trigger=5):
        device.send("010000050000000000", "010000000000000000")
        wait_until(lambda: done == ["trigger"])


def test_unplugged_and_plugged_in_again_it_goes_on_and_says_so() -> None:
    device, done, heard = Device(), [], Heard()
    with switch(device, INFINITY, done.append, heard.append, trigger=0) as running:
        for count in range(1, 6):
            wait_until(lambda: running.connected)
            device.send("0100")  # and pulled out while it is down
            wait_until(lambda count=count: len(done) == count)
            device.plugged = False
            wait_until(lambda: not running.connected)
            device.plugged = True
    assert done == ["trigger"] * 5
    assert device.opened >= 5
    assert heard.words().count("it was unplugged") == 5
    assert heard.words().count("connected after") >= 4


def test_what_a_pedal_does_may_fail_and_the_next_press_counts() -> None:
    device, done, heard = Device(), [], Heard()

    def do(action: Action) -> None:
        done.append(action)
        if action == "trigger":
            raise OSError("no room")  # not the pedal's
        raise InputError("run.nut", "recording", "is there already", "another name")

    with switch(device, INFINITY, do, heard.append, trigger=0, mark=1):
        device.send("0100", "0200", "0000")
        wait_until(lambda: len(heard) == 3)
    assert done == ["trigger", "mark"]
    assert device.opened == 1
    assert "failed: no room" in heard.words()
    assert "failed: run.nut: recording: is there already" in heard.words()


def test_one_that_is_not_there_is_said_once_and_waited_for() -> None:
    device, done, heard = Device(), [], Heard()
    device.plugged = False
    with switch(device, INFINITY, done.append, heard.append, trigger=0) as running:
        wait_until(lambda: len(heard) == 1)
        device.plugged = True
        wait_until(lambda: running.connected)
        device.send("0100")
        wait_until(lambda: done == ["trigger"])
    assert [event.words.partition(" after")[0] for event in heard] == [
        "it is not connected",
        "connected",
    ]


# --- learning -----------------------------------------------------------------------------------


def test_a_pedal_is_learned_by_pressing_it() -> None:
    infinity, keys = Device(), Device(KEYBOARD)
    devices = {INFINITY.path: infinity, PCSENSOR.path: keys}
    keys.send("0000050000000000")
    found = learn(
        threading.Event(), lambda: [MOUSE_3D, INFINITY, PCSENSOR], lambda i: devices[i.path]
    )
    assert found == Learned(PCSENSOR, 5)
    pedals = found.mapped("trigger").with_action(6, "mark").with_action(7, "trigger")
    assert pedals.actions == {5: "trigger", 6: "mark", 7: "trigger"}
    assert pedals.with_action(5, "next").with_action(6, None).actions == {5: "next", 7: "trigger"}
    assert (pedals.device, pedals.keyboard) == ("3553:b001:0", True)


def test_a_mouse_that_is_moved_is_no_pedal_but_a_pedal_may_be_a_mouse() -> None:
    mouse = HidInfo("/dev/hidraw1", 0x046D, 0xC077, 0, (1, 2), "Some mouse")
    clicking = replace(PCSENSOR, usage=(1, 2))
    moved, pressed = Device(), Device()
    moved.send("0102", "0104")
    pressed.send("01000000")
    devices = {mouse.path: moved, PCSENSOR.path: pressed}
    found = learn(threading.Event(), lambda: [mouse, clicking], lambda i: devices[i.path])
    assert found == Learned(clicking, 0)
    assert moved.opened == 0


def test_learning_can_be_given_up_and_says_what_cannot_be_read() -> None:
    device, ending, told = Device(), threading.Event(), []

    def opened(info: HidInfo) -> Device:
        if info is PCSENSOR:
            raise HidError("may not be read")
        return device

    def tell(problems: list[str]) -> None:
        told.extend(problems)
        ending.set()

    assert learn(ending, lambda: [INFINITY, PCSENSOR], opened, tell) is None
    assert told == ["may not be read"]


def test_a_device_that_does_not_tell_what_it_sends_is_left_out_when_learning() -> None:
    class Mute(Device):
        def get_report_descriptor(self) -> list[int]:
            raise OSError("get_report_descriptor failed")

    device, told = Device(), []
    device.send("0200")
    devices = {INFINITY.path: device, PCSENSOR.path: Mute()}
    found = learn(
        threading.Event(), lambda: [PCSENSOR, INFINITY], lambda i: devices[i.path], told.extend
    )
    assert found == Learned(INFINITY, 1)
    assert told == ["PCsensor FootSwitch cannot be read: get_report_descriptor failed"]


def test_where_nothing_can_be_learned_it_is_said_why() -> None:
    device = Device()
    with pytest.raises(HidError, match="no foot switch is connected"):
        learn(threading.Event(), list)
    device.plugged = False
    with pytest.raises(HidError, match="Infinity foot pedal is not connected"):
        learn(threading.Event(), lambda: [INFINITY], device.open)
    with pytest.raises(HidError, match="was unplugged"):
        learn(threading.Event(), lambda: [INFINITY], lambda _: device)


def test_a_map_is_kept_and_read_again() -> None:
    pedals = PedalMap("05f3:00ff:0", "A pedal", False, {0: "trigger", 1: "mark"})
    assert PedalMap.from_dict(json.loads(json.dumps(pedals.as_dict()))) == pedals
    for wrong in (None, [], {}, {**pedals.as_dict(), "actions": {"x": "mark"}}):
        with pytest.raises(InputError, match="foot switch"):
            PedalMap.from_dict(wrong)
    with pytest.raises(InputError, match="one of trigger, mark, next"):
        PedalMap.from_dict({**pedals.as_dict(), "actions": {"0": "explode"}})


# --- the system -----------------------------------------------------------------------------------


def test_what_hidapi_lists_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_this_system_is_listed_without_a_fault() -> None:
    pytest.importorskip("hidraw")
    assert isinstance(find_hid(), list)
    with pytest.raises(HidError, match="is not connected"):
        open_hid(HidInfo("/dev/hidraw-none", 1, 2, 0, (1, 6), "No pedal"))


def test_which_rule_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = tmp_path / "hidraw7"
    node.touch()
    monkeypatch.setattr("os.access", lambda *_: False)
    known = HidInfo(str(node), 0x05F3, 0x00FF, 0, (12, 3), "VEC Infinity foot pedal")
    assert "resources/udev/70-labapp.rules /etc/udev/rules.d/" in why_closed(known)
    other = HidInfo(str(node), 0x1234, 0x00AB, 0, (1, 6), "Some pedal")
    rule = 'KERNEL=="hidraw*", ATTRS{idVendor}=="1234", ATTRS{idProduct}=="00ab", TAG+="uaccess"'
    assert f"echo '{rule}' | sudo tee -a /etc/udev/rules.d/70-labapp.rules" in why_closed(other)
    # Where the file of rules is not there, the rule is written, not copied.
    monkeypatch.setattr(hid, "bundled", tmp_path.joinpath)
    assert 'ATTRS{idVendor}=="05f3"' in commands(known)
    assert commands(known).startswith("echo '")


def test_the_commands_are_what_a_shell_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With sudo and udevadm that only say what they were given."""
    place = tmp_path / "a folder"
    (place / "resources" / "udev").mkdir(parents=True)
    (place / hid.RULES).write_text("a rule\n")
    monkeypatch.setattr(hid, "bundled", place.joinpath)
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


def test_the_rules_let_in_every_device_that_is_known() -> None:
    text = (ROOT / hid.RULES).read_text("utf-8")
    rule = re.compile(
        r'^KERNEL=="hidraw\*", ATTRS\{idVendor\}=="(\w{4})", '
        r'(?:ATTRS\{idProduct\}=="([\w\[\]-]+)", )?TAG\+="uaccess"$'
    )
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    ruled = {found.groups() for line in lines if (found := rule.match(line))}
    assert len(ruled) == len(lines)
    assert {(f"{vendor:04x}", f"{product:04x}") for vendor, product in hid.KNOWN} <= ruled
    assert ("256f", None) in ruled


# --- six axes -------------------------------------------------------------------------------------


def test_six_axes_in_two_reports() -> None:
    held = SixAxes().after(1, bytes.fromhex("5e01 51ff 0000"))
    assert (held.right, held.near, held.down) == (1.0, -0.5, 0.0)
    held = held.after(2, bytes.fromhex("0000 a2fe af00"))
    assert (held.pitch, held.roll, held.yaw) == (0.0, -1.0, 0.5)
    assert held.right == 1.0
    held = held.after(3, bytes.fromhex("0200"))
    assert held.buttons == {1}
    assert held.after(3, b"\0\0").buttons == frozenset()
    assert held.after(-1, b"") == SixAxes()


def test_six_axes_in_one_report_and_what_is_cut_off() -> None:
    held = SixAxes().after(1, bytes.fromhex("000000000000 af00 0000 ff7f"))
    assert (held.pitch, held.yaw) == (0.5, 1.0)
    assert held.after(1, b"\1\2") == held
    assert held.after(23, b"\x64") == held  # the battery


def test_a_3d_controller_is_read_whenever_it_is_plugged_in() -> None:
    mouse, held, heard = Device(AXES), [], Heard()
    mouse.plugged = False
    reader = SpaceMouse(
        held.append, heard.append, lambda: [MOUSE_3D] if mouse.plugged else [], mouse.open
    )
    wait_until(lambda: reader._reported == hid.AWAY)
    assert not heard  # most benches have none
    mouse.plugged = True
    wait_until(lambda: reader.connected)
    mouse.send("01 5e01 0000 0000", "01 5e01 0000 0000", "01 0000 0000 0000", "03 01")
    wait_until(lambda: len(held) == 3)
    assert [(each.right, each.buttons) for each in held] == [(1, set()), (0, set()), (0, {0})]
    mouse.plugged = False  # and pulled out while it is held
    wait_until(lambda: held[-1] == SixAxes())
    reader.stop()
    assert "it was unplugged" in heard.words()


def test_actions_are_those_that_the_types_name() -> None:
    from typing import get_args

    from labapp.media.devices.foot_switch import ACTIONS

    assert get_args(Action) == ACTIONS
