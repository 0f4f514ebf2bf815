"""What a session notes: the experiment, the calibrations' readings, the recording."""

from __future__ import annotations

from dataclasses import dataclass

from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays


@dataclass(frozen=True)
class Record:
    """The experiment record in the operator's words; empty or None where nothing was noted."""

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
    """Size of the pool that is expected; a negative height is a concave one."""
    notes: str = ""
    safety: tuple[tuple[str, str], ...] = ()
    """Items of the lists of Appendix II (`checklist`) that were ticked: (item, ISO 8601) pairs."""


@dataclass(frozen=True)
class LaserReadings:
    """A laser calibration (Appendix I) and what it was found from."""

    l1_mm: tuple[float, ...]
    l2_mm: tuple[float, ...]
    l3_mm: tuple[float, ...]
    """Lengths of the cross as read, mm; one or more of each."""
    fan_angle_deg: float
    """Fan angle of the cross-hair lens, degrees."""
    found: LaserCalibration
    """What follows from them."""
    picture_sha256: str | None = None
    """The picture of the cross-hair, kept in the session; None where lengths were typed."""
    fan_angle_sigma_deg: float | None = None
    """Standard uncertainty of the fan angle, degrees; None in older files."""
    resolution_mm: float | None = None
    """Smallest step of the callipers, mm; None likewise."""


@dataclass(frozen=True)
class PlanePicture:
    """An imaging-plane calibration (§5.1) and what it was found from."""

    unit_mm: float
    """Length of a unit of the target's axes, or edge of a board's squares, mm."""
    found: PlaneCalibration | BoardCalibration
    """What was found in the picture."""
    picture_sha256: str
    """The picture, kept in the session."""


@dataclass(frozen=True)
class MirrorPicture(ReadOnlyArrays):
    """A picture of a known mirror (bench check), and what became of its n dots with a ray."""

    name: str
    """Of the picture's file."""
    kind: str
    height_mm: float
    """Height of the plate's surface, or of the top of a cap or ball, over the work piece."""
    diameter_mm: float | None
    """Of the cap's rim or of the ball; None for a plate."""
    picture_sha256: str
    """The picture, kept in the session."""
    ray: IntArray
    """Ray (i, j) of each dot, counted from 1, shape (n, 2)."""
    dot_px: FloatArray
    computed_px: FloatArray
    """Where it is, and where the adjusted bench has it, (u, v), shape (n, 2), px."""
    residual_mm: FloatArray
    """Observed minus computed dot on the plane, shape (n, 2), mm."""
    measured: tuple[tuple[str, float, float, float], ...] = ()
    """The mirror, measured with the adjusted bench as if its size were not known: (name, known,
    measured, standard uncertainty by the noise of the dots), mm.
    """
    independent: tuple[tuple[float, float], ...] = ()
    """Each of these sizes measured without its known value (`MeasuredSize.independent_mm`), and its
    standard uncertainty, mm; empty in older files.
    """
    pose_sigma: tuple[tuple[str, float], ...] = ()
    """Standard uncertainty of each parameter of the mirror's pose (`Mirror.parameters`), by its
    name, as it was given; empty in older files.
    """


@dataclass(frozen=True)
class BenchCheckRecord(ReadOnlyArrays):
    """A bench check and what it was found from."""

    date: str
    """When it was made, ISO 8601."""
    pictures: tuple[MirrorPicture, ...]
    quantities: tuple[str, ...]
    """Keys of the q quantities that were adjusted (`uncertainty.QUANTITIES`)."""
    before: FloatArray
    before_sigma: FloatArray
    after: FloatArray
    after_sigma: FloatArray
    """Their values and standard uncertainties before and after, shape (q,), in their units."""
    free: tuple[str, ...] = ()
    """Keys of what was not held by its uncertainty; in older files not kept."""


@dataclass(frozen=True)
class Recording:
    """Where a session's frames come from, as it was found at import."""

    path: str
    """Relative to the session's folder where that can be said, with ``/``; else absolute."""
    size: int
    """Of all its files together, bytes."""
    sha256: str
    """Of the file; of a recording of several files, of their names and SHA-256."""
    description: str
    """Codec, frame size, depth and rate, in words."""
    frames: int
    rows: int
    columns: int
    bit_depth: int
    """Frames in the recording, of which a session may use a part; their size, px; significant bits
    of a grey level.
    """
    frame_rate_hz: float | None
    """The rate that the session's times follow; None where there is no time base."""
    rate_is_given: bool
    """Whether the rate was given at import; otherwise it is the recording's own."""
    frame_exact: bool
    """Whether frames read at random were those read in order."""
    selected: tuple[int, int, int]
    """Start, stop and step of the frames that the session uses."""
    embedded: bool
    """Whether the session holds these frames itself."""
    warnings: tuple[str, ...]
    """What the user should know, one sentence each."""
    index: bytes | None
    """What opening it again needs to know (`FrameSource.index`)."""
    imported: str
    """When, ISO 8601."""
    frames_sha256: str = ""
    """Of the number, time and checksum of every frame that the session uses."""
