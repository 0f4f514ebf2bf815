"""The timeline: one tick per frame, the frame in view, playing and jumping."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QSignalBlocker, Qt, QTimer, Signal
from PySide6.QtGui import QIcon, QPainter, QPalette, QResizeEvent
from PySide6.QtWidgets import (
    QSizePolicy,
    QSpinBox,
    QStyle,
    QToolButton,
    QWidget,
)

from labapp.gui.theme import FollowsTheme, is_dark
from labapp.gui.widgets.labels import plain_label
from labapp.gui.widgets.layouts import fill, hbox, vbox
from labapp.gui.widgets.scrubber import Scrubber, Tick

PLAY_HZ = 30.0
"""Maximum number of frames per second while playing; every frame is shown."""


class Timeline(FollowsTheme, QWidget):
    """The scrubber with its buttons, the frame's number and time.

    It is independent of the session: it is given the numbers, times and kinds of the frames.
    """

    moved = Signal(int)
    """The operator went to a frame: its number."""
    jumped = Signal(str, bool)
    """The operator asked for the next frame to check or corrected: ``doubtful`` or ``corrected``,
    and whether forward.
    """

    def __init__(self, ticks: Sequence[Tick]) -> None:
        super().__init__()
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.ActionsContextMenu)
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
        self.position_text = plain_label()
        self.position_text.setMinimumWidth(
            self.fontMetrics().horizontalAdvance("of 10000 · 0000.0000 s  ")
        )
        self.counts = plain_label()
        self.counts.setTextFormat(Qt.TextFormat.RichText)
        self.counts.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.counts.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self._lay_out()
        self.follow_theme()

    def take_colours(self) -> None:
        """Draw icons and the legend's squares in the window's colours."""
        self._show_counts()
        for button, icon in list(self._icons.items()):
            self._show_icon(button, icon)

    def _lay_out(self) -> None:
        style = QStyle.StandardPixmap
        self.play_button = self._button("Play", "Show one frame after another", style.SP_MediaPlay)
        self.play_button.setCheckable(True)
        self.play_button.clicked.connect(self.set_playing)
        row = hbox()
        for name, tip, icon, go in (
            ("First frame", "Go to the first frame (Home)", style.SP_MediaSkipBackward, -(10**9)),
            ("Previous frame", "Go to the frame before (←)", style.SP_MediaSeekBackward, -1),
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
        fill(row, self.number, self.position_text)
        for kind, words, which, key in (
            ("doubtful", "to check", "in doubt, out of date, or that could not be measured", "F8"),
            ("corrected", "corrected", "that was corrected by hand", "F7"),
        ):
            previous, following = f"previous frame {words}", f"next frame {words}"
            row.addSpacing(8)
            row.addWidget(self._jump(kind, previous, f"{which} (Shift+{key})", False))
            row.addWidget(plain_label(words))
            row.addWidget(self._jump(kind, following, f"{which} ({key})", True))
        row.addSpacing(8)
        row.addWidget(self.counts, 1)
        column = vbox(self.scrubber, row, of=self)
        column.setContentsMargins(6, 4, 6, 4)
        column.setSpacing(4)

    def _jump(self, kind: str, name: str, which: str, forward: bool) -> QToolButton:
        where = "next" if forward else "previous"
        button = self._button(name.capitalize(), f"Go to the {where} frame {which}", None)
        button.setText("▸" if forward else "◂")
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
        """Show an icon of the style in the colour of button texts: the original icons are black."""
        self._icons[button] = icon
        ratio, shown = self.devicePixelRatioF(), QIcon()
        for mode, group in (
            (QIcon.Mode.Normal, QPalette.ColorGroup.Active),
            (QIcon.Mode.Disabled, QPalette.ColorGroup.Disabled),
        ):
            pixmap = self.style().standardIcon(icon).pixmap(button.iconSize(), ratio)
            with QPainter(pixmap) as painter:
                painter.setCompositionMode(QPainter.CompositionMode.CompositionMode_SourceIn)
                colour = self.palette().color(group, QPalette.ColorRole.ButtonText)
                painter.fillRect(pixmap.rect(), colour)
            shown.addPixmap(pixmap, mode)
        button.setIcon(shown)

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
            Numbers of the frames, ascending, shape (n,).
        times_s
            Times of the frames, shape (n,), s; NaN if unknown.
        kinds
            Indices into the ticks, shape (n,).
        """
        self._frames, self._times_s = frames, times_s
        self.scrubber.set_kinds(kinds)
        self.setEnabled(len(frames) > 0)
        with QSignalBlocker(self.number):
            self.number.setRange(*((int(frames[0]), int(frames[-1])) if len(frames) else (0, 0)))
        self._show_counts()

    def set_frame(self, frame: int) -> None:
        """Mark the frame in view."""
        if not len(self._frames):
            self.position_text.setText("")
            return
        position = int(np.searchsorted(self._frames, frame).clip(0, len(self._frames) - 1))
        self.scrubber.set_position(position)
        with QSignalBlocker(self.number):
            self.number.setValue(frame)
        time_s = self._times_s[position]
        when = "" if np.isnan(time_s) else f" · {time_s:.4f} s"
        self.position_text.setText(f"{position + 1} of {len(self._frames)}{when}")

    def described(self, position: int) -> str:
        """Text of a frame."""
        time_s = self._times_s[position]
        when = "" if np.isnan(time_s) else f", {time_s:.4f} s"
        return f"Frame {self._frames[position]}{when}"

    def _show_counts(self) -> None:
        """A legend that counts the kinds that occur: in a word each where there is little room.

        It is empty on a small screen, where the tooltip of the scrubber has it.
        """
        dark = is_dark(self.palette())
        kinds = self.scrubber.kinds
        found = np.bincount(kinds, minlength=len(self._ticks)) if len(kinds) else ()
        long: list[str] = []
        short: list[str] = []
        parts: list[str] = []
        for tick, count in zip(self._ticks, found, strict=False):
            if count:
                square = (
                    f'<span style="color:{(tick.dark if dark else tick.light) or "gray"}">■</span>'
                )
                for texts, words in ((long, tick.words.split(":")[0]), (short, tick.short)):
                    texts.append(f"{square}&nbsp;{count}&nbsp;{words.replace(' ', '&nbsp;')}")
                parts.append(f"{count} {tick.words}")
        self.counts.setToolTip("\n".join(parts))
        self.counts.setAccessibleName(", ".join(parts))
        for texts in (long, short, []):
            self.counts.setText(" &nbsp; ".join(texts))
            if self.counts.sizeHint().width() <= self.counts.width():
                break

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Show the texts of the legend if there is space for them."""
        super().resizeEvent(event)
        self._show_counts()

    # --- going ------------------------------------------------------------------------------

    def step(self, by: int) -> None:
        """Go this many frames forwards or backwards, up to the first or last frame."""
        self.scrubber.go_to(self.scrubber.position + by)

    @property
    def playing(self) -> bool:
        """Whether frames are shown one after another."""
        return self._timer.isActive()

    def set_playing(self, playing: bool) -> None:
        """Play from here, or from the first frame if the last is in view; or stop."""
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
        """Go to the frame with the typed number, or the nearest one."""
        position = int(np.abs(self._frames - number).argmin())
        if position == self.scrubber.position:
            self.set_frame(int(self._frames[position]))
        else:
            self.scrubber.go_to(position)
