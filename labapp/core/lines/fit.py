"""Fit of a pool surface to reflected lines, which the dissertation does not reconstruct (§3.2.2).

A point of a line gives one equation, its perpendicular distance from the predicted curve; an end of
a line lies on the boundary, z = 0. The lines are identified by their order only. Surfaces of both
curvatures are therefore fitted, first as quadrics, with each possible numbering. The best of them
are refined as splines with a smoothness prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labapp.core.geometry.line_pattern import LineRig, line_directions
from labapp.core.geometry.optics import intersect_level
from labapp.core.lines.model import Linearized, LineData, LineModel
from labapp.core.lines.surface import LineSurface, quadric_terms
from labapp.core.surface.pool_fit import CORRELATED_MM2
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import CannotMeasure, FloatArray

RADII_MM = (6.0, 9.0, 14.0, 24.0, 45.0, 120.0)
"""Initial radii of curvature of the quadrics, convex and concave."""

QUADRIC_SIGMA_MM = 0.1
"""Typical deviation of a pool's lines from those of a quadric, mm on the imaging plane."""

HALF_WIDTH_MM = 2.8
"""Half width of the pools for these radii."""

POOR_COST = 2.0
"""If the cost per point is larger, the quadric is also fitted from a second initial radius."""

NEAR_COST, NEAR_COST_MORE, MOST_REFINED = 4.0, 60.0, 3
"""Quadrics that cost less than this multiple of the best one, plus this, are refined, at most this
many of each order of the lines."""

QUADRIC_ROUNDS, SPLINE_ROUNDS = 20, 40
MARGIN_MM = 0.8

ALIKE_HEIGHT = 0.05, 2.0
"""Heights that differ by no more than this share of the second, plus this many times its standard
uncertainty, are those of one solution."""

STRETCHES, ALIKE_COST = (0.7, 1.25), 12.0
"""Factors by which the quadric is made narrower and wider for two more fits, and largest additional
cost of a surface that counts. Pools of different widths reflect nearly the same lines, as the
position along the fan is unknown: the iterations may end near where they begin."""

AGREES = 3.0
"""Largest standardised residual of a point or an end that agrees with the surface."""


LEAST_LINES = 3
"""Least number of lines that determine a surface: surfaces of both curvatures fit two lines."""

KNOT_MM = 0.9
"""Spacing of the spline knots, mm."""

JERK, MOST_JERK, JERK_SHARE = 0.03, 0.12, 3.0
"""Expected third derivatives of the surface, mm⁻²: least and most, and as a multiple of height over
half width cubed, since small steep pools have larger ones. With 0.005 the lines fit equally well,
but the height of hollow pools is 3 % too large, more than its ±."""

WIDTH_ERROR = 0.03, 0.1
"""Relative standard uncertainty of the width of hollow and of convex pools that the covariance does
not include: it is linearised and takes third derivatives for independent at each point, while those
of a pool are alike all over it. In simulations of caps, cosines, plateaus, ripples and lopsided
pools the widths of convex ones were 12 % too large (median), those of hollow ones 2 %."""

SETTLED = 0.02
"""The iteration stops if a step reduces the cost by less, and was expected to."""

LEAST_MARGIN, NUMBERS_MARGIN = 6.0, 0.5
"""Least difference of the cost of another sign, height or numbering from the best; for another
numbering, plus this share of the best: it may fit worse only as a line is found worse. Another
numbering within this difference must give the same height."""

MOST_RELATIVE_SIGMA, MOST_MISFIT = 0.1, 0.35
"""Largest relative standard uncertainty of a height that is determined, and largest χ² over its
degrees of freedom of a surface that fits."""


@dataclass(frozen=True)
class _Hypothesis:
    """A numbering and its best-fitting quadric."""

    numbers: FloatArray
    model: LineModel
    coefficients: FloatArray
    cost: float


@dataclass(frozen=True)
class _Refined:
    """A spline surface refined from a quadric, and its cost.

    ``smooth``: it bends no more than expected, so that its uncertainties hold.
    """

    surface: LineSurface
    cost: float
    smooth: bool
    start: _Hypothesis


def fit_lines(data: LineData, numberings: list[FloatArray], rig: LineRig) -> LineSurface:
    """Fit the surface that reflects the lines of a frame.

    Parameters
    ----------
    data
        Points and ends of the lines, on the imaging plane.
    numberings
        Possible numbers of the lines, from the lowest up, each shape (k,). If several agree with
        the lines and give the same height, the surface is that of the best, see
        `LineSurface.renumbered`.

    Raises
    ------
    CannotMeasure
        ``too-few-lines`` with fewer than two lines.
    """
    if data.line.max(initial=-1) < 1:
        raise CannotMeasure("too-few-lines", "one line alone does not settle a surface")
    tried = sorted(
        (_best_quadric(data, numbers, rig) for numbers in numberings),
        key=lambda one: one.cost,
    )
    near, others, all_near = _near(tried)
    refined, jerk = _all_refined(near, data, JERK), JERK
    if not refined[0].smooth:
        jerk = _jerk_of(refined[0].surface)
        refined = _all_refined(near, data, jerk)
    best = refined[0]
    others += [one.cost - best.cost for one in refined[1:] if _differ(one.surface, best.surface)]
    margin = min(others, default=np.inf)
    least = LEAST_MARGIN + NUMBERS_MARGIN * best.cost
    rivals = [one for one in refined[1:] if one.cost - best.cost < least]
    determined = _is_determined(best, margin, rivals) and (all_near or not rivals)
    if determined:
        best, *rivals = (_of_widths(one, data, jerk) for one in (best, *rivals))
        determined = _is_determined(best, margin, rivals)
        best = _of_numbers(best, rivals)
    determined = determined and _is_sure(best.surface)
    return replace(best.surface, margin=margin, status="ok" if determined else "profile")


def _near(tried: list[_Hypothesis]) -> tuple[list[_Hypothesis], list[float], bool]:
    """Quadrics to refine, of both orders of the lines, and additional costs of the others.

    Also whether these are no more than those that cost too much.
    """
    limit = NEAR_COST * tried[0].cost + NEAR_COST_MORE
    near, others, are_all = list[_Hypothesis](), list[float](), True
    left = {True: MOST_REFINED, False: MOST_REFINED}
    for one in tried:
        upwards = bool(one.numbers[-1] > one.numbers[0])
        if one.cost < limit and left[upwards]:
            left[upwards] -= 1
            near.append(one)
        else:
            others.append(one.cost - tried[0].cost)
            are_all &= one.cost >= limit
    return near, others, are_all


def _all_refined(near: list[_Hypothesis], data: LineData, jerk: float) -> list[_Refined]:
    return sorted((_refined(one, data, jerk) for one in near), key=lambda one: one.cost)


def _jerk_of(surface: LineSurface) -> float:
    """Third derivatives expected of a pool of this height and width, mm⁻²."""
    half = surface.width_mm / 2
    return float(np.clip(JERK_SHARE * abs(surface.height_mm) / half**3, JERK, MOST_JERK))


def _is_determined(best: _Refined, margin: float, rivals: list[_Refined]) -> bool:
    """Whether the lines determine the surface; ``rivals`` have other numbers and fit as well."""
    surface = best.surface
    fits = surface.misfit <= MOST_MISFIT and best.smooth
    enough = len(np.unique(surface.numbers)) >= LEAST_LINES
    alike = not any(_differ(one.surface, surface) for one in rivals)
    return enough and fits and alike and margin >= LEAST_MARGIN and _is_sure(surface)


def _is_sure(surface: LineSurface) -> bool:
    """Whether the height is known and agrees with the curvature."""
    limit = MOST_RELATIVE_SIGMA * abs(surface.height_mm)
    return surface.bulges and surface.height_sigma_mm <= limit


def _of_widths(found: _Refined, data: LineData, jerk: float) -> _Refined:
    """Fit narrower and wider pools, too: return the best, with the others in its uncertainties."""
    again = [found, *(_refined(found.start, data, jerk, stretch) for stretch in STRETCHES)]
    best = min(again, key=lambda one: one.cost)
    surface = best.surface
    alike = [one.surface for one in again if one.cost - best.cost < ALIKE_COST]
    away = np.stack([one.surface.coefficients - surface.surface.coefficients for one in alike])
    wider = np.array([one.width_mm - surface.width_mm for one in alike])
    share = 1 / len(STRETCHES)
    surface = replace(
        surface,
        covariance=surface.covariance + share * away.T @ away,
        width_sigma_mm=float(np.sqrt(surface.width_sigma_mm**2 + share * wider @ wider)),
    )
    return replace(best, surface=surface)


def _of_numbers(found: _Refined, rivals: list[_Refined]) -> _Refined:
    """Include the surfaces of other numbers of the lines in the uncertainties."""
    if not rivals:
        return found
    surface = found.surface
    own = surface.surface
    away = []
    for one in rivals:
        model = replace(one.start.model, basis=one.surface.surface.basis)
        moved = _in_basis(own.basis, model, one.surface.surface.coefficients)
        away.append(moved - own.coefficients)
    higher = np.array([one.surface.height_mm - surface.height_mm for one in rivals])
    wider = np.array([one.surface.width_mm - surface.width_mm for one in rivals])
    surface = replace(
        surface,
        renumbered=np.stack(away),
        renumbered_height_mm=float(np.sqrt(np.mean(higher**2))),
        width_sigma_mm=float(np.hypot(surface.width_sigma_mm, np.sqrt(np.mean(wider**2)))),
    )
    return replace(found, surface=surface)


def _differ(one: LineSurface, other: LineSurface) -> bool:
    """Whether two surfaces are different solutions."""
    apart = abs(one.height_mm - other.height_mm)
    share, sigmas = ALIKE_HEIGHT
    return apart > share * abs(other.height_mm) + sigmas * other.height_sigma_mm


# --- quadrics -------------------------------------------------------------------------------------


def _spline_coefficients(
    basis: SplineBasis, values: Callable[[FloatArray, FloatArray], FloatArray]
) -> FloatArray:
    """Spline coefficients, shape (p, …), of functions of x and y with values (n, …)."""
    x, y = (np.linspace(*ends, 20) for ends in zip(basis.low_mm, basis.high_mm, strict=True))
    x, y = (each.ravel() for each in np.meshgrid(x, y))
    rows, rough = basis.matrix(x, y), _dense(basis.roughness_matrix)
    found = np.linalg.solve(rows.T @ rows + 1e-9 * rough, rows.T @ values(x, y))
    return np.asarray(found, np.float64)


def _best_quadric(data: LineData, numbers: FloatArray, rig: LineRig) -> _Hypothesis:
    """Fit the best quadric to the lines for a numbering."""
    half = rig.pattern.half_fan
    corner = line_directions(
        rig.laser,
        rig.pattern,
        np.array([0.0, rig.pattern.count + 1.0])[:, None],
        np.array([-half, half]),
    )
    ground = intersect_level(rig.laser.position_mm, corner).reshape(-1, 3)[:, :2]
    basis = SplineBasis.over(ground.min(axis=0), ground.max(axis=0), KNOT_MM)
    model = LineModel(rig, basis, np.asarray(numbers, float), 41)
    into = _spline_coefficients(basis, quadric_terms)  # exact
    softer = replace(
        data,
        sigma_mm=np.hypot(data.sigma_mm, QUADRIC_SIGMA_MM),
        end_sigma_mm=np.hypot(data.end_sigma_mm, 0.3),
    )
    y = ground[:, 1].mean()
    # Numbers increase upwards in the picture for a flat or convex pool.
    sign = 1.0 if model.numbers[-1] > model.numbers[0] else -1.0
    starts = []
    for radius in RADII_MM:
        height = min(HALF_WIDTH_MM**2 / (2 * radius), 0.6)
        bend = -0.5 / radius
        starts.append(sign * np.array([height + bend * y * y, 0.0, -2 * bend * y, bend, 0.0, bend]))
    order = np.argsort([_cost(model, into @ start, softer) for start in starts])
    quadric, cost = _fit_quadric(model, into, starts[order[0]], softer)
    if cost > POOR_COST * len(data.line):
        quadric, cost = min(
            ((quadric, cost), _fit_quadric(model, into, starts[order[1]], softer)),
            key=lambda one: one[1],
        )
    return _Hypothesis(model.numbers, model, into @ quadric, cost)


def _cost(model: LineModel, coefficients: FloatArray, data: LineData) -> float:
    residual = model.residuals(coefficients, data).residual
    return float(np.sum(_robust(residual)))


def _robust(residual: FloatArray) -> FloatArray:
    """Huber loss of residuals: quadratic up to 3, linear beyond."""
    return np.asarray(2.0 * scipy.special.huber(3.0, residual))


def _weights(residual: FloatArray) -> FloatArray:
    return np.minimum(1.0, 3.0 / np.maximum(np.abs(residual), 1e-9))


def _fit_quadric(
    model: LineModel, into: FloatArray, start: FloatArray, data: LineData
) -> tuple[FloatArray, float]:
    """Fit the six coefficients of a quadric by the Levenberg–Marquardt method."""
    scale = np.array([0.3, 0.1, 0.1, 0.05, 0.05, 0.05])
    quadric, damping = start, 1e-2
    linear = model.residuals(into @ quadric, data)
    cost = float(np.sum(_robust(linear.residual)))
    for _ in range(QUADRIC_ROUNDS):
        weights = _weights(linear.residual)
        jacobian = linear.jacobian @ into * scale
        normal = (jacobian * weights[:, None]).T @ jacobian + np.eye(6)  # prior with σ = scale
        right = jacobian.T @ (weights * linear.residual) - quadric / scale
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
        tried = quadric + scale * np.clip(step, -2.0, 2.0)
        there = model.residuals(into @ tried, data)
        new = float(np.sum(_robust(there.residual)))
        if new < cost:
            done = cost - new < 1e-3 * cost
            quadric, linear, cost, damping = tried, there, new, damping / 5
            if done:
                break
        else:
            damping *= 8
            if damping > 1e4:
                break
    return quadric, cost


# --- splines --------------------------------------------------------------------------------------


def _dense(band: FloatArray) -> FloatArray:
    """A symmetric matrix from its lower band, shape (width + 1, p)."""
    count = band.shape[1]
    dense = np.zeros((count, count))
    for k, row in enumerate(band):
        dense[np.arange(k, count), np.arange(count - k)] = row[: count - k]
    return dense + np.tril(dense, -1).T


def _in_basis(
    basis: SplineBasis, model: LineModel, coefficients: FloatArray, stretch: float = 1.0
) -> FloatArray:
    """Coefficients in another basis of a model's surface, stretched along X about its middle."""
    middle = (basis.low_mm[0] + basis.high_mm[0]) / 2

    def height(x: FloatArray, y: FloatArray) -> FloatArray:
        place = np.stack([middle + (x - middle) / stretch, y, np.zeros_like(x)], axis=-1)
        return model.surface_at(coefficients, place)[0]

    return _spline_coefficients(basis, height)


def _refined(start: _Hypothesis, data: LineData, jerk: float, stretch: float = 1.0) -> _Refined:
    """Refine a quadric, stretched along X, as a smooth spline surface."""
    points = start.model.residuals(start.coefficients, data).point_mm[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2 * np.array([max(STRETCHES), 1.0])
    low, high = middle - half - MARGIN_MM, middle + half + MARGIN_MM
    basis = SplineBasis.over(low, high, KNOT_MM)
    model = replace(start.model, basis=basis, rays=81)
    first = _in_basis(basis, start.model, start.coefficients, stretch)
    stiffness = _dense(basis.roughness_matrix) / (jerk**2 * CORRELATED_MM2)
    coefficients, covariance, linear = _fit_splines(model, first, data, stiffness)
    agrees = np.abs(linear.residual) <= AGREES
    agrees = agrees if agrees.sum() > 3 else np.ones_like(agrees)
    point, aside = linear.point_mm[agrees], linear.aside[agrees]
    ends = aside[[np.argmin(point[:, 0]), np.argmax(point[:, 0])]]
    wider = ends[1] - ends[0]
    misfit, bends = _misfit(linear), float(coefficients @ stiffness @ coefficients)
    # On average c·S·c of the prior equals the number of parameters that the data determine.
    settled = len(coefficients) - float(np.sum(stiffness * covariance))
    convex = bool(np.median(point[:, 2]) > 0)
    error = WIDTH_ERROR[convex] * float(np.ptp(point[:, 0]))
    covariance = _with_width_error(covariance, ends, error)
    surface = LineSurface(
        SplineSurface(basis, coefficients),
        covariance,
        np.rint(start.numbers).astype(np.int64),
        point,
        misfit / max(len(linear.residual) - 8, 1),
        np.inf,
        "profile",
        float(np.sqrt(wider @ covariance @ wider)),
    )
    return _Refined(surface, misfit + bends, bends <= settled, start)


def _with_width_error(covariance: FloatArray, ends: FloatArray, error_mm: float) -> FloatArray:
    """Add an error of the width, half of its variance at each end, to a covariance, shape (p, p).

    The coefficients change with the places of the ends as those of the best surface for each place
    do: by the regression C·Eᵀ(E·C·Eᵀ)⁻¹ for the derivatives E of the places, ``ends``, (2, p).
    """
    along = covariance @ ends.T
    change = error_mm / np.sqrt(2) * np.linalg.solve(ends @ along, along.T)
    return np.asarray(covariance + change.T @ change)


def _misfit(linear: Linearized) -> float:
    """χ² of points and ends."""
    return float(np.sum(_cauchy(linear.residual)))


def _cauchy(residual: FloatArray) -> FloatArray:
    """Cauchy loss of residuals: outliers, such as an end in a gap, have little influence."""
    return np.asarray(AGREES**2 * np.log1p((residual / AGREES) ** 2))


def _fit_splines(
    model: LineModel, first: FloatArray, data: LineData, stiffness: FloatArray
) -> tuple[FloatArray, FloatArray, Linearized]:
    """Return the coefficients, their covariance and the linearised equations.

    Levenberg–Marquardt method; its damping follows from the ratio of the decrease of the cost to
    the expected one (H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05).
    """
    c, damping, growth = first, 1e-6, 2.0
    linear = model.residuals(c, data)
    cost = _misfit(linear) + float(c @ stiffness @ c)
    for _ in range(SPLINE_ROUNDS):
        gram, right = _normal_equations(linear)
        normal, right = gram + stiffness, right - stiffness @ c
        lift = damping * np.trace(gram) / len(c) * np.eye(len(c))
        step = scipy.linalg.solve(normal + lift, right, assume_a="pos")
        expected = float(2 * right @ step - step @ normal @ step)
        there = model.residuals(c + step, data)
        new = _misfit(there) + float((c + step) @ stiffness @ (c + step))
        gain = cost - new
        if gain > 0:
            c, linear, cost = c + step, there, new
            damping, growth = damping * max(1 / 3, 1 - (2 * gain / expected - 1) ** 3), 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        if max(gain, expected) < SETTLED:
            break
    gram = _normal_equations(linear)[0]
    factor = np.linalg.cholesky(gram + stiffness + 1e-9 * np.eye(len(c)))
    inverse = np.linalg.inv(factor)
    return c, inverse.T @ inverse, linear


def _normal_equations(linear: Linearized) -> tuple[FloatArray, FloatArray]:
    """Matrix and right side of the weighted equations, shape (p, p) and (p,)."""
    weighted = linear.jacobian * (1 / (1 + (linear.residual / AGREES) ** 2))[:, None]
    return weighted.T @ linear.jacobian, weighted.T @ linear.residual
