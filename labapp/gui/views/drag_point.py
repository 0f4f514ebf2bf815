"""A named point in a picture, dragged or nudged; and how far an arrow key nudges."""

from __future__ import annotations

import pyqtgraph as pg
from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QColor, QKeyEvent

NUDGE_PX = 0.1
FAR_NUDGE_PX = 1.0
"""How far an arrow key moves a point, without and with Shift."""

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
    """How far an arrow key nudges, (du, dv) px; None for any other key."""
    if event.key() not in ARROWS or event.modifiers() & (CONTROL | ALT):
        return None
    size = FAR_NUDGE_PX if event.modifiers() & SHIFT else NUDGE_PX
    right, down = ARROWS[Qt.Key(event.key())]
    return right * size, down * size


class DragPoint(pg.TargetItem):  # type: ignore[misc]
    """A named point to drag, or to nudge with the arrow keys."""

    moved = Signal(float, float)
    """It was dragged or nudged, or is being dragged: u, v."""

    def __init__(self, name: str, u: float, v: float, color: str = "#ffb000") -> None:
        self.name = name
        self._color = QColor(color)
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

    @property
    def place(self) -> tuple[float, float]:
        """(u, v), px."""
        return float(self.pos().x()), float(self.pos().y())

    def set_place(self, u: float, v: float) -> None:
        """Move it without a signal; ignored while it is being dragged."""
        if self.moving:
            return
        blocked = self.blockSignals(True)
        self.setPos(u, v)
        self.blockSignals(blocked)

    def nudge(self, du: float, dv: float) -> None:
        """Move it a little, as the arrow keys do; not where it cannot be dragged either."""
        if not self.movable:
            return
        u, v = self.place
        self.setPos(u + du, v + dv)

    def show_chosen(self, chosen: bool) -> None:
        """Show whether the arrow keys move it."""
        self.setPen(pg.mkPen(self._color, width=2.5 if chosen else 1.5))
