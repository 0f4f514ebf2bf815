"""Predicted dots of rays for a fitted surface, and likelihoods of pairs of ray and dot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.rig import Rig
from labapp.core.matching.observation import Observation
from labapp.core.surface.pool_fit import FittedPool
from labapp.core.surface.solver import inverse_of
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

GATE_SIGMA2, RIVAL_MARGIN = 20.0, 6.0
"""A dot may belong to a ray if its squared Mahalanobis distance from the prediction is below the
first; it does if the deviance of every rival is larger by the second. (A correct pair exceeds the
gate once in 22,000; a margin of 6 makes it 20 times as likely as its rival.)"""

SIGMA_INFLATION = 1.4
"""Factor applied to the σ of the surface while dots are labelled: beyond the last labelled row the
σ relies on the assumed smoothness of pools."""

MODEL_ERROR_MM = 0.06
"""Standard error of correct predictions due to detail that the splines cannot represent, mm."""

FALSE_DOTS_PER_MM2 = 5e-4
"""Expected density of false dots on the imaging plane: a few per frame. Where a prediction is
uncertain, a dot is as likely to be false as to belong to the ray."""

NEWTON_STEPS = 4
"""Newton steps from the landing points to the surface: rays near labelled ones land close to where
they meet it. `RayPaths.of` takes more, as it includes rays far outside."""


@dataclass(frozen=True)
class RayPaths(ReadOnlyArrays):
    """Intersections of all R rays of the pattern, row by row, with a surface, and their dots.

    Parameters
    ----------
    basis, coefficients
        The surface's splines, and their coefficients, shape (p,), mm.
    points_mm
        Reflection points, shape (R, 3), mm.
    slopes
        Gradient of the surface there, shape (R, 2).
    plane_mm
        Dots, IPCS, shape (R, 2), mm; NaN for rays that leave the splines or miss the plane.
    """

    basis: SplineBasis
    coefficients: FloatArray
    points_mm: FloatArray
    slopes: FloatArray
    plane_mm: FloatArray

    @classmethod
    def of(
        cls,
        bench: Bench,
        basis: SplineBasis,
        coefficients: FloatArray,
        near_mm: FloatArray | None = None,
        steps: int = 12,
    ) -> RayPaths:
        """Intersect and reflect the rays; start at nearby points, shape (R, 3), or at z = 0."""
        from labapp.core.surface.kernels import ray_kernels

        start = bench.rays.landing_mm.reshape(-1, 3) if near_mm is None else near_mm
        rays, plane = bench.rays.directions.reshape(-1, 3), bench.rig.imaging_plane.pose_mm
        points, slopes, dots = ray_kernels.intersect_and_reflect(
            basis.grid, coefficients, rays, start, steps, plane
        )
        return cls(basis, coefficients, points, slopes, dots)


@dataclass(frozen=True)
class Prediction:
    """Predicted dots of m rays.

    Parameters
    ----------
    at
        Rows and columns of the rays in the pattern's arrays, counted from 0, shape (m, 2).
    points_mm
        Reflection points, shape (m, 3), mm.
    plane_mm
        Dots, IPCS, shape (m, 2), mm.
    spacing_mm
        Distance from each to the next predicted dot, shape (m,), mm.
    """

    at: IntArray
    points_mm: FloatArray
    plane_mm: FloatArray
    spacing_mm: FloatArray

    def covariance_mm2(self, pool: FittedPool, rig: Rig) -> FloatArray:
        """Covariance of the dots due to that of the surface, shape (m, 2, 2), mm²."""
        basis, inverse = pool.surface.basis, inverse_of(pool.factor)
        return covariance_of_dots(rig, basis, inverse, self.points_mm, self.plane_mm)


def covariance_of_dots(
    rig: Rig, basis: SplineBasis, inverse: FloatArray, points_mm: FloatArray, plane_mm: FloatArray
) -> FloatArray:
    """Covariance of computed dots due to that of the surface, shape (n, 2, 2), mm².

    Parameters
    ----------
    rig
        The rig.
    basis, inverse
        The surface's splines, and the covariance of their coefficients (`solver.inverse_of`).
    points_mm, plane_mm
        Reflection points, shape (n, 3), and the dots computed for them, IPCS, shape (n, 2), mm.
    """
    from labapp.core.surface.kernels import solver_kernels

    laser, plane = rig.laser.position_mm, rig.imaging_plane.pose_mm
    dots_mm = rig.imaging_plane.to_universal(plane_mm)
    return solver_kernels.covariance_of_dots(basis.grid, inverse, laser, plane, points_mm, dots_mm)


def predict(observed: Observation, pool: FittedPool, where: BoolArray) -> Prediction:
    """Predict the dots of those rays in a mask, shape (rows, columns), that reach the plane."""
    from labapp.core.images import band_pass_kernels
    from labapp.core.surface.kernels import ray_kernels

    at = np.argwhere(where)
    index, surface, pose = tuple(at.T), pool.surface, observed.rig.imaging_plane.pose_mm
    points, _, plane = ray_kernels.intersect_and_reflect(
        surface.basis.grid,
        surface.coefficients,
        observed.rays.directions[index],
        observed.rays.landing_mm[index],
        NEWTON_STEPS,
        pose,
    )
    finite = np.isfinite(plane[:, 0])
    at, points, plane = at[finite], points[finite], plane[finite]
    return Prediction(at, points, plane, band_pass_kernels.next_apart(plane))


def sure_pairs(
    observed: Observation, dots: IntArray, plane_mm: FloatArray, covariance_mm2: FloatArray
) -> tuple[IntArray, IntArray]:
    """Find the unambiguous pairs of dot and ray.

    A pair is unambiguous if it is likelier by `RIVAL_MARGIN` than the dot with any other ray, the
    ray with any other dot, and a false dot.

    Parameters
    ----------
    observed, dots
        The frame's dots, and the indices of the n candidates among them.
    plane_mm, covariance_mm2
        Predicted dots of m > 0 rays, IPCS, shape (m, 2), mm, and their covariance due to that of
        the surface, shape (m, 2, 2), mm².

    Returns
    -------
    dot, ray
        For each pair, the index of the dot and the position of the ray among the m.
    """
    from labapp.core.matching import match_kernels

    dot, ray = match_kernels.sure_pairs(
        observed.plane_mm[dots],
        observed.covariance_mm2[dots],
        plane_mm,
        covariance_mm2,
        sure_limits(),
    )
    return dots[dot], ray


def sure_limits() -> FloatArray:
    """Limits of `match_kernels.sure_pairs`."""
    inflation, error = SIGMA_INFLATION**2, MODEL_ERROR_MM**2
    return np.array([inflation, error, GATE_SIGMA2, RIVAL_MARGIN, false_dot_deviance()])


def pair_deviances(
    observed: Observation, pool: FittedPool, predicted: Prediction, dots: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Distances and deviances of n dots from m predictions.

    The covariance of a pair is the sum of those of dot and prediction.

    Returns
    -------
    distance, deviance
        Squared Mahalanobis distances, and deviances: −2 log likelihoods up to a constant common to
        all pairs. Both of shape (n, m).
    """
    from labapp.core.matching import match_kernels

    spread = _enlarged(predicted.covariance_mm2(pool, observed.rig))
    return match_kernels.pair_deviances(
        observed.plane_mm[dots], observed.covariance_mm2[dots], predicted.plane_mm, spread
    )


def _enlarged(covariance_mm2: FloatArray) -> FloatArray:
    """Inflate the covariance from the fit, shape (m, 2, 2), mm², and add the model error."""
    return SIGMA_INFLATION**2 * covariance_mm2 + MODEL_ERROR_MM**2 * np.eye(2)


def false_dot_deviance(per_mm2: float = FALSE_DOTS_PER_MM2) -> float:
    """Deviance of a false dot for a density of false dots, comparable with `pair_deviances`."""
    return -2 * float(np.log(2 * np.pi * per_mm2))
