"""3Dconnexion's controllers: six axes, to turn what is seen in 3-D."""

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
"""Pause between looks for one: most benches have none."""

FULL = 350.0
"""What an axis gives at its stop."""

TRANSLATION, ROTATION, BUTTONS = 1, 2, 3
"""Numbers of the reports; newer devices send the rotation with the translation."""


@dataclass(frozen=True)
class SixAxes:
    """How a controller is held; each axis −1 … 1."""

    right: float = 0.0
    near: float = 0.0
    down: float = 0.0
    """Pushed to the right, towards the operator, down."""
    pitch: float = 0.0
    roll: float = 0.0
    yaw: float = 0.0
    """Turned about the first, the second, the third of these, right-handed."""
    buttons: frozenset[int] = frozenset()
    """Those that are down, by number from 0."""

    def after(self, number: int, report: bytes) -> SixAxes:
        """How it is held after a report of this number; unchanged by other reports.

        Number −1, the device is gone: released.
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
        Called with every event but that none is connected.
    """

    def __init__(
        self,
        on_move: Callable[[SixAxes], None],
        on_event: OnEvent = ignore_event,
        find: Find = find_hid,
        opener: Open = open_hid,
    ) -> None:
        self._on_move, self._on_event = on_move, on_event
        self._held = SixAxes()
        super().__init__("3-D controller", on_event, find, opener, RETRY_S)

    def matches(self, info: HidInfo) -> bool:
        """Whether it is a 3-D controller."""
        return info.is_3d

    def on_report(self, number: int, report: bytes) -> None:
        """Report a change."""
        held = self._held.after(number, report)
        if held != self._held:
            self._held = held
            self._on_move(held)

    def _emit(self, kind: Kind, words: str) -> None:
        if words not in (AWAY, MISSING):
            super()._emit(kind, words)


def _axes(report: bytes) -> tuple[float, float, float]:
    x, y, z = (max(-1.0, min(1.0, value / FULL)) for value in struct.unpack("<3h", report[:6]))
    return x, y, z
