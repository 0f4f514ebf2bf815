"""Zonal integration of slopes (Southwell 1980) on the grid of the rays.

W. H. Southwell, Wave-front estimation from wave-front slope measurements, J. Opt. Soc. Am. 70,
998–1006 (1980): the difference in height of neighbours follows from the mean of their slopes, and
the heights are the least-squares solution for all differences. The original geometry is a square
grid; here the points lie where the rays meet the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes.integration import reconstruct_by
from labapp.core.schemes.slopes import ReflectedRays, rows_or_columns
from labapp.core.surface.boundary import BoundaryModel
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray


@dataclass(frozen=True)
class ZonalSettings:
    """Settings of zonal integration.

    Parameters
    ----------
    loops
        Maximum number of loops; they end when the reflection points have converged.
    boundary
        Boundary model: ``piecewise`` (§6.3.2) or ``circle`` (§8.2.1).
    """

    loops: int = 100
    boundary: BoundaryModel = "piecewise"


def reconstruct(match: Match, rig: Rig, settings: ZonalSettings) -> Reconstruction:
    """Reconstruct the pool surface by zonal integration; `CannotMeasure` as `reconstruct_by`."""
    return reconstruct_by("zonal", heights, match, rig, settings.loops, settings.boundary)


def heights(rays: ReflectedRays, place: FloatArray, gradient: FloatArray) -> FloatArray:
    """Heights up to a constant; see `integration.Integrate`.

    Points that are not connected to others by neighbours get the minimum-norm height, 0.
    """
    chains = [*rows_or_columns(rays.ray, axis=0), *rows_or_columns(rays.ray, axis=1)]
    start, end = np.concatenate([np.stack([one[:-1], one[1:]]) for one in chains], axis=1)
    change = np.sum((gradient[start] + gradient[end]) / 2 * (place[end] - place[start]), axis=-1)
    step = np.arange(len(start))
    system = np.zeros((len(start), len(place)))
    system[step, end], system[step, start] = 1.0, -1.0
    return np.asarray(np.linalg.lstsq(system, change)[0])
