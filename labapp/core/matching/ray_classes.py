"""Classification of rays as returned or not; dots and rays that a surface leaves unexplained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation, amid, widened
from labapp.core.matching.prediction import RayPaths, lines_out_of_view
from labapp.core.values import FloatArray, IntArray


@dataclass(frozen=True)
class RayClasses:
    """Classes of rays and dots for a given surface.

    Parameters
    ----------
    witness
        +1 returned, −1 did not, 0 unknown, shape (rows, columns) (see `Match.witness`).
    missed
        Flat indices of the rays between lit rays that have no dot, shape (m,).
    stray
        Indices of the dots that have no ray, shape (s,).
    """

    witness: IntArray
    missed: IntArray
    stray: IntArray


def classify_rays(observed: Observation, labels: IntArray, paths: RayPaths) -> RayClasses:
    """Classify every ray, for labels of shape (rows, columns) and a surface fitted to them.

    Where the surface predicts that dots merge, neither a dot nor a ray counts as unexplained.
    """
    from labapp.core.images import dot_kernels
    from labapp.core.surface.kernels import ray_kernels

    lit, plane = labels != UNLABELLED, paths.plane_mm
    known = np.flatnonzero(np.isfinite(plane[:, 0]))
    tip = observed.rig.electrode.height_mm
    rays = observed.rays.reshape(-1, 3)[known]
    blocked = ray_kernels.behind_torch(paths.points_mm[known], rays, paths.slopes[known], tip)
    in_view = observed.in_view(plane[known]) & ~blocked

    without_dot = observed.absent | observed.hidden
    between = amid(lit)
    is_among = (between & ~without_dot).ravel()[known]
    among = known[is_among]
    merged = dot_kernels.next_apart(plane[among]) < observed.resolution_mm
    missed = among[in_view[is_among] & ~merged & ~lit.ravel()[among]]
    is_stray = np.ones(len(observed.plane_mm), bool)
    is_stray[labels[lit]] = False
    stray = unlabelled = np.flatnonzero(is_stray)
    if merged.any() and len(stray):
        off = dot_kernels.two_nearest(observed.plane_mm[stray], plane[among[merged]])[0][:, 0]
        stray = stray[off > observed.resolution_mm]

    spacing = dot_kernels.next_apart(plane[known])
    witness = np.zeros(lit.size, np.int64)
    witness[known[in_view & (spacing >= observed.resolution_mm)]] = -1
    witness[(between | without_dot).ravel()] = 0
    if len(unlabelled):
        # A stray dot near a prediction may be the dot of a ray that seems dark.
        off = dot_kernels.two_nearest(plane[known], observed.plane_mm[unlabelled])[0][:, 0]
        witness[known[off < spacing]] = 0
    witness[lit.ravel()] = 1
    return RayClasses(witness.reshape(lit.shape), missed, stray)


def certain_witness(
    observed: Observation,
    witness: IntArray,
    paths: RayPaths,
    covariance_of: Callable[[IntArray], FloatArray],
) -> IntArray:
    """Return the witness with dark rows set to unknown if they may have left the view.

    Beyond the last visible row the fit extrapolates smoothly, whereas the pool gets steeper towards
    its edge: the dots of the next row may lie farther out than predicted.

    Parameters
    ----------
    observed, paths
        The frame's dots, and the ray paths for the surface.
    witness
        The witness of `classify_rays`.
    covariance_of
        Function of the flat indices of rays, shape (m,), that returns the covariance of their
        dots, shape (m, 2, 2), mm².
    """
    rim = np.flatnonzero((witness < 0) & widened(witness > 0, 1))
    at = np.stack(np.divmod(rim, witness.shape[1]), axis=-1)
    plane_mm = paths.plane_mm[rim]
    lost = lines_out_of_view(observed, at, plane_mm, lambda which: covariance_of(rim[which]))
    return np.where(lost, 0, witness)
