"""Shape parameters of a pool's surface, from which later work estimates penetration.

Width, length and convexity together predicted the width of the back-side bead best (W. J. Zhang et
al., "Characterization of Three-Dimensional Weld Pool Surface in GTAW", Weld. J. 91 (2012) 195-s).
Asymmetry and slope at the boundary indicate a torch beside the joint, undercut and wetting.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.spline import SplineBasis
from labapp.core.surface.surface import Surface
from labapp.core.values import FloatArray

RIM = 0.99
"""Fraction of the distance from centre to boundary at which the slope is evaluated."""

SPOKES = 48
"""Directions from the middle of the boundary, the first along −Y; a multiple of 4."""

STEP_MM = 0.01
"""Step of the finite differences of slopes."""

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(8)
FRACTION, WEIGHT = (_NODE + 1) / 2, _WEIGHT / 2
_PHI = -np.pi / 2 + 2 * np.pi * np.arange(SPOKES) / SPOKES
_WAY = np.column_stack([np.cos(_PHI), np.sin(_PHI)])
_ENDS = [0, SPOKES // 2]
"""Spokes along the longitudinal section: towards −Y and +Y."""

_RIGHT = (1 + np.sign(np.round(_WAY[:, :1], 9))) / 2
"""Share of each spoke that is right of that section, shape (SPOKES, 1)."""


def shape_of(surface: Surface, boundary: Boundary) -> FloatArray:
    """Return convexity (mm), asymmetry and wetting slope (°) of a surface, shape (3,).

    * Convexity: mean height of the longitudinal section through the middle of the boundary, its
      area over its length. Negative for a concave pool.
    * Asymmetry: volume between surface and work piece right of that section (+X) minus that left
      of it, over their sum; volumes below the work piece are positive too.
    * Wetting slope: mean angle along the boundary between the surface and the work piece; positive
      if the surface rises inwards.

    Parameters
    ----------
    surface
        Surface that is defined everywhere within the boundary.
    boundary
        The pool's boundary.
    """
    return _Samples.of(surface, boundary).shape


def shape_and_gradients(
    basis: SplineBasis, coefficients: FloatArray, boundary: Boundary, boundary_slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return `shape_of` a spline surface, shape (3,), and its derivatives, shape (3, p).

    Derivatives are by the spline coefficients; the boundary moves with the surface.

    Parameters
    ----------
    basis, coefficients
        The surface: splines and their coefficients, shape (p,), mm.
    boundary, boundary_slope
        See `trace_boundary`.
    """
    from labapp.core.surface.kernels import spline_kernels

    surface = _Evaluated(basis, coefficients)
    samples = _Samples.of(surface, boundary)
    outline = boundary.points_mm
    extremes = [int(np.argmin(outline[:, 0])), int(np.argmax(outline[:, 0]))]
    half = -0.5 / boundary_slope[extremes, 0]
    terms = (
        _convexity_terms(samples, surface, boundary, boundary_slope),
        _asymmetry_terms(samples, boundary, boundary_slope),
        _wetting_terms(samples, surface, boundary, boundary_slope),
    )
    gradients = []
    for places, shares, by_middle in terms:
        # The middle of the boundary moves by half the displacement of each side.
        every = np.concatenate([*places, outline[extremes, :2]])
        share = np.concatenate([*shares, by_middle * half])
        gradients.append(
            spline_kernels.gradient_of_sum(basis.grid, len(coefficients), every, share)
        )
    return samples.shape, np.stack(gradients)


@dataclass(frozen=True)
class _Evaluated:
    """A spline surface within its rectangle, evaluated by the compiled kernels."""

    basis: SplineBasis
    coefficients: FloatArray

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return np.asarray(self._at(x_mm, y_mm)[0].reshape(x_mm.shape))

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return np.asarray(self._at(x_mm, y_mm)[1:].T.reshape(*x_mm.shape, 2))

    def _at(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        from labapp.core.surface.kernels import spline_kernels

        places = np.column_stack([x_mm.ravel(), y_mm.ravel()])
        return spline_kernels.surface_at(self.basis.grid, self.coefficients, places)


_Terms = tuple[list[FloatArray], list[FloatArray], float]
"""A derivative as Σ share · height at places: places, shape (n, 2) each, and shares, shape (n,)
each; and the derivative by X of the boundary's middle."""


@dataclass(frozen=True)
class _Samples:
    """Samples of a surface on spokes from the middle of its boundary, and next to the boundary.

    Parameters
    ----------
    middle_mm, reach_mm
        Middle of the boundary, shape (2,); length of each spoke, shape (s,).
    place_mm, height_mm
        Shape (s, r, 2) and (s, r).
    length_mm, inward, rim_mm, rise
        At each of m boundary points: the length of boundary that it represents, shape (m,); the
        inward normal and the place where the slope is evaluated, shape (m, 2); the slope, shape
        (m,).
    """

    middle_mm: FloatArray
    reach_mm: FloatArray
    place_mm: FloatArray
    height_mm: FloatArray
    length_mm: FloatArray
    inward: FloatArray
    rim_mm: FloatArray
    rise: FloatArray

    @classmethod
    def of(cls, surface: Surface, boundary: Boundary) -> _Samples:
        outline = boundary.points_mm[:, :2]
        middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
        reach = _around(boundary, middle, np.linalg.norm(outline - middle, axis=1), _PHI)
        place = middle + (reach[:, None, None] * (1 - 1e-9)) * FRACTION[:, None] * _WAY[:, None]
        tangent = (np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)) / 2
        length = np.hypot(*tangent.T)
        inward = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / length[:, None]
        rim = boundary.center_mm + RIM * (outline - boundary.center_mm)
        rise = np.sum(surface.gradient(rim[:, 0], rim[:, 1]) * inward, axis=1)
        height = surface.height(place[..., 0], place[..., 1])
        return cls(middle, reach, place, height, length, inward, rim, np.asarray(rise))

    @property
    def section_mm(self) -> tuple[FloatArray, FloatArray]:
        """Places along the longitudinal section, shape (2r, 2), and lengths they represent."""
        lengths = self.reach_mm[_ENDS][:, None] * WEIGHT
        return self.place_mm[_ENDS].reshape(-1, 2), lengths.ravel()

    @property
    def area_mm2(self) -> FloatArray:
        """Area represented by each sample, shape (s, r)."""
        return self.reach_mm[:, None] ** 2 * (WEIGHT * FRACTION) * (2 * np.pi / SPOKES)

    @cached_property
    def shape(self) -> FloatArray:
        """See `shape_of`."""
        volume = self.area_mm2 * np.abs(self.height_mm)
        sides = np.sum(_RIGHT * volume), np.sum((1 - _RIGHT) * volume)
        lengths = self.section_mm[1]
        return np.array(
            [
                self.height_mm[_ENDS].ravel() @ lengths / lengths.sum(),
                (sides[0] - sides[1]) / max(sum(sides), 1e-30),
                np.degrees(np.arctan(self.rise)) @ self.length_mm / self.length_mm.sum(),
            ]
        )


def _around(
    boundary: Boundary, middle_mm: FloatArray, values: FloatArray, phi: FloatArray
) -> FloatArray:
    """Interpolate values at boundary points, shape (m,), at angles about a middle."""
    offset = boundary.points_mm[:, :2] - middle_mm
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    order = np.argsort(angle)
    return np.asarray(np.interp(phi, angle[order], values[order], period=2 * np.pi))


def _moved(boundary_slope: FloatArray) -> FloatArray:
    """Displacement of boundary points per mm of rise of the surface, shape (m, 2): −∇h/|∇h|²."""
    return np.asarray(-boundary_slope / np.sum(boundary_slope**2, axis=1)[:, None])


def _convexity_terms(
    samples: _Samples, surface: Surface, boundary: Boundary, boundary_slope: FloatArray
) -> _Terms:
    """Terms of the convexity; the ends of the section stay on the boundary as the middle moves."""
    places, lengths = samples.section_mm
    middle, length = samples.middle_mm, lengths.sum()
    ends = middle + samples.reach_mm[_ENDS][:, None] * _WAY[_ENDS]
    x, y = (_around(boundary, middle, slope, _PHI[_ENDS]) for slope in boundary_slope.T)
    height = _around(boundary, middle, boundary.points_mm[:, 2], _PHI[_ENDS])
    outwards = _WAY[_ENDS, 1] * (height - samples.shape[0])
    aside = lengths @ surface.gradient(*places.T)[:, 0] - outwards @ (x / y)
    return [places, ends], [lengths / length, -outwards / y / length], float(aside / length)


def _asymmetry_terms(samples: _Samples, boundary: Boundary, boundary_slope: FloatArray) -> _Terms:
    """Terms of the asymmetry; the section that divides the volume moves with the middle."""
    outline, middle, lean = boundary.points_mm, samples.middle_mm, samples.shape[1]
    height, area = samples.height_mm, samples.area_mm2
    total = np.sum(area * np.abs(height))
    right = (1 + np.sign(outline[:, 0] - middle[0])) / 2
    outwards = -np.sum(samples.inward * _moved(boundary_slope), axis=1)
    outwards *= np.abs(outline[:, 2]) * samples.length_mm
    # The weight of the right side is 1 − asymmetry, that of the left −(1 + asymmetry).
    within = ((2 * _RIGHT - 1 - lean) * area * np.sign(height)).ravel() / total
    across = samples.section_mm[1] @ np.abs(height[_ENDS]).ravel()
    places = [samples.place_mm.reshape(-1, 2), outline[:, :2]]
    return places, [within, (2 * right - 1 - lean) * outwards / total], float(-2 * across / total)


def _wetting_terms(
    samples: _Samples, surface: Surface, boundary: Boundary, boundary_slope: FloatArray
) -> _Terms:
    """Terms of the wetting slope: tilt of the surface, and displacement of the boundary."""
    length, rise, moved = samples.length_mm, samples.rise, _moved(boundary_slope)
    step = STEP_MM * samples.inward
    more, less = samples.rim_mm + step, samples.rim_mm - step
    bend = (surface.gradient(*more.T) - surface.gradient(*less.T)) / (2 * STEP_MM)
    turned = np.degrees(length / (1 + rise**2) / length.sum())
    over = (np.degrees(np.arctan(rise)) - samples.shape[2]) / length.sum()
    pull = over[:, None] * np.column_stack([samples.inward[:, 1], -samples.inward[:, 0]])
    grown = (np.roll(pull, 1, axis=0) - np.roll(pull, -1, axis=0)) / 2
    by_move = np.sum((RIM * turned[:, None] * bend + grown) * moved, axis=1)
    slope = turned / (2 * STEP_MM)
    return [boundary.points_mm[:, :2], more, less], [by_move, slope, -slope], 0.0
