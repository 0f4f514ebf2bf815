"""A named point in a picture that can be dragged or moved with the arrow keys."""

from __future__ import annotations

import pyqtgraph as pg
from PySide6.QtCore import QSignalBlocker, Qt, Signal
from PySide6.QtGui import QColor, QKeyEvent

NUDGE_PX = 0.1
FAR_NUDGE_PX = 1.0
"""Step of an arrow key, px, without and with Shift."""

ARROWS = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, -1),
    Qt.Key.Key_Down: (0, 1),
}

CONTROL = Qt.KeyboardModifier.ControlModifier
ALT = Qt.KeyboardModifier.AltModifier
SHIFT = Qt.KeyboardModifier.ShiftModifier


def arrow_step(event: QKeyEvent) -> tuple[float, float] | None:
    """Step of an arrow key, (du, dv) px; None for any other key."""
    if event.key() not in ARROWS or event.modifiers() & (CONTROL | ALT):
        return None
    size = FAR_NUDGE_PX if event.modifiers() & SHIFT else NUDGE_PX
    right, down = ARROWS[Qt.Key(event.key())]
    return right * size, down * size


class DragPoint(pg.TargetItem):  # type: ignore[misc]
    """A named point that can be dragged or moved with the arrow keys."""

    moved = Signal(float, float)
    """The point was or is being moved by the operator: u, v, px."""
    placed = Signal()
    """The operator has finished moving it: the button or the arrow key is released."""

    def __init__(self, name: str, u: float, v: float, color: str = "#ffb000") -> None:
        self.name = name
        self._color = QColor(color)
        self._nudged = False
        super().__init__(
            pos=(u, v),
            size=15,
            symbol="crosshair",
            pen=pg.mkPen(color, width=1.5),
            hoverPen=pg.mkPen(color, width=3),
            label=name,
            labelOpts={"color": color, "offset": (10, 0), "fill": (0, 0, 0, 130)},
        )
        self.setToolTip(f"{name}: drag it, or use the arrow keys (Shift: {FAR_NUDGE_PX:g} px)")
        self.sigPositionChanged.connect(lambda *_: self.moved.emit(*self.place))
        self.sigPositionChangeFinished.connect(lambda *_: self.placed.emit())

    @property
    def place(self) -> tuple[float, float]:
        """Position (u, v), px."""
        return float(self.pos().x()), float(self.pos().y())

    def set_place(self, u: float, v: float) -> None:
        """Move the point without a signal; ignored while it is being dragged."""
        if self.moving:
            return
        with QSignalBlocker(self):
            self.setPos(u, v)

    def nudge(self, du: float, dv: float) -> None:
        """Move the point by (du, dv) px, as the arrow keys do, unless it is fixed."""
        if not self.movable:
            return
        u, v = self.place
        self.setPos(u + du, v + dv)
        self._nudged = True

    def release(self) -> None:
        """End a move by the arrow keys, if there is one."""
        if self._nudged:
            self._nudged = False
            self.placed.emit()

    def show_chosen(self, chosen: bool) -> None:
        """Show whether the arrow keys move the point."""
        self.setPen(pg.mkPen(self._color, width=2.5 if chosen else 1.5))
