"""How a frame is exposed, as bars and in words."""

from __future__ import annotations

from dataclasses import dataclass

from PySide6.QtWidgets import QFormLayout, QProgressBar

from labapp.core.images.exposure import Exposure
from labapp.gui.widgets.labels import Message, plain_tip
from labapp.gui.widgets.layouts import Group


@dataclass(frozen=True)
class ExposureBar:
    """A bar that shows how much.

    Parameters
    ----------
    name
        Of what.
    part
        From 0 to 1.
    words
        How much, in words.
    tip
        What it means.
    """

    name: str
    part: float
    words: str
    tip: str


class ExposureBars(Group):
    """Exposure, saturation and contrast of the frame in view, and a verdict in words."""

    def __init__(self) -> None:
        form = QFormLayout()
        self.bars = []
        for name in ("Exposure", "Saturation", "Contrast"):
            bar = QProgressBar()
            bar.setRange(0, 100)
            self.bars.append(bar)
            form.addRow(f"{name}:", bar)
        self.verdict = Message(3)
        super().__init__("Exposure of the frame in view", form, self.verdict)

    def show_exposure(self, exposure: Exposure, verdict: str, good: bool) -> None:
        """Show how a frame is exposed, and what to do about it."""
        for bar, widget in zip(bars(exposure), self.bars, strict=True):
            widget.setValue(round(100 * bar.part))
            widget.setFormat(bar.words)
            widget.setAccessibleName(f"{bar.name}: {bar.words}")
            widget.setToolTip(plain_tip(bar.tip))
        self.verdict.setText(f"{'●' if good else '▲'} {verdict}")


def bars(exposure: Exposure) -> tuple[ExposureBar, ExposureBar, ExposureBar]:
    """Exposure, saturation and contrast."""
    dots = exposure.snr > 0
    of = "dots" if dots else "pixels"
    contrast = f"{exposure.contrast:.0%}, {exposure.snr:.0f} × the noise" if dots else "no dots"
    return (
        ExposureBar(
            "Exposure",
            exposure.level,
            f"{exposure.level:.0%} of full scale",
            f"Level of the bright {of} as a part of the camera's full scale",
        ),
        ExposureBar(
            "Saturation",
            exposure.clipped,
            f"{exposure.clipped:.0%} of the {of} clipped",
            f"Part of the {of} at the top of the scale: their centres are inaccurate",
        ),
        ExposureBar(
            "Contrast",
            exposure.contrast,
            contrast,
            "How far the dots rise above their background, as a part of their level",
        ),
    )
