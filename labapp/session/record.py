"""What a session notes: the experiment, the calibrations' readings, the recording."""

from __future__ import annotations

from dataclasses import dataclass

from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays


@dataclass(frozen=True)
class Record:
    """The experiment record; empty or None where nothing was noted.

    Parameters
    ----------
    title, operator, material, gas, notes
        In the operator's words.
    thickness_mm, current_a, voltage_v, travel_speed_mm_s, gas_flow_l_min
        The weld's parameters.
    expected_width_mm, expected_length_mm, expected_height_mm
        Size of the pool that is expected; a negative height is a concave one.
    safety
        Items of the safety list (Appendix II) that were ticked: (item, ISO 8601 time) pairs.
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


@dataclass(frozen=True)
class LaserReadings:
    """A laser calibration (Appendix I) and what it was found from.

    Parameters
    ----------
    l1_mm, l2_mm, l3_mm
        Lengths of the cross as read, mm; one or more of each.
    fan_angle_deg
        Fan angle of the cross-hair lens, degrees.
    found
        What follows from them.
    picture_sha256
        The picture of the cross-hair, kept in the session; None where lengths were typed.
    fan_angle_sigma_deg
        Standard uncertainty of the fan angle, degrees; None in older files.
    resolution_mm
        Smallest step of the callipers, mm; None likewise.
    """

    l1_mm: tuple[float, ...]
    l2_mm: tuple[float, ...]
    l3_mm: tuple[float, ...]
    fan_angle_deg: float
    found: LaserCalibration
    picture_sha256: str | None = None
    fan_angle_sigma_deg: float | None = None
    resolution_mm: float | None = None


@dataclass(frozen=True)
class PlanePicture:
    """An imaging-plane calibration (§5.1) and what it was found from.

    Parameters
    ----------
    unit_mm
        Length of a unit of the target's axes, or edge of a board's squares, mm.
    found
        What was found in the picture.
    picture_sha256
        The picture, kept in the session.
    """

    unit_mm: float
    found: PlaneCalibration | BoardCalibration
    picture_sha256: str


@dataclass(frozen=True)
class MirrorPicture(ReadOnlyArrays):
    """A picture of a known mirror (bench check), and what became of its n dots with a ray.

    Parameters
    ----------
    name
        Of the picture's file.
    kind
        Which mirror it shows.
    height_mm
        Height of the plate's surface, or of the top of a cap or ball, over the work piece.
    diameter_mm
        Of the cap's rim or of the ball; None for a plate.
    picture_sha256
        The picture, kept in the session.
    ray
        Ray (i, j) of each dot, counted from 1, shape (n, 2).
    dot_px, computed_px
        Where it is, and where the adjusted bench has it, (u, v), shape (n, 2), px.
    residual_mm
        Observed minus computed dot on the plane, shape (n, 2), mm.
    measured
        The mirror, measured with the adjusted bench as if its size were not known: (name, known,
        measured, standard uncertainty by the noise of the dots), mm.
    """

    name: str
    kind: str
    height_mm: float
    diameter_mm: float | None
    picture_sha256: str
    ray: IntArray
    dot_px: FloatArray
    computed_px: FloatArray
    residual_mm: FloatArray
    measured: tuple[tuple[str, float, float, float], ...] = ()


@dataclass(frozen=True)
class BenchCheckRecord(ReadOnlyArrays):
    """A bench check and what it was found from.

    Parameters
    ----------
    date
        When it was made, ISO 8601.
    pictures
        The mirrors and their dots.
    quantities
        Keys of the q quantities that were adjusted (`uncertainty.QUANTITIES`).
    before, before_sigma, after, after_sigma
        Their values and standard uncertainties before and after, shape (q,), in their units.
    """

    date: str
    pictures: tuple[MirrorPicture, ...]
    quantities: tuple[str, ...]
    before: FloatArray
    before_sigma: FloatArray
    after: FloatArray
    after_sigma: FloatArray


@dataclass(frozen=True)
class Recording:
    """Where a session's frames come from, as it was found at import.

    Parameters
    ----------
    path
        Relative to the session's folder where that can be said, with ``/``; else absolute.
    size
        Of all its files together, bytes.
    sha256
        Of the file; of a recording of several files, of their names and SHA-256.
    description
        Codec, frame size, depth and rate, in words.
    frames, rows, columns, bit_depth
        Frames in the recording, of which a session may use a part; their size, px; significant
        bits of a grey level.
    frame_rate_hz
        The rate that the session's times follow; None where there is no time base.
    rate_is_given
        Whether the rate was given at import; otherwise it is the recording's own.
    frame_exact
        Whether frames read at random were those read in order.
    selected
        Start, stop and step of the frames that the session uses.
    embedded
        Whether the session holds these frames itself.
    warnings
        What the user should know, one sentence each.
    index
        What opening it again needs to know (`FrameSource.index`).
    imported
        When, ISO 8601.
    frames_sha256
        Of the number, time and checksum of every frame that the session uses.
    """

    path: str
    size: int
    sha256: str
    description: str
    frames: int
    rows: int
    columns: int
    bit_depth: int
    frame_rate_hz: float | None
    rate_is_given: bool
    frame_exact: bool
    selected: tuple[int, int, int]
    embedded: bool
    warnings: tuple[str, ...]
    index: bytes | None
    imported: str
    frames_sha256: str = ""
