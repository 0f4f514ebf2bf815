"""A 3-D controller turns, moves and zooms the 3-D view that is seen."""

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
"""A view that is slow to draw is turned as if so much time had passed, at most."""

TURN_DEG_S, MOVE_S, ZOOM_S = 120.0, 0.8, 1.5
"""At the stop: degrees a second; heights of the view a second; e-folds a second."""

DEAD = 0.04
"""A controller at rest may still report so much."""

OBLIQUE = 0
"""The button that looks obliquely again."""


class Steering(QObject):
    """Reads the controller while `start` has been called and `stop` has not."""

    def __init__(
        self, view: Callable[[], View3d], say: Callable[[str], object], parent: QObject
    ) -> None:
        super().__init__(parent)
        self._view, self._say = view, say
        self._told: set[str] = set()
        self._mouse: SpaceMouse | None = None
        # Filled in the controller's thread, which holds nothing of Qt.
        self._held: deque[SixAxes] = deque([SixAxes()], maxlen=1)
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._ticked_s = 0.0
        self._timer = QTimer(self, interval=TICK_MS)
        self._timer.timeout.connect(self._tick)

    def start(self) -> None:
        """Steer from now on, whenever a controller is plugged in."""
        if self._mouse is None:
            self._held.append(SixAxes())
            self._mouse = SpaceMouse(self._held.append, self._events.put)
            self._timer.start()

    def stop(self) -> None:
        """Steer no more. Twice does no harm."""
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
    """Turn, move and zoom a view as long as a controller has been held so.

    What is seen follows the hand: pushed to the right it goes there, pulled it comes nearer,
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
    """Value of an axis beyond the dead zone."""
    return math.copysign(max(0.0, abs(value) - DEAD) / (1 - DEAD), value)
