"""Rays that meet the surface and fall on the imaging plane, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BOOLS_1, FLOAT, FLOATS_1, FLOATS_2, FLOATS_3, INT
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.spline_kernels import height_and_slopes
from labapp.core.values import BoolArray, FloatArray, IntArray

_INTS_2 = types.Array(INT, 2, "A", readonly=True)
_surface = types.Tuple((FLOATS_2, FLOATS_1))  # type: ignore[no-untyped-call]

LONGEST_STEP_MM, LEAST_DESCENT = 0.5, 0.05
"""Longest Newton step along a ray, mm, and the least descent towards the surface that is assumed
per mm of the ray: a step along a grazing ray would otherwise leave the pool."""

LEAST_STEP_MM = 1e-12
"""Newton's method stops after a shorter step: the slopes before and after it are the same."""

TIP_MARGIN_MM = 0.3
"""A ray that passes less than this below the electrode's tip may be hidden."""

AGAIN_STEP_MM = 0.2
"""Step along a reflected ray while it is searched for a place where it meets the surface again."""

SNELL_STEPS = 4
"""Newton steps to the direction that leads through the glass to a dot: exact to rounding."""

DOT_STEP_MM = 1e-3
"""Step of the finite differences by the place of a dot."""


@_inner
def newton_step(
    grid: FloatArray, coefficients: FloatArray, ray: FloatArray, point: FloatArray, work: FloatArray
) -> tuple[float, float, float]:
    """Move a point along its ray to a surface by a bounded Newton step; returns step and slopes.

    The step, mm, and the slopes are those from before the move.
    """
    z, slope_x, slope_y = height_and_slopes(grid, coefficients, point[0], point[1], work)
    descent = slope_x * ray[0] + slope_y * ray[1] - ray[2]
    step = (point[2] - z) / max(descent, LEAST_DESCENT)
    step = min(max(step, -LONGEST_STEP_MM), LONGEST_STEP_MM)
    for axis in range(3):
        point[axis] += step * ray[axis]
    return step, slope_x, slope_y


@_inner
def _in_glass(index: float, tangent2: float) -> float:
    """Ratio of the tangents of a ray's angles in glass and in air.

    ``tangent2`` is the square of that in air.
    """
    return float(1.0 / np.sqrt(index * index + (index * index - 1.0) * tangent2))


@_inner
def _through_glass(
    x: float, z: float, away: tuple[float, float, float], along: float, plane: FloatArray
) -> tuple[float, float]:
    """Dot of a ray in a direction that would meet the plane at (x, z) without its glass.

    ``along`` is the direction's component along the normal.
    """
    aside, up = 0.0, 0.0
    for axis in range(3):
        aside += away[axis] / abs(along) * plane[1, axis]
        up += away[axis] / abs(along) * plane[2, axis]
    shift = plane[4, 0] * (1.0 - _in_glass(plane[4, 1], aside * aside + up * up))
    return x - shift * aside, z - shift * up


@_inner
def _reflected(ray: FloatArray, slope_x: float, slope_y: float) -> tuple[float, float, float]:
    """Direction of a ray after its reflection where the surface has given slopes (Eq. 4-4)."""
    # Twice the ray's part along the normal (−f_x, −f_y, 1) is taken off.
    twice = 2.0 * (ray[2] - slope_x * ray[0] - slope_y * ray[1])
    twice /= slope_x * slope_x + slope_y * slope_y + 1.0
    return ray[0] + twice * slope_x, ray[1] + twice * slope_y, ray[2] - twice


@_inner
def reflected_dot(
    ray: FloatArray, point: FloatArray, slope_x: float, slope_y: float, plane: FloatArray
) -> tuple[float, float]:
    """Dot (X′, Z′) of a ray reflected at a point of given slopes; NaN if there is none."""
    away = _reflected(ray, slope_x, slope_y)
    gap, along = 0.0, 0.0
    for axis in range(3):
        gap += (plane[0, axis] - point[axis]) * plane[3, axis]
        along += away[axis] * plane[3, axis]
    distance = gap / along if along != 0.0 else np.nan
    if not 0.0 < distance < np.inf:
        return np.nan, np.nan
    x, z = 0.0, 0.0
    for axis in range(3):
        at = point[axis] + distance * away[axis] - plane[0, axis]
        x += at * plane[1, axis]
        z += at * plane[2, axis]
    if plane[4, 0] != 0.0:
        return _through_glass(x, z, away, along, plane)
    return x, z


@_inner
def without_glass(
    point: FloatArray, dot: tuple[float, float, float], plane: FloatArray
) -> tuple[float, float, float]:
    """Where a ray from a point to a dot would meet the plane without its glass, UCS, mm."""
    glass, index = plane[4, 0], plane[4, 1]
    gap = 0.0
    for axis in range(3):
        gap += (plane[0, axis] - point[axis]) * plane[3, axis]
    air = abs(gap) - glass
    if not air > 0.0:
        return dot
    x = dot[0] - point[0] - gap * plane[3, 0]
    y = dot[1] - point[1] - gap * plane[3, 1]
    z = dot[2] - point[2] - gap * plane[3, 2]
    aside = np.sqrt(x * x + y * y + z * z)
    tangent = aside / (air + glass / index)
    for _ in range(SNELL_STEPS):
        share = _in_glass(index, tangent * tangent)
        off = (air + glass * share) * tangent - aside
        tangent -= off / (air + glass * index * index * share**3)
    farther = abs(gap) * tangent / aside - 1.0 if aside > 0.0 else 0.0
    return dot[0] + farther * x, dot[1] + farther * y, dot[2] + farther * z


@_compiled(_INTS_2, FLOATS_3, FLOATS_3)
def rays_of_pairs(
    ray: IntArray, directions: FloatArray, landing: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Rays of n pairs, where they land, and which land far from the centre.

    Parameters
    ----------
    ray
        Row and column of each, counted from 1, shape (n, 2).
    directions, landing
        Of all rays of the pattern, shapes (rows, columns, 3), the latter in mm.

    Returns
    -------
    rays, points, outer
        Directions, shape (n, 3), and landing points, shape (n, 3), mm; and which of these are
        farther from their centre than the median distance, shape (n,).
    """
    rays, points = np.empty((len(ray), 3)), np.empty((len(ray), 3))
    x, y = 0.0, 0.0
    for n in range(len(ray)):
        i, j = ray[n, 0] - 1, ray[n, 1] - 1
        for axis in range(3):
            rays[n, axis], points[n, axis] = directions[i, j, axis], landing[i, j, axis]
        x, y = x + points[n, 0] / len(ray), y + points[n, 1] / len(ray)
    square = np.empty(len(ray))
    for n in range(len(ray)):
        square[n] = (points[n, 0] - x) ** 2 + (points[n, 1] - y) ** 2
    return rays, points, square > np.median(square)


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_2, INT, FLOATS_2)
def intersect_and_reflect(
    grid: FloatArray,
    coefficients: FloatArray,
    rays: FloatArray,
    points: FloatArray,
    steps: int,
    plane: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intersect rays with a surface, from points nearby, and reflect them to the imaging plane.

    Parameters
    ----------
    grid, coefficients, rays, plane
        See the package.
    points
        Where Newton's method begins, shape (n, 3).
    steps
        Newton steps.

    Returns
    -------
    met, slopes, dots
        Reflection points, shape (n, 3), mm; slopes of the surface there, shape (n, 2); dots, IPCS,
        shape (n, 2), mm, NaN for rays that leave the rectangle or never meet the plane.
    """
    count = len(rays)
    met, slopes, dots = points.copy(), np.empty((count, 2)), np.empty((count, 2))
    work = np.empty((4, 4))
    for k in range(count):
        ray, point = rays[k], met[k]
        slope_x, slope_y = 0.0, 0.0
        for _ in range(steps):
            step, slope_x, slope_y = newton_step(grid, coefficients, ray, point, work)
            if abs(step) < LEAST_STEP_MM:
                break
        slopes[k, 0], slopes[k, 1] = slope_x, slope_y
        dots[k, 0] = dots[k, 1] = np.nan
        if grid[0, 0] <= point[0] <= grid[0, 1] and grid[1, 0] <= point[1] <= grid[1, 1]:
            dots[k, 0], dots[k, 1] = reflected_dot(ray, point, slope_x, slope_y, plane)
    return met, slopes, dots


@_inner
def bisecting_slopes(
    laser: FloatArray, point: FloatArray, dot_x: float, dot_y: float, dot_z: float
) -> tuple[float, float]:
    """Slopes that turn the ray from the laser at a point to a dot (`optics.bisecting_gradient`)."""
    to_x, to_y, to_z = point[0] - laser[0], point[1] - laser[1], point[2] - laser[2]
    on_x, on_y, on_z = dot_x - point[0], dot_y - point[1], dot_z - point[2]
    to = np.sqrt(to_x * to_x + to_y * to_y + to_z * to_z)
    on = np.sqrt(on_x * on_x + on_y * on_y + on_z * on_z)
    normal_z = on_z / on - to_z / to
    return -(on_x / on - to_x / to) / normal_z, -(on_y / on - to_y / to) / normal_z


@_inner
def slope_jacobian(
    laser: FloatArray, plane: FloatArray, point: FloatArray, dot: FloatArray
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Rows of ∂(slopes at a point)/∂(its dot along either axis of the plane), mm⁻¹."""
    step = DOT_STEP_MM
    by = plane[1]
    across = dot[0] + step * by[0], dot[1] + step * by[1], dot[2] + step * by[2]
    by = plane[2]
    up = dot[0] + step * by[0], dot[1] + step * by[1], dot[2] + step * by[2]
    own = dot[0], dot[1], dot[2]
    if plane[4, 0] != 0.0:
        own, across = without_glass(point, own, plane), without_glass(point, across, plane)
        up = without_glass(point, up, plane)
    base_x, base_y = bisecting_slopes(laser, point, own[0], own[1], own[2])
    x, y = bisecting_slopes(laser, point, across[0], across[1], across[2])
    u, v = bisecting_slopes(laser, point, up[0], up[1], up[2])
    return (
        ((x - base_x) / step, (u - base_x) / step),
        ((y - base_y) / step, (v - base_y) / step),
    )


@_compiled(FLOATS_1, FLOATS_2, FLOATS_2, FLOATS_2, FLOATS_3, FLOAT)
def slope_weights(
    laser: FloatArray,
    plane: FloatArray,
    points: FloatArray,
    dots: FloatArray,
    covariance: FloatArray,
    floor: float,
) -> FloatArray:
    """Inverse covariance of the slopes at points that follow from dots, shape (n, 2, 2).

    Points and dots are in the UCS, shape (n, 3), mm; the covariance of the dots along the axes of
    the imaging plane has shape (n, 2, 2), mm². ``floor`` is the least uncertainty of a dot, mm.
    """
    out = np.empty(covariance.shape)
    for k in range(len(points)):
        (a, b), (c, d) = slope_jacobian(laser, plane, points[k], dots[k])
        xx, xy, yy = covariance[k, 0, 0] + floor**2, covariance[k, 0, 1], covariance[k, 1, 1]
        yy += floor**2
        one = a * a * xx + 2.0 * a * b * xy + b * b * yy
        other = c * c * xx + 2.0 * c * d * xy + d * d * yy
        both = a * c * xx + (a * d + b * c) * xy + b * d * yy
        area = one * other - both * both
        out[k, 0, 0], out[k, 1, 1] = other / area, one / area
        out[k, 0, 1] = out[k, 1, 0] = -both / area
    return out


@_compiled(FLOATS_2, FLOATS_2, FLOATS_2, FLOAT)
def behind_torch(points: FloatArray, rays: FloatArray, slopes: FloatArray, tip: float) -> BoolArray:
    """Whether the torch may hide the dots of rays (§4.2.1): they pass above its tip, or nearly.

    The incident ray does so for points behind the electrode (y < 0), the reflected one for points
    in front of it. A mask, shape (n,); slopes of the surface at the points have shape (n, 2),
    ``tip`` is the height of the electrode's tip, mm.
    """
    hidden = np.empty(len(rays), np.bool_)
    for k in range(len(rays)):
        y, z = -rays[k, 1], -rays[k, 2]
        if points[k, 1] >= 0.0:
            _, y, z = _reflected(rays[k], slopes[k, 0], slopes[k, 1])
        y = y if y != 0.0 else 1e-12
        # Both ways lead towards y = 0 and up.
        hidden[k] = points[k, 2] - points[k, 1] * z / y > tip - TIP_MARGIN_MM
    return hidden


@_inner
def _meet_again(
    surface: tuple[FloatArray, FloatArray],
    points: FloatArray,
    rays: FloatArray,
    slopes: FloatArray,
    rim: float,
) -> BoolArray:
    """Whether reflected rays meet a surface again below a height, mm; a mask, shape (n,)."""
    (grid, coefficients), work = surface, np.empty((4, 4))
    met = np.zeros(len(rays), np.bool_)
    for k in range(len(rays)):
        x, y, z = _reflected(rays[k], slopes[k, 0], slopes[k, 1])
        step = AGAIN_STEP_MM / np.hypot(x, y)
        at_x, at_y, at_z = points[k, 0], points[k, 1], points[k, 2]
        while at_z <= rim and not met[k]:
            at_x, at_y, at_z = at_x + step * x, at_y + step * y, at_z + step * z
            if not (grid[0, 0] <= at_x <= grid[0, 1] and grid[1, 0] <= at_y <= grid[1, 1]):
                met[k] = z <= 0.0
                break
            met[k] = height_and_slopes(grid, coefficients, at_x, at_y, work)[0] > at_z
    return met


@_compiled(_surface, FLOATS_2, FLOATS_2, FLOATS_2, BOOLS_1, BOOLS_1)
def stopped_by_far_side(
    surface: tuple[FloatArray, FloatArray],
    points: FloatArray,
    rays: FloatArray,
    slopes: FloatArray,
    lit: BoolArray,
    dark: BoolArray,
) -> BoolArray:
    """Whether the far side of a concave pool stops reflected rays, which then make no dot.

    Rays that leave the near side at a small angle meet the far side, if it is high enough. Its rim
    is taken to be half-way between the highest lit point and the lowest dark one whose ray nothing
    would stop; if there is none, the rim may be as high as any dark point.

    Parameters
    ----------
    surface, points, rays, slopes
        Grid and coefficients of the surface; reflection points and directions of rays, shape
        (n, 3), and slopes of the surface there, shape (n, 2).
    lit, dark
        Masks of the rays with a dot, and of those beside them that should have one in the picture
        if the pool extended to them, shape (n,).

    Returns
    -------
    BoolArray
        A mask, shape (n,).
    """
    low, high = -np.inf, -np.inf
    for k in range(len(points)):
        low = max(low, points[k, 2]) if lit[k] else low
        high = max(high, points[k, 2]) if dark[k] else high
    if not high > low:  # of a convex pool
        return np.zeros(len(points), np.bool_)
    stopped, free = _meet_again(surface, points, rays, slopes, high), np.inf
    for k in range(len(points)):
        if dark[k] and not stopped[k]:
            free = min(free, points[k, 2])
    if free == np.inf:
        return stopped
    return _meet_again(surface, points, rays, slopes, max(low, (low + free) / 2.0))


@_compiled(FLOATS_2, FLOATS_2, FLOATS_1)
def rise_per_depth(slope: FloatArray, landing: FloatArray, laser: FloatArray) -> FloatArray:
    """By how much m rays pass higher over a boundary that lies lower by 1, shape (m,).

    At the depth of the boundary a ray is farther from the laser than where it lands on z = 0. If
    the surface is lower there, the ray may meet the wall beyond the boundary. If it is higher, the
    ray comes across the work piece, and all that lands outside the boundary meets that first.

    Parameters are the gradients at the landing points, the landing points, and the laser, mm.
    """
    made = np.ones(len(landing))
    for n in range(len(landing)):
        rise = 0.0
        for axis in range(2):
            rise += slope[n, axis] * (landing[n, axis] - laser[axis]) / laser[2]
        made[n] += min(rise, 0.0)
    return made
