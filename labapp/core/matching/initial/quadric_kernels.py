"""Compiled reflection off quadrics and caps, and matching of their dots (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.ray_kernels import (
    LEAST_DESCENT,
    bisecting_slopes,
    reflected_dot,
    without_glass,
)
from labapp.core.values import BoolArray, FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1, _f2, _f3, _f4 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2, 3, 4))
_mask = types.Array(types.boolean, 2, "A", readonly=True)

LONGEST_QUADRIC_STEP_MM = 1.0
"""Longest Newton step along a ray to a quadric, which continues beyond the pool."""

QUADRIC_STEPS = 3
"""Newton steps to a quadric from the plane z = 0, or from the horizontal plane at a cap's top."""


@_inner
def _quadric_at(quadric: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Height and slopes at (x, y) from the centre of a quadric (g_x, g_y, κ_x, κ_xy, κ_y)."""
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
        See `ray_kernels`.

    Returns
    -------
    points, dots
        Shape (m, n, 3), mm, and IPCS, shape (m, n, 2), mm; NaN where a ray diverges.
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
            dots[q, k, 0], dots[q, k, 1] = reflected_dot(ray, point, slope_x, slope_y, plane)
    return points, dots


@_inner
def _square_distance(one: FloatArray, other: FloatArray) -> float:
    """Square of the distance of two dots; infinite if either is NaN."""
    x, y = one[0] - other[0], one[1] - other[1]
    square = x * x + y * y
    return square if np.isfinite(square) else np.inf


@_compiled(_f4, _f2, _mask, _f)
def match_predicted_dots(
    pattern: FloatArray, places: FloatArray, absent: BoolArray, gate: float
) -> tuple[BoolArray, IntArray, FloatArray]:
    """Match predicted dots with the nearest observed ones.

    Parameters
    ----------
    pattern
        Predicted dots, shape (m, rows, columns, 2), mm; NaN where there is none.
    places
        Observed dots, shape (d, 2), mm.
    absent
        Rays that have no dot, or whose dots are not searched for, shape (rows, columns).
    gate
        Largest distance of a match, as a fraction of the distance to the nearest predicted dot of
        the row or the column.

    Returns
    -------
    hit, dot, off
        Whether an observed dot is within the gate; index of the nearest one; its distance in units
        of the gate, infinite for absent rays. Shape (m, rows, columns) each.
    """
    count, rows, columns = pattern.shape[:3]
    hit = np.zeros((count, rows, columns), np.bool_)
    dot = np.zeros((count, rows, columns), np.int64)
    off = np.full((count, rows, columns), np.inf)
    for p in range(count):
        for i in range(rows):
            for j in range(columns):
                own = pattern[p, i, j]
                if absent[i, j] or not (np.isfinite(own[0]) and np.isfinite(own[1])):
                    continue
                spacing = np.inf
                if i > 0:
                    spacing = min(spacing, _square_distance(own, pattern[p, i - 1, j]))
                if i < rows - 1:
                    spacing = min(spacing, _square_distance(own, pattern[p, i + 1, j]))
                if j > 0:
                    spacing = min(spacing, _square_distance(own, pattern[p, i, j - 1]))
                if j < columns - 1:
                    spacing = min(spacing, _square_distance(own, pattern[p, i, j + 1]))
                least = np.inf
                for k in range(len(places)):
                    x, y = own[0] - places[k, 0], own[1] - places[k, 1]
                    if x * x + y * y < least:
                        least = x * x + y * y
                        dot[p, i, j] = k
                off[p, i, j] = np.sqrt(least) / max(gate * np.sqrt(spacing), 1e-9)
                hit[p, i, j] = off[p, i, j] < 1.0
    return hit, dot, off


@_inner
def _cap_dots(
    cap: FloatArray, rays: FloatArray, bench: tuple[FloatArray, FloatArray], dots: FloatArray
) -> BoolArray:
    """Write the dots of rays off a cap into ``dots``, shape (n, 2); return which rays meet it."""
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
            dots[k, 0], dots[k, 1] = reflected_dot(ray, point, slope_x, slope_y, plane)
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
    """Find the nearest observed dot of each predicted one, and return which pairs are mutual.

    Write its index into ``dot``, its distance into ``away``, and the distance to the nearest other
    prediction into ``spacing``.
    """
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
    """Score caps by how well their predicted dots match the observed ones, and label the rays.

    Parameters
    ----------
    caps
        Paraboloids over ellipses: centre X and Y, semi-axes along them, height, shape (m, 5), mm.
    rays, laser, plane
        See `reflect_off_quadrics`.
    places, absent
        Observed dots, shape (d, 2), mm; which rays the lens does not make, shape (n,).
    settings
        Minimum number of rays; the gate, a fraction of the distance to the nearest other
        prediction; penalty for a ray without a dot; the gate for a dot at an absent ray, and the
        penalty for it (`caps`).

    Returns
    -------
    score, labels
        The higher the better, −inf for too few rays, shape (m,); and index of each ray's dot, −1
        where it has none, shape (m, n).
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
                nearest = min(nearest, _square_distance(dots[k], places[m]))
            shown += np.sqrt(nearest) < lit_gate * usual
        score[c] = total - lit * shown / max(len(marked), 1)
    return score, labels


@_inner
def _solve_small(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve small normal equations by elimination; undetermined unknowns are set to 0."""
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
    """Fit quadrics, shape (m, 5), to the dots that match their rays next to the central one.

    Least squares of slopes: the dot of each matched ray gives the slopes that reflect the ray to it
    (`bisecting_slopes`). A quadric with fewer than four matched rays is not changed.

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
        for _ in range(2):  # the reflection points move with the quadric
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
                        at = without_glass(point, at, plane)
                    slopes = bisecting_slopes(laser, point, at[0], at[1], at[2])
                    x, y = point[0] - center[0], point[1] - center[1]
                    by[0, 0], by[0, 2], by[0, 3] = 1.0, x, y
                    by[1, 1], by[1, 3], by[1, 4] = 1.0, x, y
                    for axis in range(2):
                        for m in range(5):
                            right[m] += by[axis, m] * slopes[axis]
                            for n in range(5):
                                normal[m, n] += by[axis, m] * by[axis, n]
            if count < 4:
                break
            out[q] = _solve_small(normal, right)
    return out
