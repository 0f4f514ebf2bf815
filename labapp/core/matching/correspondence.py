"""Lattice → Match: which ray made which dot, and how sure (§4.2.2, §5.2.3, §7.1).

The absent centre dot gives the rays of a whole grid at once, for each orientation. Every such
hypothesis is followed by what the surface itself says: fit it to the dots labelled so far,
predict where every ray's dot should be, label the dots that one ray alone can have made, and fit
again until nothing changes. That finds the dots the grid left in doubt and drops the ones it got
wrong. Where rows bow too much for a grid to grow, hypotheses come from the optics instead: quadrics
whose rays round a hole fall on dots.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.images.dots import Dots
from labapp.core.match import ORIENTATIONS, Match, Orientation, Trial, ways
from labapp.core.matching.cap_search import search_caps
from labapp.core.matching.decision import (
    FAR_OFF,
    MISFIT_MM,
    MISFIT_TIMES,
    MatchSettings,
    any_explains,
    decide,
    explains,
    nearly_explains,
)
from labapp.core.matching.hypothesis import (
    Hypothesis,
    certain_witness,
    from_grid,
    grow_and_score,
    joined,
    turned,
)
from labapp.core.matching.quadric_search import search_quadrics
from labapp.core.matching.ray_growth import LEAST_LABELS, QUICK, SOFT, UNLABELLED, Scene, try_fit
from labapp.core.matching.repair import with_repaired, with_rows_beyond
from labapp.core.rows.lattice import Lattice, Site, empty_sites
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import CannotMeasure, IntArray


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
        ``too-few-dots``; ``no-reference`` if no hole can be the absent centre dot,
        ``ambiguous-rows`` if several can; ``ambiguous-orientation``; ``no-match`` if no surface
        explains the dots.
    """
    if len(dots) < LEAST_LABELS:
        raise CannotMeasure(
            "too-few-dots", f"{len(dots)} dots were found, telling rays needs {LEAST_LABELS}"
        )
    scene = Scene.of(dots, rig, calibration, frame_shape)
    orientations = settings.orientations
    found: list[Hypothesis] = []
    for way in (_by_grid, _by_placement, _by_optics):
        found = with_repaired(scene, found + way(scene, lattice, orientations))
        if any_explains(scene, found):
            break
    # Where nothing explains most dots, what is found is not mended, but caps are followed at once.
    hopeless = bool(found) and not any(nearly_explains(scene, each) for each in found)
    try:
        best = None if hopeless else _answer(scene, found, lattice, settings)
    except CannotMeasure as reason:
        if reason.status != "no-match":
            raise
        best = None
    if best is None:
        best = _answer(scene, found + _by_caps(scene), lattice, settings)
    return as_match(scene, best, best.orientation(scene))


def _answer(
    scene: Scene, found: list[Hypothesis], lattice: Lattice | None, settings: MatchSettings
) -> Hypothesis:
    """Settle on one of the hypotheses, or what one leads to; `CannotMeasure` as `match_rays`."""
    found = with_rows_beyond(scene, found)
    # Followed to its end, a hypothesis may have come round to a correspondence not asked for.
    asked = settings.orientations
    found = [hypothesis for hypothesis in found if hypothesis.orientation(scene) in asked]
    if not found:
        if scene.rig.pattern.marker is None or (lattice is not None and not lattice.candidates):
            raise CannotMeasure("no-reference", "no hole in the rows can be the absent dot")
        raise CannotMeasure("no-match", "no surface explains the reflected dots")
    return decide(scene, found, settings)


def indexed_lattice(match: Match, rig: Rig, count: int) -> Lattice:
    """Rows and columns of ``count`` dots as their rays have them.

    They index dots that the picture alone leaves in doubt, and none that the rays do not.
    """
    way, marker = ways(match.orientation), rig.pattern.marker or rig.pattern.reference
    k, t = np.array(marker) * way + (match.reflected - match.ray * way)[0]
    row, column = np.zeros((2, count), np.int64)
    row[match.dot], column[match.dot] = match.reflected.T
    # Rows that lack two or more neighbouring dots between others are blocked.
    sites = match.reflected[np.lexsort(match.reflected.T[::-1])]
    step = np.diff(sites, axis=0)
    blocked = np.unique(sites[1:, 0][(step[:, 0] == 0) & (step[:, 1] > 2)])
    site = (int(k), int(t))
    return Lattice(row, column, site, (site,), frozenset(blocked.tolist()))


def _by_grid(
    scene: Scene, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Follow the grid with the marker at each site that could be it, each way round."""
    return [] if lattice is None else _placed(scene, lattice, lattice.candidates, orientations)


def _by_placement(
    scene: Scene, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Follow the grid with the marker at each empty site, also at its rim, each way round.

    False dots, missing ones or the torch may leave the marker without three lit neighbours.
    """
    return [] if lattice is None else _placed(scene, lattice, empty_sites(lattice), orientations)


MOST_PLACES = 8
"""So many places of the marker in the grid are followed, of those that fit it best."""


def _placed(
    scene: Scene, lattice: Lattice, sites: Iterable[Site], orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Follow the grid with the marker at some of its sites, each way round."""
    pattern = scene.rig.pattern
    if pattern.marker is None:
        return []
    shape = (pattern.rows, pattern.columns)
    labelled = [
        from_grid(lattice, site, pattern.marker, orientation, shape)
        for site, orientation in product(sites, orientations)
    ]
    quick = _fitting(scene, labelled, QUICK)[: 2 * MOST_PLACES]
    labelled = [labels for off_mm, labels in quick if off_mm <= FAR_OFF * quick[0][0]]
    rough = _fitting(scene, labelled, SOFT)[:MOST_PLACES]
    most_mm = max(MISFIT_MM, MISFIT_TIMES * rough[0][0]) if rough else 0.0
    scored = (grow_and_score(scene, labels) for off_mm, labels in rough if off_mm < most_mm)
    return [hypothesis for hypothesis in scored if hypothesis is not None]


def _fitting(
    scene: Scene, labelled: list[IntArray], settings: FitSettings
) -> list[tuple[float, IntArray]]:
    """Sort labels by the residuals that the surface through them leaves, mm, the least first."""
    pools = ((try_fit(scene, labels, settings), labels) for labels in labelled)
    found = [(pool.residual_rms_mm, labels) for pool, labels in pools if pool is not None]
    return sorted(found, key=lambda one: one[0])


def _by_caps(scene: Scene) -> list[Hypothesis]:
    """Follow the caps that the dots lie on best, and mend what each leaves unexplained."""
    found: list[Hypothesis] = []
    for labels in search_caps(scene):
        hypothesis = grow_and_score(scene, labels)
        found += with_repaired(scene, [hypothesis]) if hypothesis is not None else []
        if any_explains(scene, found):
            break
    return found


def _by_optics(
    scene: Scene, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Follow the quadrics that explain the dots round some hole, with the grid's help."""
    found = []
    for guess in search_quadrics(scene):
        hypothesis = grow_and_score(scene, guess.labels)
        if hypothesis is None:
            continue
        found.append(hypothesis)
        if lattice is not None:
            labels = joined(hypothesis, lattice, hypothesis.orientation(scene))
            wider = None if labels is None else grow_and_score(scene, labels)
            found += [wider] if wider is not None else []
        if explains(scene, hypothesis):
            break
    return found


def as_match(
    scene: Scene, best: Hypothesis, own: Orientation, reference: Site | None = None
) -> Match:
    """Write a hypothesis down; reflected numbers from 1, or so that the reference has its own."""
    trials = [Trial(own, best.residual_mm)]
    for orientation in ORIENTATIONS:
        if orientation != own:
            other = try_fit(scene, turned(scene, best.labels, own, orientation))
            trials.append(Trial(orientation, np.inf if other is None else other.residual_rms_mm))
    at = np.argwhere(best.labels != UNLABELLED)
    dot = best.labels[at[:, 0], at[:, 1]]
    trials.sort(key=lambda trial: trial.residual_mm)
    return match_of(scene, at, dot, own, certain_witness(scene, best), trials, reference)


def match_of(
    scene: Scene,
    at: IntArray,
    dot: IntArray,
    orientation: Orientation,
    witness: IntArray,
    trials: Iterable[Trial],
    reference: Site | None = None,
) -> Match:
    """Build the match of rays, rows and columns counted from 0, shape (n, 2), with dots, (n,)."""
    pattern = scene.rig.pattern
    numbers = (at + 1 - (pattern.marker or pattern.reference)) * ways(orientation)
    least = numbers.min(axis=0)
    numbers += 1 - least if reference is None else np.maximum(reference, 1 - least)
    return Match(
        orientation=orientation,
        dot=dot,
        ray=at + 1,
        reflected=numbers,
        plane_mm=scene.plane_mm[dot],
        plane_covariance_mm2=scene.covariance_mm2[dot],
        witness=witness,
        trials=tuple(trials),
    )
