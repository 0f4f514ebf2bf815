"""Data of the dots page, computed from a session. Without Qt."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.dots import Dots, Image
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.pipeline import Measurement, Settings, start_correction
from labapp.core.rows.correction import Correction
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice import Lattice, number_on_plane
from labapp.core.values import CannotMeasure, FloatArray, IntArray
from labapp.errors import InputError
from labapp.gui.digits import ResultRow
from labapp.gui.tasks import Cancelled, Control
from labapp.session.corrections.carrying_on import carried_on
from labapp.session.results.measured import CORRECTION_CHANGED, Result
from labapp.session.session import Session
from labapp.text import SIGMA_OF, plain, pluralize

NO_PLACES: FloatArray = np.zeros((0, 2))

NO_DOTS = "Lower the detector's threshold below, add dots, or record with more light."

NO_DOTS_LEFT = "Add dots, or press Back to automatic."

Origin = Literal["corrected", "measured", "found", "looked for"]


@dataclass(frozen=True)
class DetectedDots:
    """Dots and rows detected in a frame."""

    frame: int
    by: tuple[DotSettings, LatticeSettings]
    """Settings of the detection."""
    dots: Dots | None
    lattice: Lattice | None
    """Rows and columns in the picture."""
    why: str
    """What could not be found, one sentence; empty if all was."""

    def correction(self, calibration: ImageCalibration | None) -> Correction:
        """Dots and rows as the start of a correction.

        With a calibration they are numbered as on the imaging plane, otherwise as in the picture.
        """
        lattice = self.lattice
        if calibration is not None and lattice is not None and self.dots is not None:
            lattice = number_on_plane(lattice, self.dots, calibration)
        return start_correction(Measurement("", "", "fit", self.dots, lattice))


@dataclass(frozen=True)
class DotsState:
    """Data shown for one frame."""

    frame: int
    origin: Origin
    correction: Correction | None
    """Dots and rows, the start of an edit; None during the detection."""
    computed_px: FloatArray
    """Positions of the dots computed from the measured surface, shape (m, 2), px."""
    result: Result | None
    """Last result of the frame, which may be stale."""
    why: str
    """Reasons for missing data, one or two sentences."""


@dataclass(frozen=True)
class Figures:
    """Figures that show whether an edit improved the fit; lengths in mm, NaN where unknown."""

    status: str
    matched: int
    """Number of dots with a known ray."""
    are_mm: float
    mre_mm: float
    """Reflection errors."""
    height_mm: float
    height_sigma_mm: float
    """Largest height, or the depth of a pool that is deeper than high, and its σ."""


@dataclass(frozen=True)
class RowLine:
    """One line of the list of rows; row 0 contains the doubtful dots."""

    row: int
    dots: int
    columns: str
    note: str


# --- the frame in view ------------------------------------------------------------------------


def shown(session: Session, frame: int, found: DetectedDots | None) -> DotsState:
    """Data of a frame: its correction, else its measurement, else the detected dots."""
    correction = session.correction(frame)
    result, damage = _result(session, frame)
    computed = computed_px(result)
    if correction is not None:
        why = damage if result is None or result.stale else result.measurement.reason
        return DotsState(frame, "corrected", correction, computed, result, why)
    by = session.settings.dots, session.settings.lattice
    measured_by = result and (result.settings.dots, result.settings.lattice)
    if result is not None and measured_by == by and result.measurement.correction is None:
        measurement = result.measurement
        start = start_correction(measurement)
        return DotsState(frame, "measured", start, computed, result, measurement.reason)
    if found is not None and (found.frame, found.by) == (frame, by):
        start = found.correction(None if session.setup_problems else session.setup.calibration)
        return DotsState(frame, "found", start, computed, result, damage or found.why)
    return DotsState(frame, "looked for", None, NO_PLACES, result, damage)


def needs_dots(session: Session, frame: int) -> bool:
    """Whether dots of a frame must be detected, because the session has none."""
    return shown(session, frame, None).origin == "looked for"


def _result(session: Session, frame: int) -> tuple[Result | None, str]:
    """Result of a frame, or None and the reason if it is damaged."""
    try:
        return session.result(frame), ""
    except InputError as error:
        return None, f"{error}; measure the frame again"


def detect(
    image: Image, frame: int, by: tuple[DotSettings, LatticeSettings], control: Control
) -> DetectedDots:
    """Detect dots and rows in a frame without measuring it."""
    dots: Dots | None = None
    lattice: Lattice | None = None
    why = ""
    try:
        dots = find_dots(image, by[0])
        control.check()
        lattice = find_lattice(dots, (image.shape[0], image.shape[1]), by[1])
    except CannotMeasure as answer:
        why = answer.reason
    return DetectedDots(frame, by, dots, lattice, why)


def computed_px(result: Result | None) -> FloatArray:
    """Positions of matched dots computed from the measured surface, shape (m, 2), px.

    Dots whose rays do not intersect the surface are omitted.
    """
    if result is None:
        return NO_PLACES
    match, surface = result.measurement.match, result.measurement.reconstruction
    if match is None or surface is None:
        return NO_PLACES
    plane = match.plane_mm + surface.residual_mm
    met = np.isfinite(plane).all(axis=1)
    return result.parsed_setup.calibration.to_image(plane[met])


def needs_fit(seen: DotsState) -> bool:
    """Whether a frame must be refitted because its dots or rows were changed by hand."""
    if seen.result is None:
        return seen.origin == "corrected"
    return CORRECTION_CHANGED in seen.result.stale


# --- in words and numbers ---------------------------------------------------------------------


def sentence(seen: DotsState) -> str:
    """Text describing the frame, one or two sentences."""
    if seen.correction is None:
        return "Looking for the dots…"
    lattice, dots = seen.correction.lattice, seen.correction.dots
    doubtful = int((~seen.correction.sited).sum())
    rows = len(set(lattice.row[lattice.row > 0].tolist()))
    message = {
        "corrected": "Corrected by hand",
        "measured": "As measured",
        "found": "As found, not measured",
        "looked for": "",
    }[seen.origin]
    if not len(dots):
        return f"{message}: no dots. {NO_DOTS_LEFT if seen.origin == 'corrected' else NO_DOTS}"
    words = f"{message}: {pluralize(len(dots), 'dot')} in {pluralize(rows, 'row')}"
    words += f", {doubtful} in doubt" if doubtful else ", none in doubt"
    if lattice.reference is None:
        words += ". The reference is not known"
    else:
        words += ". Reference in row {}, column {}".format(*lattice.reference)
    return f"{words}."


def row_lines(correction: Correction) -> tuple[RowLine, ...]:
    """The list of rows in the order of the picture from the top down, doubtful dots last."""
    lattice = correction.lattice
    reference = lattice.reference or (0, 0)
    numbers = {int(k) for k in lattice.row} | set(lattice.blocked_rows) | {reference[0]}
    lines = []
    for k in sorted(numbers - {0}, reverse=True):
        columns = lattice.column[(lattice.row == k) & (lattice.column > 0)]
        notes = ["blocked"] * (k in lattice.blocked_rows)
        notes += [f"reference {reference[1]}"] * (k == reference[0])
        missing = int(np.sum((lattice.row == k) & (lattice.column == 0)))
        notes += [f"{missing} without column"] * bool(missing)
        span = f"{columns.min()}–{columns.max()}" if len(columns) else ""
        lines.append(RowLine(k, int(np.sum(lattice.row == k)), span, ", ".join(notes)))
    doubtful = int(np.sum(lattice.row == 0))
    return (*lines, RowLine(0, doubtful, "", "in doubt")) if doubtful else tuple(lines)


def chosen_words(correction: Correction | None, selection: Sequence[int]) -> str:
    """Short text describing the selection."""
    if correction is None or not len(selection):
        return "Nothing selected: click a dot, or draw a box"
    if len(selection) > 1:
        return f"{len(selection)} dots selected"
    n = int(selection[0])
    row, column = int(correction.lattice.row[n]), int(correction.lattice.column[n])
    u, v = correction.dots.image_px[n]
    site = f"row {row or '–'}, column {column or '–'}"
    hand = ", by hand" if correction.manual[n] else ""
    return f"Dot at u {u:.1f}, v {v:.1f} px: {site}{hand}"


Need = Literal["", "rows", "reference", "dots", "site", "row", "two rows", "corrected"]
"""Requirement of an edit."""


def unmet_need(need: Need, seen: DotsState | None, selection: IntArray, rows: Sequence[int]) -> str:
    """Instruction if the requirement of an edit is not met; empty if it is."""
    if seen is None or seen.correction is None:
        return "The dots of this frame are not known yet"
    lattice, sited = seen.correction.lattice, seen.correction.sited
    there = {
        "": True,
        "rows": bool((lattice.row > 0).any()),
        "reference": lattice.reference is not None,
        "dots": len(selection) > 0,
        "site": len(selection) == 1 and bool(sited[selection].all()),
        "row": len(rows) > 0,
        "two rows": len(rows) == 2,
        "corrected": seen.origin == "corrected",
    }
    return "" if there[need] else UNMET[need]


UNMET: dict[Need, str] = {
    "rows": "There are no rows yet",
    "reference": "No reference is known",
    "dots": "Select a dot first",
    "site": "Select one dot that has a row first",
    "row": "Select a row first, or a dot that has one",
    "two rows": "Select dots of two rows first",
    "corrected": "This frame is as it was found: nothing was corrected",
}


def figures(result: Result | None) -> Figures | None:
    """Figures of the fit of a result; None if it was not measured."""
    if result is None:
        return None
    measurement = result.measurement
    size = measurement.measures
    matched = 0 if measurement.match is None else len(measurement.match.dot)
    deep = size is not None and size.depth_mm < -size.height_mm
    most = ("depth_mm", "depth_sigma_mm") if deep else ("height_mm", "height_sigma_mm")
    names = ("are_mm", "mre_mm", *most)
    values = (math.nan if size is None else float(getattr(size, name)) for name in names)
    return Figures(measurement.status, matched, *values)


def compared(before: Figures | None, after: Figures | None, pending: str = "") -> list[ResultRow]:
    """Rows of the fit before and after the last edit; ``pending`` replaces unknown values."""

    def pair(texts: Sequence[str]) -> str:
        first, last = texts
        last = pending or last
        return last if before is None else f"{first} → {last}"

    def length(name: str) -> str:
        values = [math.nan if f is None else getattr(f, name) for f in (before, after)]
        return pair([plain(v, 3) if math.isfinite(v) else "–" for v in values])

    texts = [("–", "–") if f is None else (f.status, str(f.matched)) for f in (before, after)]
    sigma = math.nan if after is None or pending else after.height_sigma_mm
    height = length("height_mm") + (f" ± {plain(sigma, 3)}" if math.isfinite(sigma) else "")
    note = f"Largest height, or depth (below 0), with ± ({SIGMA_OF})"
    return [
        ResultRow("Fit", pair([t[0] for t in texts]), note="Status before the edit, and now"),
        ResultRow("Dots matched", pair([t[1] for t in texts])),
        ResultRow("ARE", length("are_mm"), unit="mm", note="Average reflection error (Eq. 6-3)"),
        ResultRow("MRE", length("mre_mm"), unit="mm", note="Largest reflection error (Eq. 6-4)"),
        ResultRow("Height", height, unit="mm", note=note),
    ]


# --- following frames -------------------------------------------------------------------------


def carry(
    session: Session, seen: DotsState, most: int | None, control: Control
) -> tuple[dict[int, Correction], str]:
    """Apply a frame's dots and rows to following frames, see `carried_on`.

    If the operator cancels, the corrections made so far are kept.
    """

    def proceed(done: int, total: int) -> bool:
        try:
            control.progress(done, total)
        except Cancelled:
            return False
        return True

    return carried_on(session, seen.frame, _confirmed(seen), most, proceed)


def _confirmed(seen: DotsState) -> Correction:
    """Dots of a frame with the rows confirmed by its measurement unless that is stale."""
    assert seen.correction is not None
    result = seen.result
    if result is None or result.stale or result.measurement.lattice is None:
        return seen.correction
    rows = result.measurement.lattice
    return replace(seen.correction, lattice=rows) if seen.origin == "corrected" else seen.correction


# --- the detector -----------------------------------------------------------------------------

METHODS = (
    ("band-pass", "Band-pass (default)"),
    ("block-threshold", "Block threshold (§5.2.1)"),
    ("wavelet", "Wavelet (§5.3)"),
)


ROW_SEARCHES = (
    ("grow", "From dot to dot (default)"),
    ("rows", "Row search (§5.2.2)"),
    ("masks", "Masks (§5.3)"),
)


@dataclass(frozen=True)
class DetectorNumber:
    """A numerical setting of a detector, explained in the settings class."""

    method: str
    name: str
    label: str
    unit: str
    lowest: float
    highest: float
    step: float
    decimals: int
    tooltip: str
    optional: bool = False

    @property
    def group(self) -> str:
        """Name of the method's group in `DotSettings`."""
        return self.method.replace("-", "_")


NUMBERS = (
    DetectorNumber("band-pass", "size_px", "Dot size σ", "px", 0.5, 20, 0.1, 1,
                   "Standard deviation of a dot's light; empty: estimated from the frame", True),
    DetectorNumber("band-pass", "threshold", "Threshold", "σ", 1, 50, 0.5, 1,
                   "How many times the noise a dot is above the background"),
    DetectorNumber("band-pass", "contrast", "Contrast", "", 0, 1, 0.05, 2,
                   "… and is at least this fraction of a typical dot"),
    DetectorNumber("block-threshold", "block_px", "Block size", "px", 8, 200, 1, 0,
                   "Side of a block: each has its own threshold"),
    DetectorNumber("block-threshold", "delta_grey", "Threshold ΔI", "levels", 0, 100, 1, 1,
                   "How far a dot's light is above its block's mean (Eq. 5-9)"),
    DetectorNumber("block-threshold", "size_divisor", "Size divisor", "", 1, 50, 0.5, 1,
                   "A dot smaller than the average size over this is noise (Eq. 5-11)"),
    DetectorNumber("wavelet", "offset_sigma", "Threshold", "σ", 0, 50, 0.5, 1,
                   "How many times the noise a dot's light is above the mean of its window"),
    DetectorNumber("wavelet", "soft_threshold", "Denoising", "σ", 0, 10, 0.1, 1,
                   "How many times the noise details are shrunk by"),
)  # fmt: skip


def detector_value(settings: Settings, number: DetectorNumber) -> float | None:
    """Value of a numerical setting of a detector."""
    value: float | None = getattr(getattr(settings.dots, number.group), number.name)
    return value


def with_detector_value(
    settings: Settings, number: DetectorNumber, value: float | None
) -> Settings:
    """Copy of settings with another value of a detector's setting."""
    part: Any = replace(getattr(settings.dots, number.group), **{number.name: value})
    return replace(settings, dots=replace(settings.dots, **{number.group: part}))
