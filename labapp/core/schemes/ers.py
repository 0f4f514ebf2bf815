"""Extrapolation reconstruction scheme: one base point on the pool's head, at z = 0 (ch. 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes.slopes import (
    Paths,
    best_of_loops,
    parents_from,
    reconstruction_within,
    reflected_rays,
)
from labapp.core.surface.boundary import BoundaryModel, boundary_on_work_piece
from labapp.core.surface.interpolation import ThinPlateSurface
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import CannotMeasure, IntArray


@dataclass(frozen=True)
class ErsSettings:
    """Settings of the extrapolation scheme.

    Parameters
    ----------
    loops
        Maximum number of loops; they end when the reflection points have converged.
    boundary
        Boundary model: ``piecewise`` (§6.3.2) or ``circle`` (§8.2.1).
    """

    loops: int = 100
    boundary: BoundaryModel = "piecewise"


def reconstruct(match: Match, rig: Rig, settings: ErsSettings) -> Reconstruction:
    """Reconstruct the pool surface by extrapolation (Fig. 7-1).

    The boundary model gives X and Y of the boundary, the extrapolated surface its Z; the whole
    surface is interpolated through boundary and reflection points (step 5).

    Raises
    ------
    CannotMeasure
        ``too-few-dots``, ``no-surface`` or ``no-boundary``.
    """
    rays = reflected_rays(match, rig)
    paths = Paths.along(parents_from(rays.ray, head_left(rays.ray, rig.head_sign)), rays.direction)
    work_piece = rays.distance_at(0.0)
    best = best_of_loops(
        rays,
        lambda normals, _: paths.follow(normals, work_piece),
        ThinPlateSurface,
        settings.loops,
    )
    if best is None:
        raise CannotMeasure("no-surface", "the reflection points diverge from the first loop on")
    outline = boundary_on_work_piece(match, rig, settings.boundary)
    x, y, _ = outline.points_mm.T
    boundary = outline.at_height(best.surface.height(x, y))
    return reconstruction_within("ers", match, rays, best, boundary)


def head_left(ray: IntArray, head_sign: int = 1) -> int:
    """Index of the base point: the leftmost ray of the row nearest the head.

    That is the row of the largest i for a head towards +Y, of the smallest for one towards −Y.
    """
    return int(np.lexsort((ray[:, 1], -head_sign * ray[:, 0]))[0])
