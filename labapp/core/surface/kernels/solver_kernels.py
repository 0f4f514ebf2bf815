"""The steps of the fit and its covariance, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BAND, FLOATS_1, FLOATS_2, FLOATS_3, INT
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.ray_kernels import (
    bisecting_slopes,
    newton_step,
    slope_jacobian,
    without_glass,
)
from labapp.core.surface.kernels.spline_kernels import cubic_splines, height_and_slopes, surface_at
from labapp.core.values import FloatArray

_bands, _bench = types.UniTuple(BAND, 2), types.Tuple((FLOATS_1, FLOATS_2))  # type: ignore[no-untyped-call]

ON_SURFACE_MM = 1e-9
"""Newton's method stops after a shorter step: the next would be far below rounding."""

AT_ONCE = 4
"""Columns of a matrix that are eliminated at once, from as many columns."""


@_inner
def _products_along(products: FloatArray, cells: int) -> FloatArray:
    """Products of each spline along an axis with itself and the next three, for each order.

    The arguments are those of `roughness_band` and the number of cells along the axis; shape
    (4, cells + 3, 4).
    """
    along = np.zeros((4, cells + 3, 4))
    for order in range(4):
        for one in range(4):
            for on in range(4 - one):
                for cell in range(cells):
                    along[order, cell + one, on] += products[order, one, one + on]
    return along


@_compiled(FLOATS_3, FLOATS_2)
def roughness_band(products: FloatArray, grid: FloatArray) -> FloatArray:
    """Band of `SplineBasis.roughness_matrix`.

    ``products`` are the integrals over a cell of size 1 of products of the four splines there, or
    of their derivatives of orders 0 … 3, shape (4, 4, 4).
    """
    x_cells, y_cells, step = int(grid[0, 3]), int(grid[1, 3]), grid[:, 2]
    along_x, along_y = _products_along(products, x_cells), _products_along(products, y_cells)
    nx, ny = x_cells + 3, y_cells + 3
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
    """Add the contribution of slopes at points to the columns of a normal matrix's lower band."""
    work, y_count = np.empty((4, 4)), int(grid[1, 3]) + 3
    by_x, by_y = np.empty(16), np.empty(16)
    for k in range(len(points)):
        first_x = cubic_splines(grid[0], points[k, 0], work[0], work[1])
        first_y = cubic_splines(grid[1], points[k, 1], work[2], work[3])
        for a in range(4):
            for b in range(4):
                by_x[4 * a + b] = work[1, a] * work[2, b]
                by_y[4 * a + b] = work[0, a] * work[3, b]
        xx, xy, yy = weights[k, 0, 0], weights[k, 0, 1], weights[k, 1, 1]
        for own in range(16):
            along_x = xx * by_x[own] + xy * by_y[own]
            along_y = xy * by_x[own] + yy * by_y[own]
            column = columns[(first_x + own // 4) * y_count + first_y + own % 4]
            for other in range(own, 16):
                below = (other // 4 - own // 4) * y_count + other % 4 - own % 4
                column[below] += along_x * by_x[other] + along_y * by_y[other]


@_inner
def _factorize(columns: FloatArray, count: int, width: int) -> bool:
    """Replace the lower band of a matrix by its Cholesky factor; whether it has one.

    Each row of the array holds one column of the band, padded by 2 · `AT_ONCE` zeros; `AT_ONCE`
    rows follow the last. `AT_ONCE` columns are eliminated together, from as many after them at a
    time: each is read and written less often.
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
        for t in range(AT_ONCE, min(AT_ONCE + width, count - j), AT_ONCE):
            # Row t of the eliminated columns, and the next three.
            e0, e1, e2, e3 = c0[t], c1[t - 1], c2[t - 2], c3[t - 3]
            f0, f1, f2, f3 = c0[t + 1], c1[t], c2[t - 1], c3[t - 2]
            g0, g1, g2, g3 = c0[t + 2], c1[t + 1], c2[t], c3[t - 1]
            h0, h1, h2, h3 = c0[t + 3], c1[t + 2], c2[t + 1], c3[t]
            columns[j + t, 0] -= e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3
            columns[j + t, 1] -= e0 * f0 + e1 * f1 + e2 * f2 + e3 * f3
            columns[j + t, 2] -= e0 * g0 + e1 * g1 + e2 * g2 + e3 * g3
            columns[j + t + 1, 0] -= f0 * f0 + f1 * f1 + f2 * f2 + f3 * f3
            columns[j + t + 1, 1] -= f0 * g0 + f1 * g1 + f2 * g2 + f3 * g3
            columns[j + t + 2, 0] -= g0 * g0 + g1 * g1 + g2 * g2 + g3 * g3
            s0, s1, s2, s3 = c0[t + 3 :], c1[t + 2 :], c2[t + 1 :], c3[t:]
            o0, o1 = columns[j + t, 3:], columns[j + t + 1, 2:]
            o2, o3 = columns[j + t + 2, 1:], columns[j + t + 3]
            for k in range(width + 1 - t):
                o0[k] -= e0 * s0[k] + e1 * s1[k] + e2 * s2[k] + e3 * s3[k]
                o1[k] -= f0 * s0[k] + f1 * s1[k] + f2 * s2[k] + f3 * s3[k]
                o2[k] -= g0 * s0[k] + g1 * s1[k] + g2 * s2[k] + g3 * s3[k]
                o3[k] -= h0 * s0[k] + h1 * s1[k] + h2 * s2[k] + h3 * s3[k]
    return True


@_compiled(FLOATS_2, BAND, FLOATS_2, FLOATS_3)
def normal_factor(
    grid: FloatArray, stiffness: FloatArray, points: FloatArray, weights: FloatArray
) -> tuple[FloatArray, bool]:
    """Cholesky factor of the normal matrix (`solver.normal_factor`), and whether it has one."""
    height, count = stiffness.shape
    columns = np.zeros((count + AT_ONCE, height + 2 * AT_ONCE))
    columns[:count, :height] = stiffness.T
    _accumulate_normal_matrix(grid, points, weights, columns)
    x, y, diagonal = 0.0, 0.0, 0.0
    for k in range(len(points)):
        x, y = x + points[k, 0] / len(points), y + points[k, 1] / len(points)
    for k in range(count):
        diagonal += columns[k, 0] / count
    work = np.empty((4, 4))
    first_x = cubic_splines(grid[0], x, work[0], work[1])
    first_y = cubic_splines(grid[1], y, work[2], work[3])
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


@_compiled(BAND, FLOATS_2)
def solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of a factor for m right-hand sides, shape (m, p)."""
    columns = lower.T
    count, height = columns.shape
    if len(right) == 1:
        made = right.copy()
        _solve(columns, made[0])
        return made
    solved = right.T.copy()  # the innermost loops are over the right-hand sides
    for j in range(count):
        own = solved[j]
        own /= columns[j, 0]
        for k in range(1, min(height, count - j)):
            factor, other = columns[j, k], solved[j + k]
            for m in range(len(own)):
                other[m] -= factor * own[m]
    for j in range(count - 1, -1, -1):
        own = solved[j]
        for k in range(1, min(height, count - j)):
            factor, other = columns[j, k], solved[j + k]
            for m in range(len(own)):
                own[m] -= factor * other[m]
        own /= columns[j, 0]
    return solved.T.copy()


@_compiled(BAND)
def inverse_band(lower: FloatArray) -> FloatArray:
    """Band of the inverse of LLᵀ, both triangles, shape (p, p).

    L is the factor of the normal matrix, shape (width + 1, p). Entries farther from the diagonal
    than its band are not set. Takahashi's recurrence (Erisman and Tinney 1975, On computing certain
    elements of the inverse of a sparse matrix), from the last column to the first. Columns j and
    j − 1 are computed together, from four rows at a time: each entry is read half as often.
    """
    columns = lower.T
    width, count = columns.shape[1] - 1, len(columns)
    inverse, (one, other, own, before) = np.empty((count, count)), np.zeros((4, width))
    if count % 2:
        inverse[-1, -1] = 1.0 / columns[-1, 0] ** 2
    for j in range(count - 1 - count % 2, 0, -2):
        after, scale, scale_before = (
            min(width, count - 1 - j),
            1 / columns[j, 0],
            1 / columns[j - 1, 0],
        )
        for k in range(after):
            one[k] = columns[j, k + 1] * scale
            other[k] = columns[j - 1, k + 2] * scale_before if k < width - 1 else 0.0
        own[:], before[:] = 0.0, 0.0
        for k in range(0, after - 3, 4):
            a, b, c, d = one[k : k + 4]
            e, f, g, h = other[k : k + 4]
            rows = inverse[j + 1 + k : j + 5 + k, j + 1 :]
            for i in range(after):
                own[i] -= a * rows[0, i] + b * rows[1, i] + c * rows[2, i] + d * rows[3, i]
                before[i] -= e * rows[0, i] + f * rows[1, i] + g * rows[2, i] + h * rows[3, i]
        for k in range(after - after % 4, after):
            row = inverse[j + 1 + k, j + 1 :]
            for i in range(after):
                own[i] -= one[k] * row[i]
                before[i] -= other[k] * row[i]
        # The column before also has an entry in row j.
        last, between = scale * scale, 0.0
        for k in range(after):
            last -= one[k] * own[k]
            between -= other[k] * own[k]
        step = columns[j - 1, 1] * scale_before
        between -= step * last
        first = scale_before * scale_before - step * between
        for k in range(after):
            before[k] -= step * own[k]
            first -= other[k] * before[k]
            inverse[j, j + 1 + k] = inverse[j + 1 + k, j] = own[k]
            inverse[j - 1, j + 1 + k] = inverse[j + 1 + k, j - 1] = before[k]
        inverse[j, j], inverse[j - 1, j - 1] = last, first
        inverse[j, j - 1] = inverse[j - 1, j] = between
    return inverse


@_compiled(FLOATS_2, FLOATS_2, FLOATS_1, FLOATS_2)
def height_variances(
    grid: FloatArray, inverse: FloatArray, of_mean: FloatArray, points: FloatArray
) -> FloatArray:
    """Variance of the height at points less the mean height, shape (m,), mm².

    Parameters
    ----------
    inverse
        Covariance of the p coefficients (`inverse_band`), shape (p, p), mm².
    of_mean
        Covariance of each coefficient with the mean height, and the variance of that, shape
        (p + 1,), mm².
    points
        Shape (m, ≥ 2), mm.
    """
    out, work, y_count = np.empty(len(points)), np.empty((4, 4)), int(grid[1, 3]) + 3
    for k in range(len(points)):
        first = cubic_splines(grid[0], points[k, 0], work[0], work[1]) * y_count
        first += cubic_splines(grid[1], points[k, 1], work[2], work[3])
        variance = of_mean[-1]
        for a in range(4):
            for b in range(4):
                spline, along = first + a * y_count + b, 0.0
                for c in range(4):
                    for d in range(4):
                        along += work[0, c] * work[2, d] * inverse[spline, first + c * y_count + d]
                variance += work[0, a] * work[2, b] * (along - 2.0 * of_mean[spline])
        out[k] = max(variance, 0.0)
    return out


@_compiled(FLOATS_2, FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_2, FLOATS_2)
def covariance_of_dots(
    grid: FloatArray,
    inverse: FloatArray,
    laser: FloatArray,
    plane: FloatArray,
    points: FloatArray,
    dots: FloatArray,
) -> FloatArray:
    """Covariance of the dots that a fitted surface makes of rays, shape (n, 2, 2), mm².

    ``inverse`` is the covariance of the p coefficients (`inverse_band`), whose band contains all
    splines of a cell. Points and dots are in the UCS, shape (n, 3), mm.
    """
    pairs, work, y_count = len(points), np.empty((4, 4)), int(grid[1, 3]) + 3
    first = np.empty(pairs, np.int64)
    for k in range(pairs):
        first_x = cubic_splines(grid[0], points[k, 0], work[0], work[1])
        first[k] = first_x * y_count + cubic_splines(grid[1], points[k, 1], work[2], work[3])
    out = np.zeros((pairs, 2, 2))
    by_u, by_v = np.empty(16), np.empty(16)
    for k in range(pairs):
        (xu, xv), (yu, yv) = slope_jacobian(laser, plane, points[k], dots[k])
        area = xu * yv - xv * yu
        cubic_splines(grid[0], points[k, 0], work[0], work[1])
        cubic_splines(grid[1], points[k, 1], work[2], work[3])
        for own in range(16):
            by_x = work[1, own // 4] * work[2, own % 4]
            by_y = work[0, own // 4] * work[3, own % 4]
            by_u[own] = (yv * by_x - xv * by_y) / area
            by_v[own] = (xu * by_y - yu * by_x) / area
        for own in range(16):
            row = inverse[first[k] + own // 4 * y_count + own % 4, first[k] :]
            along_u, along_v = 0.0, 0.0
            for a in range(4):
                for b in range(4):
                    entry = row[a * y_count + b]
                    along_u += entry * by_u[4 * a + b]
                    along_v += entry * by_v[4 * a + b]
            out[k, 0, 0] += by_u[own] * along_u
            out[k, 0, 1] += by_u[own] * along_v
            out[k, 1, 1] += by_v[own] * along_v
        out[k, 1, 0] = out[k, 0, 1]
    return out


@_compiled(BAND, FLOATS_2)
def variances(lower: FloatArray, gradients: FloatArray) -> FloatArray:
    """Diagonal of G (LLᵀ)⁻¹ Gᵀ, shape (m,).

    L is the factor of the normal matrix, shape (width + 1, p); G has shape (m, p).
    """
    left, columns, out = gradients.copy(), lower.T, np.empty(len(gradients))
    for m in range(len(left)):
        _solve_lower(columns, left[m])
        out[m] = np.sum(left[m] * left[m])
    return out


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_3, FLOATS_1, FLOATS_2, FLOATS_2)
def gradient_rhs(
    grid: FloatArray,
    coefficients: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    laser: FloatArray,
    plane: FloatArray,
    dots: FloatArray,
) -> FloatArray:
    """Right-hand side of the normal equations, shape (p,): Σ Jᵀ W (slopes required − slopes).

    Required at each point are the slopes that turn its ray to its dot, shape (n, 3), UCS; weights
    are the inverse covariances of these slopes, shape (n, 2, 2).
    """
    out, work = np.zeros(len(coefficients)), np.empty((4, 4))
    y_count, glass = int(grid[1, 3]) + 3, plane[4, 0] != 0.0
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        _, slope_x, slope_y = height_and_slopes(grid, coefficients, x, y, work)
        first_x = cubic_splines(grid[0], x, work[0], work[1])
        first_y = cubic_splines(grid[1], y, work[2], work[3])
        at = dots[k, 0], dots[k, 1], dots[k, 2]
        if glass:
            at = without_glass(points[k], at, plane)
        asked_x, asked_y = bisecting_slopes(laser, points[k], at[0], at[1], at[2])
        off_x, off_y = asked_x - slope_x, asked_y - slope_y
        pull_x = weights[k, 0, 0] * off_x + weights[k, 0, 1] * off_y
        pull_y = weights[k, 1, 0] * off_x + weights[k, 1, 1] * off_y
        for a in range(4):
            for b in range(4):
                by_x, by_y = work[1, a] * work[2, b], work[0, a] * work[3, b]
                out[(first_x + a) * y_count + first_y + b] += pull_x * by_x + pull_y * by_y
    return out


@_compiled(FLOATS_2, _bands, FLOATS_1, FLOATS_1, FLOATS_2, FLOATS_3, _bench, FLOATS_2)
def fit_step(
    grid: FloatArray,
    bands: tuple[FloatArray, FloatArray],
    coefficients: FloatArray,
    from_smooth: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    bench: tuple[FloatArray, FloatArray],
    dots: FloatArray,
) -> FloatArray:
    """Coefficients after one step of the fit (`Rounds.run`), shape (p,).

    Parameters
    ----------
    grid, coefficients, points, weights, dots
        See `gradient_rhs`.
    bands
        Stiffness and factor, see `normal_factor`.
    from_smooth
        Coefficients minus those of the surface from which the roughness is counted, shape (p,).
    bench
        The laser and the plane.
    """
    (stiffness, factor), (laser, plane) = bands, bench
    change = gradient_rhs(grid, coefficients, points, weights, laser, plane, dots)
    columns, (height, count) = stiffness.T, stiffness.shape
    for j in range(count):
        column, own, rest, total = columns[j], from_smooth[j], change[j:], 0.0
        rest[0] -= column[0] * own
        for k in range(1, min(height, count - j)):
            rest[k] -= column[k] * own
            total += column[k] * from_smooth[j + k]
        rest[0] -= total
    _solve(factor.T, change)
    # Slopes leave the level open: the mean height of the points stays.
    mean = 0.0
    for height_there in surface_at(grid, change, points)[0]:
        mean += height_there / len(points)
    return coefficients + (change - mean)


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_2, INT)
def newton_along_rays(
    grid: FloatArray, coefficients: FloatArray, rays: FloatArray, points: FloatArray, steps: int
) -> tuple[FloatArray, float]:
    """Move points along their rays to a surface by ``steps`` Newton steps.

    Returns the points, shape (n, 3), and the largest displacement along X, Y or Z, mm; NaN if any
    is NaN.
    """
    moved, most, work = points.copy(), 0.0, np.empty((4, 4))
    for k in range(len(points)):
        for _ in range(steps):
            step, _, _ = newton_step(grid, coefficients, rays[k], moved[k], work)
            if abs(step) < ON_SURFACE_MM:
                break
        for axis in range(3):
            by = abs(moved[k, axis] - points[k, axis])
            if not by <= most:  # NaN, too
                most = by
        if np.isnan(most):
            break
    return moved, most
