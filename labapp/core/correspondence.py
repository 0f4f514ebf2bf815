"""Lattice → Match: which ray made which dot, and how sure (§4.2.2, §5.2.3, §7.1).

The absent centre dot gives the rays of a whole grid at once, for each orientation. Every such
hypothesis is followed by what the surface itself says: fit it to the dots labelled so far,
predict where every ray's dot should be, match mutual nearest neighbours, and fit again until
nothing changes. That finds the dots the grid left in doubt and drops the ones it got wrong. Where
rows bow too much for a grid to grow, hypotheses come from the optics instead: quadrics whose nine
rays round a hole fall on dots.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from labapp.core.coordinates import ImageCalibration
from labapp.core.dots import Dots
from labapp.core.lattice import Lattice, Site, lattice_of_sites
from labapp.core.pool_fit import FitSettings, FittedPool
from labapp.core.quadric_search import search_quadrics
from labapp.core.ray_growth import (
    UNLABELLED,
    Scene,
    blocked,
    grow_labels,
    predict,
    try_fit,
)
from labapp.core.rig import Rig
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze

Orientation = Literal["S/S", "S/I", "I/I"]
"""Column/row correspondence: S grows the same way as the rays, I the other way."""


MODEL_MM = 0.03
"""How far the right surface's dots may be off for no fault of theirs, mm."""


@dataclass(frozen=True)
class Trial:
    """One hypothesis that was tried: its orientation, reference site (k, t) and residual."""

    orientation: Orientation
    reference: tuple[int, int]
    residual_mm: float


@dataclass(frozen=True)
class Match:
    """Matched pairs of ray and reflected dot, n of them.

    Parameters
    ----------
    orientation
        The correspondence that was settled on.
    dot
        Index of each pair's dot in `Dots`, shape (n,).
    ray
        Its ray (i, j), counted from 1, shape (n, 2).
    reflected
        Its reflected row and column (k, t), counted from 1, shape (n, 2); 0 where the dot was
        matched by prediction only.
    plane_mm
        The dot on the imaging plane, IPCS (X′, Z′), shape (n, 2), mm.
    plane_covariance_mm2
        Covariance of that, shape (n, 2, 2), mm².
    witness
        Shape (rows, columns) of the pattern: +1 where the ray came back, −1 where it did not,
        0 where it cannot testify (absent, blocked by the torch, off the plane, in doubt).
    trials
        Everything that was tried, the best first.
    margin
        Residual of the best other orientation over that of the chosen one.
    """

    orientation: Orientation
    dot: IntArray
    ray: IntArray
    reflected: IntArray
    plane_mm: FloatArray
    plane_covariance_mm2: FloatArray
    witness: IntArray
    trials: tuple[Trial, ...] = ()
    margin: float = float("inf")

    def __post_init__(self) -> None:
        freeze(self)


@dataclass(frozen=True)
class MatchSettings:
    """How the correspondence is decided.

    Parameters
    ----------
    correspondence
        ``auto`` tries every orientation; otherwise the one to use.
    gate
        A dot is matched to a ray if it lies within this fraction of the local spacing of dots
        from where the surface predicts it.
    stray, missed
        What a dot without a ray and a ray without its dot amid the others cost a hypothesis, in
        units of χ².
    margin
        Two hypotheses whose costs differ by less cannot be told apart.
    """

    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    gate: float = 0.33
    stray: float = 16.0
    missed: float = 12.0
    margin: float = 8.0


def match_rays(
    dots: Dots,
    lattice: Lattice | None,
    rig: Rig,
    calibration: ImageCalibration,
    frame_shape: tuple[int, int],
    settings: MatchSettings,
) -> Match:
    """Find the ray of every dot.

    Parameters
    ----------
    dots, lattice
        What the frame shows; no lattice where none could be grown.
    rig, calibration
        The bench, and how the camera sees the imaging plane.
    frame_shape
        Height and width of the frame, px.
    settings
        See `MatchSettings`.

    Raises
    ------
    CannotMeasure
        ``no-reference`` if no hole can be the absent centre dot, ``ambiguous-rows`` if several
        can, ``ambiguous-orientation``, ``no-match`` if no surface explains the dots.
    """
    scene = Scene.of(dots, rig, calibration, frame_shape)
    solutions = [
        solution
        for orientation, reference, labels in _hypotheses(lattice, rig, settings)
        if (solution := _pursue(scene, orientation, reference, labels, settings)) is not None
    ]
    if not any(_explains(scene, solution) for solution in solutions):
        for guess in search_quadrics(scene):
            solution = _pursue(scene, "S/S", (0, 0), guess.labels, settings)
            if solution is None:
                continue
            solution = _seen_orientation(scene, solution)
            solutions.append(solution)
            labels = None if lattice is None else _joined(solution, lattice)
            if labels is not None:
                wider = _pursue(scene, solution.orientation, solution.reference, labels, settings)
                solutions += [wider] if wider is not None else []
    return _verdict(scene, lattice, solutions, settings)


def indexed_lattice(match: Match, rig: Rig, count: int) -> Lattice:
    """Rows and columns of ``count`` dots as their rays have them.

    They index dots that the picture alone leaves in doubt, and none that the rays do not.
    """
    way = _ways(match.orientation)
    site = np.array(rig.pattern.reference) * way + (match.reflected - match.ray * way)[0]
    return lattice_of_sites(
        {
            (int(k), int(t)): int(dot)
            for (k, t), dot in zip(match.reflected, match.dot, strict=True)
        },
        count,
        reference=(int(site[0]), int(site[1])),
    )


@dataclass(frozen=True)
class _Solution:
    """A hypothesis followed to its end."""

    orientation: Orientation
    reference: Site
    labels: IntArray
    pool: FittedPool
    cost: float
    stray: int
    missed: int

    @property
    def residual_mm(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.pool.residual_mm**2, axis=-1))))


def _explains(scene: Scene, solution: _Solution) -> bool:
    """Hardly a dot is left over and hardly one is missing."""
    few = max(2, 0.05 * len(scene.plane_mm))
    return solution.stray <= few and solution.missed <= few


def _seen_orientation(scene: Scene, solution: _Solution) -> _Solution:
    """Name the orientation, and the reference's site, that labels from the optics amount to."""
    at = np.argwhere(solution.labels != UNLABELLED)
    place = np.full((*solution.labels.shape, 2), np.nan)
    place[at[:, 0], at[:, 1]] = scene.plane_mm[solution.labels[at[:, 0], at[:, 1]]]
    upward = np.nansum(np.sign(np.diff(place[..., 1], axis=0))) >= 0
    rightward = np.nansum(np.sign(np.diff(place[..., 0], axis=1))) >= 0
    orientation: Orientation = "S/S" if upward else "S/I" if rightward else "I/I"
    way = _ways(orientation)
    lowest = ((at + 1) * way).min(axis=0)
    k0, t0 = np.array(scene.rig.pattern.reference) * way - lowest + 1
    return replace(solution, orientation=orientation, reference=(int(k0), int(t0)))


def _joined(solution: _Solution, lattice: Lattice) -> IntArray | None:
    """Labels for the whole grid where the rays found so far agree with it; None if they do not."""
    at = np.argwhere(solution.labels != UNLABELLED)
    dot = solution.labels[at[:, 0], at[:, 1]]
    site = np.stack([lattice.row, lattice.column], axis=-1)
    way = _ways(solution.orientation)
    indexed = site[dot, 0] > 0
    offset = (at + 1 - site[dot] * way)[indexed]
    if len(offset) == 0:
        return None
    kinds, count = np.unique(offset, axis=0, return_counts=True)
    if count.max() < 0.8 * len(offset):
        return None
    ray = site * way + kinds[np.argmax(count)]
    there = (site[:, 0] > 0) & (ray >= 1).all(axis=1) & (ray <= solution.labels.shape).all(axis=1)
    labels = np.where(np.isin(solution.labels, np.nonzero(there)[0]), UNLABELLED, solution.labels)
    labels[ray[there, 0] - 1, ray[there, 1] - 1] = np.nonzero(there)[0]
    return labels


def _ways(orientation: Orientation) -> IntArray:
    """+1 or −1: whether reflected rows, and columns, grow with the rays'; shape (2,)."""
    by_column, by_row = orientation.split("/")
    return np.array([1 if by_row == "S" else -1, 1 if by_column == "S" else -1])


def _orientations(settings: MatchSettings) -> tuple[Orientation, ...]:
    if settings.correspondence == "auto":
        return ("S/S", "S/I", "I/I")
    return (settings.correspondence,)


def _hypotheses(
    lattice: Lattice | None, rig: Rig, settings: MatchSettings
) -> Iterator[tuple[Orientation, Site, IntArray]]:
    """Label the whole grid from each site that could be the reference, each way round."""
    if lattice is None:
        return
    rows, columns = rig.pattern.rows, rig.pattern.columns
    dot = np.nonzero(lattice.row > 0)[0]
    for k0, t0 in lattice.candidates:
        for orientation in _orientations(settings):
            row_way, column_way = _ways(orientation)
            i = rig.pattern.reference[0] + row_way * (lattice.row[dot] - k0)
            j = rig.pattern.reference[1] + column_way * (lattice.column[dot] - t0)
            there = (i >= 1) & (i <= rows) & (j >= 1) & (j <= columns)
            labels = np.full((rows, columns), UNLABELLED, np.int64)
            labels[i[there] - 1, j[there] - 1] = dot[there]
            yield orientation, (k0, t0), labels


def _pursue(
    scene: Scene,
    orientation: Orientation,
    reference: Site,
    labels: IntArray,
    settings: MatchSettings,
) -> _Solution | None:
    """Follow a hypothesis to its end and count what speaks against it."""
    grown = grow_labels(scene, labels)
    pool = None if grown is None else try_fit(scene, grown)
    if grown is None or pool is None:
        return None
    lit = grown != UNLABELLED
    try:
        pool = scene.fit(grown, _witness(scene, grown, pool), FitSettings())
    except CannotMeasure:
        return None
    missed, stray = _unexplained(scene, grown, pool)
    variance = scene.covariance_mm2[grown[lit]].trace(axis1=-2, axis2=-1) / 2 + MODEL_MM**2
    surprise = np.minimum(np.sum(pool.residual_mm**2, axis=-1) / variance, settings.stray)
    cost = float(surprise.sum()) + settings.stray * stray + settings.missed * missed
    return _Solution(orientation, reference, grown, pool, cost, stray, missed)


def _unexplained(scene: Scene, labels: IntArray, pool: FittedPool) -> tuple[int, int]:
    """Count rays that should have a dot and have none, and dots that have no ray.

    Where the surface lets dots run into each other there is nothing to be told of either.
    """
    lit = labels != UNLABELLED
    among = predict(scene, pool, _amid(lit) & ~scene.absent)
    resolution = float(np.median(scene.resolution_mm))
    merged = among.spacing_mm < resolution
    rays = scene.rays[among.at[:, 0], among.at[:, 1]]
    hidden = blocked(among.points_mm, rays, scene.rig, pool)
    silent = ~lit[among.at[:, 0], among.at[:, 1]] & ~merged & ~hidden
    missed = int(np.sum(silent & scene.in_view(among.plane_mm)))
    stray = np.setdiff1d(np.arange(len(scene.plane_mm)), labels[lit])
    if merged.any() and len(stray):
        off = np.asarray(cKDTree(among.plane_mm[merged]).query(scene.plane_mm[stray])[0])
        stray = stray[off > resolution]
    return missed, len(stray)


def _amid(lit: BoolArray) -> BoolArray:
    """Rays between lit ones in their row or in their column."""
    between = np.zeros_like(lit)
    for axis in (0, 1):
        before = np.logical_or.accumulate(lit, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(lit, axis), axis=axis), axis)
        between |= before & after
    return between


def _verdict(
    scene: Scene, lattice: Lattice | None, solutions: list[_Solution], settings: MatchSettings
) -> Match:
    """Settle on the cheapest hypothesis, if nothing else comes near it."""
    if not solutions:
        if lattice is not None and not lattice.candidates:
            raise CannotMeasure("no-reference", "no hole in the rows can be the absent centre dot")
        raise CannotMeasure("no-match", "no surface explains the reflected dots")
    solutions.sort(key=lambda solution: solution.cost)
    best = solutions[0]
    count = int(np.sum(best.labels != UNLABELLED))
    if best.stray > 0.3 * len(scene.plane_mm) or best.missed > max(2, 0.15 * count):
        raise CannotMeasure(
            "no-match",
            f"the best surface leaves {best.stray} dots without a ray and {best.missed} rays "
            f"without a dot amid {count} pairs",
        )
    others = [s for s in solutions[1:] if np.any(s.labels != best.labels)]
    for other in others:
        if other.cost - best.cost < settings.margin:
            if other.orientation != best.orientation:
                raise CannotMeasure(
                    "ambiguous-orientation",
                    f"{best.orientation} and {other.orientation} explain the dots alike",
                )
            raise CannotMeasure(
                "ambiguous-rows", "several holes in the rows can be the absent centre dot"
            )
    turned = [s.residual_mm for s in others if s.orientation != best.orientation]
    at = np.argwhere(best.labels != UNLABELLED)
    dot = best.labels[at[:, 0], at[:, 1]]
    return Match(
        orientation=best.orientation,
        dot=dot,
        ray=at + 1,
        reflected=_reflected(at + 1, best.orientation),
        plane_mm=scene.plane_mm[dot],
        plane_covariance_mm2=scene.covariance_mm2[dot],
        witness=_witness(scene, best.labels, best.pool),
        trials=tuple(Trial(s.orientation, s.reference, s.residual_mm) for s in solutions),
        margin=min(turned) / max(best.residual_mm, 1e-9) if turned else float("inf"),
    )


def _reflected(ray: IntArray, orientation: Orientation) -> IntArray:
    """Reflected rows and columns (k, t) of rays, counted from 1, shape (n, 2)."""
    numbers = ray * _ways(orientation)
    return np.asarray(numbers - numbers.min(axis=0) + 1)


def _witness(scene: Scene, labels: IntArray, pool: FittedPool) -> IntArray:
    """Say which rays came back, which did not, and which cannot tell (see `Match.witness`)."""
    lit = labels != UNLABELLED
    witness = np.zeros(lit.shape, np.int64)
    around = predict(scene, pool, np.ones_like(lit))
    rays = scene.rays[around.at[:, 0], around.at[:, 1]]
    hidden = blocked(around.points_mm, rays, scene.rig, pool)
    seen = scene.in_view(around.plane_mm) & ~hidden
    witness[around.at[seen, 0], around.at[seen, 1]] = -1
    witness[_amid(lit) | scene.absent] = 0
    witness[lit] = 1
    # A dot that no ray was given may be the dot of a ray that seems dark.
    stray = np.setdiff1d(np.arange(len(scene.plane_mm)), labels[lit])
    if len(stray):
        distance = cKDTree(scene.plane_mm[stray]).query(around.plane_mm)[0]
        doubt = around.at[distance < around.spacing_mm]
        doubt = doubt[witness[doubt[:, 0], doubt[:, 1]] < 0]
        witness[doubt[:, 0], doubt[:, 1]] = 0
    return witness
