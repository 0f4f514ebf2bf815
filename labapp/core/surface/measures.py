"""Reconstruction → Measures: reflection errors and the pool's size (Eq. 6-3 … 6-8, §7.3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from labapp.core.geometry.optics import project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.shape import shape_of
from labapp.core.surface.surface import Surface
from labapp.core.values import BoolArray, FloatArray, IntArray

RINGS = 16
"""Samples along each radius; Gauss–Legendre, so that smooth pools are integrated exactly."""

NODES_MM = 0.1
"""Distance of the grid nodes among which extremes are searched; files have the same nodes."""

MOST_STEPS = 300
"""Most of these distances along the larger extent of a pool; above it, they are longer."""

STENCIL_MM = 0.1
"""Half the size of the patch on which an extreme is refined."""


@dataclass(frozen=True, repr=False)
class Measures:
    """Measures of one pool. Lengths in mm, z above the work piece.

    Parameters
    ----------
    are_mm, mre_mm
        Average and maximum reflection error (Eq. 6-3, 6-4): distances of computed from captured
        dots, mapped onto the work piece. Dots whose ray does not meet the surface are excluded.
    are_inner_mm, mre_inner_mm
        The same without the first and the last row and both ends of each row (ARE-I, MRE-I of
        §6.4.2); NaN if nothing is left.
    width_mm, length_mm
        Extent of the boundary along X and along Y.
    height_mm, depth_mm
        Largest and smallest z within the boundary and on it.
    area_mm2
        Area within the boundary, seen from above.
    volume_mm3
        Integral of z over that area: negative for a concave pool.
    center_x_mm, center_y_mm
        The "center point of the weld pool" (§7.2): origin of the boundary's polar coordinates.
    peak_x_mm, peak_y_mm
        Point of the surface farthest from the work piece: the highest point of a convex pool, the
        lowest of a concave one.
    width_sigma_mm, length_sigma_mm, height_sigma_mm, depth_sigma_mm
        Standard uncertainties due to noise, level and set-up; NaN if the scheme gives none, and for
        a depth that is that of the boundary.
    area_sigma_mm2, volume_sigma_mm3
        The same of area and volume.
    width_sigma_level_mm … volume_sigma_level_mm3
        Part of the level in these six; NaN also in results of versions that did not store it.
    width_sigma_setup_mm … volume_sigma_setup_mm3
        Part of the set-up; NaN in results of versions whose ± included noise and level only.
    convexity_mm, asymmetry, wetting_slope_deg
        See `shape_of`; NaN, as are all that follow, in results of versions without them.
    convexity_sigma_mm … wetting_slope_sigma_setup_deg
        Their standard uncertainties, and the parts of level and set-up.
    own_are_mm
        See `Reconstruction`; NaN if the scheme gives none.
    scale_x, scale_z
        Factors from a residual along X′, Z′ to the error along X, Y on the work piece: W_p/W_r and
        L_p/L_r (Eq. 6-5). NaN in results of versions that did not store them.
    """

    are_mm: float
    mre_mm: float
    are_inner_mm: float
    mre_inner_mm: float
    width_mm: float
    length_mm: float
    height_mm: float
    depth_mm: float
    area_mm2: float
    volume_mm3: float
    center_x_mm: float
    center_y_mm: float
    peak_x_mm: float
    peak_y_mm: float
    width_sigma_mm: float
    length_sigma_mm: float
    height_sigma_mm: float
    depth_sigma_mm: float
    area_sigma_mm2: float
    volume_sigma_mm3: float
    own_are_mm: float = math.nan
    scale_x: float = math.nan
    scale_z: float = math.nan
    width_sigma_level_mm: float = math.nan
    length_sigma_level_mm: float = math.nan
    height_sigma_level_mm: float = math.nan
    depth_sigma_level_mm: float = math.nan
    area_sigma_level_mm2: float = math.nan
    volume_sigma_level_mm3: float = math.nan
    width_sigma_setup_mm: float = math.nan
    length_sigma_setup_mm: float = math.nan
    height_sigma_setup_mm: float = math.nan
    depth_sigma_setup_mm: float = math.nan
    area_sigma_setup_mm2: float = math.nan
    volume_sigma_setup_mm3: float = math.nan
    convexity_mm: float = math.nan
    asymmetry: float = math.nan
    wetting_slope_deg: float = math.nan
    convexity_sigma_mm: float = math.nan
    asymmetry_sigma: float = math.nan
    wetting_slope_sigma_deg: float = math.nan
    convexity_sigma_level_mm: float = math.nan
    asymmetry_sigma_level: float = math.nan
    wetting_slope_sigma_level_deg: float = math.nan
    convexity_sigma_setup_mm: float = math.nan
    asymmetry_sigma_setup: float = math.nan
    wetting_slope_sigma_setup_deg: float = math.nan

    def __repr__(self) -> str:
        return f"<labapp measures: {self.summary}>"

    @property
    def summary(self) -> str:
        """Width, length and height, with ± where they have one."""
        words = []
        for size in ("width", "length", "height"):
            value, sigma = getattr(self, f"{size}_mm"), getattr(self, f"{size}_sigma_mm")
            words.append(f"{size} {value:.3f}" + (f" ± {sigma:.3f}" if sigma >= 0 else "") + " mm")
        return ", ".join(words)

    @property
    def sizes(self) -> FloatArray:
        """Values of `SIZES`, shape (6,), mm, mm², mm³."""
        return np.array([getattr(self, name) for name in SIZES])


SIZES = ("width_mm", "length_mm", "height_mm", "depth_mm", "area_mm2", "volume_mm3")
"""Names of the sizes, in the order of arrays."""

SHAPES = ("convexity_mm", "asymmetry", "wetting_slope_deg")
"""Names of the results of `shape_of`, in their order."""

WITH_SIGMA = (*SIZES, *SHAPES)
"""Names of the measures with a standard uncertainty, in the order of arrays."""


def sigma_name(name: str, part: str = "") -> str:
    """Name of a standard uncertainty, or of a part of it: ``width_sigma_level_mm``."""
    size, _, unit = name.rpartition("_") if "_" in name else (name, "", "")
    return "_".join(filter(None, (size, "sigma", part, unit)))


@cache
def sigma_names(part: str = "") -> tuple[str, ...]:
    """`sigma_name` of each of `WITH_SIGMA`."""
    return tuple(sigma_name(name, part) for name in WITH_SIGMA)


def measure_surface(reconstruction: Reconstruction, match: Match, rig: Rig) -> Measures:
    """Measure a reconstructed pool."""
    errors = reflection_errors(reconstruction, match, rig)
    boundary = reconstruction.boundary
    size, peak = surface_sizes(reconstruction.unbounded, boundary)
    size = np.append(size, shape_of(reconstruction.unbounded, boundary))
    made = assemble_measures(errors, size, peak, boundary.center_mm, reconstruction)
    return replace(made, own_are_mm=reconstruction.own_are_mm)


def assemble_measures(
    errors: dict[str, float],
    size: FloatArray,
    peak_mm: FloatArray,
    center_mm: FloatArray,
    reconstruction: Reconstruction,
) -> Measures:
    """Assemble `reflection_errors`, sizes and shape, shape (9,), peak, centre and σ."""
    sigmas = {
        "": reconstruction.size_sigma,
        "level": reconstruction.size_sigma_level,
        "setup": reconstruction.size_sigma_setup,
    }
    size_sigmas = {
        name: value
        for part, sigma in sigmas.items()
        for name, value in zip(sigma_names(part), sigma.tolist(), strict=True)
    }
    return Measures(
        center_x_mm=float(center_mm[0]),
        center_y_mm=float(center_mm[1]),
        peak_x_mm=float(peak_mm[0]),
        peak_y_mm=float(peak_mm[1]),
        **errors,
        **dict(zip(WITH_SIGMA, (size + 0.0).tolist(), strict=True)),
        **size_sigmas,
    )


def reflection_scale(match: Match, rig: Rig) -> FloatArray:
    """Scale W_p/W_r, L_p/L_r from imaging plane to work piece, shape (2,) (Eq. 6-7, 6-8).

    Ratios of the ranges of the projected dots on z = 0 along X and Y to those of the reflected dots
    along X′ and Z′.
    """
    projected = project_rays(rig.laser, rig.pattern).landing_mm[tuple(match.ray.T - 1)][:, :2]
    return np.asarray(np.ptp(projected, axis=0) / np.ptp(match.plane_mm, axis=0))


def reflection_errors(reconstruction: Reconstruction, match: Match, rig: Rig) -> dict[str, float]:
    """Reflection errors of a reconstruction by any scheme (Eq. 6-3 … 6-8), and their scale.

    The keys are those of `Measures`: ``are_mm``, ``mre_mm``, ``are_inner_mm``, ``mre_inner_mm``,
    ``scale_x`` and ``scale_z``.

    Only actual reflected dots are included: the centre reference that IRS and ERS add is "not an
    actual visible point" (§6.2), and the error of its substitute would be meaningless.
    """
    scale = reflection_scale(match, rig)
    error = np.hypot(*(reconstruction.residual_mm * scale).T)
    met = np.isfinite(error)
    every, inner = error[met], error[met & inside_points(reconstruction.ray)]
    return {
        "are_mm": float(every.mean()) if len(every) else math.nan,
        "mre_mm": float(every.max()) if len(every) else math.nan,
        "are_inner_mm": float(inner.mean()) if len(inner) else math.nan,
        "mre_inner_mm": float(inner.max()) if len(inner) else math.nan,
        "scale_x": float(scale[0]),
        "scale_z": float(scale[1]),
    }


def inside_points(ray: IntArray) -> BoolArray:
    """Mask of points neither in the first or last row nor at an end of their row, shape (n,)."""
    order = np.lexsort(ray.T[::-1])
    row = ray[order, 0]
    first = np.concatenate([[True], row[1:] > row[:-1]])
    last = np.concatenate([first[1:], [True]])
    inner = np.empty(len(ray), bool)
    inner[order] = ~first & ~last & (row > row[0]) & (row < row[-1])
    return inner


def surface_sizes(surface: Surface, boundary: Boundary) -> tuple[FloatArray, FloatArray]:
    """Width, length, height, depth, area, volume, shape (6,); and the peak's (x, y), shape (2,)."""
    outline = boundary.points_mm
    width, length = np.ptp(outline[:, :2], axis=0)
    wedge = wedges(boundary)
    node, weight = np.polynomial.legendre.leggauss(RINGS)
    fraction = (node + 1) / 2
    samples = spoke_points(surface, boundary, fraction)
    # ∫∫ z dA over triangles about the centre: each spoke represents half of the two adjacent ones.
    volume = wedge @ (samples[..., 2] @ (weight * fraction))
    points = np.vstack([samples.reshape(-1, 3), outline, _nodes(surface, boundary)])
    high = refined(surface.height, boundary, points[np.nanargmax(points[:, 2])], sign=1.0)
    low = refined(surface.height, boundary, points[np.nanargmin(points[:, 2])], sign=-1.0)
    peak = high if abs(high[2]) >= abs(low[2]) else low
    return np.array([width, length, high[2], low[2], wedge.sum(), volume]), peak[:2]


def _nodes(surface: Surface, boundary: Boundary) -> FloatArray:
    """Surface points of the grid that files have, or of a coarser one, shape (n, 3).

    An interpolated surface has creases, so that its extremes can be between the spokes.
    """
    spacing = max(NODES_MM, float(np.ptp(boundary.points_mm[:, :2], axis=0).max()) / MOST_STEPS)
    x, y = grid_within(boundary, spacing)
    return np.column_stack([x, y, surface.height(x, y)])


def grid_within(boundary: Boundary, spacing_mm: float) -> tuple[FloatArray, FloatArray]:
    """Nodes x, y of a grid through the origin within the boundary, shape (n,) each, mm."""
    low = np.ceil(boundary.points_mm[:, :2].min(axis=0) / spacing_mm)
    high = np.floor(boundary.points_mm[:, :2].max(axis=0) / spacing_mm)
    x, y = np.meshgrid(*(np.arange(a, b + 1) * spacing_mm for a, b in zip(low, high, strict=True)))
    inside = boundary.contains(x, y)
    return x[inside], y[inside]


def wedges(boundary: Boundary) -> FloatArray:
    """Area represented by each boundary point, shape (m,), mm²; the sum is the polygon's area."""
    x, y = (boundary.points_mm[:, :2] - boundary.center_mm).T
    after = (x * np.roll(y, -1) - y * np.roll(x, -1)) / 2
    return np.asarray((after + np.roll(after, 1)) / 2)


def spoke_points(surface: Surface, boundary: Boundary, fraction: FloatArray) -> FloatArray:
    """Surface points at fractions of the distance from centre to boundary, (m, rings, 3)."""
    offset = boundary.points_mm[:, None, :2] - boundary.center_mm
    xy = boundary.center_mm + fraction[:, None] * offset
    return np.concatenate([xy, surface.height(xy[..., 0], xy[..., 1])[..., None]], axis=-1)


_PATCH = STENCIL_MM * np.mgrid[-1:2, -1:2].reshape(2, 9)
_PARABOLOID = np.linalg.pinv(
    np.stack([np.ones(9), *_PATCH, _PATCH[0] ** 2, _PATCH[0] * _PATCH[1], _PATCH[1] ** 2], axis=1)
)[1:]
"""Offsets of the nine points of a patch; matrix that gives the coefficients of the paraboloid
fitted to their heights, without the constant."""


def refined(
    height: Callable[[FloatArray, FloatArray], FloatArray],
    boundary: Boundary,
    start_mm: FloatArray,
    sign: float,
) -> FloatArray:
    """Extreme near a sample, shape (3,): the vertex of a paraboloid fitted to a patch around it.

    An extreme at the boundary, or whose paraboloid has no such vertex, is not changed.
    """
    z = height(start_mm[0] + _PATCH[0], start_mm[1] + _PATCH[1])
    if not np.isfinite(z).all():
        return start_mm
    b_x, b_y, c_xx, c_xy, c_yy = (_PARABOLOID @ z).tolist()
    spread = math.hypot(c_xx - c_yy, c_xy)
    if not -sign * (c_xx + c_yy) - spread > 1e-9:  # the smaller of twice its curvatures
        return start_mm
    area, reach = 4 * c_xx * c_yy - c_xy * c_xy, 2 * STENCIL_MM
    vertex = (c_xy * b_y - 2 * c_yy * b_x) / area, (c_xy * b_x - 2 * c_xx * b_y) / area
    x, y = start_mm[:2] + [min(max(off, -reach), reach) for off in vertex]
    if not boundary.contains(x, y):
        return start_mm
    refined = np.append([x, y], height(x, y))
    return refined if sign * refined[2] >= sign * start_mm[2] else start_mm
