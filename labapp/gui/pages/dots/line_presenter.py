"""Data of the dots page for a frame of a line pattern. Without Qt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.lines.correction import LineCorrection
from labapp.core.lines.detection.find_lines import LightLine
from labapp.core.lines.detection.numbering import LinesSeen
from labapp.core.lines.frame import LineFrame
from labapp.core.values import BoolArray, FloatArray, IntArray
from labapp.errors import InputError
from labapp.gui.digits import ResultRow
from labapp.session.results.measured import CORRECTION_CHANGED
from labapp.session.session import Session
from labapp.text import pluralize

STATUSES = {
    "ok": "The lines determine the surface",
    "profile": "The lines leave a direction of the surface open: a profile, no height",
    "no-lines": "No line is seen",
    "folded-lines": "The pool focuses the lines to points: they can be counted, but show no shape",
    "too-few-lines": "One line alone determines no surface",
    "followed": "The line is followed",
    "pulse": "A current pulse is brighter than the line",
    "line-lost": "The line is not where it is expected",
    "line-numbers": "More lines than the pattern has, or their numbers do not follow each other",
}


@dataclass(frozen=True)
class DrawnLine:
    """A line to draw."""

    name: str
    """Its number in the pattern; in brackets its position from the lowest up if that is unsure;
    a dash for a folded line beside numbered ones."""
    image_px: FloatArray
    """(u, v) of its ridge, shape (n, 2), px."""
    ends_px: FloatArray
    """(u, v) of its ends, shape (2, 2), px."""
    cut: BoolArray
    """Whether each end is at the edge of the picture, shape (2,)."""
    folded: bool


@dataclass(frozen=True)
class LinesState:
    """Data shown for one frame."""

    words: str
    """Text describing the frame, one or two sentences."""
    lines: tuple[DrawnLine, ...] = ()
    """Lines from the lowest in the picture up."""
    listed: tuple[tuple[str, ...], ...] = ()
    """Row of the list for each line, from the top of the picture down, see `COLUMNS`."""
    rows: tuple[ResultRow, ...] = ()
    """Results for the lines and the pool."""
    why: str = ""
    """Reason why there is no surface or the result is stale; empty if neither."""
    correction: LineCorrection | None = None
    """Start of an edit; None if no lines are known."""
    by_hand: bool = False
    """Whether the lines were corrected by hand."""
    due: bool = False
    """Whether they must be measured again after a correction."""


COLUMNS = ("Line", "Length, px", "Width, px", "Gap, px", "Ends")
"""Columns of the list of lines."""


def show_lines(session: Session, frame: int) -> LinesState:
    """Data of a frame: its corrected or measured lines."""
    correction = session.line_correction(frame)
    try:
        result = session.result(frame)
    except InputError as error:
        return LinesState("This frame's result is damaged.", why=f"{error}; measure it again")
    due = result is None or CORRECTION_CHANGED in result.stale
    if correction is not None and due:
        words = f"Corrected by hand: {_count(correction.seen)}. Not measured yet."
        names = _places(correction.number)
        return _with_lines(LinesState(words, correction=correction), names, by_hand=True, due=True)
    if result is None:
        return LinesState("This frame is not measured yet: measure it to see its lines.")
    found = result.measurement.lines
    if found is None:  # a pattern of dots, or a frame that could not be read
        why = result.measurement.reason or "; ".join(result.stale)
        return LinesState("No lines were looked for in this frame: measure it.", why=why)
    if np.isfinite(found.pulse):
        return _followed(found, "; ".join(result.stale))
    by_hand = correction is not None
    correction = correction or LineCorrection.of(found.seen)
    words = ("Corrected by hand: " if by_hand else "") + _words(found)
    why = "; ".join(result.stale) or found.reason
    state = LinesState(words, rows=_rows(found), why=why, correction=correction)
    return _with_lines(state, line_names(found, correction.number), by_hand, due)


def _followed(found: LineFrame, why: str) -> LinesState:
    """Data of a frame with a single tracked line, which cannot be edited."""
    rows = [ResultRow("Pulse", found.pulse, decimals=2, note="Probability that a pulse is on")]
    track = found.track
    if track is None:
        return LinesState(f"{STATUSES[found.status]}.", rows=tuple(rows), why=why)
    u = np.arange(track.u_px[0], track.u_px[-1] + 1)
    place = np.stack([u, np.interp(u, track.u_px, track.v_px)], axis=-1)
    lines = (DrawnLine("1", place, place[[0, -1]], np.zeros(2, bool), folded=False),)
    rows += [
        ResultRow("Shift", track.shift_px, unit="px", note="Downwards, from the first frame"),
        ResultRow("Tilt", track.tilt_px, unit="px", note="Rise over half of its length"),
        ResultRow("Bend", track.bend_px, unit="px", note="Rise of its ends over its middle"),
        ResultRow("Agreeing", track.share, decimals=2, note="Share of columns that agree"),
    ]
    return LinesState(f"{STATUSES[found.status]}.", lines, rows=tuple(rows), why=why)


def _with_lines(state: LinesState, names: Sequence[str], by_hand: bool, due: bool) -> LinesState:
    """Copy of the state with lines to draw and list."""
    assert state.correction is not None
    named = tuple(zip(names, state.correction.seen.lines, strict=True))
    drawn = (DrawnLine(name, one.image_px, one.ends_px, one.cut, one.folded) for name, one in named)
    listed = tuple(_listed(name, one) for name, one in named)[::-1]
    return replace(state, lines=tuple(drawn), listed=listed, by_hand=by_hand, due=due)


def _places(number: IntArray) -> list[str]:
    """Numbers set by hand, or the position of a line, in brackets, if it has none."""
    return [str(n) if n else f"({k + 1})" for k, n in enumerate(number.tolist())]


def line_names(found: LineFrame, by_hand: IntArray) -> tuple[str, ...]:
    """Name of each line, see `DrawnLine`."""
    if not _is_numbered(found):
        return tuple(_places(by_hand))
    assert found.surface is not None
    numbers = iter(found.surface.numbers.tolist())
    return tuple(
        (str(given) if given else "–") if one.folded else str(next(numbers))
        for given, one in zip(by_hand.tolist(), found.seen.lines, strict=True)
    )


def _is_numbered(found: LineFrame) -> bool:
    return found.status == "ok" and found.surface is not None and found.surface.numbered


def _words(found: LineFrame) -> str:
    seen = found.seen
    message = _count(seen)
    if seen.lines and not _is_numbered(found):
        message += ". The lines' numbers are uncertain: counted from the lowest up"
        if found.status == "ok":
            return f"{message}. All possible numbers give the same height."
    return f"{message}. {STATUSES.get(found.status, found.reason or found.status)}."


def _count(seen: LinesSeen) -> str:
    message = pluralize(len(seen.lines), "line") if seen.lines else "No line"
    return f"{message}, {seen.left_out} left out (fringes)" if seen.left_out else message


def _listed(name: str, one: LightLine) -> tuple[str, ...]:
    ends = ["cut off" if cut else "seen" for cut in one.cut.tolist()]
    words = ends[0] if ends[0] == ends[1] else f"left {ends[0]}, right {ends[1]}"
    shape = "folded" if one.folded else words
    return name, f"{one.length_px:.0f}", f"{one.width_px:.1f}", f"{one.gap_px:.0f}", shape


def _rows(found: LineFrame) -> tuple[ResultRow, ...]:
    seen, surface = found.features, found.surface
    rows = [
        ResultRow("Lines", str(seen.count), note="How many of the pattern's lines are seen"),
        ResultRow("Extent, X′", seen.width_mm, unit="mm", note="Of the lines, on the plane"),
        ResultRow("Extent, Z′", seen.height_mm, unit="mm", note="Of the lines, on the plane"),
        ResultRow("Area", seen.area_mm2, unit="mm²", decimals=1, note="Between the outermost"),
        ResultRow("Curvature", seen.curvature_per_mm, unit="1/mm",
                  note="Of the lines on the plane, positive where they are arched upwards"),
        ResultRow("Asymmetry", seen.asymmetry,
                  note="Right extent less left one, about the highest points, over their sum"),
    ]  # fmt: skip
    if surface is not None and found.status == "ok":
        rows += [
            ResultRow("Pool height", surface.height_mm, surface.height_sigma_mm, "mm",
                      note="Under the lines; negative for a hollow. ± without the set-up's part"),
            ResultRow("Pool width", surface.width_mm, surface.width_sigma_mm, "mm",
                      note="Between the ends of the lines. ± without the set-up's part"),
            ResultRow("Misfit", surface.misfit, decimals=2,
                      note="χ² of points and ends over its degrees of freedom"),
        ]  # fmt: skip
    return tuple(rows)
