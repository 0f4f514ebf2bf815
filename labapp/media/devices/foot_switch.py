"""Foot switches: detection of pedals, and their actions."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from labapp.errors import InputError
from labapp.media.devices.hid import (
    LONGEST,
    Find,
    HidDevice,
    HidError,
    HidInfo,
    HidReader,
    Open,
    find_hid,
    has_numbers,
    open_hid,
)
from labapp.media.events import OnEvent, ignore_event

PedalAction = Literal["trigger", "mark", "next"]
"""Trigger a recording, mark the frame, or go to the next step."""

ACTIONS: tuple[PedalAction, ...] = ("trigger", "mark", "next")

BOUNCE_S = 0.05
"""Time for debouncing: a pedal pressed again within it counts once, s."""

GLANCE_MS = 10
"""Time for which each device is polled in turn by `learn`, ms."""

MODIFIERS = 0xE0
"""The first of the keys that a keyboard sends as bits (Ctrl, Shift …)."""


@dataclass(frozen=True)
class PedalMap:
    """A foot switch and the actions of its pedals."""

    device: str
    """Its `HidInfo.key`."""
    name: str
    keyboard: bool
    """Whether it sends keys."""
    actions: Mapping[int, PedalAction] = field(default_factory=dict)
    """Number of a pedal → its action."""

    def with_action(self, pedal: int, action: PedalAction | None) -> PedalMap:
        """Return a copy with another action of a pedal; None: no action."""
        actions = {key: value for key, value in self.actions.items() if key != pedal}
        if action is not None:
            actions[pedal] = action
        return replace(self, actions=actions)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for the preferences."""
        actions = {str(pedal): action for pedal, action in self.actions.items()}
        return {**vars(self), "actions": actions}

    @classmethod
    def from_dict(cls, values: Any) -> PedalMap:
        """Create from the result of `as_dict`.

        Raises
        ------
        InputError
            If the values are invalid.
        """
        try:
            actions = {int(pedal): action for pedal, action in values["actions"].items()}
            texts = str(values["device"]), str(values["name"])
            keyboard = bool(values["keyboard"])
        except (TypeError, KeyError, ValueError, AttributeError) as error:
            raise InputError("foot switch", "settings", values, "device and actions") from error
        for action in actions.values():
            if action not in ACTIONS:
                expected = f"one of {', '.join(ACTIONS)}"
                raise InputError("foot switch", "action", action, expected)
        return cls(*texts, keyboard, actions)


@dataclass(frozen=True)
class Learned:
    """A pedal that was pressed: its device, and its number there."""

    info: HidInfo
    pedal: int

    def mapped(self, action: PedalAction) -> PedalMap:
        """Return a foot switch with an action of this pedal."""
        info = self.info
        return PedalMap(info.key, info.name, info.is_keyboard, {self.pedal: action})


class Pedals:
    """State of a device's pedals, from its reports.

    A keyboard's report lists its keys; for other devices every bit may be a pedal, and bits that
    are not mapped, such as those of a joystick's axes, have no effect.
    """

    def __init__(self, keyboard: bool) -> None:
        self._keyboard = keyboard
        self._down: dict[int, frozenset[int]] = {}

    @property
    def down(self) -> frozenset[int]:
        """Pedals that are pressed according to the last reports."""
        return frozenset().union(*self._down.values())

    def pressed(self, number: int, report: bytes) -> frozenset[int]:
        """Return the pedals that are newly pressed in a report.

        Parameters
        ----------
        number
            Report ID; 0 if there is none; −1: the device is disconnected.
        report
            Its bytes, without the ID.
        """
        if number < 0:
            self._down.clear()
            return frozenset()
        down = _keys(report) if self._keyboard else _bits(number, report)
        before = self._down.get(number, frozenset())
        self._down[number] = down
        return down - before


def _keys(report: bytes) -> frozenset[int]:
    """Return the pressed keys from a byte of modifiers, an unused byte, and key numbers."""
    modifiers = {MODIFIERS + bit for bit in range(8) if report[:1] and report[0] >> bit & 1}
    # 1 to 3 mean errors, such as too many keys.
    return frozenset(modifiers | {key for key in report[2:] if key > 3})


def _bits(number: int, report: bytes) -> frozenset[int]:
    places = (8 * k + bit for k in range(len(report)) for bit in range(8) if report[k] >> bit & 1)
    return frozenset(number * 8 * LONGEST + place for place in places)


class FootSwitch(HidReader):
    """A foot switch in use, which may be unplugged and plugged in again.

    Parameters
    ----------
    pedals
        The device and its pedals' actions, which may be replaced at any time.
    on_action
        Called with an action when its pedal is pressed, in a thread of the foot switch.
    """

    def __init__(
        self,
        pedals: PedalMap,
        on_action: Callable[[PedalAction], None],
        on_event: OnEvent = ignore_event,
        find: Find = find_hid,
        opener: Open = open_hid,
    ) -> None:
        self.pedals = pedals
        self._on_action = on_action
        self._known = Pedals(pedals.keyboard)
        self._down_s: dict[int, float] = {}
        super().__init__(pedals.name, on_event, find, opener)

    def matches(self, info: HidInfo) -> bool:
        """Whether it is this foot switch."""
        return info.key == self.pedals.device

    def on_report(self, number: int, report: bytes) -> None:
        """Call the actions of the pressed pedals."""
        now_s, before = time.monotonic(), self._known.down
        new = self._known.pressed(number, report)
        first = [p for p in sorted(new) if now_s - self._down_s.get(p, -math.inf) >= BOUNCE_S]
        # Including released pedals, as contacts also bounce on release.
        self._down_s |= dict.fromkeys(before | new, now_s)
        if number < 0:
            self._down_s.clear()
        for pedal in first:
            action = self.pedals.actions.get(pedal)
            if action is not None:
                self._on_action(action)


def learn(
    ending: threading.Event,
    find: Find = find_hid,
    opener: Open = open_hid,
    on_problems: Callable[[list[str]], None] = lambda _: None,
) -> Learned | None:
    """Wait for a pedal on any device except 3-D controllers and mice.

    Parameters
    ----------
    ending
        Set to stop waiting.
    on_problems
        Called once with the reasons why some devices cannot be read.

    Returns
    -------
    Learned
        The pedal; None if ``ending`` was set first.

    Raises
    ------
    HidError
        If no device can be read; the message says why and what to do.
    """
    problems: list[str] = []
    with ExitStack() as devices:
        listening = list(_listen(find(), opener, devices, problems))
        if not listening:
            raise HidError("; ".join(problems) or "no foot switch is connected: plug it in")
        on_problems(problems)
        while not ending.is_set():
            for info, device, numbered, pedals in tuple(listening):
                try:
                    report = bytes(device.read(LONGEST, GLANCE_MS))
                except (OSError, ValueError):
                    listening.remove((info, device, numbered, pedals))
                    continue
                if not report:
                    continue
                new = pedals.pressed(report[0] if numbered else 0, report[numbered:])
                if new:
                    return Learned(info, min(new))
            if not listening:
                raise HidError("the foot switch was unplugged: plug it in")
    return None


def _listen(
    infos: Iterable[HidInfo], opener: Open, devices: ExitStack, problems: list[str]
) -> Iterable[tuple[HidInfo, HidDevice, bool, Pedals]]:
    for info in infos:
        if info.is_3d or (info.is_mouse and not info.is_pedal):
            continue
        try:
            device = opener(info)
        except HidError as error:
            problems.append(str(error))
            continue
        devices.callback(device.close)
        try:
            numbered = has_numbers(device.get_report_descriptor())
        except (OSError, ValueError) as error:
            problems.append(f"{info.name} cannot be read: {error}")
            continue
        yield info, device, numbered, Pedals(info.is_keyboard)
