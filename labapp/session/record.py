"""Records of a session: the experiment, calibrations with their readings, the recording."""

from __future__ import annotations

from dataclasses import dataclass

from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays


@dataclass(frozen=True)
class Record:
    """The experiment record, entered by the operator; unknown values are empty or None.

    Parameters
    ----------
    title, operator
        Of the experiment.
    material, thickness_mm
        Of the work piece; thickness in mm.
    current_a, voltage_v, travel_speed_mm_s
        Welding current, A; arc voltage, V; travel speed, mm/s.
    gas, gas_flow_l_min
        Shielding gas, and its flow, l/min.
    expected_width_mm, expected_length_mm, expected_height_mm
        Expected size of the pool, mm; the height is negative for a concave pool.
    notes
        Further notes.
    safety
        Ticked items of the checklists of Appendix II (`checklist`): (item, ISO 8601) pairs.
    """

    title: str = ""
    operator: str = ""
    material: str = ""
    thickness_mm: float | None = None
    current_a: float | None = None
    voltage_v: float | None = None
    travel_speed_mm_s: float | None = None
    gas: str = ""
    gas_flow_l_min: float | None = None
    expected_width_mm: float | None = None
    expected_length_mm: float | None = None
    expected_height_mm: float | None = None
    notes: str = ""
    safety: tuple[tuple[str, str], ...] = ()

    @property
    def expected_size_mm(self) -> tuple[float, float, float]:
        """Width, length and height of the expected pool, mm; unknown ones of a usual, flat pool."""
        from labapp.simulation.positioning import USUAL_LENGTH_MM, USUAL_WIDTH_MM

        return (
            self.expected_width_mm or USUAL_WIDTH_MM,
            self.expected_length_mm or USUAL_LENGTH_MM,
            self.expected_height_mm or 0.0,
        )


@dataclass(frozen=True)
class LaserReadings:
    """A laser calibration (Appendix I) and its readings."""

    l1_mm: tuple[float, ...]
    l2_mm: tuple[float, ...]
    l3_mm: tuple[float, ...]
    """Readings of the half lengths of the cross, mm; at least one of each."""
    fan_angle_deg: float
    """Fan angle of the cross-hair lens, degrees."""
    found: LaserCalibration
    """Result of the calibration."""
    picture_sha256: str | None = None
    """The picture of the cross-hair in the session; None if lengths were typed."""
    fan_angle_sigma_deg: float | None = None
    """Standard uncertainty of the fan angle, degrees; None in older files."""
    resolution_mm: float | None = None
    """Smallest step of the callipers, mm; None in older files."""


@dataclass(frozen=True)
class CrossPicture:
    """A picture of the laser's cross, and the points that the operator places in it."""

    picture_sha256: str
    """The picture in the session."""
    places_px: tuple[tuple[float, float], ...]
    """(u, v) of the ends of the cross on the laser's side, opposite, left and right, and of both
    points of the scale, px."""
    scale_mm: float
    """Distance between the points of the scale, mm."""


@dataclass(frozen=True)
class LaserEntries:
    """Readings of the laser's cross as the operator entered them, not applied yet."""

    cells: tuple[tuple[str, str, str], ...]
    """Texts of l1, l2 and l3, mm, a line for each time; a text may be empty, or no length."""
    fan_angle_deg: float
    fan_angle_sigma_deg: float
    resolution_mm: float
    """Fan angle, its standard uncertainty and step of the callipers, as in `LaserReadings`."""
    picture_sha256: str | None = None
    """The picture of the cross-hair in the session; None if lengths were typed."""
    cross: CrossPicture | None = None
    """The picture from which further readings are made; None if there is none."""


@dataclass(frozen=True)
class PlanePicture:
    """An imaging-plane calibration (§5.1) and its picture; also one that is not applied yet."""

    unit_mm: float
    """Length of a unit of the target's axes, or edge of a board's squares, mm."""
    found: PlaneCalibration | BoardCalibration
    """Result of the calibration."""
    picture_sha256: str
    """The picture in the session."""
    further_sha256: tuple[str, ...] = ()
    """Pictures of the board in other poses, while the calibration is not applied."""


@dataclass(frozen=True)
class MirrorEntry:
    """A picture for a bench check and the mirror entered for it."""

    name: str
    kind: str
    height_mm: float
    diameter_mm: float | None
    """Name of the file, and the mirror, as in `MirrorPicture`."""
    height_sigma_mm: float | None
    level_sigma_deg: float | None
    """Standard uncertainties of the height and of a plate's level; None: the usual ones."""
    picture_sha256: str
    """The picture in the session."""


@dataclass(frozen=True)
class BenchEntries:
    """Pictures for a bench check that are not applied yet."""

    pictures: tuple[MirrorEntry, ...]


Entries = LaserEntries | PlanePicture | BenchEntries
"""What was entered for a calibration and is not applied yet."""


@dataclass(frozen=True)
class MirrorPicture(ReadOnlyArrays):
    """A picture of a known mirror (bench check), with the fit of its n dots that have a ray."""

    name: str
    """Name of the picture's file."""
    kind: str
    height_mm: float
    """Height of the plate's surface, or of the top of a cap or ball, above the work piece."""
    diameter_mm: float | None
    """Diameter of the cap's rim or of the ball; None for a plate."""
    picture_sha256: str
    """The picture in the session."""
    ray: IntArray
    """Ray (i, j) of each dot, counted from 1, shape (n, 2)."""
    dot_px: FloatArray
    computed_px: FloatArray
    """Observed dot, and dot computed with the adjusted bench, (u, v), shape (n, 2), px."""
    residual_mm: FloatArray
    """Observed minus computed dot on the plane, shape (n, 2), mm."""
    measured: tuple[tuple[str, float, float, float], ...] = ()
    """Sizes of the mirror measured with the adjusted bench, as if unknown: (name, known, measured,
    standard uncertainty from dot noise), mm.
    """
    independent: tuple[tuple[float, float], ...] = ()
    """Each of these sizes measured independently of its known value
    (`MeasuredSize.independent_mm`), and its standard uncertainty, mm; empty in older files.
    """
    pose_sigma: tuple[tuple[str, float], ...] = ()
    """Given standard uncertainty of each parameter of the mirror's pose (`Plate.parameters`), by
    name; empty in older files.
    """


@dataclass(frozen=True)
class BenchCheckRecord(ReadOnlyArrays):
    """A bench check and its pictures."""

    date: str
    """Time of the check, ISO 8601."""
    pictures: tuple[MirrorPicture, ...]
    quantities: tuple[str, ...]
    """Keys of the q adjusted quantities (`uncertainty.QUANTITIES`)."""
    before: FloatArray
    before_sigma: FloatArray
    after: FloatArray
    after_sigma: FloatArray
    """Their values and standard uncertainties before and after, shape (q,), in their units."""
    free: tuple[str, ...] = ()
    """Keys of the quantities adjusted without a prior; empty in older files."""


@dataclass(frozen=True)
class Recording:
    """Source of a session's frames, as examined at import."""

    path: str
    """Path relative to the session's folder, with ``/``; absolute on another drive."""
    size: int
    """Size of all its files together, bytes."""
    sha256: str
    """SHA-256 of the file; for several files, of their names and SHA-256."""
    description: str
    """Codec, frame size, depth and rate as text."""
    frames: int
    rows: int
    columns: int
    bit_depth: int
    """Number of frames in the recording, of which a session may use a part; their size, px;
    significant bits of a grey level.
    """
    frame_rate_hz: float | None
    """Frame rate of the session's times; None without a time base."""
    rate_is_given: bool
    """Whether the rate was given at import; otherwise it is that of the recording."""
    frame_exact: bool
    """Whether random access returns the same frames as sequential reading."""
    selected: tuple[int, int, int]
    """Start, stop and step of the frames that the session uses."""
    embedded: bool
    """Whether the frames are stored in the session itself."""
    warnings: tuple[str, ...]
    """Warnings for the user, one sentence each."""
    index: bytes | None
    """Index for opening it again (`FrameSource.index`)."""
    imported: str
    """Time of the import, ISO 8601."""
    frames_sha256: str = ""
    """SHA-256 of number, time and checksum of every frame that the session uses."""
