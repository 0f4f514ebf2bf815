"""Interpolation reconstruction scheme: edge-points and one-point algorithms (ch. 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes.slopes import (
    Estimate,
    Move,
    Paths,
    ReflectedRays,
    best_of_loops,
    parents_along,
    parents_from,
    reconstruction_within,
    reflected_rays,
    rows_or_columns,
)
from labapp.core.surface.boundary import Boundary, BoundaryModel, boundary_on_work_piece
from labapp.core.surface.interpolation import CloughTocherSurface
from labapp.core.surface.measures import reflection_errors
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

Algorithm = Literal["opa", "epa-r", "epa-c", "epa-rc"]
"""One-point algorithm; edge-points algorithm with row slopes, column slopes or both."""


@dataclass(frozen=True)
class IrsSettings:
    """Settings of the interpolation scheme.

    Parameters
    ----------
    algorithm
        ``opa``, ``epa-r``, ``epa-c`` or ``epa-rc``.
    loops
        Maximum number of loops; they end when the reflection points have converged.
    base_heights_mm
        Heights of the base point that the one-point algorithm tries, mm.
    are_margin
        With 0 the height of the smallest ARE of the points is chosen, as in the text. Otherwise
        the whole surfaces, which end at the boundary, are compared: heights whose ARE exceeds the
        smallest by no more than this share explain the dots equally well, and the one nearest
        z = 0 is chosen.
    boundary
        Boundary model: ``piecewise`` (§6.3.2) or ``circle`` (§8.2.1).
    """

    algorithm: Algorithm = "opa"
    loops: int = 100
    base_heights_mm: tuple[float, ...] = tuple(k / 10 for k in range(-5, 6))
    are_margin: float = 0.1
    boundary: BoundaryModel = "piecewise"


def reconstruct(match: Match, rig: Rig, settings: IrsSettings) -> Reconstruction:
    """Reconstruct the pool surface by interpolation (Fig. 6-2).

    The boundary lies on the work piece, z = 0; the whole surface is interpolated through
    boundary and reflection points (§6.4).

    Raises
    ------
    CannotMeasure
        ``too-few-dots``, ``no-surface`` or ``no-boundary``.
    """
    rays = reflected_rays(match, rig)
    found = estimates(match, rays, settings)
    if not found:
        raise CannotMeasure("no-surface", "the reflection points diverge from the first loop on")
    if not settings.are_margin:
        found = [min(found, key=lambda pair: pair[1].are_mm)]
    boundary = boundary_on_work_piece(match, rig, settings.boundary)
    wholes = _whole_surfaces(match, rig, rays, found, boundary)
    least = min(are_mm for _, are_mm, _ in wholes)
    equals = [each for each in wholes if each[1] <= least * (1 + settings.are_margin)]
    return min(equals, key=lambda each: (abs(each[0]), each[1]))[2]


def estimates(
    match: Match, rays: ReflectedRays, settings: IrsSettings
) -> list[tuple[float, Estimate]]:
    """Best estimates for all heights of the base point, mm, that have one (Fig. 6-13).

    The edge-points algorithm has one base height, 0.
    """
    if settings.algorithm == "opa":
        moves = _one_point(match, rays, settings.base_heights_mm)
    else:
        moves = [(0.0, _edge_points(rays, settings.algorithm))]
    found = (
        (height, best_of_loops(rays, move, CloughTocherSurface, settings.loops))
        for height, move in moves
    )
    return [(height, estimate) for height, estimate in found if estimate is not None]


def lower_left(match: Match) -> int:
    """Index of the dot in the lower left corner of the image, that of the base point (§6.4.2).

    The leftmost dot of the lowest reflected row; if no dot has a reflected row, that of the row of
    rays that lies lowest on the imaging plane.
    """
    row = match.reflected[:, 0]
    if (row > 0).any():
        lowest = row == row[row > 0].min()
    else:
        level = {i: match.plane_mm[match.ray[:, 0] == i, 1].mean() for i in match.ray[:, 0]}
        lowest = match.ray[:, 0] == min(level, key=lambda i: level[i])
    return int(np.argmin(np.where(lowest, match.plane_mm[:, 0], np.inf)))


def _whole_surfaces(
    match: Match,
    rig: Rig,
    rays: ReflectedRays,
    found: list[tuple[float, Estimate]],
    boundary: Boundary,
) -> list[tuple[float, float, Reconstruction]]:
    """Height of the base point, ARE and whole surface of each estimate, at least one; mm.

    The ARE of the points hardly depends on the height. That of the surface through points and
    boundary does.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no estimate has a whole surface.
    """
    wholes: list[tuple[float, float, Reconstruction]] = []
    refused = CannotMeasure("no-surface", "no ray meets the surface within the boundary")
    for height_mm, estimate in found:
        try:
            whole = reconstruction_within("irs", match, rays, estimate, boundary)
        except CannotMeasure as error:
            refused = error
            continue
        are_mm = reflection_errors(whole, match, rig)["are_mm"]
        if math.isfinite(are_mm):
            wholes.append((height_mm, are_mm, whole))
    if not wholes:
        raise refused
    return wholes


def _one_point(
    match: Match, rays: ReflectedRays, heights_mm: tuple[float, ...]
) -> list[tuple[float, Move]]:
    """One-point algorithm: all points are reached from one, for several heights (Fig. 6-6)."""
    paths = Paths.along(parents_from(rays.ray, lower_left(match)), rays.direction)

    def move_from(height_mm: float) -> Move:
        start = rays.distance_at(height_mm)
        return lambda normals, _: paths.follow(normals, start)

    return [(height_mm, move_from(height_mm)) for height_mm in heights_mm]


def _edge_points(rays: ReflectedRays, algorithm: Algorithm) -> Move:
    """Edge-points algorithm: points are reached from the ends of their row or column (Fig. 6-5)."""
    rows, columns = rows_or_columns(rays.ray, axis=0), rows_or_columns(rays.ray, axis=1)
    row_paths, column_paths = _both_ways(rows, rays), _both_ways(columns, rays)
    edge = _ends(rows, len(rays.ray))

    def move(normals: FloatArray, before: FloatArray) -> FloatArray:
        # `before` is z = 0 in the first loop, and the positions of the previous loop later.
        by_rows = _mean(row_paths, normals, before)
        if algorithm == "epa-r":
            return by_rows
        by_columns = _mean(column_paths, normals, np.where(edge, before, by_rows))
        return by_columns if algorithm == "epa-c" else (by_rows + by_columns) / 2

    return move


def _both_ways(chains: list[IntArray], rays: ReflectedRays) -> tuple[Paths, Paths]:
    """Paths along each chain from either end."""
    reverse = [chain[::-1] for chain in chains]
    return (
        Paths.along(parents_along(chains), rays.direction),
        Paths.along(parents_along(reverse), rays.direction),
    )


def _mean(paths: tuple[Paths, Paths], normals: FloatArray, base: FloatArray) -> FloatArray:
    """Mean of the two positions that follow from the two base points of a chain."""
    return (paths[0].follow(normals, base) + paths[1].follow(normals, base)) / 2


def _ends(rows: list[IntArray], count: int) -> BoolArray:
    """Mask of the edge points: the first and the last of each row."""
    edge = np.zeros(count, bool)
    for row in rows:
        edge[row[[0, -1]]] = True
    return edge
