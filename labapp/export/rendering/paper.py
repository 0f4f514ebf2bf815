"""Pictures of scenes for print: width in mm, black on white, margins cropped."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from labapp.export.rendering.drawing import Camera, Direction
from labapp.export.rendering.scene import Scene
from labapp.export.rendering.studio import Picture, Studio

MM_AN_INCH = 25.4

SMALLER = 0.75
"""Text size on paper relative to the screen: 7.5 points."""

MARGIN_MM = 1.0


@dataclass(frozen=True)
class Paper:
    """Size of a picture on paper."""

    width_mm: float = 90.0
    """Width; the default is one column of a journal, two are 180 mm."""
    dpi: int = 300

    @property
    def width_px(self) -> int:
        """Width in pixels."""
        return round(self.width_mm / MM_AN_INCH * self.dpi)


def paper_picture(
    scene: Scene, direction: Direction | Camera, paper: Paper, high_over_wide: float = 0.75
) -> Picture:
    """Draw a scene for print; returns a picture, shape (height, width, 3), B, G, R.

    Parameters
    ----------
    paper
        Width of the cropped picture, and resolution.
    high_over_wide
        Aspect ratio of the view before cropping.
    """
    scene = replace(scene, foreground="#000000", background="#ffffff")
    wide, wanted = float(paper.width_px), paper.width_px
    for _ in range(2):  # the first time to determine the margins
        studio = Studio((round(wide), round(wide * high_over_wide)), direction, paper.dpi * SMALLER)
        picture = studio.draw(scene)
        studio.close()
        cropped = _crop(picture, round(MARGIN_MM / MM_AN_INCH * paper.dpi))
        wide *= wanted / cropped.shape[1]
    height = round(cropped.shape[0] * wanted / cropped.shape[1])
    return np.asarray(cv2.resize(cropped, (wanted, height), interpolation=cv2.INTER_AREA), np.uint8)


def _crop(picture: Picture, margin: int) -> Picture:
    """Crop the white borders, except a margin."""
    ink = picture.min(axis=2) < 250
    if not ink.any():
        return picture
    ends = []
    for axis in (1, 0):
        found = np.flatnonzero(ink.any(axis=axis))
        ends.append(slice(max(found[0] - margin, 0), found[-1] + 1 + margin))
    return picture[tuple(ends)]
