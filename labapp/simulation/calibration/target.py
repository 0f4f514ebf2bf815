"""The marks on the imaging plane: the design of Fig. 5-1 (c), as a picture and for printing.

A thick dot at O′ and, along each axis, a bar with unit flags. The bars begin at the first unit, so
that the dot and the bars are three separate objects. They end at X′ = 10 and at Z′ = 4 units, which
puts their midpoints at (5.5, 0) and (0, 2.5), the points of Eq. 5-6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from labapp.core.values import BoolArray, FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.render import GreyImage

FINE = 4
"""Points along each side of a pixel at which the print is looked up."""

STRIP_ROWS = 4
"""Rows of pixels that are rendered at a time: few enough to stay in the processor's cache."""


@dataclass(frozen=True)
class Target:
    """Marks on the imaging plane."""

    unit_mm: float = 6.35
    """Length of a unit. The default is a quarter of an inch: ten of them fit on the 4-inch plate
    and into the picture of it.
    """
    x_units: int = 10
    z_units: int = 4
    """Ends of the bars, in units; they begin at 1."""
    bar_mm: float = 1.6
    flag_mm: float = 0.4
    dot_mm: float = 4.0
    """Thickness of the bars, thickness of the unit flags, diameter of the dot at the origin."""
    flag_length_mm: float = 1.2
    """Length of a flag on either side of its bar."""
    plate_mm: float = 101.6
    margin_mm: float = 7.0
    """Edge of the square plate; distance of O′ from its left and its lower edge."""

    @property
    def x_middle_mm(self) -> float:
        """X′ of the midpoint of the bar on O′X′."""
        return (1 + self.x_units) / 2 * self.unit_mm

    @property
    def z_middle_mm(self) -> float:
        """Z′ of the midpoint of the bar on O′Z′."""
        return (1 + self.z_units) / 2 * self.unit_mm

    def rectangles_mm(self) -> FloatArray:
        """Bars and flags as (X′ from, Z′ from, X′ to, Z′ to), shape (m, 4), mm."""
        unit, half, thin = self.unit_mm, self.bar_mm / 2, self.flag_mm / 2
        out = half + self.flag_length_mm
        along_x = [(unit, -half, self.x_units * unit, half)] + [
            (n * unit - thin, -out, n * unit + thin, out) for n in range(2, self.x_units)
        ]
        along_z = [(-half, unit, half, self.z_units * unit)] + [
            (-out, n * unit - thin, out, n * unit + thin) for n in range(2, self.z_units)
        ]
        return np.array(along_x + along_z)

    def inked(self, plane_mm: FloatArray) -> BoolArray:
        """Whether points (X′, Z′), shape (…, 2), mm, are on a mark, shape (…)."""
        x, z = plane_mm[..., 0], plane_mm[..., 1]
        ink = np.asarray(np.hypot(x, z) <= self.dot_mm / 2)
        for left, low, right, high in self.rectangles_mm():
            ink |= (x >= left) & (x <= right) & (z >= low) & (z <= high)
        return ink


@dataclass(frozen=True)
class TargetLook:
    """Appearance of the calibration picture: dim and of low contrast, as in Fig. 5-2."""

    light: float = 32.0
    dark: float = 12.0
    """Grey levels of plane and marks in the middle of the picture."""
    vignetting: float = 0.35
    """Fraction of the light lost at the corners."""
    slope: float = 0.25
    """Fraction by which the light decreases from one side of the picture to the other."""
    blur_px: float = 0.9
    noise: float = 1.3
    """Standard deviation of the camera's blur, px, and of its noise, grey levels."""
    specks: int = 60
    """Number of dead and hot pixels (the impulse noise of Eq. 5-2)."""


def render_target(
    target: Target, view: CameraView, look: TargetLook, rng: np.random.Generator
) -> GreyImage:
    """Render the calibration picture, shape (height, width), grey levels."""
    shape = (view.height_px, view.width_px)
    ink = np.vstack(
        [
            _share_of_ink(target, view, range(row, min(row + STRIP_ROWS, shape[0])))
            for row in range(0, shape[0], STRIP_ROWS)
        ]
    )
    y, x = (np.linspace(-1, 1, size) for size in shape)
    fall = 1 - look.vignetting * (x**2 + y[:, None] ** 2) / 2 + look.slope * x / 2
    seen = gaussian_filter((look.light + (look.dark - look.light) * ink) * fall, look.blur_px)
    seen += look.noise * rng.normal(size=shape)
    seen.flat[rng.integers(0, seen.size, look.specks)] = rng.choice([2.0, 60.0], look.specks)
    return np.asarray(np.clip(np.rint(seen), 0, 255).astype(np.uint8))


def _share_of_ink(target: Target, view: CameraView, rows: range) -> FloatArray:
    """Return the black share of each pixel of some rows, shape (rows, width)."""
    columns = range(view.width_px)
    u, v = (
        (np.arange(FINE * over.start, FINE * over.stop) + 0.5) / FINE - 0.5
        for over in (columns, rows)
    )
    ink = target.inked(view.to_plane(np.stack(np.meshgrid(u, v), axis=-1)))
    return np.asarray(ink.reshape(len(rows), FINE, len(columns), FINE).mean(axis=(1, 3)))


def target_svg(target: Target) -> str:
    """Draw the plate at true size as an SVG document, to be printed without scaling."""
    plate, margin = target.plate_mm, target.margin_mm

    def rectangle(left: float, low: float, right: float, high: float) -> str:
        # SVG counts downwards from the upper left corner of the plate.
        return (
            f'    <rect x="{margin + left:.3f}" y="{plate - margin - high:.3f}"'
            f' width="{right - left:.3f}" height="{high - low:.3f}"/>'
        )

    marks = "\n".join(rectangle(*map(float, row)) for row in target.rectangles_mm())
    note = (
        f"unit {target.unit_mm:g} mm · middles X′ {target.x_middle_mm:g}, "
        f"Z′ {target.z_middle_mm:g} mm · edge {plate:g} mm: print at 100 %"
    )
    return f"""<svg xmlns="http://www.w3.org/2000/svg" version="1.1" \
width="{plate:g}mm" height="{plate:g}mm" viewBox="0 0 {plate:g} {plate:g}">
  <title>Imaging plane, {plate:g} mm, unit {target.unit_mm:g} mm</title>
  <rect x="0.05" y="0.05" width="{plate - 0.1:g}" height="{plate - 0.1:g}" fill="white" \
stroke="black" stroke-width="0.1"/>
  <g fill="black">
    <circle cx="{margin:g}" cy="{plate - margin:g}" r="{target.dot_mm / 2:g}"/>
{marks}
  </g>
  <text x="{plate - 2:g}" y="4" font-family="sans-serif" font-size="2.2" text-anchor="end" \
fill="#777">{note}</text>
</svg>
"""
