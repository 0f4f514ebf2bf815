"""Normal equations of the fit.

The normal matrix of the spline coefficients is banded, so that its Cholesky factor is cheap to
compute. One factor is used for several rounds of the fit: each evaluates the slopes at the current
reflection points, and solves for the remaining residual. The rounds converge to the same surface
whatever factor is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.surface.level import NO_SEARCH, Level, LevelSearch
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import CannotMeasure, FloatArray

REUSE_MM = 5e-3
"""By default a factor is reused if no reflection point has moved by more, which is small compared
with the cells of the splines."""

NEWTON_STEPS = 4
"""Steps from a reflection point to that on another surface, or on that of the next round if the
level is searched for among all levels: the surface may then move far."""

NO_SURFACE = "no surface has the slopes that the dots require"


@dataclass
class NormalEquations:
    """Normal equations of n rays and their dots for a surface of p splines.

    Parameters
    ----------
    stiffness
        Weight of the roughness times its matrix, lower band, shape (width + 1, p).
    laser_mm, plane
        The laser, shape (3,), and the imaging plane (`ImagingPlane.pose_mm`), mm.
    dots_mm
        The dots in the UCS, shape (n, 3), mm.
    weights
        Inverse covariance of the slopes that follow from the dots, shape (n, 2, 2).
    factor
        Cholesky factor of the normal matrix (`normal_factor`); None: not computed yet.
    reuse_mm
        The factor is reused if no reflection point has moved by more. With an outdated factor
        weakly determined modes diverge, the sooner the smaller the σ of the dots.
    """

    basis: SplineBasis
    stiffness: FloatArray
    laser_mm: FloatArray
    plane: FloatArray
    dots_mm: FloatArray
    weights: FloatArray
    factor: FloatArray | None = None
    reuse_mm: float = REUSE_MM
    _inverse: tuple[FloatArray, FloatArray] | None = None

    @property
    def known_inverse(self) -> FloatArray | None:
        """Covariance of the coefficients (`inverse_of`), if computed with the current factor."""
        return self._inverse[1] if self._inverse and self._inverse[0] is self.factor else None

    @property
    def inverse(self) -> FloatArray:
        """Covariance of the coefficients (`inverse_of`)."""
        assert self.factor is not None
        if (known := self.known_inverse) is None:
            self._inverse = self.factor, (known := inverse_of(self.factor))
        return known


@dataclass
class Rounds:
    """Rounds of the fit of n rays to their dots, and their current state.

    Each round solves for the surface with the slopes at the current reflection points, and moves
    these along their rays to it.

    Parameters
    ----------
    equations
        The normal equations.
    rays
        Unit directions of the rays, shape (n, 3).
    coefficients
        The current surface, shape (p,), mm.
    points_mm
        The reflection points on it, shape (n, 3), mm.
    moved_mm
        Largest displacement of a reflection point in the last round, mm.
    """

    equations: NormalEquations
    rays: FloatArray
    coefficients: FloatArray
    points_mm: FloatArray
    moved_mm: float = 0.0

    def height_sigma_mm(self, places_mm: FloatArray) -> FloatArray:
        """Standard uncertainty of the height at m places (`height_sigma`), shape (m,), mm."""
        equations = self.equations
        assert equations.factor is not None
        mean = mean_splines(equations.basis, self.points_mm)
        return height_sigma(equations.basis, equations.factor, equations.inverse, mean, places_mm)

    def run(
        self,
        most: int,
        until_mm: float,
        smooth_about: FloatArray | None = None,
        search: LevelSearch = NO_SEARCH,
    ) -> Level:
        """Run rounds until no reflection point moves by ``until_mm``.

        In each the slopes at the reflection points become those that reflect the rays to their
        dots, as far as the roughness penalty allows: a linear least-squares problem, in which the
        points and their mean height are fixed. Then the surface is shifted to its level.

        Parameters
        ----------
        most
            Maximum number of rounds.
        until_mm
            See above, mm.
        smooth_about
            Coefficients of a surface, shape (p,), mm: the roughness of the difference from it is
            penalised. None: that of the surface itself.
        search
            Search for the level. By default the mean height of the points stays.

        Returns
        -------
        Level
            The final level; of no meaning without a search.

        Raises
        ------
        CannotMeasure
            ``no-surface`` if the slopes do not determine the surface.
        """
        from labapp.core.surface.kernels import rounds_kernels

        own = self.equations
        smooth = np.zeros(own.basis.count) if smooth_about is None else smooth_about
        known = (own.stiffness, np.nan) if own.factor is None else (own.factor, self.moved_mm)
        steps = 1 if search is NO_SEARCH or search.near is not None else NEWTON_STEPS
        level_input, level, search_limits = search.for_kernel
        limits = np.array([most, until_mm, steps, own.reuse_mm, known[1], *search_limits])
        self.coefficients, self.points_mm, factor, level, (moved, is_new) = (
            rounds_kernels.run_rounds(
                own.basis.grid,
                (own.stiffness, self.rays, own.weights, own.laser_mm, own.plane, own.dots_mm),
                (self.coefficients, smooth, self.points_mm, known[0]),
                level_input,
                level,
                limits,
            )
        )
        if is_new:
            own.factor = factor
        self.moved_mm = float(moved)
        if np.isnan(moved):
            raise CannotMeasure("no-surface", NO_SURFACE)
        return Level.of(level)


def normal_factor(
    basis: SplineBasis, stiffness: FloatArray, points_mm: FloatArray, weights: FloatArray
) -> FloatArray:
    """Cholesky factor of the normal matrix of slopes at points, lower band, shape (width + 1, p).

    Slopes do not determine the level; it is fixed by the spline in their middle, which affects
    nothing else.

    Parameters
    ----------
    basis
        The p splines.
    stiffness
        Weight of the roughness times its matrix, lower band, shape (width + 1, p).
    points_mm, weights
        See `fit_slopes`.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if there is none.
    """
    from labapp.core.surface.kernels import solver_kernels

    lower, has_one = solver_kernels.normal_factor(basis.grid, stiffness, points_mm, weights)
    if not has_one:
        raise CannotMeasure("no-surface", NO_SURFACE)
    return lower


def inverse_of(factor: FloatArray) -> FloatArray:
    """Covariance of the p spline coefficients, shape (p, p), mm²; undefined outside the band.

    Only entries within the band of the factor are computed; the others have arbitrary values.

    ``factor`` is the Cholesky factor of the normal matrix (`normal_factor`).
    """
    from labapp.core.surface.kernels import solver_kernels

    return solver_kernels.inverse_band(factor)


def mean_splines(basis: SplineBasis, points_mm: FloatArray) -> FloatArray:
    """Mean value of each spline over n points, shape (n, ≥ 2), mm; shape (p,)."""
    from labapp.core.surface.kernels import spline_kernels

    share = np.full(len(points_mm), 1 / len(points_mm))
    return spline_kernels.gradient_of_sum(basis.grid, basis.count, points_mm, share)


def height_sigma(
    basis: SplineBasis,
    factor: FloatArray,
    inverse: FloatArray,
    mean_splines: FloatArray,
    places_mm: FloatArray,
) -> FloatArray:
    """Standard uncertainty of the surface's height at places, apart from its level, shape (m,), mm.

    Parameters
    ----------
    basis, factor, inverse
        The splines, the Cholesky factor of the normal matrix, and its inverse (`inverse_of`).
    mean_splines
        See `propagate_sigma`.
    places_mm
        The places, shape (m, ≥ 2), mm.
    """
    from labapp.core.surface.kernels import solver_kernels

    covariance = solver_kernels.solve(factor, mean_splines[None])[0]
    of_mean = np.append(covariance, covariance @ mean_splines)
    return np.sqrt(solver_kernels.height_variances(basis.grid, inverse, of_mean, places_mm))


def propagate_sigma(
    factor: FloatArray, gradients: FloatArray, mean_splines: FloatArray
) -> FloatArray:
    """Standard uncertainty of quantities apart from that of the level, shape (m,).

    The covariance of the coefficients is the inverse of the normal matrix; the level is known
    independently of them.

    Parameters
    ----------
    factor
        Cholesky factor of the normal matrix (`normal_factor`).
    gradients
        Derivatives by the spline coefficients, shape (m, p).
    mean_splines
        Mean value of each spline over the reflection points, shape (p,): slopes determine the
        surface up to its mean there.
    """
    from labapp.core.surface.kernels import solver_kernels

    free = gradients - gradients.sum(axis=1)[:, None] * mean_splines
    return np.asarray(np.sqrt(solver_kernels.variances(factor, free)))


@dataclass(frozen=True)
class SlopeFit:
    """Least-squares surface through given slopes, up to its level.

    Parameters
    ----------
    surface
        The surface, its mean height over the points 0.
    factor
        Cholesky factor of the normal matrix with one spline fixed, lower band, shape
        (width + 1, splines).
    mean_splines
        Mean value of each spline over the points, shape (splines,).
    """

    surface: SplineSurface
    factor: FloatArray
    mean_splines: FloatArray

    def sigma_of(self, gradients: FloatArray) -> FloatArray:
        """Standard uncertainty of quantities that do not depend on the level, shape (m,)."""
        return propagate_sigma(self.factor, gradients, self.mean_splines)


def fit_slopes(
    basis: SplineBasis,
    points_mm: FloatArray,
    slopes: FloatArray,
    weights: FloatArray,
    stiffness: float,
) -> SlopeFit:
    """Least-squares surface through slopes.

    Parameters
    ----------
    points_mm
        Points of the slopes, (x, y), shape (n, 2), mm, within the rectangle of the basis.
    slopes
        (∂z/∂x, ∂z/∂y) there, shape (n, 2).
    weights
        Inverse of each slope's covariance, shape (n, 2, 2).
    stiffness
        Weight of the roughness, mm⁶: the area over which the third derivatives are correlated, over
        their expected variance.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the slopes do not determine the surface.
    """
    from labapp.core.surface.kernels import solver_kernels

    cells = basis.cells(*points_mm.T)
    splines, (value, *slope) = cells.splines, cells.value_and_slopes()
    weighted = np.einsum("nas,na->ns", weights @ np.stack(slope, axis=1), slopes)
    target = np.bincount(splines.ravel(), weighted.ravel(), basis.count).astype(float)
    factor = normal_factor(basis, stiffness * basis.roughness_matrix, points_mm, weights)
    coefficients = solver_kernels.solve(factor, target[None])[0]
    mean_splines = np.bincount(splines.ravel(), value.ravel(), basis.count) / len(points_mm)
    surface = SplineSurface(basis, coefficients - mean_splines @ coefficients)
    return SlopeFit(surface, factor, mean_splines)
