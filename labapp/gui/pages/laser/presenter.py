"""Data of the laser page: lengths of the cross, the resulting laser, and values in use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import zip_longest

import numpy as np

from labapp.core.calibration.laser_calibration import (
    LaserCalibration,
    LaserCalibrationSettings,
    calibrate_laser,
)
from labapp.core.values import FloatArray
from labapp.gui.digits import ResultRow, parsed
from labapp.gui.pages.setup.presenter import shown as setup_shown
from labapp.session.calibrations import calibrations_in_use
from labapp.session.record import LaserEntries
from labapp.session.session import Session
from labapp.text import pluralize

NAMES = ("l₁", "l₂", "l₃")

MEANINGS = (
    "Half of the cross along the beam, on the laser's side",
    "Half of the cross along the beam, away from the laser",
    "Half of the cross across the beam",
)

FAN_ANGLE_DEG = 10.0

EXAMPLE_MM = (4.65, 6.23, 2.75)
"""l₁, l₂, l₃ drawn while there are no readings: a laser 31.5 mm away at 31°."""

Place = tuple[float, float]

ENDS = ("laser's side", "far side", "left", "right")
"""Names of the points at the ends of the cross in a picture."""

SCALE = ("scale 1", "scale 2")


@dataclass(frozen=True)
class Readings:
    """Entered lengths."""

    lengths_mm: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]] = ((), (), ())
    """Readings of l₁, l₂, l₃, mm; any number of each."""
    fan_angle_deg: float = FAN_ANGLE_DEG
    """Fan angle of the cross-hair lens."""
    settings: LaserCalibrationSettings = field(default_factory=LaserCalibrationSettings)
    """Uncertainties of the fan angle and of a reading."""
    wrong: tuple[str, ...] = ()
    """Entries that are no lengths, a sentence each."""


@dataclass(frozen=True)
class LaserResult:
    """Result of the readings."""

    found: LaserCalibration | None
    """The laser; None if it cannot be computed."""
    why_not: str
    """Reason why it cannot be computed."""
    rows: tuple[ResultRow, ...]
    """Means of the lengths, and the laser."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the readings."""
        return () if self.found is None else tuple(map(_spoken, self.found.warnings))


def length_mm(text: str) -> float | None:
    """The length in a cell of the table, mm; None if it is none."""
    value = parsed(text)
    return value if value is not None and value > 0 else None


def length_text(value_mm: float) -> str:
    """Text of a length to 0.01 mm, as on callipers, or with more digits if entered."""
    return max(f"{value_mm:.2f}", f"{value_mm:g}", key=len)


def typed(entries: LaserEntries) -> Readings:
    """Readings in the entries of the page."""
    lengths: list[list[float]] = [[], [], []]
    wrong = []
    for row, line in enumerate(entries.cells, 1):
        for name, text, column in zip(NAMES, line, lengths, strict=True):
            value = length_mm(text)
            if value is not None:
                column.append(value)
            elif text.strip():
                wrong.append(f"{name}, reading {row}: “{text.strip()}” is not a length")
    l1, l2, l3 = map(tuple, lengths)
    settings = LaserCalibrationSettings(
        resolution_mm=entries.resolution_mm, fan_angle_sigma_deg=entries.fan_angle_sigma_deg
    )
    return Readings((l1, l2, l3), entries.fan_angle_deg, settings, tuple(wrong))


def kept(session: Session) -> Readings | None:
    """Readings of the calibration in use; None if there is none."""
    calibration = session.laser_calibration
    if calibration is None:
        return None
    lengths = (calibration.l1_mm, calibration.l2_mm, calibration.l3_mm)
    known = {
        "resolution_mm": calibration.resolution_mm,
        "fan_angle_sigma_deg": calibration.fan_angle_sigma_deg,
    }
    given = {name: value for name, value in known.items() if value is not None}
    settings = LaserCalibrationSettings(**given)
    return Readings(lengths, calibration.fan_angle_deg, settings)


def entries(session: Session) -> LaserEntries:
    """Entries that are not applied yet; without any, those of the calibration in use."""
    return session.laser_entries or applied_entries(session)


def applied_entries(session: Session) -> LaserEntries:
    """Entries as they are in the table after Apply; empty ones without a calibration."""
    calibration, readings = session.laser_calibration, kept(session) or Readings()
    l1, l2, l3 = (map(length_text, lengths) for lengths in readings.lengths_mm)
    settings = readings.settings
    return LaserEntries(
        tuple(zip_longest(l1, l2, l3, fillvalue="")),
        readings.fan_angle_deg,
        settings.fan_angle_sigma_deg,
        settings.resolution_mm,
        None if calibration is None else calibration.picture_sha256,
    )


def enter(session: Session, entered: LaserEntries) -> None:
    """Store entries until they are applied, unless they are those in use."""
    session.set_entries("laser", None if entered == applied_entries(session) else entered)


def apply(session: Session, readings: Readings, picture_sha256: str | None) -> None:
    """Calibrate the laser by readings, and by the picture from which they are, if there is one."""
    picture = session.picture(picture_sha256) if picture_sha256 else None
    session.calibrate_laser(
        *readings.lengths_mm, readings.fan_angle_deg, picture, readings.settings
    )


def is_in_use(session: Session, readings: Readings) -> bool:
    """Whether the set-up contains the laser of these readings."""
    return kept(session) == readings and calibrations_in_use(session)[0]


def result(readings: Readings) -> LaserResult:
    """The laser computed from readings, or the reason why it cannot be."""
    spread = tuple(
        _mean_row(name, meaning, np.array(lengths, float))
        for name, meaning, lengths in zip(NAMES, MEANINGS, readings.lengths_mm, strict=True)
    )
    missing = [name for name, found in zip(NAMES, readings.lengths_mm, strict=True) if not found]
    if readings.wrong:
        return LaserResult(None, "; ".join(readings.wrong), spread)
    if missing:
        return LaserResult(None, f"Enter at least one reading of {', '.join(missing)}", spread)
    try:
        found = calibrate_laser(*readings.lengths_mm, readings.fan_angle_deg, readings.settings)
    except ValueError as error:
        return LaserResult(None, _spoken(str(error)), spread)
    check = ResultRow(
        "l₁ computed", found.expected_l1_mm, unit="mm", note="From l₂, l₃ and the fan angle"
    )
    rows = (
        ResultRow("Projection angle", found.angle_deg, found.angle_sigma_deg, "°"),
        ResultRow("Distance", found.distance_mm, found.distance_sigma_mm, "mm"),
        ResultRow("Height", found.height_mm, found.height_sigma_mm, "mm"),
        ResultRow("Horizontal distance", found.horizontal_mm, found.horizontal_sigma_mm, "mm"),
        ResultRow("Correlation", found.correlation, decimals=2, note="Of angle and distance"),
    )
    return LaserResult(found, "", (*spread, check, *rows))


def drawn(
    readings: Readings, found: LaserCalibration | None
) -> tuple[LaserCalibration, tuple[float, float, float], float]:
    """The laser to draw, l₁, l₂, l₃, mm, and the fan angle; without a laser those of an example."""
    if found is not None:
        l1, l2, l3 = (float(np.mean(lengths)) for lengths in readings.lengths_mm)
        return found, (l1, l2, l3), readings.fan_angle_deg
    l1, l2, l3 = EXAMPLE_MM
    example = calibrate_laser([l1], [l2], [l3], FAN_ANGLE_DEG)
    return example, EXAMPLE_MM, FAN_ANGLE_DEG


def in_use(session: Session) -> tuple[ResultRow, ...]:
    """The laser in the set-up."""
    shown = setup_shown(session)
    calibrated = calibrations_in_use(session)[0]
    note = "From this session's calibration" if calibrated else "As entered"
    names = (
        ("Projection angle", "laser.projection_angle_deg", "°"),
        ("Distance", "laser.distance_mm", "mm"),
    )
    rows = []
    for name, key, unit in names:
        sigma = shown.sigmas[f"{key}_sigma"]
        about = note if sigma is not None else f"{note}; its ± is assumed"
        rows.append(ResultRow(name, shown.values[key], sigma, unit, note=about))
    return tuple(rows)


# --- a picture of the cross -------------------------------------------------------------------


def first_places(shape: tuple[int, int]) -> dict[str, Place]:
    """Initial positions of the points in a picture of shape (rows, columns)."""
    rows, columns = shape
    at = {
        SCALE[0]: (0.25, 0.9),
        SCALE[1]: (0.75, 0.9),
        ENDS[0]: (0.5, 0.25),
        ENDS[1]: (0.5, 0.75),
        ENDS[2]: (0.3, 0.5),
        ENDS[3]: (0.7, 0.5),
    }
    return {name: (x * columns, y * rows) for name, (x, y) in at.items()}


def cross_lengths(places: Mapping[str, Place], scale_mm: float) -> tuple[float, float, float]:
    """l₁, l₂, l₃ of a cross in a picture taken square to the work piece, mm.

    The centre is the intersection of the line along the beam and the line across it.

    Parameters
    ----------
    places
        (u, v) of `ENDS` and `SCALE`, px.
    scale_mm
        Distance between the two points of the scale.

    Raises
    ------
    ValueError
        If the points make no cross or no scale.
    """
    near, far, left, right = (np.array(places[name]) for name in ENDS)
    scale_px = float(np.hypot(*np.subtract(places[SCALE[1]], places[SCALE[0]])))
    if scale_px < 1:
        raise ValueError("The two points of the scale lie on each other: drag them apart")
    system = np.stack([far - near, left - right], axis=-1)
    if abs(np.linalg.det(system)) < 1:
        raise ValueError("The two lines of the cross do not cut each other")
    along, across = np.linalg.solve(system, left - near)
    if not (0 < along < 1 and 0 < across < 1):
        raise ValueError("The two lines of the cross do not cut each other between their ends")
    center = near + along * (far - near)
    mm = scale_mm / scale_px
    l1, l2 = (mm * float(np.hypot(*(end - center))) for end in (near, far))
    return l1, l2, mm * float(np.hypot(*(right - left))) / 2


def _mean_row(name: str, meaning: str, lengths: FloatArray) -> ResultRow:
    count = len(lengths)
    mean = float(lengths.mean()) if count else None
    spread = float(lengths.std(ddof=1)) if count > 1 else None
    note = f"{meaning}; mean and standard deviation of {count} readings"
    return ResultRow(f"{name}, {pluralize(count, 'reading')}", mean, spread, "mm", 2, note)


def _spoken(words: str) -> str:
    """A message of the core with the page's names of the lengths."""
    for number, name in enumerate(NAMES, 1):
        words = words.replace(f"l{number}_mm", name).replace(f"l{number} ", f"{name} ")
    return words
