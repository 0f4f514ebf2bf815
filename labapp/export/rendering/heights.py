"""Heights of a pool surface: ± at a point, difference of two surfaces, vertical section."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray, ReadOnlyArrays

PROFILE_POINTS = 241


def between_points(
    reconstruction: Reconstruction, values: FloatArray, x_mm: FloatArray, y_mm: FloatArray
) -> FloatArray:
    """Interpolate values of the reflection points at (x, y).

    Linear interpolation between the points; nearest neighbour outside their hull.

    Parameters
    ----------
    values
        Value of each reflection point, shape (p,); NaN if unknown.
    x_mm, y_mm
        Positions, shape (n,), mm.

    Returns
    -------
    FloatArray
        Interpolated values, shape (n,); NaN if fewer than four values are known.
    """
    known = np.isfinite(values)
    points, values = reconstruction.points_mm[known, :2], values[known]
    if len(points) < 4:
        return np.full(len(x_mm), np.nan)
    inside = scipy.interpolate.LinearNDInterpolator(points, values)(x_mm, y_mm)
    nearest = scipy.interpolate.NearestNDInterpolator(points, values)(x_mm, y_mm)
    return np.asarray(np.where(np.isfinite(inside), inside, nearest))


def sigma_at(reconstruction: Reconstruction, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return σ of the height at (x, y), interpolated by `between_points`, shape (n,), mm."""
    return between_points(reconstruction, reconstruction.sigma_mm, x_mm, y_mm)


def difference_at(
    one: Reconstruction, other: Reconstruction, x_mm: FloatArray, y_mm: FloatArray
) -> FloatArray:
    """Return the height of the first surface minus the other's, shape (n,), mm; NaN outside."""
    return one.surface.height(x_mm, y_mm) - other.surface.height(x_mm, y_mm)


@dataclass(frozen=True)
class Profile(ReadOnlyArrays):
    """A vertical section through a pool; n points, NaN outside the boundary."""

    along_mm: FloatArray
    """Distance along the section line from its point nearest the origin, shape (n,), mm."""
    place_mm: FloatArray
    """(X, Y) of the points, shape (n, 2), mm."""
    height_mm: FloatArray
    sigma_mm: FloatArray
    """Height of the surface and its standard uncertainty, shape (n,), mm."""
    edge_mm: FloatArray
    """(distance, height) of the line's crossings of the boundary, shape (k, 2), mm."""


def profile(
    reconstruction: Reconstruction, angle_deg: float = 90.0, offset_mm: float = 0.0
) -> Profile:
    """Return the vertical section of a pool along a line.

    Parameters
    ----------
    angle_deg
        Direction of the line, from +X towards +Y: 0 is a transverse section, 90 a longitudinal one.
    offset_mm
        Distance of the line from the origin, positive to the left looking along it, mm.
    """
    angle = np.radians(angle_deg)
    way = np.array([np.cos(angle), np.sin(angle)])
    aside = np.array([-way[1], way[0]])
    outline = reconstruction.boundary.points_mm
    edge = _crossings(outline, way, aside, offset_mm)
    reach = edge[:, 0] if len(edge) else outline[:, :2] @ way
    along = np.linspace(reach.min(), reach.max(), PROFILE_POINTS)
    place = along[:, None] * way + offset_mm * aside
    x, y = place.T
    height = reconstruction.surface.height(x, y)
    sigma = np.where(np.isfinite(height), sigma_at(reconstruction, x, y), np.nan)
    return Profile(along, place, height, sigma, edge)


def _crossings(
    outline: FloatArray, way: FloatArray, aside: FloatArray, offset: float
) -> FloatArray:
    """Return (distance, height) of a line's crossings of a closed polygon, shape (k, 2), sorted."""
    after = np.roll(outline, -1, axis=0)
    a, b = outline[:, :2] @ aside - offset, after[:, :2] @ aside - offset
    crosses = (a < 0) != (b < 0)
    share = (a[crosses] / (a[crosses] - b[crosses]))[:, None]
    at = outline[crosses] + share * (after[crosses] - outline[crosses])
    found = np.column_stack([at[:, :2] @ way, at[:, 2]])
    return np.asarray(found[np.argsort(found[:, 0])])
