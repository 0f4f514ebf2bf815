"""Data of the set-up page, computed from a session. Without Qt."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from typing import Any

from labapp.config.setup import parse_setup, updated_setup
from labapp.config.setup_keys import LINE_PATTERN, RAYS, SECTIONS, THREE_POINTS, rules_for
from labapp.core.geometry.line_pattern import KIND as LINES
from labapp.core.geometry.line_pattern import LineRays
from labapp.core.geometry.patterns import MEASURED, PATTERNS
from labapp.core.geometry.rig import DotPattern, Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.recording.residual_check import doubt_of_values, judged_status
from labapp.errors import InputError
from labapp.gui.digits import ResultRow
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.simulation.positioning import Fate, SideView, side_view
from labapp.text import marked_setup_words, pluralize, setup_words


@dataclass(frozen=True)
class Entry:
    """A field of the page."""

    key: str
    """``section.key`` of the setup, or the name in `Record`."""
    label: str
    unit: str = ""
    tooltip: str = ""
    """Label, unit and tooltip."""
    lowest: float = 0.0
    highest: float = 0.0
    step: float = 1.0
    decimals: int = 1
    """Range and decimals of the number; lowest = highest for a text field."""
    usual: float | None = None
    """Value in the dissertation (Appendix II); None if there is none."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of pattern that have this field."""
        section, _, name = self.key.partition(".")
        if section != "pattern":
            return tuple(kind for kind, _ in KINDS)
        return tuple(kind for kind, _ in KINDS if name in rules_for(section, {"kind": kind}))


RIG: tuple[tuple[str, tuple[Entry, ...]], ...] = (
    ("Pattern", (
        Entry("pattern.rows", "Rows", "", "Rows of the dot matrix, odd", 3, 99, 2, 0, 19),
        Entry("pattern.columns", "Columns", "", "Columns of it, odd", 3, 99, 2, 0, 19),
        Entry("pattern.inter_beam_angle_deg", "Inter-beam angle", "°",
              "Angle between neighbouring rays at the centre", 0, 45, 0.01, 2, 0.77),
        Entry("pattern.count", "Lines", "", "How many lines the lens makes", 1, 99, 1, 0, 5),
        Entry("pattern.interline_angle_deg", "Interline angle", "°",
              "Angle between neighbouring lines at the centre", 0, 45, 0.01, 3, 0.23),
        Entry("pattern.fan_angle_deg", "Fan angle", "°",
              "Angle from one end of a line to the other", 0, 90, 0.5, 2, 5),
        Entry("pattern.rotation_deg", "Rotation", "°",
              "How far the pattern is turned about the beam; empty: rows and lines lie level",
              -90, 90, 0.5, 2),
    )),
    ("Laser", (
        Entry("laser.projection_angle_deg", "Projection angle", "°",
              "Elevation of the beam above the work piece; step Laser measures it",
              0, 90, 0.5, 2, 30),
        Entry("laser.distance_mm", "Laser distance", "mm",
              "From the diode to the work piece under the electrode; step Laser measures it",
              0, 10_000, 0.5, 2, 35),
        Entry("laser.azimuth_deg", "Azimuth", "°",
              "How far the laser is turned out of the welding plane, anticlockwise from above; "
              "empty: it stands in it", -90, 90, 0.5, 2),
        Entry("laser.aim_x_mm", "Aim, X", "mm",
              "Where the beam meets the work piece, to the right of the electrode; empty: under it",
              -10_000, 10_000, 0.1, 2),
        Entry("laser.aim_y_mm", "Aim, Y", "mm",
              "Where the beam meets the work piece, towards the laser; empty: under the electrode",
              -10_000, 10_000, 0.1, 2),
    )),
    ("Torch", (
        Entry("electrode.height_mm", "Electrode height", "mm",
              "From the work piece up to the electrode's tip", 0, 10_000, 0.5, 2, 4),
    )),
    ("Imaging plane", (
        Entry("imaging_plane.distance_mm", "Plane distance", "mm",
              "From the electrode's axis back to O′, along −Y", 0, 10_000, 1, 2, 50),
        Entry("imaging_plane.s_mm", "s, to the left", "mm",
              "How far O′ lies to the left of the electrode, as the camera sees it",
              -10_000, 10_000, 1, 2),
        Entry("imaging_plane.h_mm", "h, above", "mm",
              "How high O′ lies above the work piece", -10_000, 10_000, 0.5, 2),
        Entry("imaging_plane.width_mm", "Plane width", "mm",
              "Size along O′X′, from O′", 0, 10_000, 1, 1, 101.6),
        Entry("imaging_plane.height_mm", "Plane height", "mm",
              "Size along O′Z′, from O′", 0, 10_000, 1, 1, 101.6),
        Entry("imaging_plane.pitch_deg", "Pitch", "°",
              "How far its upper edge leans away from the torch; empty: upright", -90, 90, 0.5, 2),
        Entry("imaging_plane.yaw_deg", "Yaw", "°",
              "How far it is turned about the upright; empty: square to the welding direction",
              -180, 180, 0.5, 2),
        Entry("imaging_plane.roll_deg", "Roll", "°",
              "How far O′X′ rises; empty: it lies level", -180, 180, 0.5, 2),
        Entry("imaging_plane.glass_mm", "Glass", "mm",
              "Thickness of a glass before the paper, on the pool's side; empty: none. "
              "Distances are measured to the paper", 0, 100, 0.5, 2),
        Entry("imaging_plane.glass_index", "Refractive index", "",
              "Of that glass; empty: 1.5", 1, 4, 0.01, 3),
    )),
)  # fmt: skip
"""Fields of the rig, by headings."""

DEFAULTS = {entry.key: entry.usual or 0.0 for _, entries in RIG for entry in entries} | {
    "imaging_plane.s_mm": 45.0,
    "imaging_plane.h_mm": 3.0,
    "imaging_plane.glass_index": 1.5,
}
"""Values drawn in grey while nothing is entered.

Where an entry is required, the value is only drawn and never used for measurements.
"""

NOT_ENTERED = "Grey numbers are the dissertation's bench, not yours: click one and type."

UNCERTAIN_ONLY = ("Image calibration", (
    Entry("image_calibration.origin_px_sigma", "O′", "px",
          "O′ in the picture, along u and along v", 0, 10_000, 0.1, 2),
    Entry("image_calibration.x_axis_px_sigma", "Point on O′X′", "px",
          "That point in the picture, along u and along v", 0, 10_000, 0.1, 2),
    Entry("image_calibration.z_axis_px_sigma", "Point on O′Z′", "px",
          "That point in the picture, along u and along v", 0, 10_000, 0.1, 2),
    Entry("image_calibration.x_axis_mm_sigma", "Its X′", "mm",
          "X′ of the point on O′X′", 0, 10_000, 0.1, 2),
    Entry("image_calibration.z_axis_mm_sigma", "Its Z′", "mm",
          "Z′ of the point on O′Z′", 0, 10_000, 0.1, 2),
    Entry("camera_lens.distortion_percent_sigma", "Lens distortion", "%",
          "Of the picture in the plane's corner, of its distance from the middle", 0, 100, 0.1, 2),
))  # fmt: skip
"""Fields for standard uncertainties only: the points are found in step Imaging plane."""

ASSUMED = {one.sigma_key: one.assumed for one in QUANTITIES}
"""Assumed standard uncertainties of quantities without an entry."""

TRAVELS = (("+y", "towards +Y"), ("-y", "towards −Y"))

KINDS = (
    *((name, kind.title) for name, kind in PATTERNS.items()),
    (MEASURED, "measured rays"),
    (LINES, "lines"),
)
"""Kinds of pattern, and their names."""


def sigma_entry(entry: Entry) -> Entry | None:
    """Field for the standard uncertainty of a value; None if it has none."""
    key = f"{entry.key}_sigma"
    if key not in ASSUMED:
        return None
    least = 10.0 ** -max(entry.decimals, 3)
    usual = f"{ASSUMED[key]:g} {entry.unit}".rstrip()
    return Entry(
        key,
        f"{entry.label} ±",
        entry.unit,
        f"Standard uncertainty of “{entry.label}”; empty: {usual} is assumed",
        0,
        90 if entry.unit == "°" else 10_000,
        max(entry.step / 10, least),
        entry.decimals,
    )


POOL = (
    Entry("expected_width_mm", "Pool width", "mm",
          "Of the pool that is expected", 0.1, 100, 0.5, 2),
    Entry("expected_length_mm", "Pool length", "mm",
          "Of the pool that is expected", 0.1, 100, 0.5, 2),
    Entry("expected_height_mm", "Pool height", "mm",
          "Of the pool that is expected; negative for a concave one", -50, 50, 0.05, 2),
)  # fmt: skip

EXPERIMENT = (
    Entry("title", "Title", tooltip="Title of the experiment"),
    Entry("operator", "Operator", tooltip="Name of the operator"),
    Entry("material", "Material", tooltip="Of the work piece"),
    Entry("thickness_mm", "Thickness", "mm", "Of the work piece", 0, 1000, 0.5, 2),
    Entry("current_a", "Current", "A", "Weld current", 0, 2000, 1, 1),
    Entry("voltage_v", "Voltage", "V", "Arc voltage", 0, 1000, 0.5, 1),
    Entry("travel_speed_mm_s", "Travel speed", "mm/s", "Of the torch", 0, 1000, 0.1, 2),
    Entry("gas", "Shielding gas", tooltip="Shielding gas, such as argon"),
    Entry("gas_flow_l_min", "Gas flow", "l/min", "Of the shielding gas", 0, 1000, 0.5, 1),
    Entry("notes", "Notes", tooltip="Anything else worth noting; Ctrl+Enter saves it"),
)  # fmt: skip


@dataclass(frozen=True)
class SetupState:
    """Data shown by the page."""

    values: dict[str, float | None]
    """Values by the keys of `RIG`; None if there is none."""
    sigmas: dict[str, float | None]
    """Standard uncertainties by the keys of `ASSUMED`; None if none is entered."""
    usual_sigmas: dict[str, float]
    """Values used if none are entered: assumed ones, or those of the bench check."""
    sigma_words: str
    """Explanation of the standard uncertainties."""
    kind: str
    """Kind of pattern, one of `KINDS`."""
    travel: str
    """Direction of the torch's travel, one of `TRAVELS`."""
    status: str
    """Text of the reliability of the set-up; empty while it is incomplete."""
    problems: dict[str, str]
    """Problems as text, by the same keys."""
    missing: frozenset[str]
    """Keys of the values that still have to be entered."""
    others: tuple[str, ...]
    """Other problems of the setup, a sentence each."""
    record: Record


def shown(session: Session) -> SetupState:
    """Data to show for a session."""
    sections: dict[str, Any] = tomllib.loads(session.setup_text)
    keys = [entry.key for _, entries in RIG for entry in entries]
    values = {key: _number(sections, key) for key in keys}
    sigmas = {key: _number(sections, key) for key in ASSUMED}
    tables = {key: sections.get(key) for key in ("pattern", "torch")}
    kind, travel = (
        table.get(key, usual) if isinstance(table := tables[section], dict) else usual
        for section, key, usual in (("pattern", "kind", DotPattern.kind), ("torch", "travel", "+y"))
    )
    found = rig(session)
    if words := session.setup_words:
        status = marked_setup_words(session.setup_status, words)
    else:  # the imaging plane may still be missing
        doubt = None if found is None else doubt_of_values(found)
        usual = "" if found is None else judged_status(found, doubt)
        reason = doubt.reason if doubt else ""
        status = marked_setup_words(usual, setup_words(usual, doubt=reason))
    usual_sigmas, sigma_words = _usual_sigmas(found)
    problems: dict[str, str] = {}
    missing: set[str] = set()
    others = []
    for problem in session.setup_problems:
        is_missing = problem.value == "missing"
        words = "missing" if is_missing else f"{problem.value}; expected {problem.expected}"
        if is_missing and problem.field in values:
            missing.add(problem.field)
        elif problem.field in values or problem.field in sigmas:
            problems[problem.field] = words
        elif is_missing and f"{problem.field}." in " ".join(keys):
            rules = rules_for(problem.field, sections.get(problem.field))
            missing |= {f"{problem.field}.{key}" for key in rules if rules[key].required}
        elif problem.field.startswith("image_calibration") and is_missing:
            others.append("The imaging plane is not calibrated: that is step Imaging plane.")
        else:
            others.append(f"{problem.field}: {words}")
    return SetupState(
        values=values,
        sigmas=sigmas,
        usual_sigmas=usual_sigmas,
        sigma_words=sigma_words,
        kind=kind,
        travel=travel,
        status=status,
        problems=problems,
        missing=frozenset(missing & values.keys()),
        others=tuple(dict.fromkeys(others)),
        record=session.record,
    )


def _usual_sigmas(found: Rig | None) -> tuple[dict[str, float], str]:
    """Standard uncertainties used if none are entered, and a note on them."""
    words = "Right: ±, one standard uncertainty. In grey: "
    known = None if found is None else found.uncertainty
    if known is None or not known.checked:
        return ASSUMED, f"{words}assumed."
    return known.sigma_by_key, f"{words}as the bench check found it."


def _number(sections: dict[str, Any], key: str) -> float | None:
    section, _, name = key.partition(".")
    table = sections.get(section)
    value = table.get(name) if isinstance(table, dict) else None
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def rig(session: Session) -> Rig | None:
    """The rig, or None if it is incomplete; the image calibration may be missing."""
    return _rig_with(session, {}) if session.setup_problems else session.setup.rig


def default_rig(session: Session) -> Rig | None:
    """The rig with dimensions of the dissertation for missing ones; None if a value is wrong."""
    values: dict[str, dict[str, object]] = {}
    for key in shown(session).missing:
        section, _, name = key.partition(".")
        values.setdefault(section, {})[name] = DEFAULTS[key]
    return _rig_with(session, values)


def _rig_with(session: Session, values: dict[str, dict[str, object]]) -> Rig | None:
    """The rig with some other values, and any image calibration; None if a value is wrong."""
    anything = {"homography": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}
    values = values | {"image_calibration": dict.fromkeys(THREE_POINTS) | anything}
    try:
        text = updated_setup(session.setup_text, session.path, values)
        return parse_setup(text, session.path, lines=True).rig
    except InputError:
        return None


@dataclass(frozen=True)
class BenchState:
    """Data for the drawing of the bench."""

    rig: Rig | None
    """The drawn rig; None if a value is wrong."""
    view: SideView | None
    """Its rays; None without a rig or if the pool is impossible."""
    words: str
    """Description of the drawing, or the reason why there is none."""
    rows: tuple[ResultRow, ...] = ()
    pattern_words: str = ""
    """Description of the drawing of the pattern."""


def bench(session: Session) -> BenchState:
    """The bench of a session with the expected pool."""
    found, record, entered = default_rig(session), session.record, rig(session) is not None
    if found is None:
        return BenchState(None, None, "The drawing appears when every number is possible.")
    size = record.expected_size_mm
    try:
        view = side_view(found, *size)
    except ValueError as error:
        words = f"There is no such pool: {error}."
        return BenchState(found, None, words, pattern_words=pattern_words(found.pattern))
    tally, room = view.tally, view.clearance
    width, length, height = size
    given = None not in (record.expected_width_mm, record.expected_length_mm)
    drawn = "the central column of the pattern"
    if isinstance(found.pattern, LineRays):
        rays = f"{found.pattern.columns} rays"
        drawn = f"the plane of light of each line, seen from its edge; a line counts as {rays}"
    words = "" if entered else f"{NOT_ENTERED} "
    words += (
        f"{tally[Fate.CAUGHT]} of {sum(tally.values())} rays come back to the imaging plane "
        f"(solid). {tally[Fate.BLOCKED]} are blocked by the torch (dashed red), "
        f"{tally[Fate.PAST]} miss the plane (dotted grey), {tally[Fate.UNUSED]} do not meet the "
        f"pool (thin grey). {'Expected' if given else 'Usual'} pool: {width:g} × {length:g} mm, "
        f"{f'{height:g} mm high' if height else 'flat'}. Drawn: {drawn}. "
        f"The torch moves {'to the right' if found.head_sign > 0 else 'to the left'}."
    )
    ends = ("tail", "head")[:: found.head_sign]
    rows = (
        ResultRow("Rays that come back", str(tally[Fate.CAUGHT])),
        ResultRow("Blocked by the torch", str(tally[Fate.BLOCKED])),
        ResultRow("Miss the plane", str(tally[Fate.PAST])),
        ResultRow("L1", room.l1_mm, unit="mm", decimals=1, note=f"Longest {ends[0]} (Eq. 4-14)"),
        ResultRow(
            "L2", room.l2_mm, unit="mm", decimals=1, note=f"Longest {ends[1]} (Eq. 4-15 … 4-18)"
        ),
        ResultRow("Least plane distance", room.least_plane_mm, unit="mm", decimals=1, note=REACH),
        ResultRow("Most plane distance", room.most_plane_mm, unit="mm", decimals=1, note=REACH),
    )
    return BenchState(found, view, words, rows if entered else (), pattern_words(found.pattern))


def pattern_words(pattern: DotPattern) -> str:
    """Description of the drawing of a pattern."""
    seen = "As the camera sees it come out of the laser: X to the right, 1 on top"
    if isinstance(pattern, LineRays):
        return f"{pluralize(pattern.rows, 'line')}. {seen}"
    made = pattern.rows * pattern.columns - len(pattern.absent_rays)
    return f"{pluralize(made, 'ray')}; rings are rays that the lens does not make. {seen}"


REACH = "The plane catches the steepest ray that passes the torch between these two (Eq. 4-16)"


# --- changes ----------------------------------------------------------------------------------


def put(session: Session, key: str, value: float | None) -> None:
    """Set a value of the rig, or its standard uncertainty, in the setup; None removes it.

    A changed calibrated value loses its ± (`config.setup.updated_setup`).
    """
    section, _, name = key.partition(".")
    value_key = key.removesuffix("_sigma")
    entries = [entry for _, entries in (*RIG, UNCERTAIN_ONLY) for entry in entries]
    label = next(entry.label for entry in entries if entry.key in (key, value_key))
    label += " ±" if key in ASSUMED else ""
    session.update_setup({section: {name: value}}, f"set-up, {label}")


def put_kind(session: Session, kind: str) -> None:
    """Set the kind of pattern, and remove keys that only the previous kind has."""
    known = (*SECTIONS["pattern"], *RAYS, *LINE_PATTERN)
    keys = {key: None for key in known if key not in rules_for("pattern", {"kind": kind})}
    session.update_setup({"pattern": {**keys, "kind": kind}}, "set-up, pattern")


def put_travel(session: Session, travel: str) -> None:
    """Set the direction of the torch's travel."""
    session.update_setup({"torch": {"travel": travel}}, "set-up, welding direction")


def put_usual(session: Session) -> None:
    """Set missing values to the usual ones; existing values are kept."""
    state = shown(session)
    values = state.values
    missing: dict[str, dict[str, object]] = {}
    for _, entries in RIG:
        for entry in entries:
            wanted = entry.usual is not None and state.kind in entry.kinds
            if values[entry.key] is None and wanted:
                section, _, name = entry.key.partition(".")
                missing.setdefault(section, {})[name] = entry.usual
    session.update_setup(missing, "defaults")


def note(session: Session, name: str, value: str | float | None) -> None:
    """Set one item of the experiment record."""
    session.set_record(replace(session.record, **{name: value}))  # type: ignore[arg-type]
