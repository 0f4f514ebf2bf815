"""View of a printed picture (PNG, black on white); on a dark background it is white on black."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import Qt
from PySide6.QtGui import QGuiApplication, QImage, QPixmap, QResizeEvent
from PySide6.QtWidgets import QFrame, QScrollArea

from labapp.gui.theme import FollowsTheme, is_dark
from labapp.gui.widgets.buttons import add_menu
from labapp.gui.widgets.labels import plain_label

MOST_SCALE = 1.25
"""Largest scale of the view relative to the printed size."""


class Sheet(FollowsTheme, QScrollArea):
    """A picture of the available width, up to slightly more than its printed size."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._printed = QImage()
        self._paper = plain_label()
        self._paper.setAlignment(Qt.AlignmentFlag.AlignHCenter | Qt.AlignmentFlag.AlignTop)
        self._paper.setMinimumWidth(1)  # it is as wide as the view, whatever it showed before
        self.setWidget(self._paper)
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOn)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setAccessibleName(name)
        self.describe("")
        add_menu(self, ("Copy picture", self.copy_picture))
        self.follow_theme()

    def describe(self, words: str) -> None:
        """Set the description of the picture."""
        keys = "Arrow keys and Page Up and Down move it; Ctrl+C copies it"
        self.setAccessibleDescription(f"{words}. {keys}" if words else keys)

    def show_png(self, content: bytes, words: str) -> None:
        """Show a picture; ``words`` is the text for a screen reader."""
        self._printed = QImage.fromData(content).convertToFormat(QImage.Format.Format_RGB32)
        self.describe(words)
        self.take_colours()

    def show_words(self, words: str) -> None:
        """Show words instead of a picture."""
        self._printed = QImage()
        self._paper.setText(words)
        self.describe(words)

    def copy_picture(self) -> None:
        """Copy the picture to the clipboard as printed."""
        if not self._printed.isNull():
            QGuiApplication.clipboard().setImage(self._printed)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Adapt to the width."""
        super().resizeEvent(event)
        self.take_colours()

    def take_colours(self) -> None:
        """Show the picture with the available width, in the window's colours."""
        if self._printed.isNull():
            return
        ratio = self.devicePixelRatioF()
        image = self._printed
        # Enlarged only as far as all of it can be seen without scrolling.
        whole = self.viewport().height() * image.width() / image.height()
        enlarged = min(MOST_SCALE * image.width(), max(whole, image.width()))
        wide = min(self.viewport().width(), round(enlarged))
        if is_dark(self.palette()):
            image = _as_image(turned(_levels(image), self.palette().base().color().lightness()))
        scaled = image.scaledToWidth(
            round(wide * ratio), Qt.TransformationMode.SmoothTransformation
        )
        scaled.setDevicePixelRatio(ratio)
        self._paper.setPixmap(QPixmap.fromImage(scaled))


def turned(levels: npt.NDArray[np.uint8], ground: int) -> npt.NDArray[np.uint8]:
    """A picture with inverted brightness and the same hues; white becomes grey level ``ground``.

    Parameters
    ----------
    levels
        Shape (height, width, 3).
    ground
        0 … 255.
    """
    whole = levels.astype(np.int32)
    turned_over = (
        whole + 255 - whole.max(axis=-1, keepdims=True) - whole.min(axis=-1, keepdims=True)
    )
    return np.asarray(ground + turned_over * (255 - ground) // 255, np.uint8)


def _levels(image: QImage) -> npt.NDArray[np.uint8]:
    lines = np.frombuffer(image.constBits(), np.uint8).reshape(image.height(), -1, 4)
    return lines[:, : image.width(), :3]


def _as_image(levels: npt.NDArray[np.uint8]) -> QImage:
    height, width, _ = levels.shape
    whole = np.full((height, width, 4), 255, np.uint8)
    whole[..., :3] = levels
    held = whole.tobytes()  # until it is copied
    return QImage(held, width, height, 4 * width, QImage.Format.Format_RGB32).copy()
