"""Heights of a pool surface where one asks: their ±, how two surfaces differ, a section."""

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
    """Values of the reflection points, interpolated at (x, y).

    Linear between the points; outside them that of the nearest.

    Parameters
    ----------
    values
        One a reflection point, shape (p,); NaN where unknown.
    x_mm, y_mm
        Where, shape (n,), mm.

    Returns
    -------
    FloatArray
        Shape (n,); NaN where fewer than four are known.
    """
    known = np.isfinite(values)
    places, values = reconstruction.points_mm[known, :2], values[known]
    if len(places) < 4:
        return np.full(len(x_mm), np.nan)
    inside = scipy.interpolate.LinearNDInterpolator(places, values)(x_mm, y_mm)
    nearest = scipy.interpolate.NearestNDInterpolator(places, values)(x_mm, y_mm)
    return np.asarray(np.where(np.isfinite(inside), inside, nearest))


def sigma_at(reconstruction: Reconstruction, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Standard uncertainty of the height at (x, y), shape (n,), mm, as `between_points` has it."""
    return between_points(reconstruction, reconstruction.sigma_mm, x_mm, y_mm)


def difference_at(
    one: Reconstruction, other: Reconstruction, x_mm: FloatArray, y_mm: FloatArray
) -> FloatArray:
    """Height of the first surface minus the other's, shape (n,), mm; NaN outside either pool."""
    return one.surface.height(x_mm, y_mm) - other.surface.height(x_mm, y_mm)


@dataclass(frozen=True)
class Profile(ReadOnlyArrays):
    """A vertical section through a pool; n points, NaN outside the boundary."""

    along_mm: FloatArray
    """Way along the section line from the point of it nearest the origin, shape (n,), mm."""
    place_mm: FloatArray
    """(X, Y) of the points, shape (n, 2), mm."""
    height_mm: FloatArray
    sigma_mm: FloatArray
    """Height of the surface and its standard uncertainty, shape (n,), mm."""
    edge_mm: FloatArray
    """(way, height) where the line crosses the boundary, shape (k, 2), mm."""


def profile(
    reconstruction: Reconstruction, angle_deg: float = 90.0, offset_mm: float = 0.0
) -> Profile:
    """Cut a pool along a line.

    Parameters
    ----------
    angle_deg
        Direction of the line, from +X towards +Y: 0 cuts across, 90 along the welding direction.
    offset_mm
        How far to the left of the origin the line passes, looking along it, mm.
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
    """(way, height) where a line crosses a closed polygon, shape (k, 2), in order."""
    after = np.roll(outline, -1, axis=0)
    a, b = outline[:, :2] @ aside - offset, after[:, :2] @ aside - offset
    crosses = (a < 0) != (b < 0)
    share = (a[crosses] / (a[crosses] - b[crosses]))[:, None]
    at = outline[crosses] + share * (after[crosses] - outline[crosses])
    found = np.column_stack([at[:, :2] @ way, at[:, 2]])
    return np.asarray(found[np.argsort(found[:, 0])])
