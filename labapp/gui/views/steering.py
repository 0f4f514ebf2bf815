"""Turning, moving and zooming of the visible 3-D view with a 3-D controller."""

from __future__ import annotations

import math
import queue
import time
from collections import deque
from collections.abc import Callable

from PySide6.QtCore import QObject, QPointF, QTimer

from labapp.gui.views.view3d import View3d
from labapp.media.devices.space_mouse import SixAxes, SpaceMouse
from labapp.media.events import Event

TICK_MS = 33

LONGEST_S = 0.1
"""Longest time step, s, so that a slowly drawn view does not jump."""

TURN_DEG_S, MOVE_S, ZOOM_S = 120.0, 0.8, 1.5
"""At full deflection: degrees, heights of the view, and factors of e per second."""

DEAD = 0.04
"""Dead zone: largest deflection that a controller may report at rest."""

OBLIQUE = 0
"""Button that restores the oblique view."""


class Steering(QObject):
    """Reads the controller between the calls of `start` and `stop`."""

    def __init__(
        self, view: Callable[[], View3d], say: Callable[[str], object], parent: QObject
    ) -> None:
        super().__init__(parent)
        self._view, self._say = view, say
        self._told: set[str] = set()
        self._mouse: SpaceMouse | None = None
        # Filled in the controller's thread, which uses no Qt object.
        self._held: deque[SixAxes] = deque([SixAxes()], maxlen=1)
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._ticked_s = 0.0
        self._timer = QTimer(self, interval=TICK_MS)
        self._timer.timeout.connect(self._tick)

    def start(self) -> None:
        """Start steering; a controller may be plugged in at any time."""
        if self._mouse is None:
            self._held.append(SixAxes())
            self._mouse = SpaceMouse(self._held.append, self._events.put)
            self._timer.start()

    def stop(self) -> None:
        """Stop steering; may be called twice."""
        self._timer.stop()
        if self._mouse is not None:
            self._mouse.stop()
            self._mouse = None

    def _tick(self) -> None:
        for _ in range(self._events.qsize()):
            words = str(self._events.get_nowait())
            if words not in self._told:
                self._told.add(words)
                self._say(words)
        now_s = time.monotonic()
        since_s, self._ticked_s = min(now_s - self._ticked_s, LONGEST_S), now_s
        steer(self._view(), self._held[-1], since_s)


def steer(view: View3d, held: SixAxes, seconds: float) -> None:
    """Turn, move and zoom a view by the deflections of a controller during some seconds.

    The scene follows the hand: pushed to the right it moves to the right, pulled it comes nearer,
    turned it turns.
    """
    if OBLIQUE in held.buttons:
        view.look("free")
        return
    yaw, pitch, roll = (
        _beyond(value) * TURN_DEG_S * seconds for value in (held.yaw, held.pitch, held.roll)
    )
    right, down = (_beyond(value) * MOVE_S * seconds for value in (held.right, held.down))
    near = _beyond(held.near)
    if yaw or pitch or roll:
        view.turn(-yaw, pitch, roll)  # seen from above, a positive yaw is clockwise
    if right or down:
        view.move_scene(QPointF(right, down) * view.height())
    if near:
        view.zoom(math.exp(near * ZOOM_S * seconds))


def _beyond(value: float) -> float:
    """Deflection of an axis beyond the dead zone, scaled to −1 … 1."""
    return math.copysign(max(0.0, abs(value) - DEAD) / (1 - DEAD), value)
