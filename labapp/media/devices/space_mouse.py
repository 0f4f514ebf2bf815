"""3Dconnexion six-axis controllers, for the 3-D view."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from labapp.media.devices.hid import (
    AWAY,
    MISSING,
    Find,
    HidInfo,
    HidReader,
    Open,
    find_hid,
    open_hid,
)
from labapp.media.events import Kind, OnEvent, ignore_event

RETRY_S = 2.0
"""Pause between searches, s; most benches have no controller."""

FULL = 350.0
"""Value of an axis at its stop."""

TRANSLATION, ROTATION, BUTTONS = 1, 2, 3
"""Numbers of the reports; newer devices send the rotation with the translation."""


@dataclass(frozen=True)
class SixAxes:
    """State of a controller; each axis −1 … 1."""

    right: float = 0.0
    near: float = 0.0
    down: float = 0.0
    """Translation to the right, towards the operator, down."""
    pitch: float = 0.0
    roll: float = 0.0
    yaw: float = 0.0
    """Rotation about these axes, right-handed."""
    buttons: frozenset[int] = frozenset()
    """Numbers of the pressed buttons, from 0."""

    def after(self, number: int, report: bytes) -> SixAxes:
        """Return the state after a report; unknown reports do not change it.

        Number −1: the device is lost, everything is released.
        """
        if number < 0:
            return SixAxes()
        move, turn = (self.right, self.near, self.down), (self.pitch, self.roll, self.yaw)
        buttons = self.buttons
        if number == TRANSLATION and len(report) >= 6:
            move = _axes(report)
            if len(report) >= 12:
                turn = _axes(report[6:])
        elif number == ROTATION and len(report) >= 6:
            turn = _axes(report)
        elif number == BUTTONS:
            bits = int.from_bytes(report, "little")
            buttons = frozenset(k for k in range(8 * len(report)) if bits >> k & 1)
        return SixAxes(*move, *turn, buttons)


class SpaceMouse(HidReader):
    """Reader thread of the connected controller, if there is one.

    Parameters
    ----------
    on_move
        Called with its state whenever that changes, in the reader's thread.
    on_event
        Called with every event, except that no controller is connected.
    """

    def __init__(
        self,
        on_move: Callable[[SixAxes], None],
        on_event: OnEvent = ignore_event,
        find: Find = find_hid,
        opener: Open = open_hid,
    ) -> None:
        self._on_move = on_move
        self._state = SixAxes()
        super().__init__("3-D controller", on_event, find, opener, RETRY_S)

    def matches(self, info: HidInfo) -> bool:
        """Whether it is a 3-D controller."""
        return info.is_3d

    def on_report(self, number: int, report: bytes) -> None:
        """Update the state, and report changes."""
        state = self._state.after(number, report)
        if state != self._state:
            self._state = state
            self._on_move(state)

    def _emit(self, kind: Kind, words: str) -> None:
        if words not in (AWAY, MISSING):
            super()._emit(kind, words)


def _axes(report: bytes) -> tuple[float, float, float]:
    x, y, z = (max(-1.0, min(1.0, value / FULL)) for value in struct.unpack("<3h", report[:6]))
    return x, y, z
