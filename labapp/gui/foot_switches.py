"""The foot switches in use, whatever page is in view: found, learned, kept, and what is pressed."""

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
from labapp.media.devices.foot_switch import Action, FootSwitch, Learned, PedalMap, learn
from labapp.media.devices.hid import AWAY, LONGEST, UNPLUGGED, HidError, HidInfo
from labapp.media.events import Event

POLL_MS = 20
"""What is pressed is done within this."""

DEAF_S = 0.5
"""Time, s, in which presses are ignored after one that was learned."""

DOES: dict[Action, str] = {
    "trigger": "record, or end it",
    "mark": "mark the moment",
    "next": "go to the next step",
}

CALLS: dict[Action, str] = {"trigger": "record", "mark": "mark", "next": "next_step"}
"""Actions of the window's menus."""


@dataclass
class InUse:
    """A foot switch in use, and its last event."""

    switch: FootSwitch
    event: Event | None = None

    @property
    def pedals(self) -> PedalMap:
        """Which it is, and what its pedals do."""
        return self.switch.pedals

    @property
    def words(self) -> str:
        """Whether it can be pressed, and if not what to do."""
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
    """What was found plugged in."""

    usable: tuple[str, ...] = ()
    """Names of the foot switches that are known and can be read."""
    closed: tuple[HidInfo, ...] = ()
    """Devices that may not be read, those that are known first."""
    problem: str = ""
    """Why nothing could be looked for; empty if it could."""

    @property
    def words(self) -> str:
        """What was found, a sentence or two."""
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

    Nothing runs while none is in use. Devices are read in threads of their own; what they tell is
    taken from a queue.
    """

    changed = Signal()
    """What is shown of them changed."""
    kept = Signal(object)
    """The foot switches in use or their actions changed: as plain values, to be stored."""
    pressed = Signal(str)
    """The name of the menus' action that a pedal was pressed for."""
    notified = Signal(str, bool)
    """Something for the operator to read: a sentence, and whether it is a problem."""

    def __init__(self, tasks: Tasks, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._tasks = tasks
        self.in_use: dict[str, InUse] = {}
        """By the device's key."""
        self.found: DevicesFound | None = None
        """What was plugged in at the last look; None before one."""
        self.learned: Learned | None = None
        """The pedal that was pressed to be learned, until its action is chosen."""
        self.unavailable: tuple[str, ...] = ()
        """Why some devices cannot be listened to while a pedal is waited for."""
        self._deaf_until_s = 0.0
        self._learning: Task | None = None
        self._looking: Task | None = None
        self._received: queue.SimpleQueue[tuple[str, Action | Event]] = queue.SimpleQueue()
        self._timer = QTimer(self, interval=POLL_MS)
        self._timer.timeout.connect(self._take)
        tasks.changed.connect(self.changed)

    # --- in use -------------------------------------------------------------------------------

    def use(self, kept: Iterable[Mapping[str, Any]]) -> None:
        """Start the foot switches that were stored; a damaged entry is reported."""
        for values in kept:
            try:
                pedals = PedalMap.from_dict(values)
            except InputError as error:
                self.notified.emit(f"A foot switch must be learned again: {error}", True)
                continue
            self._begin(pedals)
        self.changed.emit()

    def stop(self) -> None:
        """Use none any more; they stay remembered."""
        self._timer.stop()
        for each in self.in_use.values():
            each.switch.stop()
        self.in_use.clear()

    def assign(self, key: str, pedal: int, action: Action | None) -> None:
        """Let a pedal of a device in use do something else; None: nothing."""
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
        # Calls come in the device's thread: it is given the queue, and nothing of Qt.
        hear = partial(_put, self._received, pedals.device)
        switch = FootSwitch(pedals, hear, hear, hid.find_hid, hid.open_hid)
        self.in_use[pedals.device] = InUse(switch)
        if not self._timer.isActive():
            self._timer.start()

    def _keep(self) -> None:
        self.kept.emit(tuple(each.pedals.as_dict() for each in self.in_use.values()))
        self.changed.emit()

    def _take(self) -> None:
        """Do the actions of pedals that were pressed, and report events."""
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
                    self.look()  # what it may not be read for
                self.changed.emit()
            elif not deaf:
                self._do(received)

    def _do(self, action: Action) -> None:
        if action == "next" and QApplication.activeModalWidget() is not None:
            self.notified.emit(
                "The pedal goes to the next step when the question is answered", False
            )
        else:
            self.pressed.emit(CALLS[action])

    # --- to find and learn them ---------------------------------------------------------------

    @property
    def looks(self) -> bool:
        """Whether it is being looked what is plugged in."""
        return self._looking in self._tasks.active

    @property
    def learns(self) -> bool:
        """Whether a pedal is waited for."""
        return self._learning is not None and self._learning in self._tasks.active

    def look(self) -> None:
        """See what is plugged in, in the background."""

        def done(found: DevicesFound) -> None:
            self.found = found
            self.changed.emit()

        if not self.looks:
            self._looking = self._tasks.start("Looking for foot switches", lambda _: _found(), done)

    def learn(self) -> None:
        """Wait for a pedal to be pressed, in the background, until `give_up`."""
        if self.learns:
            return
        self.learned, self.unavailable = None, ()

        def done(answer: Learned | str | None) -> None:
            self._learning, self.unavailable = None, ()
            self._deaf_until_s = time.monotonic() + DEAF_S
            if isinstance(answer, str):
                self.notified.emit(answer, True)
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
        """Wait for no pedal any more, or leave the one that was pressed."""
        if self._learning is not None:
            self._learning.cancel()
        self.learned = None
        self.changed.emit()

    def use_learned(self, action: Action) -> None:
        """Let the pedal that was pressed do something from now on, and remember it."""
        learned, self.learned = self.learned, None
        if learned is None:
            return
        if learned.info.key in self.in_use:
            self.assign(learned.info.key, learned.pedal, action)
        else:
            self._begin(learned.mapped(action))
            self._keep()

    @property
    def proposed(self) -> Action:
        """What the pedal that was pressed does already, or else the first that none does yet."""
        actions: dict[int, Action] = {}
        if self.learned is not None and self.learned.info.key in self.in_use:
            actions = dict(self.in_use[self.learned.info.key].pedals.actions)
        if self.learned is not None and self.learned.pedal in actions:
            return actions[self.learned.pedal]
        taken = {does for each in self.in_use.values() for does in each.pedals.actions.values()}
        return next((action for action in DOES if action not in taken), "trigger")


def pedal_name(number: int, keyboard: bool) -> str:
    """A pedal as it is called: of a device with buttons its number from 1, else its key."""
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
    """Wait for a pedal; why none can be read, in words."""

    def report_problems(problems: list[str]) -> None:
        if not control.cancelled.is_set():
            control.part(problems)

    try:
        return learn(control.cancelled, hid.find_hid, hid.open_hid, report_problems)
    except HidError as error:
        return str(error)
