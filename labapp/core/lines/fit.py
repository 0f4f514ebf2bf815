"""Fit of a pool surface to reflected lines, which the dissertation does not reconstruct (§3.2.2).

A point of a line gives one equation, its perpendicular distance from the predicted curve; an end of
a line lies on the boundary, z = 0. The lines are identified by their order only. Surfaces of both
curvatures are therefore fitted, first as quadrics, with each possible numbering. The best of them
are refined as splines with a smoothness prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from labapp.core.geometry.line_pattern import LineRig, line_directions
from labapp.core.geometry.optics import intersect_level
from labapp.core.lines.model import Linearized, LineData, LineModel
from labapp.core.surface.pool_fit import CORRELATED_MM2
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

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

QUADRIC_ROUNDS, SPLINE_ROUNDS = 20, 20
MARGIN_MM = 0.8

STRETCHES, ALIKE_COST = (0.7, 1.25), 12.0
"""Factors by which the quadric is made narrower and wider for two more fits, and largest additional
cost of a surface that counts. Pools of different widths reflect nearly the same lines, as the
position along the fan is unknown: the iterations end near where they begin."""

AGREES = 3.0
"""Largest standardised residual of a point or an end that agrees with the surface."""


LEAST_LINES = 3
"""Least number of lines that determine a surface: surfaces of both curvatures fit two lines."""

KNOT_MM = 0.9
"""Spacing of the spline knots, mm."""

JERK = 0.03
"""Expected third derivatives of the surface, mm⁻². With 0.005 the lines fit equally well, but the
height of hollow pools is 3 % too large, more than its ±."""

SETTLED = 0.05
"""The iteration stops if a step reduces the cost by less."""

LEAST_MARGIN, NUMBERS_MARGIN = 6.0, 0.5
"""Least difference of the cost of another sign, height or numbering from the best; for another
numbering, plus this share of the best: it may fit worse only as a line is found worse."""

MOST_RELATIVE_SIGMA, MOST_MISFIT = 0.1, 0.35
"""Largest relative standard uncertainty of a height that is determined, and largest χ² over its
degrees of freedom of a surface that fits."""


@dataclass(frozen=True)
class LineSurface(ReadOnlyArrays):
    """A surface fitted to the reflected lines, and its uncertainty.

    Parameters
    ----------
    surface
        The surface, z = 0 at the boundary.
    covariance
        Covariance of its coefficients, shape (p, p), mm². It includes the differences from the
        surfaces of other widths that agree as well with the lines.
    numbers
        Number of each line in the pattern, from the lowest in the picture up, shape (k,).
    point_mm
        Points of the surface met by the rays of the points and ends that agree with it, shape
        (n, 3), mm.
    misfit
        χ² of points and ends over its degrees of freedom.
    margin
        Additional cost of the next best sign or height; infinite if there is none.
    status
        ``ok``, or ``profile`` if the lines do not fully determine the surface: its heights are then
        not a measurement, although slopes along the lines may be.
    width_sigma_mm
        Standard uncertainty of `width_mm`, mm.
    """

    surface: SplineSurface
    covariance: FloatArray
    numbers: IntArray
    point_mm: FloatArray
    misfit: float
    margin: float
    status: str
    width_sigma_mm: float = float("nan")

    @cached_property
    def peak_mm(self) -> FloatArray:
        """(x, y, z) of the highest point under the lines, or of the lowest of a hollow, mm."""
        low, high = self.point_mm[:, :2].min(axis=0), self.point_mm[:, :2].max(axis=0)
        x, y = (np.linspace(*ends, 81) for ends in zip(low, high, strict=True))
        x, y = (each.ravel() for each in np.meshgrid(x, y))
        z = self.surface.height(x, y)
        best = int(np.argmax(np.nan_to_num(np.abs(z))))
        return np.array([x[best], y[best], z[best]])

    @property
    def height_mm(self) -> float:
        """Height of the highest point, or negative depth of the lowest one, mm."""
        return float(self.peak_mm[2])

    @cached_property
    def height_sigma_mm(self) -> float:
        """Standard uncertainty of `height_mm`, mm."""
        return float(self.sigma_mm(*self.peak_mm[:2, None])[0])

    def sigma_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Standard uncertainty of the height at points, each shape (n,), mm."""
        rows = self.surface.basis.matrix(x_mm, y_mm)
        return np.asarray(np.sqrt(np.maximum(np.vecdot(rows @ self.covariance, rows), 0.0)))

    @property
    def bulges(self) -> bool:
        """Whether height and curvature agree: convex above the work piece, concave below it."""
        return self.height_mm * self.curvature_per_mm > 0

    @property
    def width_mm(self) -> float:
        """Width of the pool along X, between the ends of the lines, mm."""
        return float(np.ptp(self.point_mm[:, 0]))

    @property
    def curvature_per_mm(self) -> float:
        """Mean curvature of the least-squares quadric of the surface, 1/mm; positive if convex."""
        return float(self._curvature @ self.surface.coefficients)

    @property
    def curvature_sigma_per_mm(self) -> float:
        """Standard uncertainty of `curvature_per_mm`, 1/mm."""
        return float(np.sqrt(self._curvature @ self.covariance @ self._curvature))

    @cached_property
    def _curvature(self) -> FloatArray:
        """Derivatives of the mean curvature w.r.t. the coefficients, shape (p,), mm⁻²."""
        x, y = self.point_mm[:, :2].T
        known = np.isfinite(self.surface.height(x, y))  # a ray may leave the splines' domain
        x, y = x[known], y[known]
        quadric = np.linalg.pinv(_monomials(x - x.mean(), y - y.mean()))
        return np.asarray(-(quadric[3] + quadric[5]) @ self.surface.basis.matrix(x, y))


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
        Possible numbers of the lines, from the lowest up, each shape (k,).

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
    near, others = _near(tried)
    refined = sorted((_refined(one, data) for one in near), key=lambda one: one.cost)
    best = refined[0]
    others += [one.cost - best.cost for one in refined[1:] if _differ(one.surface, best.surface)]
    margin = min(others, default=np.inf)
    least = LEAST_MARGIN + NUMBERS_MARGIN * best.cost
    numbered = all(one.cost - best.cost >= least for one in refined[1:])
    if numbered and _is_determined(best, margin):
        best = _of_widths(best, data)
    status = "ok" if numbered and _is_determined(best, margin) else "profile"
    return replace(best.surface, margin=margin, status=status)


def _near(tried: list[_Hypothesis]) -> tuple[list[_Hypothesis], list[float]]:
    """Quadrics to refine, of both orders of the lines, and the additional costs of the others."""
    limit = NEAR_COST * tried[0].cost + NEAR_COST_MORE
    near, others = list[_Hypothesis](), list[float]()
    left = {True: MOST_REFINED, False: MOST_REFINED}
    for one in tried:
        upwards = bool(one.numbers[-1] > one.numbers[0])
        if one.cost < limit and left[upwards]:
            left[upwards] -= 1
            near.append(one)
        else:
            others.append(one.cost - tried[0].cost)
    return near, others


def _is_determined(one: _Refined, margin: float) -> bool:
    """Whether the lines determine the surface: see the statuses of `LineSurface`."""
    surface = one.surface
    sure = surface.height_sigma_mm <= MOST_RELATIVE_SIGMA * abs(surface.height_mm)
    fits = surface.misfit <= MOST_MISFIT and one.smooth
    enough = len(np.unique(surface.numbers)) >= LEAST_LINES
    return enough and sure and fits and surface.bulges and margin >= LEAST_MARGIN


def _of_widths(found: _Refined, data: LineData) -> _Refined:
    """Fit narrower and wider pools, too: return the best, with the others in its uncertainties."""
    again = [found, *(_refined(found.start, data, stretch) for stretch in STRETCHES)]
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


def _differ(one: LineSurface, other: LineSurface) -> bool:
    """Whether two surfaces are different solutions."""
    apart = abs(one.height_mm - other.height_mm)
    return apart > 0.05 * abs(other.height_mm) + 2 * other.height_sigma_mm


# --- quadrics -------------------------------------------------------------------------------------


def _monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _quadric_basis(basis: SplineBasis) -> FloatArray:
    """Spline coefficients of 1, x, y, x², xy, y², shape (p, 6); the representation is exact."""
    x, y = (
        np.linspace(low, high, 12) for low, high in zip(basis.low_mm, basis.high_mm, strict=True)
    )
    x, y = (each.ravel() for each in np.meshgrid(x, y))
    rough = _dense(basis.roughness_matrix)
    rows = basis.matrix(x, y)
    return np.asarray(
        np.linalg.solve(rows.T @ rows + 1e-9 * rough, rows.T @ _monomials(x, y)), np.float64
    )


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
    into = _quadric_basis(basis)
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


def _refined(start: _Hypothesis, data: LineData, stretch: float = 1.0) -> _Refined:
    """Refine a quadric, stretched along X, as a smooth spline surface."""
    points = start.model.residuals(start.coefficients, data).point_mm[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2 * np.array([max(STRETCHES), 1.0])
    low, high = middle - half - MARGIN_MM, middle + half + MARGIN_MM
    basis = SplineBasis.over(low, high, KNOT_MM)
    model = replace(start.model, basis=basis, rays=81)
    x, y = (np.linspace(a, b, 20) for a, b in zip(low, high, strict=True))
    x, y = (each.ravel() for each in np.meshgrid(x, y))
    rows = basis.matrix(x, y)
    place = np.stack([middle[0] + (x - middle[0]) / stretch, y, np.zeros_like(x)], axis=-1)
    height, _ = start.model.surface_at(start.coefficients, place)
    rough = _dense(basis.roughness_matrix)
    first: FloatArray = np.asarray(
        np.linalg.solve(rows.T @ rows + 1e-9 * rough, rows.T @ height), np.float64
    )
    stiffness = rough / (JERK**2 * CORRELATED_MM2)
    coefficients, covariance, cost, linear = _fit_splines(model, first, data, stiffness)
    agrees = np.abs(linear.residual) <= AGREES
    agrees = agrees if agrees.sum() > 3 else np.ones_like(agrees)
    point, aside = linear.point_mm[agrees], linear.aside[agrees]
    wider = aside[np.argmax(point[:, 0])] - aside[np.argmin(point[:, 0])]
    surface = LineSurface(
        SplineSurface(basis, coefficients),
        covariance,
        np.rint(start.numbers).astype(np.int64),
        point,
        float(np.sum(_cauchy(linear.residual))) / max(len(linear.residual) - 8, 1),
        np.inf,
        "profile",
        float(np.sqrt(wider @ covariance @ wider)),
    )
    # On average c·S·c of the prior equals the number of parameters that the data determine.
    bends = float(coefficients @ stiffness @ coefficients)
    settled = len(coefficients) - float(np.sum(stiffness * covariance))
    return _Refined(surface, cost, bends <= settled, start)


def _cauchy(residual: FloatArray) -> FloatArray:
    """Cauchy loss of residuals: outliers, such as an end in a gap, have little influence."""
    return np.asarray(AGREES**2 * np.log1p((residual / AGREES) ** 2))


def _fit_splines(
    model: LineModel, first: FloatArray, data: LineData, stiffness: FloatArray
) -> tuple[FloatArray, FloatArray, float, Linearized]:
    """Return the coefficients, their covariance, the cost and the linearised equations."""
    c, damping = first, 1e-3
    linear = model.residuals(c, data)
    cost = float(np.sum(_cauchy(linear.residual)) + c @ stiffness @ c)
    for _ in range(SPLINE_ROUNDS):
        weights = 1 / (1 + (linear.residual / AGREES) ** 2)
        gram = (linear.jacobian * weights[:, None]).T @ linear.jacobian
        normal = gram + stiffness
        right = linear.jacobian.T @ (weights * linear.residual) - stiffness @ c
        lift = damping * np.trace(gram) / len(c) * np.eye(len(c)) * 1e-3
        step = scipy.linalg.solve(normal + lift, right, assume_a="pos")
        there = model.residuals(c + step, data)
        new = float(np.sum(_cauchy(there.residual)) + (c + step) @ stiffness @ (c + step))
        if new < cost:
            done = cost - new < SETTLED
            c, linear, cost, damping = c + step, there, new, damping / 10
            if done:
                break
        else:
            damping *= 30
            if damping > 1e8:
                break
    weights = 1 / (1 + (linear.residual / AGREES) ** 2)
    gram = (linear.jacobian * weights[:, None]).T @ linear.jacobian
    factor = np.linalg.cholesky(gram + stiffness + 1e-9 * np.eye(len(c)))
    inverse = np.linalg.inv(factor)
    covariance = inverse.T @ inverse
    return c, covariance, cost, linear
