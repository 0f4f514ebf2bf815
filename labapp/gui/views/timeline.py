"""The timeline: one tick a frame, the frame in view, playing and jumping. Quick for any length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QPointF, QRectF, QSignalBlocker, QSize, Qt, QTimer, Signal
from PySide6.QtGui import (
    QColor,
    QHelpEvent,
    QIcon,
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
from PySide6.QtWidgets import (
    QAbstractSlider,
    QHBoxLayout,
    QSizePolicy,
    QSpinBox,
    QStyle,
    QStyleOptionFocusRect,
    QToolButton,
    QToolTip,
    QVBoxLayout,
    QWidget,
)

from labapp.gui.views.labels import plain_label

PLAY_HZ = 30.0
"""Most frames a second while playing; every frame is shown."""

GAP_FROM_PX = 4
"""Ticks at least this wide stand apart."""

RAIL_PX = 9
"""Room above the ticks for the marker of the frame in view."""

KEYS = "← → step through the frames, Page Up and Down go a tenth, Home End to the first and last"

Shape = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Tick:
    """How ticks of one kind look.

    Parameters
    ----------
    words
        What it means.
    short
        The same in a word, where there is little room.
    light, dark
        Colour on a light and on a dark ground; empty for the palette's.
    parts
        (from, to) up the height, 0 at the foot and 1 at the top: shape tells as much as colour.
    """

    words: str
    short: str
    light: str
    dark: str
    parts: Shape


def aggregated(kinds: npt.NDArray[np.int64], columns: int) -> npt.NDArray[np.int64]:
    """The kind that each column of pixels shows: the greatest of its frames, shape (columns,).

    Parameters
    ----------
    kinds
        Of the frames, at least one, shape (n,).
    columns
        How many there are.
    """
    count = len(kinds)
    first = np.arange(columns, dtype=np.int64) * count // columns
    if count <= columns:
        return np.asarray(kinds[first])
    return np.asarray(np.maximum.reduceat(kinds, first))


class Scrubber(QAbstractSlider):
    """The ticks, and the frame in view on them; it knows positions, not what a frame is.

    To a screen reader it is a slider, whose value is the position.

    Signals
    -------
    moved
        The operator went to a position, counted from 0.
    """

    moved = Signal(int)

    def __init__(self, ticks: Sequence[Tick], parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._ticks = tuple(ticks)
        self._kinds: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._picture: QImage | None = None
        self.describe: Callable[[int], str] = lambda position: f"{position + 1}"
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setAccessibleName("Frames")
        self.valueChanged.connect(self.moved)  # by a screen reader

    def sizeHint(self) -> QSize:
        """As wide as there is room, and high enough for the shapes to be told apart."""
        return QSize(400, self.fontMetrics().height() * 2 + RAIL_PX)

    def set_kinds(self, kinds: npt.NDArray[np.int64]) -> None:
        """Show frames of these kinds, indices into the ticks, shape (n,)."""
        if not np.array_equal(kinds, self._kinds):
            self._kinds = np.asarray(kinds, np.int64)
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
        seen = self.in_words(self.value()) if len(self._kinds) else "There are no frames"
        self.setAccessibleDescription(f"{seen}. {KEYS}")

    def in_words(self, position: int) -> str:
        """A frame and how it stands."""
        return f"{self.describe(position)}: {self._ticks[int(self._kinds[position])].words}"

    @property
    def kinds(self) -> npt.NDArray[np.int64]:
        """Of the frames, indices into the ticks, shape (n,)."""
        return self._kinds

    @property
    def position(self) -> int:
        """Of the frame in view."""
        return self.value()

    def position_at(self, x: float) -> int:
        """Position of the frame under a place across the widget, px."""
        return max(0, min(len(self._kinds) - 1, int(x * len(self._kinds) / max(1, self.width()))))

    def go_to(self, position: int) -> None:
        """Go to the nearest position there is, as if the operator had."""
        if len(self._kinds):
            position = max(0, min(len(self._kinds) - 1, position))
            if position != self.value():
                self.moved.emit(position)

    # --- drawing ----------------------------------------------------------------------------

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the ticks, made once for a width and kinds, and the marker over them."""
        painter = QPainter(self)
        if not len(self._kinds):
            return
        if self._picture is None:
            self._picture = self._drawn()
        painter.drawImage(QPointF(0, RAIL_PX), self._picture)
        width = self.width() / len(self._kinds)
        left = self.value() * width
        middle = left + width / 2
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        ink = self.palette().color(QPalette.ColorRole.WindowText)
        if width >= GAP_FROM_PX:
            painter.setPen(QPen(ink, 1.5))
            painter.drawRect(QRectF(left + 0.5, RAIL_PX, width - 1, self.height() - RAIL_PX - 1))
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
        kinds = aggregated(self._kinds, columns)
        colours, masks = self._looks(rows)
        pixels = np.where(masks[kinds].T, colours[kinds][None, :], np.uint32(0))
        if columns / len(self._kinds) >= GAP_FROM_PX * scale:
            frame = np.arange(columns) * len(self._kinds) // columns
            pixels[:, 1:][:, frame[1:] != frame[:-1]] = 0
        pixels = np.ascontiguousarray(pixels, np.uint32)
        picture = QImage(
            pixels.tobytes(), columns, rows, 4 * columns, QImage.Format.Format_ARGB32
        ).copy()
        picture.setDevicePixelRatio(scale)
        return picture

    def _looks(self, rows: int) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.bool_]]:
        """Colour of each kind, shape (kinds,), and which rows of pixels it fills, (kinds, rows)."""
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
        """Draw the ticks anew for another width."""
        self._picture = None
        super().resizeEvent(event)

    def changeEvent(self, event: QEvent) -> None:
        """Draw the ticks anew for another palette."""
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
        """Go a tenth of all frames with Page Up and Down; the other keys are the window's."""
        page = max(1, len(self._kinds) // 10)
        if event.key() == Qt.Key.Key_PageUp:
            self.go_to(self.value() - page)
        elif event.key() == Qt.Key.Key_PageDown:
            self.go_to(self.value() + page)
        else:
            event.ignore()

    def event(self, event: QEvent) -> bool:
        """Tell of the frame under the pointer."""
        if isinstance(event, QHelpEvent) and len(self._kinds):
            position = self.position_at(event.pos().x())
            QToolTip.showText(event.globalPos(), self.in_words(position), self)
            return True
        return super().event(event)


class Timeline(QWidget):
    """The scrubber with its buttons, the frame's number and time.

    It knows no session: numbers, times and kinds of frames are given to it.

    Signals
    -------
    moved
        The operator went to a frame: its number.
    jumped
        The operator asked for the next frame in doubt or corrected: ``doubtful`` or
        ``corrected``, and whether forward.
    """

    moved = Signal(int)
    jumped = Signal(str, bool)

    def __init__(self, ticks: Sequence[Tick], parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._ticks = tuple(ticks)
        self._icons: dict[QToolButton, QStyle.StandardPixmap] = {}
        self._frames: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._times_s: npt.NDArray[np.float64] = np.zeros(0)
        self.scrubber = Scrubber(ticks)
        self.scrubber.describe = self.described
        self.scrubber.moved.connect(self._moved)
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._play_on)
        self.number = QSpinBox()
        self.number.setPrefix("Frame ")
        self.number.setAccessibleName("Frame number")
        self.number.setToolTip("The frame in view, counted from 0: type a number to go there")
        self.number.setKeyboardTracking(False)
        self.number.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.number.valueChanged.connect(self._typed)
        self.told = plain_label()
        self.told.setMinimumWidth(self.fontMetrics().horizontalAdvance("of 10000 · 0000.0000 s  "))
        self.counts = plain_label()
        self.counts.setTextFormat(Qt.TextFormat.RichText)
        self.counts.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.counts.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.counts.setMinimumWidth(self.fontMetrics().horizontalAdvance("■ 0000   ") * 3)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self._lay_out()

    def changeEvent(self, event: QEvent) -> None:
        """Follow a change of theme."""
        super().changeEvent(event)
        if event.type() == QEvent.Type.PaletteChange and hasattr(self, "counts"):
            self._show_counts()
            for button, icon in list(self._icons.items()):
                self._show_icon(button, icon)

    def _lay_out(self) -> None:
        style = QStyle.StandardPixmap
        self.play_button = self._button("Play", "Show one frame after another", style.SP_MediaPlay)
        self.play_button.setCheckable(True)
        self.play_button.clicked.connect(self.set_playing)
        row = QHBoxLayout()
        row.setContentsMargins(0, 0, 0, 0)
        for name, tip, icon, go in (
            ("First frame", "Go to the first frame (Home)", style.SP_MediaSkipBackward, -(10**9)),
            ("Frame before", "Go to the frame before (←)", style.SP_MediaSeekBackward, -1),
            (None, None, None, 0),
            ("Next frame", "Go to the next frame (→)", style.SP_MediaSeekForward, 1),
            ("Last frame", "Go to the last frame (End)", style.SP_MediaSkipForward, 10**9),
        ):
            if name is None:
                row.addWidget(self.play_button)
                continue
            button = self._button(name, tip, icon)
            button.clicked.connect(lambda *_, by=go: self.step(by))
            row.addWidget(button)
        row.addWidget(self.number)
        row.addWidget(self.told)
        for kind, words, key in (("doubtful", "in doubt", "F8"), ("corrected", "corrected", "F7")):
            row.addSpacing(8)
            row.addWidget(self._jump(kind, f"previous frame {words}", "◂", f"Shift+{key}", False))
            row.addWidget(plain_label(words))
            row.addWidget(self._jump(kind, f"next frame {words}", "▸", key, True))
        row.addSpacing(8)
        row.addWidget(self.counts, 1)
        column = QVBoxLayout(self)
        column.setContentsMargins(6, 4, 6, 4)
        column.setSpacing(4)
        column.addWidget(self.scrubber)
        column.addLayout(row)

    def _jump(self, kind: str, where: str, sign: str, key: str, forward: bool) -> QToolButton:
        button = self._button(where.capitalize(), f"Go to the {where} ({key})", None)
        button.setText(sign)
        button.clicked.connect(lambda: self.jumped.emit(kind, forward))
        return button

    def _button(
        self, name: str, tip: str | None, icon: QStyle.StandardPixmap | None
    ) -> QToolButton:
        button = QToolButton()
        if icon is not None:
            self._show_icon(button, icon)
        button.setAccessibleName(name)
        button.setToolTip(tip or name)
        return button

    def _show_icon(self, button: QToolButton, icon: QStyle.StandardPixmap) -> None:
        """Show an icon of the style in the colour of buttons' texts: the style's own are black."""
        self._icons[button] = icon
        ratio = self.devicePixelRatioF()
        pixmap = self.style().standardIcon(icon).pixmap(button.iconSize(), ratio)
        painter = QPainter(pixmap)
        painter.setCompositionMode(QPainter.CompositionMode.CompositionMode_SourceIn)
        painter.fillRect(pixmap.rect(), self.palette().color(QPalette.ColorRole.ButtonText))
        painter.end()
        button.setIcon(QIcon(pixmap))

    # --- what it shows ----------------------------------------------------------------------

    def set_frames(
        self,
        frames: npt.NDArray[np.int64],
        times_s: npt.NDArray[np.float64],
        kinds: npt.NDArray[np.int64],
    ) -> None:
        """Show these frames.

        Parameters
        ----------
        frames
            Their numbers, ascending, shape (n,).
        times_s
            Their times, shape (n,), s; NaN where unknown.
        kinds
            Indices into the ticks, shape (n,).
        """
        self._frames, self._times_s = frames, times_s
        self.scrubber.set_kinds(kinds)
        self.setEnabled(len(frames) > 0)
        self.number.blockSignals(True)
        self.number.setRange(*((int(frames[0]), int(frames[-1])) if len(frames) else (0, 0)))
        self.number.blockSignals(False)
        self._show_counts()

    def set_frame(self, frame: int) -> None:
        """Mark the frame in view."""
        if not len(self._frames):
            self.told.setText("")
            return
        position = int(np.searchsorted(self._frames, frame).clip(0, len(self._frames) - 1))
        self.scrubber.set_position(position)
        self.number.blockSignals(True)
        self.number.setValue(frame)
        self.number.blockSignals(False)
        time_s = self._times_s[position]
        when = "" if np.isnan(time_s) else f" · {time_s:.4f} s"
        self.told.setText(f"{position + 1} of {len(self._frames)}{when}")

    def described(self, position: int) -> str:
        """A frame in words."""
        time_s = self._times_s[position]
        when = "" if np.isnan(time_s) else f", {time_s:.4f} s"
        return f"Frame {self._frames[position]}{when}"

    def _show_counts(self) -> None:
        """A legend that counts the kinds that occur, in a word each where there is little room."""
        dark = self.palette().color(QPalette.ColorRole.Window).lightness() < 128
        kinds = self.scrubber.kinds
        found = np.bincount(kinds, minlength=len(self._ticks)) if len(kinds) else ()
        long: list[str] = []
        short: list[str] = []
        told: list[str] = []
        for tick, count in zip(self._ticks, found, strict=False):
            if count:
                square = (
                    f'<span style="color:{(tick.dark if dark else tick.light) or "gray"}">■</span>'
                )
                for texts, words in ((long, tick.words.split(":")[0]), (short, tick.short)):
                    texts.append(f"{square}&nbsp;{count}&nbsp;{words.replace(' ', '&nbsp;')}")
                told.append(f"{count} {tick.words}")
        self.counts.setToolTip("\n".join(told))
        self.counts.setAccessibleName(", ".join(told))
        self.counts.setText(" &nbsp; ".join(long))
        if self.counts.sizeHint().width() > self.counts.width():
            self.counts.setText(" &nbsp; ".join(short))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Give the legend its words where there is room for them."""
        super().resizeEvent(event)
        self._show_counts()

    # --- going ------------------------------------------------------------------------------

    def step(self, by: int) -> None:
        """Go this many frames on, or back, as far as there are any."""
        self.scrubber.go_to(self.scrubber.position + by)

    @property
    def playing(self) -> bool:
        """Whether frames are shown one after another."""
        return self._timer.isActive()

    def set_playing(self, playing: bool) -> None:
        """Play from here, or from the first frame at the last; or stop."""
        playing = playing and len(self._frames) > 1
        if playing and not self.playing:
            if self.scrubber.position == len(self._frames) - 1:
                self.scrubber.go_to(0)
            self._timer.start(round(1000 / PLAY_HZ))
        elif not playing:
            self._timer.stop()
        self.play_button.setChecked(playing)
        style = QStyle.StandardPixmap
        icon = style.SP_MediaPause if playing else style.SP_MediaPlay
        self._show_icon(self.play_button, icon)
        self.play_button.setAccessibleName("Pause" if playing else "Play")
        self.play_button.setToolTip(
            "Stay at this frame (Space)" if playing else "Show one frame after another (Space)"
        )

    def _play_on(self) -> None:
        if self.scrubber.position >= len(self._frames) - 1:
            self.set_playing(False)
        else:
            self.step(1)

    def _moved(self, position: int) -> None:
        self.moved.emit(int(self._frames[position]))

    def _typed(self, number: int) -> None:
        """Go to the frame with the number typed, or the nearest there is."""
        position = int(np.abs(self._frames - number).argmin())
        if position == self.scrubber.position:
            self.set_frame(int(self._frames[position]))
        else:
            self.scrubber.go_to(position)
