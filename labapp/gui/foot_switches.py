"""Foot switches, regardless of the page in view: detection, learning, storage and presses."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from PySide6.QtCore import QObject, QTimer, Signal
from PySide6.QtWidgets import QApplication

from labapp.errors import InputError
from labapp.gui.tasks import Control, Task, Tasks
from labapp.media.devices import hid
from labapp.media.devices.foot_switch import FootSwitch, Learned, PedalAction, PedalMap, learn
from labapp.media.devices.hid import AWAY, LONGEST, UNPLUGGED, HidError, HidInfo
from labapp.media.events import Event
from labapp.text import capitalized

POLL_MS = 20
"""Interval, ms, at which presses are handled."""

DEAF_S = 0.5
"""Time, s, in which presses are ignored after one that was learned."""

DOES: dict[PedalAction, str] = {
    "trigger": "record, or end it",
    "mark": "mark the moment",
    "next": "go to the next step",
}

CALLS: dict[PedalAction, str] = {"trigger": "record", "mark": "mark", "next": "next_step"}
"""Names of the window's menu actions."""


@dataclass
class InUse:
    """A foot switch in use, and its last event."""

    switch: FootSwitch
    event: Event | None = None

    @property
    def pedals(self) -> PedalMap:
        """The device, and the actions of its pedals."""
        return self.switch.pedals

    @property
    def words(self) -> str:
        """State of the connection, and what to do if there is none."""
        name = self.pedals.name
        if self.switch.connected:
            return f"● {name}: connected"
        if self.event is None:
            return f"○ {name}: being looked for"
        if self.event.words in (AWAY, UNPLUGGED):
            return f"▲ {name}: not connected. It works again once it is plugged in"
        return f"▲ {self.event.words}"


@dataclass(frozen=True)
class DevicesFound:
    """Result of a search for devices."""

    usable: tuple[str, ...] = ()
    """Names of the known foot switches that can be read."""
    closed: tuple[HidInfo, ...] = ()
    """Devices without read permission, the known ones first."""
    problem: str = ""
    """Reason why the search failed; empty if it did not."""

    @property
    def words(self) -> str:
        """Text of the result, one or two sentences."""
        if self.problem:
            return self.problem
        parts = [f"Found: {', '.join(self.usable)}."] if self.usable else []
        known = [info.name for info in self.closed if info.is_pedal or info.is_3d]
        if known:
            parts.append(f"▲ No permission to read: {', '.join(known)}.")
        if not parts:
            parts = ["No known foot switch is plugged in; any other can be learned."]
        return "\n".join(parts)


class FootSwitches(QObject):
    """Foot switches: a pressed pedal runs an action of the window's menus.

    Nothing runs while none is in use. Each device is read in a separate thread, which puts its
    events into a queue.
    """

    changed = Signal()
    """The displayed information changed."""
    kept = Signal(object)
    """The foot switches in use or their actions changed: plain values to be stored."""
    pressed = Signal(str)
    """A pedal was pressed: the name of its menu action."""
    notified = Signal(str, bool)
    """A message for the operator: its text, and whether it is a problem."""

    def __init__(self, tasks: Tasks, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._tasks = tasks
        self.in_use: dict[str, InUse] = {}
        """Foot switches in use, by the device's key."""
        self.found: DevicesFound | None = None
        """Result of the last search; None before the first."""
        self.learned: Learned | None = None
        """The learned pedal, until its action is chosen."""
        self.unavailable: tuple[str, ...] = ()
        """Reasons why some devices cannot be read while waiting for a pedal."""
        self._deaf_until_s = 0.0
        self._learning: Task | None = None
        self._looking: Task | None = None
        self._received: queue.SimpleQueue[tuple[str, PedalAction | Event]] = queue.SimpleQueue()
        self._timer = QTimer(self, interval=POLL_MS)
        self._timer.timeout.connect(self._take)
        tasks.changed.connect(self.changed)

    # --- in use -------------------------------------------------------------------------------

    def use(self, kept: Iterable[Mapping[str, Any]]) -> None:
        """Start the stored foot switches; report damaged entries."""
        for values in kept:
            try:
                pedals = PedalMap.from_dict(values)
            except InputError as error:
                self.notified.emit(f"A foot switch must be learned again: {error}", True)
                continue
            self._begin(pedals)
        self.changed.emit()

    def stop(self) -> None:
        """Stop all foot switches; they stay in the preferences."""
        self._timer.stop()
        for each in self.in_use.values():
            each.switch.stop()
        self.in_use.clear()

    def assign(self, key: str, pedal: int, action: PedalAction | None) -> None:
        """Assign another action to a pedal of a device in use; None: no action."""
        switch = self.in_use[key].switch
        switch.pedals = switch.pedals.with_action(pedal, action)
        if not switch.pedals.actions:
            switch.stop()
            del self.in_use[key]
            if not self.in_use:
                self._timer.stop()
        self._keep()

    def _begin(self, pedals: PedalMap) -> None:
        if pedals.device in self.in_use or not pedals.actions:
            return
        # Callbacks run in the device's thread, so they get the queue and no Qt object.
        hear = partial(_put, self._received, pedals.device)
        switch = FootSwitch(pedals, hear, hear, hid.find_hid, hid.open_hid)
        self.in_use[pedals.device] = InUse(switch)
        if not self._timer.isActive():
            self._timer.start()

    def _keep(self) -> None:
        self.kept.emit(tuple(each.pedals.as_dict() for each in self.in_use.values()))
        self.changed.emit()

    def _take(self) -> None:
        """Run the actions of pressed pedals, and report events."""
        deaf = self.learns or time.monotonic() < self._deaf_until_s
        for _ in range(self._received.qsize()):
            key, received = self._received.get_nowait()
            if key not in self.in_use:
                continue
            if isinstance(received, Event):
                self.in_use[key].event = received
                warned = received.kind == "warning" and received.words != AWAY
                self.notified.emit(str(received), warned)
                if warned and received.words != UNPLUGGED:
                    self.look()  # to find devices without permission
                self.changed.emit()
            elif not deaf:
                self._do(received)

    def _do(self, action: PedalAction) -> None:
        if action == "next" and QApplication.activeModalWidget() is not None:
            self.notified.emit(
                "The pedal goes to the next step when the question is answered", False
            )
        else:
            self.pressed.emit(CALLS[action])

    # --- detection and learning ---------------------------------------------------------------

    @property
    def looks(self) -> bool:
        """Whether a search for devices is running."""
        return self._looking in self._tasks.active

    @property
    def learns(self) -> bool:
        """Whether the app waits for a pedal to be learned."""
        return self._learning in self._tasks.active

    def look(self) -> None:
        """Search for devices in the background."""

        def done(found: DevicesFound) -> None:
            self.found = found
            self.changed.emit()

        if not self.looks:
            self._looking = self._tasks.start("Looking for foot switches", lambda _: _found(), done)

    def learn(self) -> None:
        """Wait in the background for a pedal to be pressed, until `give_up`."""
        if self.learns:
            return
        self.learned, self.unavailable = None, ()

        def done(answer: Learned | str | None) -> None:
            self._learning, self.unavailable = None, ()
            self._deaf_until_s = time.monotonic() + DEAF_S
            if isinstance(answer, str):
                self.notified.emit(capitalized(answer), True)
                self.look()
            else:
                self.learned = answer
            self.changed.emit()

        def report_problems(problems: list[str]) -> None:
            self.unavailable = tuple(problems)
            self.changed.emit()

        self._learning = self._tasks.start("Waiting for a pedal", _learned, done, report_problems)
        self.changed.emit()

    def give_up(self) -> None:
        """Stop waiting for a pedal, or discard the learned one."""
        if self._learning is not None:
            self._learning.cancel()
        self.learned = None
        self.changed.emit()

    def use_learned(self, action: PedalAction) -> None:
        """Assign an action to the learned pedal, and store it."""
        learned, self.learned = self.learned, None
        if learned is None:
            return
        if learned.info.key in self.in_use:
            self.assign(learned.info.key, learned.pedal, action)
        else:
            self._begin(learned.mapped(action))
            self._keep()

    @property
    def proposed(self) -> PedalAction:
        """Current action of the learned pedal, or else the first action that no pedal has."""
        actions: dict[int, PedalAction] = {}
        if self.learned is not None and self.learned.info.key in self.in_use:
            actions = dict(self.in_use[self.learned.info.key].pedals.actions)
        if self.learned is not None and self.learned.pedal in actions:
            return actions[self.learned.pedal]
        taken = {does for each in self.in_use.values() for does in each.pedals.actions.values()}
        return next((action for action in DOES if action not in taken), "trigger")


def pedal_name(number: int, keyboard: bool) -> str:
    """Name of a pedal: its number from 1 for a device with buttons, otherwise its key."""
    if not keyboard:
        return f"pedal {number % (8 * LONGEST) + 1}"
    letters = {4 + k: letter for k, letter in enumerate("ABCDEFGHIJKLMNOPQRSTUVWXYZ1234567890")}
    keys = {**letters, **{58 + k: f"F{k + 1}" for k in range(12)}}
    keys |= {104 + k: f"F{k + 13}" for k in range(12)}
    keys |= {40: "Enter", 41: "Esc", 43: "Tab", 44: "Space", 75: "Page Up", 78: "Page Down"}
    return f"key {keys.get(number, f'number {number}')}"


def _put(received: queue.SimpleQueue[tuple[str, Any]], key: str, what: object) -> None:
    received.put((key, what))


def _found() -> DevicesFound:
    try:
        devices = {info.key: info for info in hid.find_hid()}
    except HidError as error:
        return DevicesFound(problem=str(error))
    known_first = sorted(devices.values(), key=lambda info: not (info.is_pedal or info.is_3d))
    usable = [info.name for info in known_first if info.is_pedal and hid.may_be_read(info)]
    closed = [info for info in known_first if not hid.may_be_read(info)]
    return DevicesFound(tuple(dict.fromkeys(usable)), tuple(closed))


def _learned(control: Control) -> Learned | str | None:
    """Wait for a pedal; return the reason as text if no device can be read."""

    def report_problems(problems: list[str]) -> None:
        if not control.cancelled.is_set():
            control.part(problems)

    try:
        return learn(control.cancelled, hid.find_hid, hid.open_hid, report_problems)
    except HidError as error:
        return str(error)
