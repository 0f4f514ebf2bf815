"""The dissertation's two searches for rows and columns: by neighbours (§5.2.2), by masks (§5.3).

Both use x to the right and z up, that is (u, −v) in px, instead of the text's imaging plane
coordinates; this is sufficient for its angles and orders. Where the text leaves a choice, a dot in
doubt gets no row and column rather than wrong ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import scipy

from labapp.core.images.dots import Dots
from labapp.core.rows.lattice import Lattice
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

Row = IntArray
"""Indices of one row's dots, from left to right."""


@dataclass(frozen=True)
class RowSearchSettings:
    """Settings of the search of §5.2.2.

    Parameters
    ----------
    row_angle_deg
        A row ends where the line to the next dot is steeper than this (Fig. 5-14).
    row_turn_deg
        A row ends where its direction changes by more than this from one dot to the next.
    column_angle_deg
        Dots of neighbouring rows are in one column only if the line through them is within this
        angle of the vertical (Fig. 5-17).
    column_gate
        A row gets columns only if the horizontal offset of its most vertical line is at most this
        fraction of its step; otherwise the columns may be wrong by one.
    reference_columns
        Number of middle columns of the longest row that determine blocked rows and the reference.
    least_dots
        Least number of dots of a row; a single dot has no row angle to check.
    """

    row_angle_deg: float = 60.0
    row_turn_deg: float = 90.0
    column_angle_deg: float = 40.0
    column_gate: float = 0.3
    reference_columns: int = 3
    least_dots: int = 2


@dataclass(frozen=True)
class MaskRowsSettings:
    """The masks of §5.3 in units of the dots' median distance to their nearest neighbour.

    Parameters
    ----------
    oblique_deg
        Slope of the two structuring elements of Fig. 5-26: up to the right in the left half of
        the pattern, down to the right in the right half, as in convex arcs.
    length, thickness
        Their length and thickness.
    widening
        Width by which the result is dilated further to form the masks (Fig. 5-27 b).
    close_rows
        Two regions side by side are one row if their facing ends differ in height by less than
        this.
    reference_gap
        Such a row has the reference if the gap between its two masks, which extend half a step
        beyond their last dots, is below this many steps; otherwise it is blocked. A step is the
        mean horizontal distance of the row's dots.
    row_angle_deg
        A region with a step steeper than this contains more than one row.
    line_gate
        A position in a row is in the reference column if it is within this fraction of the row's
        step from the vertical line.
    least_dots
        Least number of dots of a row.
    """

    oblique_deg: float = 20.0
    length: float = 1.2
    thickness: float = 0.3
    widening: float = 0.3
    close_rows: float = 0.6
    reference_gap: float = 1.5
    row_angle_deg: float = 60.0
    line_gate: float = 0.3
    least_dots: int = 2


def search_rows(dots: Dots, settings: RowSearchSettings) -> Lattice:
    """Find rows by nearest neighbours, columns by column angles (§5.2.2, Fig. 5-13 … 5-19).

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` without two dots, ``no-rows`` if no two dots form a row.
    """
    place = _places(dots)
    rows = [row for row in _neighbour_rows(place, settings) if len(row) >= settings.least_dots]
    if not rows:
        raise CannotMeasure("no-rows", "No two of the dots form a row.")
    rows = _stacked(place, rows)
    longest = int(np.argmax([len(row) for row in rows]))
    columns = [np.zeros(len(row), np.int64) for row in rows]
    columns[longest] = np.arange(1, len(rows[longest]) + 1)
    for direction in (1, -1):
        known = longest
        end = len(rows) if direction > 0 else -1
        for k in range(longest + direction, end, direction):
            columns[k] = _columns_by_angle(
                place[rows[k]], place[rows[known]], columns[known], settings
            )
            if columns[k].any():
                known = k

    middle = _middle_columns(len(rows[longest]), settings.reference_columns)
    present = np.array([np.isin(middle, found) for found in columns])
    missing = (~present).sum(axis=1)
    placed = np.array([found.any() for found in columns])
    blocked = frozenset(int(k) + 1 for k in np.flatnonzero(placed & (missing > 1)))
    candidates = [
        (int(k) + 1, int(middle[np.argmin(present[k])]))
        for k in np.flatnonzero(missing == 1)
        if _inside(int(middle[np.argmin(present[k])]), columns[k])
    ]
    # "If two or more rows are available, the row with missing point in the center is chosen."
    centre = int(middle[len(middle) // 2])
    candidates.sort(key=lambda site: (site[1] != centre, site))
    preferred = [site for site in candidates if site[1] == centre] or candidates
    reference = preferred[0] if len(preferred) == 1 else None
    return _lattice(len(dots), rows, columns, reference, candidates, blocked)


def mask_rows(dots: Dots, frame_shape: tuple[int, int], settings: MaskRowsSettings) -> Lattice:
    """Find rows by dilated masks, columns from a vertical line (§5.3, Fig. 5-25 … 5-28).

    Parameters
    ----------
    frame_shape
        (rows, columns) of that frame, px.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` without two dots, ``no-rows`` if no two dots form a row.
    """
    place = _places(dots)
    distance = np.asarray(scipy.spatial.cKDTree(place).query(place, k=2)[0])[:, 1]
    spacing = max(float(np.median(distance)), 1.0)
    labels = _row_masks(place, frame_shape, spacing, settings)
    parts = _regions(place, labels, settings)
    if not parts:
        raise CannotMeasure("no-rows", "No two of the dots form a row.")
    rows, with_reference, split = _join_parts(place, parts, spacing, settings)
    order = np.argsort([float(place[row, 1].max()) for row in rows])
    rows = [rows[k] for k in order]
    blocked = frozenset(int(k) + 1 for k, was in enumerate(order) if was in split)
    holes = [(int(k), with_reference[was]) for k, was in enumerate(order) if was in with_reference]
    columns, sites = _columns_by_line(place, rows, holes, settings)
    reference = sites[0] if len(sites) == 1 else None
    return _lattice(len(dots), rows, columns, reference, sites, blocked)


def _places(dots: Dots) -> FloatArray:
    """(x, z) of each dot, shape (n, 2), px: x right, z up."""
    if len(dots) < 2:
        raise CannotMeasure("too-few-dots", f"{len(dots)} dots form no rows.")
    return np.stack([dots.u_px, -dots.v_px], axis=-1)


# --- §5.2.2 -----------------------------------------------------------------------------------


def _neighbour_rows(place: FloatArray, settings: RowSearchSettings) -> list[Row]:
    """Form rows: from the leftmost remaining dot repeatedly to the nearest on its right."""
    left_over = np.ones(len(place), bool)
    rows = []
    while left_over.any():
        begin = np.flatnonzero(left_over)
        dot = int(begin[np.argmin(place[begin, 0])])
        row, angle = [dot], None
        left_over[dot] = False
        while True:
            right = np.flatnonzero(left_over & (place[:, 0] > place[dot, 0]))
            if right.size == 0:
                break
            step = place[right] - place[dot]
            nearest = int(np.argmin(np.hypot(*step.T)))
            next_angle = float(np.degrees(np.arctan2(step[nearest, 1], step[nearest, 0])))
            turns = angle is not None and abs(next_angle - angle) >= settings.row_turn_deg
            if abs(next_angle) >= settings.row_angle_deg or turns:
                break
            dot, angle = int(right[nearest]), next_angle
            row.append(dot)
            left_over[dot] = False
        rows.append(np.array(row))
    return rows


def _stacked(place: FloatArray, rows: list[Row]) -> list[Row]:
    """Select the rows, from the bottom up, that lie above one another, from the longest outwards.

    The first that is not entirely above (below) the previous one, or overlaps it horizontally with
    fewer than half of the dots of either, is a fragment of a row or a mixture of rows. It and all
    rows beyond it are in doubt, since their numbers would be wrong.
    """
    rows = sorted(rows, key=lambda row: float(place[row, 1].max()))
    longest = int(np.argmax([len(row) for row in rows]))
    first = last = longest
    while last + 1 < len(rows) and _above(place[rows[last + 1]], place[rows[last]]):
        last += 1
    while first > 0 and _above(place[rows[first]], place[rows[first - 1]]):
        first -= 1
    return rows[first : last + 1]


def _above(upper: FloatArray, lower: FloatArray) -> bool:
    """Whether a row is above another throughout their common range, which must be long enough."""
    over = (upper[:, 0] >= lower[0, 0]) & (upper[:, 0] <= lower[-1, 0])
    under = (lower[:, 0] >= upper[0, 0]) & (lower[:, 0] <= upper[-1, 0])
    if max(over.mean(), under.mean()) < 0.5:
        return False
    height = upper[over, 1] - np.interp(upper[over, 0], lower[:, 0], lower[:, 1])
    depth = np.interp(lower[under, 0], upper[:, 0], upper[:, 1]) - lower[under, 1]
    return bool((height > 0).all() and (depth > 0).all())


def _columns_by_angle(
    row: FloatArray, known: FloatArray, known_columns: IntArray, settings: RowSearchSettings
) -> IntArray:
    """Columns of a row's dots, shape (n,), from the most nearly vertical lines to a known row.

    Two dots are a pair if each is the other's most nearly vertical neighbour. From the most nearly
    vertical pair the columns are counted outwards as long as counts and pairs agree; a dot without
    a pair gets the counted column if it is between two that agree.
    """
    step = row[:, None] - known[None]
    lean = np.degrees(np.arctan2(np.abs(step[..., 0]), np.abs(step[..., 1])))
    lean[:, known_columns == 0] = np.inf
    best = lean.argmin(axis=1)
    dot = np.arange(len(row))
    paired = (lean[:, best].argmin(axis=0) == dot) & (lean[dot, best] <= settings.column_angle_deg)
    if not paired.any():
        return np.zeros(len(row), np.int64)
    anchor = int(np.argmin(np.where(paired, lean[dot, best], np.inf)))
    counted, sure = _counted(row[:, 0], anchor)
    counted += known_columns[best[anchor]]
    wrong = ~sure | (paired & (known_columns[best] != counted))
    agreed = paired.copy()
    for side in (dot[anchor:], dot[anchor::-1]):
        agreed[side[np.cumsum(wrong[side]) > 0]] = False
    drift = abs(step[anchor, best[anchor], 0])
    if agreed.sum() < 2 or drift > settings.column_gate * float(np.median(np.diff(row[:, 0]))):
        return np.zeros(len(row), np.int64)
    first, last = np.flatnonzero(agreed)[[0, -1]]
    # Columns below 1 are left of the longest row, and in doubt as are dots beyond its ends.
    within = (dot >= first) & (dot <= last) & (counted > 0)
    return np.where(within, counted, 0)


def _counted(x: FloatArray, anchor: int) -> tuple[IntArray, BoolArray]:
    """Columns relative to the anchor by counting along a row, and which are certain; shape (n,).

    A step is as many columns as its ratio to the median neighbouring step, rounded; beyond a step
    whose ratio is not near an integer, the count is uncertain.
    """
    gap = np.diff(x)
    jump, whole = np.ones(len(gap), np.int64), np.ones(len(gap), bool)
    for i in range(len(gap)):
        beside = np.delete(gap[max(i - 2, 0) : i + 3], min(i, 2))
        if beside.size:
            ratio = gap[i] / max(float(np.median(beside)), 1e-9)
            jump[i] = max(1, round(ratio))
            whole[i] = ratio < 1.0 or abs(ratio - round(ratio)) < 0.35
    count = np.concatenate([[0], np.cumsum(jump)])
    doubts = np.concatenate([[0], np.cumsum(~whole)])
    return np.asarray(count - count[anchor]), np.asarray(doubts == doubts[anchor])


def _middle_columns(length: int, count: int) -> IntArray:
    """Return the middle columns of a row of this many dots, counted from 1."""
    first = (length - min(count, length)) // 2 + 1
    return np.arange(first, first + min(count, length))


def _inside(column: int, columns: IntArray) -> bool:
    placed = columns[columns != 0]
    return bool((placed < column).any() and (placed > column).any())


# --- §5.3 -------------------------------------------------------------------------------------


def _row_masks(
    place: FloatArray, frame_shape: tuple[int, int], spacing: float, settings: MaskRowsSettings
) -> npt.NDArray[np.int32]:
    """Connected row masks, labelled from 1 (Fig. 5-27)."""
    element = _oblique_element(spacing, settings)
    masks = np.zeros(frame_shape, np.uint8)
    # The halves are those of the pattern, which need not be in the middle of the picture.
    middle = float(np.median(place[:, 0]))
    pixels = np.round(place * (1, -1)).astype(int)
    pixels = np.clip(pixels, 0, (frame_shape[1] - 1, frame_shape[0] - 1))
    for half, shape in [
        (place[:, 0] < middle, element),
        (place[:, 0] >= middle, np.ascontiguousarray(element[::-1])),
    ]:
        points = np.zeros(frame_shape, np.uint8)
        points[pixels[half, 1], pixels[half, 0]] = 1
        masks |= np.asarray(cv2.dilate(points, shape), np.uint8)
    widening = np.ones((3, 2 * int(settings.widening * spacing / 2.0) + 1), np.uint8)
    _, labels = cv2.connectedComponents(cv2.dilate(masks, widening), connectivity=8)
    return np.asarray(labels, np.int32)


def _oblique_element(spacing: float, settings: MaskRowsSettings) -> npt.NDArray[np.uint8]:
    """Structuring element of the left half: a thick line up to the right."""
    half_length = settings.length * spacing / 2.0
    reach = int(np.ceil(half_length + settings.thickness * spacing)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    slope = np.radians(settings.oblique_deg)
    along = x * np.cos(slope) - y * np.sin(slope)
    across = x * np.sin(slope) + y * np.cos(slope)
    half_width = max(settings.thickness * spacing / 2.0, 1.0)
    inside = (np.abs(along) <= half_length) & (np.abs(across) <= half_width)
    return np.asarray(inside, np.uint8)


def _regions(
    place: FloatArray, labels: npt.NDArray[np.int32], settings: MaskRowsSettings
) -> list[Row]:
    """Dots of each mask with a single row; dots of merged rows are left in doubt."""
    height, width = labels.shape
    u = np.clip(np.round(place[:, 0]).astype(int), 0, width - 1)
    v = np.clip(np.round(-place[:, 1]).astype(int), 0, height - 1)
    region = labels[v, u]
    rows = []
    for label in np.unique(region[region > 0]):
        row = np.flatnonzero(region == label)
        row = row[np.argsort(place[row, 0])]
        step = np.diff(place[row], axis=0)
        steep = np.abs(step[:, 1]) > np.tan(np.radians(settings.row_angle_deg)) * step[:, 0]
        if len(row) >= settings.least_dots and not steep.any():
            rows.append(row)
    return rows


def _join_parts(
    place: FloatArray, parts: list[Row], spacing: float, settings: MaskRowsSettings
) -> tuple[list[Row], dict[int, int], set[int]]:
    """Join masks that are one row with a gap.

    Returns
    -------
    rows
        Rows of dots.
    with_reference
        Row → number of its dots left of the missing reference.
    blocked
        Rows with a wider gap.

    A missing reference leaves two steps between the facing dots, so the text's limit of 1.5
    steps cannot be meant between dots. It is taken between the masks, each of which reaches half
    a step beyond its last dot: 1 step is clear where one dot is missing, 2 where two are.
    """
    pairs = []
    for a, first in enumerate(parts):
        for b, second in enumerate(parts):
            step = place[second[0]] - place[first[-1]]
            if a != b and step[0] > 0 and abs(step[1]) < settings.close_rows * spacing:
                pairs.append((float(step[0]), a, b))
    rows: list[Row] = []
    with_reference: dict[int, int] = {}
    blocked: set[int] = set()
    used: set[int] = set()
    for gap, a, b in sorted(pairs):
        if a in used or b in used:
            continue
        used |= {a, b}
        first, second = parts[a], parts[b]
        steps = np.concatenate([np.diff(place[first, 0]), np.diff(place[second, 0])])
        if gap - steps.mean() < settings.reference_gap * steps.mean():
            with_reference[len(rows)] = len(first)
        else:
            blocked.add(len(rows))
        rows.append(np.concatenate([first, second]))
    rows += [part for k, part in enumerate(parts) if k not in used]
    return rows, with_reference, blocked


def _columns_by_line(
    place: FloatArray,
    rows: list[Row],
    holes: list[tuple[int, int]],
    settings: MaskRowsSettings,
) -> tuple[list[IntArray], list[tuple[int, int]]]:
    """Assign columns by a vertical line through the middle of the reference row, then by counting.

    The line passes through the missing dot, midway between its neighbours, where the columns of the
    pattern are vertical; columns to either side are inclined. Without a reference row, the row with
    most dots is used. ``holes`` are the rows with a missing dot and the number of dots left of it;
    their sites (k, t) are returned too.

    A row must cross the line at one of its dots or at a missing dot. If it does not, or ends before
    the line, that row and those beyond it are in doubt, since their columns may be wrong by one.
    """
    if holes:
        base, before = holes[0]
        line = float(place[rows[base][before - 1 : before + 1], 0].mean())
    else:
        base = int(np.argmax([len(row) for row in rows]))
        line = float(place[rows[base][len(rows[base]) // 2], 0])
    numbers = [np.zeros(len(row), np.int64) for row in rows]
    sure = [np.zeros(len(row), bool) for row in rows]
    for way in (range(base, len(rows)), range(base - 1, -1, -1)):
        for k in way:
            x = place[rows[k], 0]
            counted, certain = _counted(x, int(np.argmin(np.abs(x - line))))
            crossing = float(np.interp(line, x, counted, left=np.nan, right=np.nan))
            if not abs(crossing - np.round(crossing)) <= settings.line_gate:
                break
            numbers[k], sure[k] = counted - round(crossing), certain
    left = min((int(n[s].min()) for n, s in zip(numbers, sure, strict=True) if s.any()), default=1)
    columns = [np.where(s, n - left + 1, 0) for n, s in zip(numbers, sure, strict=True)]
    sites = [
        (k + 1, int(columns[k][before - 1]) + 1) for k, before in holes if columns[k][before - 1]
    ]
    return columns, sites


def _lattice(
    count: int,
    rows: list[Row],
    columns: list[IntArray],
    reference: tuple[int, int] | None,
    candidates: list[tuple[int, int]],
    blocked: frozenset[int],
) -> Lattice:
    row_of, column_of = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for k, (row, found) in enumerate(zip(rows, columns, strict=True), start=1):
        placed = found != 0
        row_of[row[placed]] = k
        column_of[row[placed]] = found[placed]
    return Lattice(row_of, column_of, reference, tuple(candidates), blocked)
