"""Pictures of scenes at paper size: so wide in mm, black on white, without empty margins."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from labapp.export.rendering.drawing import Camera, Direction
from labapp.export.rendering.scene import Scene
from labapp.export.rendering.studio import Picture, Studio

MM_AN_INCH = 25.4

SMALLER = 0.75
"""Texts on paper are smaller than on the screen by this: 7.5 points."""

MARGIN_MM = 1.0


@dataclass(frozen=True)
class Paper:
    """Size of a picture on paper."""

    width_mm: float = 90.0
    """One column of a journal; two are 180 mm."""
    dpi: int = 300

    @property
    def width_px(self) -> int:
        """Its width in pixels."""
        return round(self.width_mm / MM_AN_INCH * self.dpi)


def paper_picture(
    scene: Scene, direction: Direction | Camera, paper: Paper, high_over_wide: float = 0.75
) -> Picture:
    """Draw a scene for paper; returns a picture, shape (height, width, 3), B, G, R.

    Parameters
    ----------
    direction
        Where it is looked at from.
    paper
        Width of the picture, margins cropped.
    high_over_wide
        Shape of the view, before its empty margins are cropped.
    """
    scene = replace(scene, foreground="#000000", background="#ffffff")
    wide, wanted = float(paper.width_px), paper.width_px
    for _ in range(2):  # once to find the margins, once as wide as the rest is to be
        studio = Studio((round(wide), round(wide * high_over_wide)), direction, paper.dpi * SMALLER)
        picture = studio.draw(scene)
        studio.close()
        cropped = _crop(picture, round(MARGIN_MM / MM_AN_INCH * paper.dpi))
        wide *= wanted / cropped.shape[1]
    height = round(cropped.shape[0] * wanted / cropped.shape[1])
    return np.asarray(cv2.resize(cropped, (wanted, height), interpolation=cv2.INTER_AREA), np.uint8)


def _crop(picture: Picture, margin: int) -> Picture:
    """Cut off the sides where there is nothing but white, but for a margin."""
    ink = picture.min(axis=2) < 250
    if not ink.any():
        return picture
    ends = []
    for axis in (1, 0):
        found = np.flatnonzero(ink.any(axis=axis))
        ends.append(slice(max(found[0] - margin, 0), found[-1] + 1 + margin))
    return picture[tuple(ends)]
