"""Small parts of the recording page: groups, words that wrap, and how a frame is exposed."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QFormLayout,
    QLabel,
    QProgressBar,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from labapp.core.images.exposure import Exposure
from labapp.gui.pages.capture.presenter import bars
from labapp.gui.views.fields import NumberField
from labapp.gui.views.labels import Message, headed, plain_label, plain_tip


class ExposureBars(QWidget):
    """Exposure, saturation and contrast of the frame in view, and a verdict in words."""

    def __init__(self) -> None:
        super().__init__()
        outer = QVBoxLayout(self)
        outer.setContentsMargins(0, 0, 0, 0)
        inner, layout = headed("Exposure of the frame in view")
        outer.addWidget(inner)
        form = QFormLayout()
        self.bars = []
        for name in ("Exposure", "Saturation", "Contrast"):
            bar = QProgressBar()
            bar.setRange(0, 100)
            self.bars.append(bar)
            form.addRow(f"{name}:", bar)
        layout.addLayout(form)
        self.verdict = Message(3)
        layout.addWidget(self.verdict)

    def show_exposure(self, exposure: Exposure, verdict: str, good: bool) -> None:
        """Show how a frame is exposed, and what to do about it."""
        for bar, widget in zip(bars(exposure), self.bars, strict=True):
            widget.setValue(round(100 * bar.part))
            widget.setFormat(bar.words)
            widget.setAccessibleName(f"{bar.name}: {bar.words}")
            widget.setToolTip(plain_tip(bar.tip))
        self.verdict.setText(f"{'●' if good else '▲'} {verdict}")


def wrapped(text: str = "") -> QLabel:
    """Words that wrap, even a SHA-256, and can be copied."""
    label = plain_label(breakable(text))
    label.setWordWrap(True)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    label.setToolTip(plain_tip(text))
    return label


def breakable(text: str) -> str:
    """Let long words (a checksum, a path) break where they must."""
    return "".join(
        f"{letter}\u200b" if len(text) > 24 and " " not in text else letter for letter in text
    )


def whole(label: str, lowest: int, tip: str) -> NumberField:
    """A field for a whole number."""
    return NumberField(label, lowest=lowest, highest=1, decimals=0, tooltip=tip)


def button(words: str, tip: str, work: Callable[[], object]) -> QPushButton:
    """A button that does something."""
    button = QPushButton(words)
    button.setToolTip(tip)
    button.clicked.connect(lambda _: work())
    return button
