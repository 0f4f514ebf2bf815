"""The ticks of the timeline, one per frame, and the frame in view. Fast for any length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QPointF, QRectF, QSignalBlocker, QSize, Qt, Signal
from PySide6.QtGui import (
    QColor,
    QHelpEvent,
    QImage,
    QKeyEvent,
    QMouseEvent,
    QPainter,
    QPaintEvent,
    QPalette,
    QPen,
    QPolygonF,
    QResizeEvent,
    QWheelEvent,
)
from PySide6.QtWidgets import QAbstractSlider, QSizePolicy, QStyle, QStyleOptionFocusRect, QToolTip

GAP_FROM_PX = 4
"""Ticks of at least this width are separated by gaps."""

RAIL_PX = 9
"""Space above the ticks for the marker of the frame in view."""

KEYS = "← → step through the frames, Page Up and Down go a tenth, Home End to the first and last"

Shape = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Tick:
    """Appearance of the ticks of one kind."""

    words: str
    short: str
    """The same in one word, for narrow windows."""
    light: str
    dark: str
    """Colour on a light and on a dark background; empty for that of the palette."""
    parts: Shape
    """(from, to) of the height, 0 at the bottom and 1 at the top: distinguishes without colour."""


def aggregated(kinds: npt.NDArray[np.int64], columns: int) -> npt.NDArray[np.int64]:
    """Kind shown in each column of pixels: the greatest of its frames, shape (columns,).

    Parameters
    ----------
    kinds
        Kinds of the frames, of which there is at least one, shape (n,).
    """
    count = len(kinds)
    first = np.arange(columns, dtype=np.int64) * count // columns
    if count <= columns:
        return np.asarray(kinds[first])
    return np.asarray(np.maximum.reduceat(kinds, first))


class Scrubber(QAbstractSlider):
    """The ticks and the frame in view; it knows only positions, not frames.

    For a screen reader it is a slider whose value is the position.
    """

    moved = Signal(int)
    """The operator went to a position, counted from 0."""

    def __init__(self, ticks: Sequence[Tick]) -> None:
        super().__init__()
        self._ticks = tuple(ticks)
        self.kinds: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        """Kinds of the frames, indices into the ticks, shape (n,)."""
        self._picture: QImage | None = None
        self.describe: Callable[[int], str] = lambda position: f"{position + 1}"
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setAccessibleName("Frames")
        self.valueChanged.connect(self.moved)  # by a screen reader

    def sizeHint(self) -> QSize:
        """The available width, and a height sufficient to distinguish the shapes."""
        return QSize(400, self.fontMetrics().height() * 2 + RAIL_PX)

    def set_kinds(self, kinds: npt.NDArray[np.int64]) -> None:
        """Show frames of these kinds, indices into the ticks, shape (n,)."""
        if not np.array_equal(kinds, self.kinds):
            self.kinds = np.asarray(kinds, np.int64)
            self._picture = None
            with QSignalBlocker(self):
                self.setRange(0, max(0, len(kinds) - 1))
            self._tell()
            self.update()

    def set_position(self, position: int) -> None:
        """Mark the frame in view."""
        with QSignalBlocker(self):
            self.setValue(position)
        self._tell()

    def _tell(self) -> None:
        seen = self.position_text(self.value()) if len(self.kinds) else "There are no frames"
        self.setAccessibleDescription(f"{seen}. {KEYS}")

    def position_text(self, position: int) -> str:
        """Text of a frame and its state."""
        return f"{self.describe(position)}: {self._ticks[int(self.kinds[position])].words}"

    @property
    def position(self) -> int:
        """Position of the frame in view."""
        return self.value()

    def position_at(self, x: float) -> int:
        """Position of the frame at a horizontal coordinate of the widget, px."""
        return max(0, min(len(self.kinds) - 1, int(x * len(self.kinds) / max(1, self.width()))))

    def go_to(self, position: int) -> None:
        """Go to the nearest existing position, as if the operator had."""
        if len(self.kinds):
            position = max(0, min(len(self.kinds) - 1, position))
            if position != self.value():
                self.moved.emit(position)

    # --- drawing ----------------------------------------------------------------------------

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the ticks, which are cached for a width and kinds, and the marker over them."""
        with QPainter(self) as painter:
            if not len(self.kinds):
                return
            if self._picture is None:
                self._picture = self._drawn()
            painter.drawImage(QPointF(0, RAIL_PX), self._picture)
            width = self.width() / len(self.kinds)
            left = self.value() * width
            middle = left + width / 2
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            ink = self.palette().color(QPalette.ColorRole.WindowText)
            if width >= GAP_FROM_PX:
                painter.setPen(QPen(ink, 1.5))
                painter.drawRect(
                    QRectF(left + 0.5, RAIL_PX, width - 1, self.height() - RAIL_PX - 1)
                )
            else:
                painter.setPen(QPen(ink, 1.5))
                painter.drawLine(QPointF(middle, RAIL_PX), QPointF(middle, self.height()))
            painter.setPen(Qt.PenStyle.NoPen)
            painter.setBrush(ink)
            half = RAIL_PX * 0.6
            corners = [(middle - half, 0.0), (middle + half, 0.0), (middle, RAIL_PX - 1.0)]
            painter.drawPolygon(QPolygonF([QPointF(*corner) for corner in corners]))
            if self.hasFocus():
                option = QStyleOptionFocusRect()
                option.initFrom(self)
                self.style().drawPrimitive(
                    QStyle.PrimitiveElement.PE_FrameFocusRect, option, painter, self
                )

    def _drawn(self) -> QImage:
        scale = self.devicePixelRatioF()
        columns = max(1, round(self.width() * scale))
        rows = max(8, round((self.height() - RAIL_PX) * scale))
        kinds = aggregated(self.kinds, columns)
        colours, masks = self._looks(rows)
        pixels = np.where(masks[kinds].T, colours[kinds][None, :], np.uint32(0))
        if columns / len(self.kinds) >= GAP_FROM_PX * scale:
            frame = np.arange(columns) * len(self.kinds) // columns
            pixels[:, 1:][:, frame[1:] != frame[:-1]] = 0
        pixels = np.ascontiguousarray(pixels, np.uint32)
        picture = QImage(
            pixels.tobytes(), columns, rows, 4 * columns, QImage.Format.Format_ARGB32
        ).copy()
        picture.setDevicePixelRatio(scale)
        return picture

    def _looks(self, rows: int) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.bool_]]:
        """Colour of each kind, shape (kinds,), and rows of pixels that it fills, (kinds, rows)."""
        palette = self.palette()
        dark = palette.color(QPalette.ColorRole.Window).lightness() < 128
        plain = palette.color(QPalette.ColorRole.Shadow if not dark else QPalette.ColorRole.Mid)
        colours, masks = [], []
        up = 1 - (np.arange(rows) + 0.5) / rows
        for tick in self._ticks:
            name = tick.dark if dark else tick.light
            colours.append((QColor(name) if name else plain).rgba())
            fills = [(up >= foot) & (up <= top) for foot, top in tick.parts]
            masks.append(np.any(fills, axis=0))
        return np.array(colours, np.uint32), np.array(masks, bool)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Redraw the ticks for another width."""
        self._picture = None
        super().resizeEvent(event)

    def changeEvent(self, event: QEvent) -> None:
        """Redraw the ticks for another palette."""
        if event.type() in (QEvent.Type.PaletteChange, QEvent.Type.StyleChange):
            self._picture = None
        super().changeEvent(event)

    # --- going ------------------------------------------------------------------------------

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Go to the frame under the pointer."""
        if event.button() == Qt.MouseButton.LeftButton:
            self.go_to(self.position_at(event.position().x()))

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Scrub."""
        if event.buttons() & Qt.MouseButton.LeftButton:
            self.go_to(self.position_at(event.position().x()))

    def wheelEvent(self, event: QWheelEvent) -> None:
        """Step through the frames."""
        steps = event.angleDelta().y() or event.angleDelta().x()
        self.go_to(self.value() - (steps > 0) + (steps < 0))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Go a tenth of all frames with Page Up and Down; the window handles the other keys."""
        page = max(1, len(self.kinds) // 10)
        if event.key() == Qt.Key.Key_PageUp:
            self.go_to(self.value() - page)
        elif event.key() == Qt.Key.Key_PageDown:
            self.go_to(self.value() + page)
        else:
            event.ignore()

    def event(self, event: QEvent) -> bool:
        """Show a tooltip for the frame under the pointer."""
        if isinstance(event, QHelpEvent) and len(self.kinds):
            position = self.position_at(event.pos().x())
            QToolTip.showText(event.globalPos(), self.position_text(position), self)
            return True
        return super().event(event)
