"""Zonal integration of slopes (Southwell 1980), on the rays' own grid.

W. H. Southwell, Wave-front estimation from wave-front slope measurements, J. Opt. Soc. Am. 70,
998–1006 (1980): between neighbours the height changes by the mean of their slopes, and of all these
changes together the heights are the least-squares solution. His geometry is a square grid; here the
neighbours lie where the rays meet the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes.integration import reconstruct_by
from labapp.core.schemes.slopes import ReflectedRays, lines
from labapp.core.surface.boundary import BoundaryModel
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray


@dataclass(frozen=True)
class ZonalSettings:
    """Settings of zonal integration.

    Parameters
    ----------
    loops
        How many loops at most; they end when the reflection points have settled.
    boundary
        Boundary model: ``piecewise`` (§6.3.2) or ``circle`` (§8.2.1).
    """

    loops: int = 100
    boundary: BoundaryModel = "piecewise"


def reconstruct(match: Match, rig: Rig, settings: ZonalSettings | None = None) -> Reconstruction:
    """Reconstruct the pool surface by zonal integration; `CannotMeasure` as `reconstruct_by`."""
    settings = settings or ZonalSettings()
    return reconstruct_by("zonal", heights, match, rig, settings.loops, settings.boundary)


def heights(rays: ReflectedRays, place: FloatArray, gradient: FloatArray) -> FloatArray:
    """Heights but for a constant; see `integration.Integrate`.

    Points that no neighbours join to the others have the height of least norm, 0.
    """
    chains = [*lines(rays.ray, axis=0), *lines(rays.ray, axis=1)]
    start, end = np.concatenate([np.stack([one[:-1], one[1:]]) for one in chains], axis=1)
    change = np.sum((gradient[start] + gradient[end]) / 2 * (place[end] - place[start]), axis=-1)
    step = np.arange(len(start))
    system = np.zeros((len(start), len(place)))
    system[step, end], system[step, start] = 1.0, -1.0
    return np.asarray(np.linalg.lstsq(system, change)[0])
