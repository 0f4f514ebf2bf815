"""3Dconnexion's controllers: six axes, to turn what is seen in 3-D."""

from __future__ import annotations

import struct
from dataclasses import dataclass

FULL = 350.0
"""What an axis gives at its stop."""

TRANSLATION, ROTATION, BUTTONS = 1, 2, 3
"""Numbers of the reports; newer devices send the rotation with the translation."""


@dataclass(frozen=True)
class SixAxes:
    """How a controller is held; each axis −1 … 1.

    Parameters
    ----------
    right, near, down
        Pushed to the right, towards the operator, down.
    pitch, roll, yaw
        Turned about the first, the second, the third of these, right-handed.
    buttons
        Those that are down, by number from 0.
    """

    right: float = 0.0
    near: float = 0.0
    down: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    yaw: float = 0.0
    buttons: frozenset[int] = frozenset()

    def after(self, number: int, report: bytes) -> SixAxes:
        """How it is held after a report of this number; as before where it tells nothing.

        Number −1, the device is gone: let go of.
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


def _axes(report: bytes) -> tuple[float, float, float]:
    x, y, z = (max(-1.0, min(1.0, value / FULL)) for value in struct.unpack("<3h", report[:6]))
    return x, y, z
