"""Loops over rays and splines, compiled for the processor (docs/adr/0018).

A frame has a hundred dots: NumPy's overhead per call would take longer than the sums. Those that
call each other are in one file because a compiled function is kept on disk as long as its own file
does not change, whatever became of those it calls. Arrays may be read-only, and of any layout.

Six arguments mean the same everywhere, all in the UCS and mm:

* ``grid``: low end, high end, step and number of cells of the splines along x and along y, shape
  (2, 4) (`SplineBasis.grid`); with it ``coefficients`` of the splines, shape (p,).
* ``rays``: unit directions from the laser, shape (n, 3); ``points``: where they meet the surface.
* ``plane``: O′, the directions of O′X′ and O′Z′ and the normal of the imaging plane, and thickness
  and index of its glass, shape (5, 3) (`ImagingPlane.pose_mm`).
* ``work``: memory to write on, which holds values and slopes of the four splines along x, then
  those along y, shape (4, 4).

A lower band has the shape (width + 1, p), as LAPACK has it, and its columns follow on each other in
memory; ``columns`` is the same transposed.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.values import BoolArray, FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1, _f2, _f3, _f4 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2, 3, 4))
_mask = types.Array(types.boolean, 2, "A", readonly=True)
_lower = types.Array(_f, 2, "F", readonly=True)
_bands, _bench = types.UniTuple(_lower, 2), types.Tuple((_f1, _f2))  # type: ignore[no-untyped-call]


LONGEST_STEP_MM, LEAST_DESCENT = 0.5, 0.05
"""A Newton step along a ray is no longer, and a ray comes no slower nearer to the surface, mm a mm:
where one grazes the surface a step would throw it off the pool."""

LONGEST_QUADRIC_STEP_MM = 1.0
"""The same for quadrics, which go on beyond the pool."""

ON_SURFACE_MM = 1e-9
"""After a step as short no other is taken: the next would be far below rounding."""

QUADRIC_STEPS = 3
"""Newton steps from the plane z = 0, or that of the cap's top, to a quadric."""

TIP_MARGIN_MM = 0.3
"""A ray that passes less than this below the electrode's tip may be hidden."""

SNELL_STEPS = 4
"""Newton steps to the direction that leads through the glass to a dot: exact to rounding."""

DOT_STEP_MM = 1e-3
"""Step of the finite differences by the place of a dot."""

AT_ONCE = 8
"""Columns of a matrix that are factorized at once."""

MOST_BOUNDARY_STEPS = 20
"""Newton steps along a direction, if the boundary does not settle before."""


# --- splines ------------------------------------------------------------------------------------


@_inner
def _cubic_splines(axis: FloatArray, place: float, value: FloatArray, slope: FloatArray) -> int:
    """Values and slopes of the four cubic splines at a place; returns the number of the first one.

    The axis is a row of ``grid``; a place beyond its ends is moved to them.
    """
    low, high, step = axis[0], axis[1], axis[2]
    at = (min(max(place, low), high) - low) / step
    first = min(int(at), int(axis[3]) - 1) if at > 0.0 else 0
    t = at - first
    s = 1.0 - t
    value[0] = s * s * s / 6.0
    value[1] = ((3.0 * t - 6.0) * t * t + 4.0) / 6.0
    value[2] = ((3.0 * s - 6.0) * s * s + 4.0) / 6.0
    value[3] = t * t * t / 6.0
    slope[0] = -s * s / 2.0 / step
    slope[1] = (1.5 * t - 2.0) * t / step
    slope[2] = (2.0 - 1.5 * s) * s / step
    slope[3] = t * t / 2.0 / step
    return first


@_inner
def _height_and_slopes(
    grid: FloatArray, coefficients: FloatArray, x: float, y: float, work: FloatArray
) -> tuple[float, float, float]:
    """Height and slopes of a surface; values and slopes of the splines there stay in ``work``."""
    first_x = _cubic_splines(grid[0], x, work[0], work[1])
    first_y = _cubic_splines(grid[1], y, work[2], work[3])
    many = int(grid[1, 3]) + 3
    z, slope_x, slope_y = 0.0, 0.0, 0.0
    for a in range(4):
        at = (first_x + a) * many + first_y
        value, slope = 0.0, 0.0
        for b in range(4):
            value += work[2, b] * coefficients[at + b]
            slope += work[3, b] * coefficients[at + b]
        z += work[0, a] * value
        slope_x += work[1, a] * value
        slope_y += work[0, a] * slope
    return z, slope_x, slope_y


@_compiled(_f2, _f2)
def splines_at(grid: FloatArray, place: FloatArray) -> tuple[IntArray, FloatArray]:
    """Splines that are not zero at places, shape (n, 2), held to the rectangle.

    Returns their numbers, shape (n, 16); value and derivatives by x and by y, shape (3, n, 16).
    """
    count, many = len(place), int(grid[1, 3]) + 3
    splines, values = np.empty((count, 16), np.int64), np.empty((3, count, 16))
    work = np.empty((4, 4))
    for k in range(count):
        first_x = _cubic_splines(grid[0], place[k, 0], work[0], work[1])
        first_y = _cubic_splines(grid[1], place[k, 1], work[2], work[3])
        for a in range(4):
            for b in range(4):
                splines[k, 4 * a + b] = (first_x + a) * many + first_y + b
                values[0, k, 4 * a + b] = work[0, a] * work[2, b]
                values[1, k, 4 * a + b] = work[1, a] * work[2, b]
                values[2, k, 4 * a + b] = work[0, a] * work[3, b]
    return splines, values


@_compiled(_f2, _f1, _f2)
def surface_at(grid: FloatArray, coefficients: FloatArray, place: FloatArray) -> FloatArray:
    """Height, mm, and slopes by x and by y of a surface at places, shape (n, 2): shape (3, n)."""
    out, work = np.empty((3, len(place))), np.empty((4, 4))
    for k in range(len(place)):
        z, slope_x, slope_y = _height_and_slopes(grid, coefficients, place[k, 0], place[k, 1], work)
        out[0, k], out[1, k], out[2, k] = z, slope_x, slope_y
    return out


@_inner
def _accumulate_splines(
    grid: FloatArray, x: float, y: float, share: float, work: FloatArray, out: FloatArray
) -> None:
    """Add to ``out`` the value of every spline at a place, times a share."""
    many = int(grid[1, 3]) + 3
    first_x = _cubic_splines(grid[0], x, work[0], work[1])
    first_y = _cubic_splines(grid[1], y, work[2], work[3])
    for a in range(4):
        for b in range(4):
            out[(first_x + a) * many + first_y + b] += share * work[0, a] * work[2, b]


@_compiled(_f2, _i, _f2, _f1)
def gradient_of_sum(
    grid: FloatArray, count: int, place: FloatArray, share: FloatArray
) -> FloatArray:
    """Derivative of Σ share · height at places by so many coefficients, shape (p,)."""
    out, work = np.zeros(count), np.empty((4, 4))
    for k in range(len(place)):
        _accumulate_splines(grid, place[k, 0], place[k, 1], share[k], work, out)
    return out


# --- rays ---------------------------------------------------------------------------------------


@_inner
def _newton_step(
    grid: FloatArray, coefficients: FloatArray, ray: FloatArray, point: FloatArray, work: FloatArray
) -> tuple[float, float, float]:
    """Move a point along its ray to a surface by a bounded Newton step; returns step and slopes.

    The step, mm, and the slopes are those from before the move.
    """
    z, slope_x, slope_y = _height_and_slopes(grid, coefficients, point[0], point[1], work)
    descent = slope_x * ray[0] + slope_y * ray[1] - ray[2]
    step = (point[2] - z) / max(descent, LEAST_DESCENT)
    step = min(max(step, -LONGEST_STEP_MM), LONGEST_STEP_MM)
    for axis in range(3):
        point[axis] += step * ray[axis]
    return step, slope_x, slope_y


@_inner
def _in_glass(index: float, tangent2: float) -> float:
    """Tangent of a ray's angle to the normal in glass, over that in air; of which the square."""
    return float(1.0 / np.sqrt(index * index + (index * index - 1.0) * tangent2))


@_inner
def _through_glass(
    x: float, z: float, away: tuple[float, float, float], along: float, plane: FloatArray
) -> tuple[float, float]:
    """Dot of a ray in a direction that would meet the plane at (x, z) without its glass.

    ``along`` is what the direction has along the normal.
    """
    aside, up = 0.0, 0.0
    for axis in range(3):
        aside += away[axis] / abs(along) * plane[1, axis]
        up += away[axis] / abs(along) * plane[2, axis]
    shift = plane[4, 0] * (1.0 - _in_glass(plane[4, 1], aside * aside + up * up))
    return x - shift * aside, z - shift * up


@_inner
def _reflected_dot(
    ray: FloatArray, point: FloatArray, slope_x: float, slope_y: float, plane: FloatArray
) -> tuple[float, float]:
    """Dot (X′, Z′) of a ray reflected at a point where a surface has some slopes; NaN if none."""
    # Twice the ray's part along the normal (−f_x, −f_y, 1) is taken off (Eq. 4-4).
    twice = 2.0 * (ray[2] - slope_x * ray[0] - slope_y * ray[1])
    twice /= slope_x * slope_x + slope_y * slope_y + 1.0
    away = ray[0] + twice * slope_x, ray[1] + twice * slope_y, ray[2] - twice
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
def _without_glass(
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


@_compiled(_f2, _f1, _f2, _f2, _i, _f2)
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
        See the module.
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
            _, slope_x, slope_y = _newton_step(grid, coefficients, ray, point, work)
        slopes[k, 0], slopes[k, 1] = slope_x, slope_y
        dots[k, 0] = dots[k, 1] = np.nan
        if grid[0, 0] <= point[0] <= grid[0, 1] and grid[1, 0] <= point[1] <= grid[1, 1]:
            dots[k, 0], dots[k, 1] = _reflected_dot(ray, point, slope_x, slope_y, plane)
    return met, slopes, dots


@_inner
def _bisecting_slopes(
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
def _slope_jacobian(
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
        own, across = _without_glass(point, own, plane), _without_glass(point, across, plane)
        up = _without_glass(point, up, plane)
    base_x, base_y = _bisecting_slopes(laser, point, own[0], own[1], own[2])
    x, y = _bisecting_slopes(laser, point, across[0], across[1], across[2])
    u, v = _bisecting_slopes(laser, point, up[0], up[1], up[2])
    return (
        ((x - base_x) / step, (u - base_x) / step),
        ((y - base_y) / step, (v - base_y) / step),
    )


@_compiled(_f1, _f2, _f2, _f2, _f3, _f)
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
        (a, b), (c, d) = _slope_jacobian(laser, plane, points[k], dots[k])
        xx, xy, yy = covariance[k, 0, 0] + floor**2, covariance[k, 0, 1], covariance[k, 1, 1]
        yy += floor**2
        one = a * a * xx + 2.0 * a * b * xy + b * b * yy
        other = c * c * xx + 2.0 * c * d * xy + d * d * yy
        both = a * c * xx + (a * d + b * c) * xy + b * d * yy
        area = one * other - both * both
        out[k, 0, 0], out[k, 1, 1] = other / area, one / area
        out[k, 0, 1] = out[k, 1, 0] = -both / area
    return out


@_compiled(_f2, _f2, _f2, _f)
def behind_torch(points: FloatArray, rays: FloatArray, slopes: FloatArray, tip: float) -> BoolArray:
    """Whether the torch may hide the dots of rays (§4.2.1): they pass above its tip, or nearly.

    The incident ray does so for points behind the electrode (y < 0), the reflected one for points
    before it. A mask, shape (n,); slopes of the surface at the points have shape (n, 2), ``tip`` is
    the height of the electrode's tip, mm.
    """
    hidden = np.empty(len(rays), np.bool_)
    for k in range(len(rays)):
        x, y, z = -rays[k, 0], -rays[k, 1], -rays[k, 2]
        if points[k, 1] >= 0.0:  # Eq. 4-4
            a, b = slopes[k, 0], slopes[k, 1]
            twice = 2.0 * (a * x + b * y - z) / (a * a + b * b + 1.0)
            y, z = twice * b - y, -twice - z
        y = y if y != 0.0 else 1e-12
        # Both ways lead towards y = 0 and up.
        hidden[k] = points[k, 2] - points[k, 1] * z / y > tip - TIP_MARGIN_MM
    return hidden


# --- the fit ------------------------------------------------------------------------------------


@_compiled(_f3, _f3, _f1)
def roughness(along_x: FloatArray, along_y: FloatArray, step: FloatArray) -> FloatArray:
    """Band of `SplineBasis.roughness` from the products along x and along y in cells of size 1.

    Those of each spline with itself and the next three, for orders 0 … 3, shapes (4, nx, 4) and
    (4, ny, 4) (`spline._products`); the size of a cell has shape (2,), mm.
    """
    nx, ny = along_x.shape[1], along_y.shape[1]
    columns = np.zeros((nx * ny, 3 * (ny + 1) + 1))
    scale = np.empty(4)
    for order in range(4):
        scale[order] = 3.0 if 0 < order < 3 else 1.0
        scale[order] *= step[0] ** (2 * order - 5) * step[1] ** (1 - 2 * order)
    for i in range(nx):
        for j in range(ny):
            for a in range(min(4, nx - i)):
                for b in range(-min(3, j) if a else 0, min(4, ny - j)):
                    first, on = (j, b) if b >= 0 else (j + b, -b)
                    total = 0.0
                    for order in range(4):
                        total += scale[order] * along_x[3 - order, i, a] * along_y[order, first, on]
                    columns[i * ny + j, a * ny + b] = total
    return columns.T


@_inner
def _accumulate_normal_matrix(
    grid: FloatArray, points: FloatArray, weights: FloatArray, columns: FloatArray
) -> None:
    """Add what slopes at points weigh to the columns of a normal matrix's lower band."""
    work, many = np.empty((4, 4)), int(grid[1, 3]) + 3
    by_x, by_y = np.empty(16), np.empty(16)
    for k in range(len(points)):
        first_x = _cubic_splines(grid[0], points[k, 0], work[0], work[1])
        first_y = _cubic_splines(grid[1], points[k, 1], work[2], work[3])
        for a in range(4):
            for b in range(4):
                by_x[4 * a + b] = work[1, a] * work[2, b]
                by_y[4 * a + b] = work[0, a] * work[3, b]
        xx, xy, yy = weights[k, 0, 0], weights[k, 0, 1], weights[k, 1, 1]
        for own in range(16):
            along_x = xx * by_x[own] + xy * by_y[own]
            along_y = xy * by_x[own] + yy * by_y[own]
            column = columns[(first_x + own // 4) * many + first_y + own % 4]
            for other in range(own, 16):
                below = (other // 4 - own // 4) * many + other % 4 - own % 4
                column[below] += along_x * by_x[other] + along_y * by_y[other]


@_inner
def _factorize(columns: FloatArray, count: int, width: int) -> bool:
    """Replace the lower band of a matrix by its Cholesky factor; whether it has one.

    Columns are one a row, and there is room of `AT_ONCE` beyond the last and below the band. So
    many columns at once are taken from those after them, each of which is read and written once.
    """
    for j in range(0, count, AT_ONCE):
        for a in range(min(AT_ONCE, count - j)):
            own = columns[j + a]
            for b in range(a):
                factor, other = columns[j + b, a - b], columns[j + b, a - b :]
                for k in range(width + 1):
                    own[k] -= factor * other[k]
            if not own[0] > 0.0:
                return False
            scale = 1.0 / np.sqrt(own[0])
            for k in range(width + 1):
                own[k] *= scale
        c0, c1, c2, c3 = columns[j], columns[j + 1], columns[j + 2], columns[j + 3]
        c4, c5, c6, c7 = columns[j + 4], columns[j + 5], columns[j + 6], columns[j + 7]
        for t in range(AT_ONCE, min(AT_ONCE + width, count - j)):
            own = columns[j + t]
            f0, f1, f2, f3 = c0[t], c1[t - 1], c2[t - 2], c3[t - 3]
            f4, f5, f6, f7 = c4[t - 4], c5[t - 5], c6[t - 6], c7[t - 7]
            s0, s1, s2, s3 = c0[t:], c1[t - 1 :], c2[t - 2 :], c3[t - 3 :]
            s4, s5, s6, s7 = c4[t - 4 :], c5[t - 5 :], c6[t - 6 :], c7[t - 7 :]
            for k in range(width + AT_ONCE - t):
                own[k] -= (f0 * s0[k] + f1 * s1[k] + f2 * s2[k] + f3 * s3[k]) + (
                    f4 * s4[k] + f5 * s5[k] + f6 * s6[k] + f7 * s7[k]
                )
    return True


@_compiled(_f2, _lower, _f2, _f3)
def normal_factor(
    grid: FloatArray, stiffness: FloatArray, points: FloatArray, weights: FloatArray
) -> tuple[FloatArray, bool]:
    """Cholesky factor of the normal matrix (`solver.normal_factor`), and whether it has one."""
    height, count = stiffness.shape
    columns = np.zeros((count + AT_ONCE, height + AT_ONCE))
    columns[:count, :height] = stiffness.T
    _accumulate_normal_matrix(grid, points, weights, columns)
    x, y, diagonal = 0.0, 0.0, 0.0
    for k in range(len(points)):
        x, y = x + points[k, 0] / len(points), y + points[k, 1] / len(points)
    for k in range(count):
        diagonal += columns[k, 0] / count
    work = np.empty((4, 4))
    first_x = _cubic_splines(grid[0], x, work[0], work[1])
    first_y = _cubic_splines(grid[1], y, work[2], work[3])
    columns[(first_x + 1) * (int(grid[1, 3]) + 3) + first_y + 1, 0] += diagonal
    has_one = _factorize(columns, count, height - 1)
    return columns[:count, :height].copy().T, has_one


@_inner
def _solve_lower(columns: FloatArray, right: FloatArray) -> None:
    """Replace a right-hand side by the solution, with a lower band."""
    count, height = columns.shape
    for j in range(count):
        if right[j] != 0.0:
            column, rest = columns[j], right[j:]
            value = rest[0] / column[0]
            for k in range(1, min(height, count - j)):
                rest[k] -= value * column[k]
            rest[0] = value


@_inner
def _solve(columns: FloatArray, right: FloatArray) -> None:
    """Replace a right-hand side by the solution, with a Cholesky factor."""
    count, height = columns.shape
    _solve_lower(columns, right)
    for j in range(count - 1, -1, -1):
        column, rest, total = columns[j], right[j:], 0.0
        for k in range(1, min(height, count - j)):
            total += column[k] * rest[k]
        rest[0] = (rest[0] - total) / column[0]


@_compiled(_lower, _f2)
def solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of a factor for m right-hand sides, shape (m, p)."""
    made = right.copy()
    for m in range(len(made)):
        _solve(lower.T, made[m])
    return made


@_inner
def _inverse_band(columns: FloatArray, start: int) -> FloatArray:
    """Band of the inverse of LLᵀ from row ``start`` on, both triangles, shape (p, p).

    Entries farther from the diagonal than the band of L, and rows before ``start``, are not set.
    Takahashi's recurrence (Erisman and Tinney 1975, On computing certain elements of the inverse
    of a sparse matrix), from the last row to the first.
    """
    width, count = columns.shape[1] - 1, len(columns)
    inverse, column = np.empty((count, count)), np.empty(width)
    for j in range(count - 1, start - 1, -1):
        after = min(width, count - 1 - j)
        column[:] = 0.0
        for k in range(0, after - 3, 4):  # four at a time: the column is read and written once
            a, b = columns[j, k + 1] / columns[j, 0], columns[j, k + 2] / columns[j, 0]
            c, d = columns[j, k + 3] / columns[j, 0], columns[j, k + 4] / columns[j, 0]
            rows = inverse[j + 1 + k : j + 5 + k, j + 1 :]
            for i in range(after):
                column[i] -= a * rows[0, i] + b * rows[1, i] + c * rows[2, i] + d * rows[3, i]
        for k in range(after - after % 4, after):
            factor, row = columns[j, k + 1] / columns[j, 0], inverse[j + 1 + k, j + 1 :]
            for i in range(after):
                column[i] -= factor * row[i]
        own = 1.0 / (columns[j, 0] * columns[j, 0])
        for k in range(after):
            inverse[j, j + 1 + k] = inverse[j + 1 + k, j] = column[k]
            own -= columns[j, k + 1] / columns[j, 0] * column[k]
        inverse[j, j] = own
    return inverse


@_compiled(_f2, _lower, _f1, _f2, _f2, _f2)
def covariance_of_dots(
    grid: FloatArray,
    lower: FloatArray,
    laser: FloatArray,
    plane: FloatArray,
    points: FloatArray,
    dots: FloatArray,
) -> FloatArray:
    """Covariance of the dots that a fitted surface makes of rays, shape (n, 2, 2), mm².

    With L the factor of the normal matrix, shape (width + 1, p), and R what each coefficient moves
    either coordinate of a dot by, Rᵀ (LLᵀ)⁻¹ R. Points and dots are in the UCS, shape (n, 3), mm.
    """
    pairs, work, many = len(points), np.empty((4, 4)), int(grid[1, 3]) + 3
    first = np.empty(pairs, np.int64)
    for k in range(pairs):
        first_x = _cubic_splines(grid[0], points[k, 0], work[0], work[1])
        first[k] = first_x * many + _cubic_splines(grid[1], points[k, 1], work[2], work[3])
    out = np.zeros((pairs, 2, 2))
    if pairs == 0:
        return out
    # The splines of a cell are all within the band.
    inverse = _inverse_band(lower.T, first.min())
    by_u, by_v = np.empty(16), np.empty(16)
    for k in range(pairs):
        (xu, xv), (yu, yv) = _slope_jacobian(laser, plane, points[k], dots[k])
        area = xu * yv - xv * yu
        _cubic_splines(grid[0], points[k, 0], work[0], work[1])
        _cubic_splines(grid[1], points[k, 1], work[2], work[3])
        for own in range(16):
            by_x = work[1, own // 4] * work[2, own % 4]
            by_y = work[0, own // 4] * work[3, own % 4]
            by_u[own] = (yv * by_x - xv * by_y) / area
            by_v[own] = (xu * by_y - yu * by_x) / area
        for own in range(16):
            row = inverse[first[k] + own // 4 * many + own % 4, first[k] :]
            along_u, along_v = 0.0, 0.0
            for a in range(4):
                for b in range(4):
                    entry = row[a * many + b]
                    along_u += entry * by_u[4 * a + b]
                    along_v += entry * by_v[4 * a + b]
            out[k, 0, 0] += by_u[own] * along_u
            out[k, 0, 1] += by_u[own] * along_v
            out[k, 1, 1] += by_v[own] * along_v
        out[k, 1, 0] = out[k, 0, 1]
    return out


@_compiled(_lower, _f2)
def variances(lower: FloatArray, gradients: FloatArray) -> FloatArray:
    """Diagonal of G (LLᵀ)⁻¹ Gᵀ, shape (m,).

    L is the factor of the normal matrix, shape (width + 1, p); G has shape (m, p).
    """
    left, columns, out = gradients.copy(), lower.T, np.empty(len(gradients))
    for m in range(len(left)):
        _solve_lower(columns, left[m])
        out[m] = np.sum(left[m] * left[m])
    return out


@_compiled(_f2, _f1, _f2, _f3, _f1, _f2, _f2)
def gradient_rhs(
    grid: FloatArray,
    coefficients: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    laser: FloatArray,
    plane: FloatArray,
    dots: FloatArray,
) -> FloatArray:
    """Right-hand side of the normal equations, shape (p,): Σ Jᵀ W (slopes asked for − slopes).

    Asked for at each point are the slopes that turn its ray to its dot, shape (n, 3), UCS; weights
    are the inverse covariances of these slopes, shape (n, 2, 2).
    """
    out, work = np.zeros(len(coefficients)), np.empty((4, 4))
    many, glass = int(grid[1, 3]) + 3, plane[4, 0] != 0.0
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        _, slope_x, slope_y = _height_and_slopes(grid, coefficients, x, y, work)
        first_x = _cubic_splines(grid[0], x, work[0], work[1])
        first_y = _cubic_splines(grid[1], y, work[2], work[3])
        at = dots[k, 0], dots[k, 1], dots[k, 2]
        if glass:
            at = _without_glass(points[k], at, plane)
        asked_x, asked_y = _bisecting_slopes(laser, points[k], at[0], at[1], at[2])
        off_x, off_y = asked_x - slope_x, asked_y - slope_y
        pull_x = weights[k, 0, 0] * off_x + weights[k, 0, 1] * off_y
        pull_y = weights[k, 1, 0] * off_x + weights[k, 1, 1] * off_y
        for a in range(4):
            for b in range(4):
                by_x, by_y = work[1, a] * work[2, b], work[0, a] * work[3, b]
                out[(first_x + a) * many + first_y + b] += pull_x * by_x + pull_y * by_y
    return out


@_compiled(_f2, _bands, _f1, _f1, _f2, _f3, _bench, _f2)
def fit_step(
    grid: FloatArray,
    bands: tuple[FloatArray, FloatArray],
    coefficients: FloatArray,
    rough: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    bench: tuple[FloatArray, FloatArray],
    dots: FloatArray,
) -> FloatArray:
    """Coefficients after one step of the fit (`NormalEquations.step`), shape (p,).

    Parameters
    ----------
    grid, coefficients, points, weights, dots
        See `gradient_rhs`.
    bands
        Stiffness and factor, see `normal_factor`.
    rough
        Coefficients of the surface that is held smooth, shape (p,).
    bench
        The laser and the plane.
    """
    (stiffness, factor), (laser, plane) = bands, bench
    change = gradient_rhs(grid, coefficients, points, weights, laser, plane, dots)
    columns, (height, count) = stiffness.T, stiffness.shape
    for j in range(count):
        column, own, rest, total = columns[j], rough[j], change[j:], 0.0
        rest[0] -= column[0] * own
        for k in range(1, min(height, count - j)):
            rest[k] -= column[k] * own
            total += column[k] * rough[j + k]
        rest[0] -= total
    _solve(factor.T, change)
    # Slopes leave the level open: the mean height of the points stays.
    mean = 0.0
    for height_there in surface_at(grid, change, points)[0]:
        mean += height_there / len(points)
    return coefficients + (change - mean)


@_compiled(_f2, _f1, _f2, _f2, _i)
def newton_along_rays(
    grid: FloatArray, coefficients: FloatArray, rays: FloatArray, points: FloatArray, steps: int
) -> tuple[FloatArray, float]:
    """Points moved along their rays to a surface by so many Newton steps, shape (n, 3), mm.

    The second value is how far the farthest moved along X, Y or Z, mm; NaN where one is.
    """
    moved, most, work = points.copy(), 0.0, np.empty((4, 4))
    for k in range(len(points)):
        for _ in range(steps):
            step, _, _ = _newton_step(grid, coefficients, rays[k], moved[k], work)
            if abs(step) < ON_SURFACE_MM:
                break
        for axis in range(3):
            by = abs(moved[k, axis] - points[k, axis])
            if not by <= most:  # NaN, too
                most = by
        if np.isnan(most):
            break
    return moved, most


# --- the boundary -------------------------------------------------------------------------------


@_compiled(_f2, _f1, _f1, _f1, _f2, _f1, _f1, _f)
def newton_to_boundary(
    grid: FloatArray,
    coefficients: FloatArray,
    rear: FloatArray,
    center: FloatArray,
    way: FloatArray,
    radius: FloatArray,
    longest: FloatArray,
    last: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Newton steps along m directions to where a surface comes down to its boundary.

    Parameters
    ----------
    grid, coefficients
        See the module.
    rear
        `Rear.as_array`: the height that the boundary has at y.
    center, way, radius
        Where directions start, shape (2,), unit vectors along them, shape (m, 2), and how far out
        the steps begin, shape (m,), mm.
    longest
        Longest step along each direction, shape (m,), mm.
    last
        The steps end after one in which all are shorter, mm.

    Returns
    -------
    radius, boundary_slope, over
        Radii of the boundary, shape (m,), mm. Where each was before its last step: gradient of the
        surface's height over the boundary's, shape (m, 2), and that height, shape (m,), mm.
    """
    count, work = len(radius), np.empty((4, 4))
    out, boundary_slope, over = radius.copy(), np.empty((count, 2)), np.empty(count)
    for _ in range(MOST_BOUNDARY_STEPS):
        most = 0.0
        for k in range(count):
            x, y = center[0] + out[k] * way[k, 0], center[1] + out[k] * way[k, 1]
            z, slope_x, slope_y = _height_and_slopes(grid, coefficients, x, y, work)
            part = max((rear[1] - y) / (rear[1] - rear[2]), 0.0)
            over[k] = z + rear[0] * part * part
            boundary_slope[k, 0] = slope_x
            boundary_slope[k, 1] = slope_y - 2.0 * rear[0] * part / (rear[1] - rear[2])
            outward = boundary_slope[k, 0] * way[k, 0] + boundary_slope[k, 1] * way[k, 1]
            change = -over[k] / outward if abs(outward) > 1e-6 else 0.0
            out[k] += min(max(change, -longest[k]), longest[k])
            most = max(most, abs(change))
        if most < last:
            break
    return out, boundary_slope, over


# --- sizes --------------------------------------------------------------------------------------


@_compiled(_f2, _f1, _f2, _f1, _f1, _f1, _f1, _i)
def spokes(
    grid: FloatArray,
    coefficients: FloatArray,
    outline: FloatArray,
    center: FloatArray,
    fraction: FloatArray,
    weight: FloatArray,
    rear: FloatArray,
    stride: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sample a surface at fractions of the way from a centre to each ``stride``-th boundary point.

    The outline is the m boundary points, shape (m, 3), m a multiple of ``stride``. The rear is
    `Rear.as_array`.

    Returns
    -------
    samples, over, share
        Places with their height, shape (n, 3); height over that of the boundary, shape (n,); what a
        sample counts in the volume, shape (n,): its weight times its share of the wedges of all
        boundary points (`measures.wedges`), those between two spokes shared by how near they are.
    """
    count, rings, work = len(outline), len(fraction), np.empty((4, 4))
    wedge = np.empty(count)
    for k in range(count):
        before, after = outline[k - 1], outline[(k + 1) % count]
        x, y = outline[k, 0] - center[0], outline[k, 1] - center[1]
        twice = (before[0] - center[0]) * y - x * (before[1] - center[1])
        twice += x * (after[1] - center[1]) - (after[0] - center[0]) * y
        wedge[k] = twice / 4.0
    samples = np.empty((count // stride * rings, 3))
    over, share = np.empty(len(samples)), np.empty(len(samples))
    for spoke in range(count // stride):
        own = 0.0
        for off in range(1 - stride, stride):
            own += wedge[(spoke * stride + off) % count] * (1.0 - abs(off) / stride)
        end = outline[spoke * stride]
        for ring in range(rings):
            at = spoke * rings + ring
            x = center[0] + fraction[ring] * (end[0] - center[0])
            y = center[1] + fraction[ring] * (end[1] - center[1])
            z, _, _ = _height_and_slopes(grid, coefficients, x, y, work)
            part = max((rear[1] - y) / (rear[1] - rear[2]), 0.0)
            samples[at, 0], samples[at, 1], samples[at, 2] = x, y, z
            over[at] = z + rear[0] * part * part
            share[at] = own * weight[ring] * fraction[ring]
    return samples, over, share


@_compiled(_f2, _i, _f2, _f1, _f2, _f2, _f1)
def size_gradients(
    grid: FloatArray,
    count: int,
    samples: FloatArray,
    share: FloatArray,
    outline: FloatArray,
    boundary_slope: FloatArray,
    center: FloatArray,
) -> FloatArray:
    """Derivatives of width, length, area and volume by so many coefficients, shape (4, p).

    Samples and what they count in the volume are those of `spokes`; ``boundary_slope`` is the
    gradient of the surface's height over the boundary's at each boundary point, shape (m, 2).
    """
    out, work = np.zeros((4, count)), np.empty((4, 4))
    for axis in range(2):
        low, high = 0, 0
        for k in range(len(outline)):
            low = k if outline[k, axis] < outline[low, axis] else low
            high = k if outline[k, axis] > outline[high, axis] else high
        for end, sign in ((high, -1.0), (low, 1.0)):
            moved = sign / boundary_slope[end, axis]
            _accumulate_splines(grid, outline[end, 0], outline[end, 1], moved, work, out[axis])
    for k in range(len(outline)):
        x, y = outline[k, 0] - center[0], outline[k, 1] - center[1]
        # Where the surface rises by dz the boundary moves by −dz over its slope outwards.
        moved = (
            -2.0
            * np.pi
            / len(outline)
            * (x * x + y * y)
            / (boundary_slope[k, 0] * x + boundary_slope[k, 1] * y)
        )
        _accumulate_splines(grid, outline[k, 0], outline[k, 1], moved, work, out[2])
        _accumulate_splines(grid, outline[k, 0], outline[k, 1], moved * outline[k, 2], work, out[3])
    for k in range(len(samples)):
        _accumulate_splines(grid, samples[k, 0], samples[k, 1], share[k], work, out[3])
    return out


# --- quadrics -----------------------------------------------------------------------------------


@_inner
def _quadric_at(quadric: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Height and slopes of a quadric at a place from its centre: g_x, g_y, κ_x, κ_xy, κ_y."""
    along_x = quadric[0] + quadric[2] * x + quadric[3] * y
    along_y = quadric[1] + quadric[3] * x + quadric[4] * y
    return ((quadric[0] + along_x) * x + (quadric[1] + along_y) * y) / 2.0, along_x, along_y


@_compiled(_f1, _f2, _f2, _f1, _f2)
def reflect_off_quadrics(
    center: FloatArray, quadrics: FloatArray, rays: FloatArray, laser: FloatArray, plane: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Intersect rays with quadrics and reflect them to the imaging plane.

    Parameters
    ----------
    center, quadrics
        Shape (2,), mm; slopes and curvatures of each (`_quadric_at`), shape (m, 5).
    rays, laser
        Shapes (n, 3) and (3,), mm.
    plane
        See the module.

    Returns
    -------
    points, dots
        Shape (m, n, 3), mm, and IPCS, shape (m, n, 2), mm; NaN where a ray runs away.
    """
    points = np.empty((len(quadrics), len(rays), 3))
    dots = np.empty((len(quadrics), len(rays), 2))
    for q in range(len(quadrics)):
        for k in range(len(rays)):
            ray, point = rays[k], points[q, k]
            for axis in range(3):
                point[axis] = laser[axis] - laser[2] / ray[2] * ray[axis]
            for _ in range(QUADRIC_STEPS):
                z, slope_x, slope_y = _quadric_at(
                    quadrics[q], point[0] - center[0], point[1] - center[1]
                )
                descent = slope_x * ray[0] + slope_y * ray[1] - ray[2]
                step = (point[2] - z) / max(descent, LEAST_DESCENT)
                step = min(max(step, -LONGEST_QUADRIC_STEP_MM), LONGEST_QUADRIC_STEP_MM)
                for axis in range(3):
                    point[axis] += step * ray[axis]
            _, slope_x, slope_y = _quadric_at(
                quadrics[q], point[0] - center[0], point[1] - center[1]
            )
            dots[q, k, 0], dots[q, k, 1] = _reflected_dot(ray, point, slope_x, slope_y, plane)
    return points, dots


@_inner
def _distance(one: FloatArray, other: FloatArray) -> float:
    """Distance of two dots; infinite where there is none."""
    distance = np.hypot(one[0] - other[0], one[1] - other[1])
    return distance if np.isfinite(distance) else np.inf


@_compiled(_f4, _f2, _mask, _f)
def match_predicted_dots(
    pattern: FloatArray, places: FloatArray, absent: BoolArray, gate: float
) -> tuple[BoolArray, IntArray, FloatArray]:
    """Which predicted dots fall on which of some places.

    Parameters
    ----------
    pattern
        Predicted dots, shape (m, rows, columns, 2), mm; NaN where there is none.
    places
        Dots that were found, shape (d, 2), mm.
    absent
        Rays that make no dot, shape (rows, columns).
    gate
        Share of the way to the next predicted dot in the row or the column within which a place is
        a predicted dot's.

    Returns
    -------
    hit, dot, off
        Whether a place is within the gate; the nearest place; how far off it is, in units of the
        gate. Shape (m, rows, columns) each.
    """
    count, rows, columns = pattern.shape[:3]
    hit = np.zeros((count, rows, columns), np.bool_)
    dot = np.zeros((count, rows, columns), np.int64)
    off = np.full((count, rows, columns), np.inf)
    for p in range(count):
        for i in range(rows):
            for j in range(columns):
                own = pattern[p, i, j]
                if not (np.isfinite(own[0]) and np.isfinite(own[1])):
                    continue
                spacing = np.inf
                if i > 0:
                    spacing = min(spacing, _distance(own, pattern[p, i - 1, j]))
                if i < rows - 1:
                    spacing = min(spacing, _distance(own, pattern[p, i + 1, j]))
                if j > 0:
                    spacing = min(spacing, _distance(own, pattern[p, i, j - 1]))
                if j < columns - 1:
                    spacing = min(spacing, _distance(own, pattern[p, i, j + 1]))
                least = np.inf
                for k in range(len(places)):
                    x, y = own[0] - places[k, 0], own[1] - places[k, 1]
                    if x * x + y * y < least:
                        least = x * x + y * y
                        dot[p, i, j] = k
                off[p, i, j] = np.sqrt(least) / max(gate * spacing, 1e-9)
                hit[p, i, j] = off[p, i, j] < 1.0 and not absent[i, j]
    return hit, dot, off


@_inner
def _cap_dots(
    cap: FloatArray, rays: FloatArray, bench: tuple[FloatArray, FloatArray], dots: FloatArray
) -> BoolArray:
    """Put the dots that a cap makes of rays into ``dots``, (n, 2); which rays it meets, (n,)."""
    x_mm, y_mm, along_x, along_y, height = cap
    laser, plane = bench
    quadric, point, there = np.zeros(5), np.empty(3), np.zeros(len(rays), np.bool_)
    quadric[2], quadric[4] = -2.0 * height / along_x**2, -2.0 * height / along_y**2
    for k in range(len(rays)):
        ray = rays[k]
        for axis in range(3):
            point[axis] = laser[axis] + (height - laser[2]) / ray[2] * ray[axis]
        for _ in range(QUADRIC_STEPS):
            z, slope_x, slope_y = _quadric_at(quadric, point[0] - x_mm, point[1] - y_mm)
            descent = slope_x * ray[0] + slope_y * ray[1] - ray[2]
            step = (point[2] - height - z) / max(descent, LEAST_DESCENT)
            step = min(max(step, -LONGEST_QUADRIC_STEP_MM), LONGEST_QUADRIC_STEP_MM)
            for axis in range(3):
                point[axis] += step * ray[axis]
        across, along = (point[0] - x_mm) / along_x, (point[1] - y_mm) / along_y
        if across * across + along * along < 1.0:
            _, slope_x, slope_y = _quadric_at(quadric, point[0] - x_mm, point[1] - y_mm)
            dots[k, 0], dots[k, 1] = _reflected_dot(ray, point, slope_x, slope_y, plane)
            there[k] = np.isfinite(dots[k, 0]) and np.isfinite(dots[k, 1])
    return there


@_inner
def _nearest_pairs(
    dots: FloatArray,
    own: IntArray,
    places: FloatArray,
    dot: IntArray,
    spacing: FloatArray,
    away: FloatArray,
) -> BoolArray:
    """Nearest place of each own dot, how far it and the next own dot are; and which are mutual."""
    back, ray_of = np.full(len(places), np.inf), np.empty(len(places), np.int64)
    spacing[: len(own)] = np.inf
    for a in range(len(own)):
        u, v = dots[own[a]]
        for b in range(a):
            x, y = u - dots[own[b], 0], v - dots[own[b], 1]
            square = x * x + y * y
            spacing[a], spacing[b] = min(spacing[a], square), min(spacing[b], square)
        away[a] = np.inf
        for m in range(len(places)):
            x, y = u - places[m, 0], v - places[m, 1]
            square = x * x + y * y
            if square < away[a]:
                away[a], dot[a] = square, m
            if square < back[m]:
                back[m], ray_of[m] = square, a
    mutual = np.empty(len(own), np.bool_)
    for a in range(len(own)):
        spacing[a], away[a] = np.sqrt(spacing[a]), np.sqrt(away[a])
        mutual[a] = ray_of[dot[a]] == a
    return mutual


@_compiled(_f2, _f2, _f1, _f2, _f2, types.Array(types.boolean, 1, "A", readonly=True), _f1)
def score_caps(
    caps: FloatArray,
    rays: FloatArray,
    laser: FloatArray,
    plane: FloatArray,
    places: FloatArray,
    absent: BoolArray,
    settings: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """How well places on the plane fit the dots that caps make of rays, and which is whose.

    Parameters
    ----------
    caps
        Paraboloids over ellipses: middle X and Y, semi-axes along them, height, shape (m, 5), mm.
    rays, laser, plane
        See `reflect_off_quadrics`.
    places, absent
        Shape (d, 2), mm; which rays make no dot, shape (n,).
    settings
        Least rays; the gate, a share of the way to the next predicted dot; what a ray without its
        place takes off; share of the way within which an absent ray has a place, and what that
        takes off (`cap_search`).

    Returns
    -------
    score, labels
        The higher the better, −inf for too few rays, shape (m,); and index of the place that is
        each ray's, −1 where none is, shape (m, n).
    """
    least, gate, dark, lit_gate, lit = settings
    count, bench = len(rays), (laser, plane)
    score, labels = np.full(len(caps), -np.inf), np.full((len(caps), count), -1)
    dots, dot, spacing, away = (
        np.empty((count, 2)),
        np.empty(count, np.int64),
        np.empty(count),
        np.empty(count),
    )
    for c in range(len(caps)):
        there = _cap_dots(caps[c], rays, bench, dots)
        own, marked = np.flatnonzero(there & ~absent), np.flatnonzero(there & absent)
        if len(own) < least:
            continue
        mutual = _nearest_pairs(dots, own, places, dot, spacing, away)
        total = 0.0
        for a in range(len(own)):
            if mutual[a] and away[a] < gate * spacing[a]:
                total += 1.0 - away[a] / spacing[a]
                labels[c, own[a]] = dot[a]
            else:
                total -= dark
        usual, shown = np.median(spacing[: len(own)]), 0
        for k in marked:
            nearest = np.inf
            for m in range(len(places)):
                nearest = min(nearest, _distance(dots[k], places[m]))
            shown += nearest < lit_gate * usual
        score[c] = total - lit * shown / max(len(marked), 1)
    return score, labels


@_inner
def _solve_small(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve small normal equations by elimination; what they leave open is 0."""
    count, most = len(right), normal.max()
    for k in range(count):
        if not normal[k, k] > 1e-10 * most:
            normal[k, :], normal[:, k], right[k] = 0.0, 0.0, 0.0
            normal[k, k] = 1.0
        for i in range(k + 1, count):
            factor = normal[i, k] / normal[k, k]
            right[i] -= factor * right[k]
            for j in range(k, count):
                normal[i, j] -= factor * normal[k, j]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            right[k] -= normal[k, j] * right[j]
        right[k] /= normal[k, k]
    return right


@_compiled(_f1, _f2, _f3, _f1, _f2, _f2, _mask, _f)
def fit_quadrics(
    center: FloatArray,
    quadrics: FloatArray,
    rays: FloatArray,
    laser: FloatArray,
    plane: FloatArray,
    places: FloatArray,
    absent: BoolArray,
    gate: float,
) -> FloatArray:
    """Fit quadrics, shape (m, 5), to the places that their rays next to the middle one fall near.

    Least squares of slopes: every ray that falls on a place asks for the slopes that turn it
    there (`_bisecting_slopes`). One on which fewer than four fall stays as it is.

    Parameters
    ----------
    center, laser, plane
        See `reflect_off_quadrics`.
    rays
        Shape (rows, columns, 3), rows and columns odd.
    places, absent, gate
        See `match_predicted_dots`.
    """
    rows, columns = rays.shape[:2]
    flat, out = rays.copy().reshape(rows * columns, 3), quadrics.copy()
    normal, right, by, dot = np.empty((5, 5)), np.empty(5), np.zeros((2, 5)), np.empty(3)
    for q in range(len(out)):
        for _ in range(2):  # they land elsewhere then
            points, dots = reflect_off_quadrics(center, out[q : q + 1], flat, laser, plane)
            hit, number, _ = match_predicted_dots(
                dots.reshape(1, rows, columns, 2), places, absent, gate
            )
            normal[:], right[:], count = 0.0, 0.0, 0
            for i in range(rows // 2 - 1, rows // 2 + 2):
                for j in range(columns // 2 - 1, columns // 2 + 2):
                    if not hit[0, i, j]:
                        continue
                    count += 1
                    point, place = points[0, i * columns + j], places[number[0, i, j]]
                    for axis in range(3):
                        dot[axis] = plane[0, axis] + place[0] * plane[1, axis]
                        dot[axis] += place[1] * plane[2, axis]
                    at = dot[0], dot[1], dot[2]
                    if plane[4, 0] != 0.0:
                        at = _without_glass(point, at, plane)
                    asked = _bisecting_slopes(laser, point, at[0], at[1], at[2])
                    x, y = point[0] - center[0], point[1] - center[1]
                    by[0, 0], by[0, 2], by[0, 3] = 1.0, x, y
                    by[1, 1], by[1, 3], by[1, 4] = 1.0, x, y
                    for axis in range(2):
                        for m in range(5):
                            right[m] += by[axis, m] * asked[axis]
                            for n in range(5):
                                normal[m, n] += by[axis, m] * by[axis, n]
            if count < 4:
                break
            out[q] = _solve_small(normal, right)
    return out
