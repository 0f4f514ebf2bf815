"""One smooth surface under all reflections at once: the engine of matching and of the fit.

Round by round from z = 0, every matched ray is met with the surface, the bisector of the incoming
ray and the direction to its dot gives two slopes there (Eq. 4-3), and the smooth surface that best
has all these slopes replaces the last. Slopes leave the level open. It comes from which rays came
back and which did not: a lit ray landed inside the contour z = 0, a dark one outside.

Slopes are weighted by what the dots' places are uncertain by on the imaging plane, so that it is
the reflection residual there whose squares are least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labapp.core.geometry.optics import meet_level, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.surface.solver import NormalEquations, sigma_of
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze, median

REACH = 2.5
"""How far beyond the outermost dots the surface goes on, in rows of rays: the torch may hide some
before the boundary is reached."""


CORRELATED_MM2 = 1.0
"""Area over which a pool's third derivatives go together, mm²."""


@dataclass(frozen=True)
class FitSettings:
    """How the fit decides.

    Parameters
    ----------
    rounds
        Most rounds of meeting rays, taking slopes and fitting.
    knot_mm
        Spacing of the spline knots, mm.
    jerk
        Third derivatives of the surface that are to be expected, mm⁻².
    floor_mm
        Least uncertainty of a dot on the imaging plane, mm.
    settled_mm
        The rounds end when no reflection point moves by more.
    """

    rounds: int = 12
    knot_mm: float = 0.7
    jerk: float = 0.05
    floor_mm: float = 0.01
    settled_mm: float = 1e-4


@dataclass(frozen=True)
class Rear:
    """How far the boundary lies below the work piece towards the pool's end (§7.2).

    Parameters
    ----------
    drop_mm
        Depth at the end, mm; 0 for a boundary on the work piece all round.
    start_mm, end_mm
        Where the boundary leaves the work piece, and where the pool ends, along Y, mm.
    """

    drop_mm: float = 0.0
    start_mm: float = 0.0
    end_mm: float = -1.0

    @property
    def numbers(self) -> FloatArray:
        """Its three numbers, as compiled functions have it, shape (3,)."""
        return np.array([self.drop_mm, self.start_mm, self.end_mm])

    def height(self, y_mm: FloatArray) -> FloatArray:
        """Height of the boundary at y, of the shape of ``y_mm``, mm."""
        share = np.maximum((self.start_mm - y_mm) / (self.start_mm - self.end_mm), 0.0)
        return -self.drop_mm * share**2


@dataclass(frozen=True)
class Level:
    """Where z = 0 lies on a surface that is known up to its level.

    Parameters
    ----------
    shift_mm
        What to add to the surface's height, mm.
    sigma_mm
        Its standard uncertainty, mm.
    sign
        +1 for a pool that stands above the work piece inside its boundary, −1 for one below.
    rear
        Where the boundary lies below the work piece.
    negative_log_likelihood
        Of the rays near the boundary, being lit or dark: 0 where every lit one lands inside and
        every dark one outside, or where no ray is known to be dark.
    rays, rise_mm
        How many these are; by how much the surface rises there from one ray to the next, mm.
    """

    shift_mm: float
    sigma_mm: float
    sign: int
    rear: Rear
    negative_log_likelihood: float
    rays: int = 0
    rise_mm: float = 0.0

    @property
    def disagreement(self) -> float:
        """Mean surprise of the rays near the boundary, bits; infinite where there are none."""
        return self.negative_log_likelihood / np.log(2) / self.rays if self.rays else np.inf


@dataclass(frozen=True)
class FittedPool:
    """One solution: the surface, where the matched rays meet it, and how well it is known.

    Parameters
    ----------
    surface
        The surface, z = 0 at the boundary.
    factor
        Cholesky factor of the normal matrix (`solver.normal_factor`).
    level
        The level and its uncertainty.
    points_mm
        Reflection points, shape (n, 3), mm.
    residual_mm
        Computed minus captured dot on the imaging plane (X′, Z′), shape (n, 2), mm.
    unsettled_mm
        How far the reflection point that moved most moved in the last round, mm.
    """

    surface: SplineSurface
    factor: FloatArray
    level: Level
    points_mm: FloatArray
    residual_mm: FloatArray
    unsettled_mm: float

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def residual_rms_mm(self) -> float:
        """Root mean square distance of computed from captured dots, mm."""
        return float(np.sqrt(np.mean(np.sum(self.residual_mm**2, axis=-1))))

    @cached_property
    def level_at(self) -> FloatArray:
        """Mean value of each spline over the reflection points, shape (splines,)."""
        from labapp.core.surface import kernels

        share = np.full(len(self.points_mm), 1 / len(self.points_mm))
        grid, count = self.surface.basis.grid, self.factor.shape[1]
        return kernels.gradient_of_sum(grid, count, self.points_mm, share)

    def sigma_of(self, gradients: FloatArray) -> FloatArray:
        """Standard uncertainty of quantities, shape (m,), from their derivatives, shape (m, p)."""
        return sigma_of(self.factor, gradients, self.level_at, self.level.sigma_mm)


def fit_pool(
    ray: IntArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    witness: IntArray,
    rig: Rig,
    settings: FitSettings,
    near: SplineSurface | None = None,
) -> FittedPool:
    """Solve for the surface that turns each ray (i, j), shape (n, 2), to its dot.

    Parameters are those of `Match`, and a surface that is near: fewer rounds are needed then.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no surface can be fitted or it sends rays away from the plane.
    """
    from labapp.core.surface import kernels

    laser, plane = rig.laser.position_mm, rig.imaging_plane.pose_mm
    pattern = ray_directions(rig.laser, rig.pattern)
    ground = meet_level(laser, pattern)
    rays, points = pattern[tuple(ray.T - 1)], ground[tuple(ray.T - 1)]
    spacing = landing_spacing(ground)
    basis = _basis_around(points[:, :2], REACH * spacing.max(), settings.knot_mm)
    grid, covariance = basis.grid, plane_covariance_mm2
    witnesses = (witness != 0) & basis.contains(ground[..., 0], ground[..., 1])
    stiffness = CORRELATED_MM2 / settings.jerk**2 * basis.roughness
    dots = rig.imaging_plane.to_universal(plane_mm)
    weights = kernels.slope_weights(laser, plane[1:3], points, dots, covariance, settings.floor_mm)
    reuse = settings.floor_mm / 50
    equations = NormalEquations(basis, stiffness, laser, dots, weights, reuse_mm=reuse)
    out = np.linalg.norm(points[:, :2] - points[:, :2].mean(axis=0), axis=-1)
    rim = out > median(out)
    coefficients, moved = np.zeros(basis.count), np.inf
    if near is not None:
        points, _ = kernels.advance(near.basis.grid, near.coefficients, rays, points, 4)
    level = Level(0.0, np.inf, 1, Rear(), 0.0)
    for count in range(settings.rounds):
        coefficients = equations.improve(coefficients, points, moved)
        if not (witness[witnesses] < 0).any():
            level = _rim_level(kernels.surface_at(grid, coefficients, points)[0], rim)
        else:
            # Whether the rear sinks is settled half-way, or the rounds might go to and fro.
            drop = None if 2 * count <= settings.rounds else level.rear.drop_mm
            height, *slope = kernels.surface_at(grid, coefficients, ground[witnesses])
            about = (0.0, level.sign) if count else None
            before = level
            at = np.array(slope).T, ground[witnesses, 1], witness[witnesses], spacing
            level = place_level(height, *at, drop, about, NEARER if count else 1.0)
            if drop is not None:  # how far the rear leaves the level open stays as it was
                level = replace(level, sigma_mm=max(level.sigma_mm, before.sigma_mm))
        coefficients += level.shift_mm  # the splines add up to 1
        if not np.isfinite(coefficients).all():
            raise CannotMeasure("no-surface", "no surface has the slopes that the dots ask for")
        met, _ = kernels.advance(grid, coefficients, rays, points, 4)
        moved, points = float(np.max(np.abs(met - points))), met
        if moved < settings.settled_mm:
            break
    points, _, made = kernels.meet(grid, coefficients, rays, points, 1, plane)
    residual = made - plane_mm
    if not np.isfinite(residual).all():
        raise CannotMeasure("no-surface", "the fitted surface sends rays away from the plane")
    surface = SplineSurface(basis, coefficients)
    assert equations.factor is not None
    return FittedPool(surface, equations.factor, level, points, residual, moved)


def _basis_around(places_mm: FloatArray, margin_mm: float, knot_mm: float) -> SplineBasis:
    """Splines over places, shape (n, 2), mm, and a margin round them."""
    low, high = places_mm.min(axis=0) - margin_mm, places_mm.max(axis=0) + margin_mm
    return SplineBasis.over(low, high, knot_mm)


def landing_spacing(landing_mm: FloatArray) -> FloatArray:
    """Distance between neighbours of a grid of landing points along X and along Y, (2,), mm."""
    across = np.median(np.diff(landing_mm[..., 0], axis=1))
    along = np.median(np.diff(landing_mm[..., 1], axis=0))
    return np.asarray(np.abs([across, along]), float)


def _rim_level(height: FloatArray, rim: BoolArray) -> Level:
    """Guess the level where nobody says where the pool ends: the outermost points lie at 0."""
    shift = -float(np.mean(height[rim]))
    sign = 1 if height[~rim].mean() + shift > 0 else -1
    return Level(shift, float(np.std(height)), sign, Rear(), 0.0)


NEARER = 0.3
"""Reach of the search for a level (`place_level`) that was found in the round before."""

AT_END, AT_FAR_END = 1e-6, 0.02
"""If so much of the level's probability is at the ends of what was searched, near a level that is
known or farther from it, more is searched."""

# Width of the step from inside to outside, in dot spacings: from a boundary that is known as
# sharply as the surface is to one that half the neighbouring rays contradict.
_BLURS = np.geomspace(1 / 200, 1 / 4, 9)
_BLUR_COST = 1.2 * np.log(_BLURS)
_ROUGH = _BLURS[-1:]

# How deep a rear may lie, mm, and how often one lies below the work piece at all.
_DROPS = np.concatenate([[0.0], np.linspace(0.01, 0.15, 10)])
_SINKS = 0.2
_SUNK = -float(np.log(_SINKS / (1 - _SINKS) / (len(_DROPS) - 1)))


def find_level(
    surface: SplineSurface,
    landing_mm: FloatArray,
    witness: IntArray,
    spacing_mm: FloatArray,
    drop_mm: float | None = None,
) -> Level:
    """Place z = 0 so that lit rays land inside the contour and dark ones outside.

    A ray that lands a distance d inside the contour came back with probability
    1/(1 + exp(−d/s)). The blur s is found along with the level: both are weighed on a grid, and
    the level's mean and spread are taken over it.

    Parameters
    ----------
    surface
        Known up to its level.
    landing_mm
        Where the witnesses would land on z = 0, shape (m, 2), mm.
    witness
        +1 lit, −1 dark, shape (m,).
    spacing_mm
        Distance between neighbouring landing points along X and along Y, mm.
    drop_mm
        How deep the rear lies, mm; None: found along with the level.
    """
    height, slope = surface.height_and_gradient(*landing_mm.T)
    return place_level(height, slope, landing_mm[:, 1], witness, spacing_mm, drop_mm)


def place_level(
    height: FloatArray,
    slope: FloatArray,
    y: FloatArray,
    witness: IntArray,
    spacing_mm: FloatArray,
    drop_mm: float | None = None,
    about: tuple[float, int] | None = None,
    reach: float = 1.0,
) -> Level:
    """Do what `find_level` does, with the surface known where the witnesses would land.

    Parameters
    ----------
    height, slope, y
        Of the surface there, up to its level, shape (m,), mm, and (m, 2); and the place along Y.
    witness, spacing_mm, drop_mm
        See `find_level`.
    about
        A level that is near, as its shift, mm, and its sign; None: it is looked for.
    reach
        How far from there the level may be, in heights by which the surface changes from one ray
        to the next. If it is found at the end of that, it is looked for farther off.
    """
    from labapp.core.surface import level_kernels

    # Height by which the surface changes from one ray to the next, straight across the contour.
    rise = np.linalg.norm(slope * spacing_mm, axis=-1) + 1e-6
    usual = median(rise)
    rise = np.maximum(rise, usual / 4)
    shift, sign = about or _rough_level(height, rise, witness)
    near = np.abs(height + shift) < 3.0 * rise
    count = round(120 * reach) + 1
    first, step = shift - reach * usual, 2 * reach * usual / (count - 1)
    lit = y[witness > 0]
    start = (lit.max() + lit.min()) / 2
    end = min(lit.min(), start - 1e-6)  # a single row has no rear
    # Only a pool that stands above the work piece is seen to sink at its rear.
    seen = sign > 0 and bool(np.any(near & (witness < 0) & (y < end)))
    drops = (_DROPS if seen else _DROPS[:1]) if drop_mm is None else np.array([drop_mm])
    over = height[near] - drops[:, None] * Rear(1.0, start, end).height(y[near])
    side = sign * witness[near] / rise[near]
    nats = level_kernels.level_negative_log_likelihood(over, side, first, step, count, _BLURS)
    asked = _BLUR_COST, _SUNK, drops, first, step
    drop, mean, sigma, off_window = level_kernels.weigh(nats, *asked)
    if about is not None and off_window > (AT_END if reach < 1.0 else AT_FAR_END):
        farther = about if reach < 1.0 else None
        return place_level(height, slope, y, witness, spacing_mm, drop_mm, farther)
    least, rays = float(nats.min()), int(near.sum())
    return Level(mean, sigma, sign, Rear(drop, start, end), least, rays, usual)


def _rough_level(height: FloatArray, rise: FloatArray, witness: IntArray) -> tuple[float, int]:
    """Shift, mm, and sign that the witnesses contradict least."""
    from labapp.core.surface import level_kernels

    scan, side = np.linspace((-height).min(), (-height).max(), 300), witness / rise
    asked = scan[0], scan[1] - scan[0], len(scan), _ROUGH
    above, below = (
        level_kernels.level_negative_log_likelihood(height[None], k * side, *asked)[0, 0]
        for k in (1, -1)
    )
    if above.min() <= below.min():
        return float(scan[np.argmin(above)]), 1
    return float(scan[np.argmin(below)]), -1
