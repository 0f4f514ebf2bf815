"""Dots and rays that a hypothesis leaves unexplained: whether it is accepted in spite of them."""

from __future__ import annotations

import cv2
import numpy as np

from labapp.core.matching.free_setup import SETUP_GAIN, with_setup_free
from labapp.core.matching.hypothesis import KNOT_ERROR_MM, USUAL_FIT, Hypothesis
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import UNLABELLED, Observation, count_labels
from labapp.core.surface.level import KnownRays
from labapp.core.surface.pool_fit import FittedPool
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

FEW_LEFT = 0.05
"""A hypothesis explains a frame if at most this share of the dots is stray, and as few rays are
missed."""

MOST_STRAY = 0.5
"""If a larger share of the dots is stray, a hypothesis is not repaired; another one is searched
for.
"""

CONTRADICTED_BITS = 0.36
"""Mean −log₂ likelihood of the rays near the boundary above which the surface is rejected. It was
less than 0.12 with the correct set-up, less than 0.33 with one that is wrong within its ±, more
than 1 if the labels are wrong for that reason, and 0.35 to 0.49 where the dots beyond a line were
hidden: these rays seem to land outside the pool, which then is 15 to 30 % too low."""

CONTRADICTED, BY_LIT, MOST_OF_A_RAY = 1.2, 0.35, 0.3
"""A surface is rejected if rays contradict its boundary by more than the first in all, and lit rays
by more than the second: the sum of how far they land on the wrong side, beyond 1 σ of the height,
in units of the change of the height from one ray to the next. One ray counts by the third at most,
as its dot may be false or missing. Where the dots beyond a line were hidden, 8 of 12 frames that
were not rejected otherwise exceeded both, among them 4 of the 5 whose height was off by over 3 σ.
None did of 82 rendered frames of all kinds, and of 140 with 5 % of the dots missing and 12 false
ones. Without the second limit pools with a few dark rays side by side were rejected."""

NO_BOUNDARY = (
    "no boundary of the best surface separates the rays that came back from those that did not: "
    "is the set-up correct, and does nothing hide dots?"
)
"""Reason for ``no-match`` if rays near the boundary contradict it."""

NOTHING_EXPLAINS = "no surface explains the reflected dots"
"""Reason for ``no-match`` if most of the dots have no ray."""

PAIR, ROW = 2, 4
"""Up to the first number of adjacent missed rays, or of stray dots in line, is not taken for a row;
the second number of stray dots in line is."""

BEYOND_STEPS, BETWEEN_STEPS = 0.45, 0.2
"""A stray dot continues the labels within these distances of its expected place: beyond the last
dot of a row or column, as a share of the last step; between two dots, as a share of their distance.
Of the outermost dots of 240 pools less than 1 % lie farther from where the next ones lead, and 4 to
7 % if the pool has waves or a dent."""

FEW_SCATTERED, MOST_SCATTERED, MOST_SCATTERED_AT_LAST, MOST_SCATTERED_OF_ALL = 0.2, 0.3, 0.38, 0.9
"""Largest share of stray dots and missed rays together, relative to the labelled dots, that is
accepted if they are isolated: false dots and random failures are isolated, whereas the dots of a
row that was omitted or skipped are not. The third applies when every kind of initial labels has
been tried, the fourth when no likelier set-up explains more. With at most the first share no other
kind is tried (`suffices`)."""

MOST_MISSED_APART = 0.12
"""Largest share of isolated missed rays, relative to the labelled dots, with which a hypothesis
explains a frame."""

MOST_IN_DOUBT = 0.2
"""Largest share of missed rays, relative to the labelled dots, after doubtful labels are removed.
In 400 frames of pools of all kinds, measured correctly, it was at most 0.12; with a steep hump it
was 0.27, and the height was off by 5 σ."""


def few_left(observed: Observation) -> float:
    """Largest number of stray dots with which a hypothesis explains a frame."""
    return max(2, FEW_LEFT * len(observed.plane_mm))


def explains(observed: Observation, hypothesis: Hypothesis) -> bool:
    """Whether there are few stray dots, few and isolated missed rays, and no dot at the marker."""
    few = few_left(observed)
    apart = _missed_lie_apart(hypothesis.labels, hypothesis.missed_rays)
    most = MOST_MISSED_APART * hypothesis.label_count if apart else 0.0
    missed = hypothesis.missed_count <= max(few, most)
    return hypothesis.stray_count <= few and missed and hypothesis.marker != "lit"


def suffices(observed: Observation, hypothesis: Hypothesis) -> bool:
    """Whether a hypothesis `explains` the frame, perhaps but for a few isolated dots and rays.

    Other kinds of initial labels are then not tried.
    """
    return explains(observed, hypothesis) or (
        hypothesis.residual_rms_mm < KNOT_ERROR_MM
        and _leaves_isolated(hypothesis, FEW_SCATTERED)
        and _strays_in_line(observed, hypothesis.labels, hypothesis.stray_dots) <= PAIR
    )


def explains_half(observed: Observation, hypothesis: Hypothesis) -> bool:
    """Whether most dots have a ray; the rest may be a row, or a dip."""
    return hypothesis.stray_count <= MOST_STRAY * len(observed.plane_mm)


def any_explains(observed: Observation, found: list[Hypothesis]) -> bool:
    """Whether one of several hypotheses `explains` the frame."""
    return any(explains(observed, hypothesis) for hypothesis in found)


def refuse_unexplained(
    observed: Observation, best: Hypothesis, settings: MatchSettings, most_scattered: float
) -> None:
    """Raise ``no-match`` if too much is left unexplained, or what is left may be a row.

    ``most_scattered`` is the largest accepted share of isolated strays and missed rays, such as
    `MOST_SCATTERED`.
    """
    few = best.stray_count <= settings.most_strays(best.label_count + best.stray_count)
    scattered = _leaves_isolated(best, most_scattered) and (
        few or _strays_in_line(observed, best.labels, best.stray_dots) < ROW
    )
    if not explains_half(observed, best):
        raise CannotMeasure("no-match", NOTHING_EXPLAINS)
    if not scattered and settings.leaves_much(best):
        raise CannotMeasure(
            "no-match",
            f"the best surface leaves {_counted(best.stray_count, 'dot')} without a ray and "
            f"{_counted(best.missed_count, 'ray')} without a dot among {best.label_count} pairs"
            f"{_doubt_of_setup(observed, best)}",
        )
    if best.pool.level.ray_count and best.pool.level.disagreement_bits > CONTRADICTED_BITS:
        raise CannotMeasure("no-match", NO_BOUNDARY)


def refuse_much_in_doubt(best: Hypothesis, before: IntArray) -> None:
    """Raise ``no-match`` if so many labels were removed that the surface is not well known.

    ``before`` are the labels before, shape (rows, columns).
    """
    removed = int(np.count_nonzero((before != UNLABELLED) & (best.labels == UNLABELLED)))
    if max(best.missed_count, removed) > MOST_IN_DOUBT * best.label_count:
        raise CannotMeasure(
            "no-match",
            f"the best surface supports the rays of {best.label_count} dots only: those of "
            f"{removed} others are in doubt, and {best.missed_count} rays between them have no dot",
        )


def is_scattered(
    observed: Observation, labels: IntArray, missed_rays: IntArray, stray_dots: IntArray
) -> bool:
    """Whether strays and missed rays are isolated, and at most `MOST_SCATTERED` of the labels.

    Parameters are those of `Hypothesis`; its marker must be empty.
    """
    few = len(stray_dots) + len(missed_rays) <= MOST_SCATTERED * count_labels(labels)
    return (
        few
        and _missed_lie_apart(labels, missed_rays)
        and _strays_in_line(observed, labels, stray_dots) < ROW
    )


def refuse_contradicted(rays: KnownRays, pool: FittedPool) -> None:
    """Raise ``no-match`` if rays that came back contradict the boundary, or those that did not.

    Where something hides dots, their rays seem to land outside, and the pool is too low.

    Parameters
    ----------
    rays
        The rays known to be lit or dark, with the uncertainty of the surface's height there.
    pool
        The surface and its level.
    """
    bits = pool.level.disagreement_bits if pool.level.ray_count else 0.0
    by_lit, by_dark = _contradictions(rays, pool)
    if bits > CONTRADICTED_BITS or (by_lit > BY_LIT and by_lit + by_dark > CONTRADICTED):
        raise CannotMeasure("no-match", NO_BOUNDARY)


def _contradictions(rays: KnownRays, pool: FittedPool) -> tuple[float, float]:
    """Sums of how far lit rays land outside the boundary, and dark ones inside (`CONTRADICTED`)."""
    rise_mm = pool.level.rise_mm
    if not rise_mm or not len(rays.ray_states) or rays.height_sigma_mm is None:
        return 0.0, 0.0
    surface, level = pool.surface, pool.level
    inside_mm = rays.surface_there(surface.basis, surface.coefficients, level)[2]
    beyond_mm = -rays.ray_states * inside_mm - rays.height_sigma_mm
    by_ray = np.minimum(np.maximum(beyond_mm / rise_mm, 0.0), MOST_OF_A_RAY)
    by_lit = float(by_ray @ (rays.ray_states > 0))
    return by_lit, float(by_ray.sum()) - by_lit


def _doubt_of_setup(observed: Observation, best: Hypothesis) -> str:
    """Return the end of the reason for a rejection that another set-up would avoid, or nothing."""
    freed = with_setup_free(observed, best, USUAL_FIT)
    if freed.gain <= SETUP_GAIN:
        return ""
    count = np.sum(freed.labels != UNLABELLED)
    explained = f"{count} of {len(observed.plane_mm)} dots would have a ray"
    return f"; with another set-up {explained}: is the set-up correct?"


def _leaves_isolated(hypothesis: Hypothesis, most: float) -> bool:
    """Whether little is left unexplained, a share of the labels at most, and missed rays lie apart.

    Adjacent missed rays are a hole or a row: stray dots may then be their dots.
    """
    left = hypothesis.stray_count + hypothesis.missed_count
    few = left <= most * hypothesis.label_count
    apart = _missed_lie_apart(hypothesis.labels, hypothesis.missed_rays)
    return few and hypothesis.marker == "empty" and apart


def _missed_lie_apart(labels: IntArray, missed_rays: IntArray) -> bool:
    """Whether at most `PAIR` missed rays are connected, or one more around a corner."""
    seen = np.zeros(labels.shape, np.uint8)
    seen[tuple(missed_rays.T)] = 1
    found = cv2.connectedComponentsWithStats(seen, connectivity=4)[2][1:]
    count, sides = found[:, cv2.CC_STAT_AREA], found[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    return bool((count <= PAIR + (sides == PAIR).all(axis=1)).all())


def _strays_in_line(observed: Observation, labels: IntArray, stray_dots: IntArray) -> int:
    """Largest number of stray dots side by side that continue the labelled rows and columns.

    An omitted row lies where the labelled dots beside it lead, by equal steps or by steps that
    change equally; a skipped one lies half-way between two labelled dots. False dots elsewhere are
    not taken for a row, however many there are.
    """
    labelled = labels != UNLABELLED
    place = np.full((*np.add(labelled.shape, 6), 2), np.nan)
    place[3:-3, 3:-3][labelled] = observed.plane_mm[labels[labelled]]
    stray = observed.plane_mm[stray_dots]
    return max(_most_in_line(along, stray) for along in (place, place.swapaxes(0, 1)))


def _most_in_line(place: FloatArray, stray_mm: FloatArray) -> int:
    """As `_strays_in_line`, for rows; labelled dots, shape (rows, columns, 2), mm, else NaN."""
    # The absent dot, or a missing one, does not divide the row beyond it.
    beside = (np.roll(place, 1, 1) + np.roll(place, -1, 1)) / 2
    known = np.where(np.isnan(place), beside, place)
    after = np.roll(place, 1, 0)
    between = _near(stray_mm, (place + after) / 2, BETWEEN_STEPS * (place - after))
    near = between | np.roll(between, -1, 0)  # a skipped row is either of the two
    for step in (1, -1):
        last, second, third = (np.roll(known, by * step, 0) for by in (1, 2, 3))
        radius = BEYOND_STEPS * (last - second)
        beyond = _near(stray_mm, 2 * last - second, radius)
        beyond |= _near(stray_mm, 3 * (last - second) + third, radius)
        near |= beyond & np.isnan(known[..., :1])
    most = 0
    for row in near[near.any(axis=(1, 2))]:
        parts = np.split(row, np.flatnonzero(~row.any(axis=1)))
        most = max(most, *(int(part.any(axis=0).sum()) for part in parts))
    return most


def _near(stray_mm: FloatArray, expected_mm: FloatArray, radius_mm: FloatArray) -> BoolArray:
    """Mask of the stray dots, shape (s, 2), near expected places, shape (rows, columns, s).

    The places and the vectors as long as the radii have the shape (rows, columns, 2).
    """
    off = np.linalg.norm(expected_mm[..., None, :] - stray_mm, axis=-1)
    return np.asarray(off <= np.linalg.norm(radius_mm, axis=-1)[..., None])


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'s' * (count != 1)}"
