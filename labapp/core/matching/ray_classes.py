"""Which rays came back, which did not, and which dots and rays a surface leaves unexplained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation, amid, widened
from labapp.core.matching.prediction import RayPaths, lines_out_of_view
from labapp.core.values import FloatArray, IntArray


@dataclass(frozen=True)
class RayClasses:
    """What the rays say with a surface under them.

    Parameters
    ----------
    witness
        +1 came back, −1 did not, 0 cannot tell, shape (rows, columns) (see `Match.witness`).
    missed
        Numbers of the rays amid the others that have no dot, row by row, shape (m,).
    stray
        Indices of the dots that have no ray, shape (s,).
    """

    witness: IntArray
    missed: IntArray
    stray: IntArray


def classify_rays(observed: Observation, labels: IntArray, paths: RayPaths) -> RayClasses:
    """Classify every ray, for labels of shape (rows, columns) and a surface fitted to them.

    Neither a dot nor a ray is left over where the surface lets dots run into each other.
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
        # A dot that no ray was given may be the dot of a ray that seems dark.
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
    """The witness without rows that are dark but may have left the view.

    Beside the last row that is seen the fit goes on as smoothly as it can, while a pool's edge
    grows steep: the dots of the next row may lie farther out than they are predicted.

    Parameters
    ----------
    observed, paths
        The frame's dots, and what the surface makes of the rays.
    witness
        Of `classify_rays`.
    covariance_of
        Covariance of the dots of some rays, by their numbers, shape (m,): shape (m, 2, 2), mm².
    """
    rim = np.flatnonzero((witness < 0) & widened(witness > 0, 1))
    at = np.stack(np.divmod(rim, witness.shape[1]), axis=-1)
    some = paths.plane_mm[rim]
    lost = lines_out_of_view(observed, at, some, lambda which: covariance_of(rim[which]))
    return np.where(lost, 0, witness)
