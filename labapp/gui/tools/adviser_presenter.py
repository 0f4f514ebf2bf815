"""Data of the adviser's window: request, results, and use in a session. Without Qt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from labapp.config.setup import pattern_values
from labapp.gui.digits import ResultRow
from labapp.gui.pages.setup.presenter import rig
from labapp.gui.shell.steps import read_only
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.studies.adviser.bench_limits import CONSTRAINTS, BenchLimits
from labapp.studies.adviser.files import advised_setup
from labapp.studies.adviser.keys import calibration_values
from labapp.studies.adviser.report import WORDS, error_words, unknown_words
from labapp.studies.adviser.search import Advice

USUAL_HEIGHT_MM = 0.25

ABOUT = 0.1
"""Relative range of pool sizes around that of the session."""

LINES = "The session is of a line pattern, and the adviser plans a bench for a pattern of dots."

NO_ADVICE = "There is no advice yet: press Advise"

IMPOSSIBLE = "No set-up is possible within the limits: widen them, or expect smaller pools"

Values = dict[str, dict[str, Any]]
"""Table → key → value, as required by `studies.adviser.keys.parse_request`."""


def question(session: Session | None) -> Values:
    """Default request: the session's expected pool and rig, within the limits of a usual bench."""
    record = Record() if session is None else session.record
    width, length, height = record.expected_size_mm
    height = height or USUAL_HEIGHT_MM
    usual = BenchLimits()
    values: Values = {
        "pools": {
            "kind": "convex" if height > 0 else "concave",
            "width_mm": _about(width),
            "length_mm": _about(length),
            "height_mm": _about(abs(height)),
            "shift_mm": 0.3,
        },
        "bench": {
            "projection_angle_deg": list(usual.angle_deg),
            "distance_mm": list(usual.distance_mm),
            "plane_distance_mm": list(usual.plane_mm),
            "s_mm": list(usual.s_mm),
            "h_mm": list(usual.h_mm),
            "width_mm": usual.plate_mm[0],
            "height_mm": usual.plate_mm[1],
            "edge_mm": usual.edge_mm,
            "electrode_height_mm": usual.electrode_mm,
        },
    }
    found = None if session is None or session.has_lines else rig(session)
    if found is not None:
        bench = values["bench"]
        for key, value in (
            ("projection_angle_deg", found.laser.projection_angle_deg),
            ("distance_mm", found.laser.distance_mm),
            ("plane_distance_mm", -float(found.imaging_plane.origin_mm[1])),
        ):
            bench[key] = [min(bench[key][0], value), max(bench[key][1], value)]
        bench["width_mm"] = found.imaging_plane.width_mm
        bench["height_mm"] = found.imaging_plane.height_mm
        bench["electrode_height_mm"] = found.electrode.height_mm
        values["pattern"] = pattern_values(found.pattern)
        if found.uncertainty is not None:
            values["calibration"] = calibration_values(found.uncertainty)
    return values


def _about(size_mm: float) -> list[float]:
    return [round(size_mm * (1 - ABOUT), 3), round(size_mm * (1 + ABOUT), 3)]


def why_not_advised(session: Session | None) -> str:
    """Reason why no advice can be sought; empty if it can."""
    return LINES if session is not None and session.has_lines else ""


def why_not_applied(session: Session | None, advice: Advice, sought_for: Path | None) -> str:
    """Reason why an advice does not concern the open session; empty if it does.

    ``sought_for`` is the file of the session for which it was sought; None: without a session.
    """
    if sought_for != (None if session is None else session.path):
        of = "without a session" if sought_for is None else f"for {sought_for.stem}"
        again = ""
        if session is not None and not session.has_lines:
            again = f": press Advise for {session.path.stem}"
        return f"This advice was sought {of}{again}."
    found = None if session is None or session.has_lines else rig(session)
    if found is not None and pattern_values(found.pattern) != pattern_values(advice.limits.pattern):
        return "This advice was sought for another pattern: press Advise again."
    return ""


def why_not_usable(session: Session | None, advice: Advice | None) -> str:
    """Reason why an advice cannot be applied, whatever it was sought for; empty if it can."""
    if session is None:
        return "Open a session first: the advised set-up is for its measurement"
    if advice is None:
        return NO_ADVICE
    return read_only(session) or ("" if advice.possible else IMPOSSIBLE)


def headline(advice: Advice) -> str:
    """The advice in a sentence or two, or the reason why there is none."""
    if advice.possible:
        words = f"Expect a mean height error of {error_words(advice)}."
        return words + unknown_words(advice)
    broken = [CONSTRAINTS[name][0] for name, margin in advice.best.margins.items() if margin < 0]
    return (
        f"No set-up is possible within these limits, because of: {'; '.join(broken)}. "
        "The one below comes nearest. Widen the limits, or expect smaller pools."
    )


def place_rows(advice: Advice) -> tuple[ResultRow, ...]:
    """Rows of the recommended set-up."""
    place = advice.best.place
    return tuple(
        ResultRow(words, float(getattr(place, name)), unit=unit, decimals=2)
        for name, (words, unit) in WORDS.items()
    )


def kept_rows(advice: Advice) -> tuple[ResultRow, ...]:
    """Rows of the margins by which the set-up satisfies its constraints."""
    return tuple(
        ResultRow(
            CONSTRAINTS[name][0],
            margin,
            unit=CONSTRAINTS[name][1],
            decimals=1 if CONSTRAINTS[name][1] in ("mm", "px") else 0,
            note="How far it is from its limit; below 0 it is violated",
        )
        for name, margin in advice.best.margins.items()
    )


def use(session: Session, advice: Advice) -> None:
    """Use the recommended set-up in a session; one step of undo.

    The advice is for a beam in the YOZ plane aimed at the origin, and a vertical, level plane.
    """
    values = advised_setup(advice)
    values["laser"] |= dict.fromkeys(("azimuth_deg", "aim_x_mm", "aim_y_mm"))
    values["imaging_plane"] |= dict.fromkeys(("pitch_deg", "yaw_deg", "roll_deg"))
    session.update_setup(values, "advised set-up")
