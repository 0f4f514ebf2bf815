"""Scheme fit, the default: surface, boundary and their uncertainty (`pool_fit`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes import LEAST_DOTS
from labapp.core.surface import measures
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.boundary_trace import retrace_boundary, trace_boundary
from labapp.core.surface.level import BOUNDARY_UNSEEN, boundary_is_seen
from labapp.core.surface.pool_fit import FitSettings, FittedPool, fit_pool
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.setup_uncertainty import setup_changes, setup_sigma
from labapp.core.surface.shape import shape_and_gradients
from labapp.core.surface.sizes import sizes_and_gradients
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays

UNSETTLED_MM = 0.02
"""The fit has not converged if a reflection point still moves by this in the last round."""

CHANGED = 0.1
"""The set-up's part of the uncertainty is recomputed if a size differs by more than this share from
those for which it was computed."""

SETUP_EVERY, MOST_AVERAGED = 16, 8
"""It is computed again after so many frames for each frame over which it is averaged, and the
largest number of these. It depends on few rays, in steps, and varies by a third from frame to
frame."""


MOST_ROUGH = 1.0
"""A surface with a larger `FittedPool.roughness_ratio` bends more than is expected, as at a steep
rim or a toe: it is fitted again, with larger third derivatives expected. Of 144 other pools, some
with dips, 3 exceed it."""

MOST_MISFIT = 3.0
"""The set-up may be wrong if χ² per residual exceeds this multiple of that ratio, and no smooth
surface explains the dots: a rougher one would pass through them all, and hide it. Steep rims have
0.3 to 1.9; a plane rolled by 3.5° or pitched by 8°, 6 and 11."""

ROUGHER, MOST_JERK, FINE_KNOT_MM = 20.0, 2.0, 0.4
"""Square of those derivatives over that of the first surface, which is smoothed: steep rims bend
most where the dots are farthest apart; their maximum, mm⁻²; and the spacing of the knots, mm."""


@dataclass(frozen=True)
class SetupPart(ReadOnlyArrays):
    """The set-up's part of the uncertainty of sizes, and the sizes for which it was computed.

    Parameters
    ----------
    sigma
        Standard uncertainty of each of `measures.WITH_SIGMA`, shape (9,).
    sizes
        The sizes, shape (6,), mm, mm², mm³.
    averaged
        Number of frames over which the variance is averaged.
    used
        Number of frames that have used it since it was last computed.
    """

    sigma: FloatArray
    sizes: FloatArray
    averaged: int = 1
    used: int = 0

    @property
    def is_due(self) -> bool:
        """Whether it is computed again for the next frame of such sizes."""
        return self.used >= SETUP_EVERY * self.averaged

    def sigma_with(self, sigma: FloatArray) -> FloatArray:
        """Average the variance with that of one more frame; return its root, shape (9,)."""
        both = np.sqrt((self.averaged * self.sigma**2 + sigma**2) / (self.averaged + 1))
        return np.where(np.isnan(both), np.fmax(self.sigma, sigma), both)

    def after(self, sigma: FloatArray) -> SetupPart:
        """Return the part after a frame, with the uncertainty that was used for it."""
        if not self.is_due:
            return replace(self, used=self.used + 1)
        return replace(self, sigma=sigma, averaged=min(self.averaged + 1, MOST_AVERAGED), used=0)


def nearest_part(parts: tuple[SetupPart, ...], sizes: FloatArray) -> int | None:
    """Index of the part with the nearest sizes, shape (6,); None if all differ by over `CHANGED`.

    Compared is the largest relative change of a size; height and depth have a common scale.
    """
    if not parts:
        return None
    known = np.array([part.sizes for part in parts])
    scale = np.abs(known)
    scale[:, 2:4] = scale[:, 2:4].max(axis=1, keepdims=True)
    change = (np.abs(sizes - known) / scale).max(axis=1)
    nearest = int(np.argmin(change))
    return nearest if change[nearest] <= CHANGED else None


def parts_after(
    parts: tuple[SetupPart, ...], sigma: FloatArray, sizes: FloatArray
) -> tuple[SetupPart, ...]:
    """Return the parts after a frame with such sizes, and the set-up's part used for it."""
    nearest = nearest_part(parts, sizes)
    if nearest is None:
        return *parts, SetupPart(sigma, sizes)
    return *parts[:nearest], parts[nearest].after(sigma), *parts[nearest + 1 :]


@dataclass(frozen=True)
class FromPrevious:
    """What the previous frame, and those before it, give for the next.

    Parameters
    ----------
    boundary
        The boundary of the previous frame.
    setup_parts
        The set-up's part of the uncertainty, as computed earlier for some sizes.
    """

    boundary: Boundary
    setup_parts: tuple[SetupPart, ...]


def reconstruct(match: Match, rig: Rig, settings: FitSettings) -> Reconstruction:
    """Fit one smooth surface to all reflections (`fit_pool`), and trace its boundary.

    Raises
    ------
    CannotMeasure
        As `fit_surface`; ``open-boundary`` if the surface does not come down to the work piece all
        round.
    """
    pool = fit_surface(match, rig, settings)
    return bound_and_measure(match, pool, rig)[0]


def fit_surface(
    match: Match, rig: Rig, settings: FitSettings, initial: SplineSurface | None = None
) -> FittedPool:
    """Fit the surface (`fit_pool`), starting from an initial one if given.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` for fewer than nine matched dots; ``no-surface`` if no surface fits the
        dots; ``open-boundary`` if no dark rays show the boundary.
    """
    if len(match.ray) < LEAST_DOTS:
        raise CannotMeasure(
            "too-few-dots", f"only {len(match.ray)} dots have a ray; a surface needs {LEAST_DOTS}"
        )
    if not boundary_is_seen(match.ray_states):
        raise CannotMeasure("open-boundary", BOUNDARY_UNSEEN)
    pool = fit_pool(match, rig, settings, initial, weigh_by_height_sigma=True)
    if is_too_smooth(pool, match, settings):
        settings, initial = _for_rough(settings, pool.roughness_ratio), pool.surface
        pool = fit_pool(match, rig, settings, initial, weigh_by_height_sigma=True)
    if pool.unsettled_mm > UNSETTLED_MM:
        raise CannotMeasure("no-surface", "the surface does not settle")
    return pool


def is_too_smooth(pool: FittedPool, match: Match, settings: FitSettings) -> bool:
    """Whether the pool bends more than a fitted surface, and the set-up need not be wrong."""
    variance = match.plane_covariance_mm2.trace(axis1=1, axis2=2) + 2 * settings.floor_mm**2
    misfit = float(np.mean(np.sum(pool.residual_mm**2, axis=-1) / variance))
    return MOST_ROUGH < pool.roughness_ratio > misfit / MOST_MISFIT


def _for_rough(settings: FitSettings, ratio: float) -> FitSettings:
    """Settings for a surface whose roughness is ``ratio`` times the expected one."""
    jerk = min(settings.jerk * np.sqrt(ROUGHER * ratio), MOST_JERK)
    return replace(settings, jerk=float(jerk), knot_mm=min(FINE_KNOT_MM, settings.knot_mm))


def bound_and_measure(
    match: Match,
    pool: FittedPool,
    rig: Rig,
    previous: FromPrevious | None = None,
) -> tuple[Reconstruction, measures.Measures]:
    """Compute the boundary, the sizes and all uncertainties of a fitted surface.

    With the results for a previous frame the boundary is traced from the former one, and the part
    of the set-up is computed only if a size has changed (`CHANGED`), or if it is due.

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if the surface does not come down to the work piece all round.
    """
    basis, coefficients, level = pool.surface.basis, pool.surface.coefficients, pool.level
    points = pool.points_mm
    center = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    if previous is None:
        boundary, slope = trace_boundary(basis, coefficients, level, center)
    else:
        boundary, slope = retrace_boundary(basis, coefficients, level, center, previous.boundary)
    sizes = sizes_and_gradients(basis, coefficients, level, boundary, slope)
    if previous is not None and not sizes.holds:  # `trace_boundary` finds the first crossing itself
        raise CannotMeasure(
            "open-boundary", "the surface comes down to the work piece within its boundary"
        )
    shape_parameters, by_shape = shape_and_gradients(
        basis, coefficients, level.rear, boundary, slope
    )
    by_all = np.concatenate([sizes.gradient, by_shape])
    gradient, by_drop = by_all[:, :-1], by_all[:, -1]
    # The splines add up to 1: the sum is the derivative by the shift.
    level_sigma = level.sigma_of(gradient.sum(axis=1), by_drop)
    parts = () if previous is None else previous.setup_parts
    nearest = nearest_part(parts, sizes.values)
    former = None if nearest is None else parts[nearest]
    if former is not None and not former.is_due:
        sigma_of_setup = former.sigma
    else:
        sigma_of_setup = setup_sigma(setup_changes(match, rig, pool, by_all))
        if former is not None:
            sigma_of_setup = former.sigma_with(sigma_of_setup)
    reconstruction = Reconstruction(
        scheme="fit",
        surface=pool.surface,
        boundary=boundary,
        ray=match.ray,
        points_mm=points,
        residual_mm=pool.residual_mm,
        sigma_mm=np.hypot(pool.height_sigma_mm(points), level.sigma_mm),
        size_sigma=np.sqrt(pool.sigma_of(gradient) ** 2 + level_sigma**2 + sigma_of_setup**2),
        size_sigma_level=level_sigma,
        size_sigma_setup=sigma_of_setup,
    )
    errors = measures.reflection_errors(reconstruction, match, rig)
    sizes_and_shape = np.concatenate([sizes.values, shape_parameters])
    return reconstruction, measures.assemble_measures(
        errors, sizes_and_shape, sizes.peak_mm, center, reconstruction
    )
