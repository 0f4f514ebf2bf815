"""The exposure of a frame as bars and text."""

from __future__ import annotations

from PySide6.QtWidgets import QFormLayout, QProgressBar

from labapp.core.images.exposure import Exposure
from labapp.gui.widgets.labels import Message, plain_tip
from labapp.gui.widgets.layouts import Group

BARS = (
    ("Exposure", "Level of the bright {} as a fraction of the camera's full scale"),
    ("Saturation", "Part of the {} at the top of the scale: their centres are inaccurate"),
    ("Contrast", "How far the dots rise above their background, as a part of their level"),
)
"""Names and explanations, for dots or pixels."""


LINES_NOT_JUDGED = "Lines are not judged: expose as long as nothing in them is clipped."


class ExposureBars(Group):
    """Exposure, saturation and contrast of the frame in view, and an assessment."""

    def __init__(self) -> None:
        form = self._form = QFormLayout()
        self.bars = []
        for name, _ in BARS:
            bar = QProgressBar()
            bar.setRange(0, 100)
            self.bars.append(bar)
            form.addRow(f"{name}:", bar)
        self.verdict = Message(3)
        super().__init__("Exposure of the frame in view", form, self.verdict)

    def show_exposure(self, exposure: Exposure, verdict: str, good: bool) -> None:
        """Show the exposure of a frame and how to correct it."""
        self._show_bars(exposure)
        self.verdict.setText(f"{'●' if good else '▲'} {verdict}")

    def show_lines(self, exposure: Exposure) -> None:
        """Show how bright a frame of lines is; whether it is right is not known."""
        self._show_bars(exposure, of_lines=True)
        self.verdict.setText(f"○ {LINES_NOT_JUDGED}")

    def _show_bars(self, exposure: Exposure, of_lines: bool = False) -> None:
        self._form.setRowVisible(self.bars[-1], not of_lines)
        of = "dots" if exposure.snr > 0 else "pixels"
        for bar, (name, tip), (part, words) in zip(self.bars, BARS, bars(exposure), strict=True):
            bar.setValue(round(100 * part))
            bar.setFormat(words)
            bar.setAccessibleName(f"{name}: {words}")
            bar.setToolTip(plain_tip(tip.format(of)))


def bars(exposure: Exposure) -> tuple[tuple[float, str], ...]:
    """Exposure, saturation and contrast: 0 … 1, and as text."""
    dots = exposure.snr > 0
    contrast = f"{exposure.contrast:.0%}, {exposure.snr:.0f} × the noise" if dots else "no dots"
    clipped = f"{exposure.clipped:.0%} of the {'dots' if dots else 'pixels'} clipped"
    return (
        (exposure.level, f"{exposure.level:.0%} of full scale"),
        (exposure.clipped, clipped),
        (exposure.contrast, contrast),
    )
