"""Interface of cameras: `Camera`, settings and frames.

All back-ends implement `Camera`; `feed.Feed` keeps one running in spite of faults.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Protocol, Self

from labapp.core.values import ReadOnlyArrays
from labapp.errors import InputError
from labapp.media.base import GreyImage

Trigger = Literal["free", "software", "line"]
"""Trigger of frames: free-running, by software, or by a signal at the camera's input."""

Region = tuple[int, int, int, int]
"""(u, v, width, height) of the region of the sensor that is read out, px."""

NUMBERS = {"exposure_us": "µs", "gain_db": "dB", "rate_hz": "frames/s"}
"""Numeric settings and their units."""

BUFFERED_S, BUFFERED_BYTE, LEAST_BUFFERED = 2.0, 128_000_000, 32
"""Size of the frame buffer: duration, s; limit of memory, bytes; fewest frames."""


class CameraError(Exception):
    """A request to a camera failed; the message says why, and what to do about it."""


class CameraLost(CameraError):
    """The camera is disconnected or used by another program, and must be opened again."""


class BrokenFrame(CameraError):
    """A frame arrived incomplete; the next may be complete."""


@dataclass(frozen=True)
class CameraInfo:
    """A camera that was found."""

    id: str
    """Id for opening it: "uvc:0", "aravis:Vendor-Serial", "simulated:cap.toml"."""
    name: str
    """Vendor and model, as it reports them."""
    kind: str
    """Interface: "USB video", "GigE Vision", "USB3 Vision", "simulated"."""


@dataclass(frozen=True)
class Range:
    """Range of a setting, from ``lowest`` to ``highest``, both included."""

    lowest: float
    highest: float


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Ranges of a camera's settings; None: cannot be set."""

    exposure_us: Range | None = None
    gain_db: Range | None = None
    rate_hz: Range | None = None
    """Lowest and highest value."""
    sensor: tuple[int, int]
    """(width, height) of the whole picture, px."""
    least_region: tuple[int, int] | None = None
    """(width, height) of the smallest region, px; None if no region can be set."""
    triggers: tuple[Trigger, ...] = ("free",)
    """Supported triggers, including "free"."""
    gain_unit: str = "dB"
    """Unit of the gain for display; empty for driver-specific steps."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Present or requested settings of a camera; None: unknown, or unchanged."""

    exposure_us: float | None = None
    """Exposure time, µs."""
    gain_db: float | None = None
    """Gain, dB (for USB video in steps of the driver)."""
    rate_hz: float | None = None
    region: Region | None = None
    trigger: Trigger | None = None

    def specified(self) -> dict[str, Any]:
        """Return the settings that are not None, by name."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in found.items() if value is not None}

    def describe(self) -> str:
        """Describe the settings that are not None: "exposure 800 µs, rate 200 frames/s"."""
        parts = []
        for name, value in self.specified().items():
            unit = NUMBERS.get(name)
            shown = value if unit is None else f"{value:.6g} {unit}"
            parts.append(f"{name.partition('_')[0]} {shown}")
        return ", ".join(parts)


@dataclass(frozen=True)
class CameraFrame(ReadOnlyArrays):
    """A frame of a camera."""

    number: int
    """Frame number by the camera; a gap means frames lost in transfer."""
    time_s: float
    """Time by the camera's clock, s; by the computer's if the camera has none."""
    arrived_s: float
    """`time.monotonic` at its arrival, s."""
    image: GreyImage = field(repr=False)
    """Grey levels, shape (rows, columns), uint8 or uint16, read-only."""


class Camera(Protocol):
    """An open camera. To be used by one thread at a time."""

    info: CameraInfo
    """Its id, name and kind."""
    limits: Limits
    """Ranges of its settings."""
    bit_depth: int
    """Significant bits of a grey level."""

    @property
    def settings(self) -> CameraSettings:
        """Present settings by the camera, which rounds values, and whose settings interact."""
        ...

    def apply(self, wanted: CameraSettings) -> CameraSettings:
        """Apply the settings that are not None; not during acquisition.

        Returns
        -------
        CameraSettings
            The resulting settings.

        Raises
        ------
        InputError
            If a value is out of range or cannot be set; nothing is changed then.
        CameraError
            If the camera rejects a setting.
        """
        ...

    def start(self) -> None:
        """Start acquisition; frame numbers begin anywhere."""
        ...

    def read(self, timeout_s: float) -> CameraFrame | None:
        """Wait for the next frame; None after the timeout.

        Raises
        ------
        BrokenFrame
            If an incomplete frame arrived.
        CameraLost
            If the camera is disconnected.
        """
        ...

    def trigger(self) -> None:
        """Trigger a frame; only with the trigger "software"."""
        ...

    @property
    def dropped(self) -> int:
        """Frames since `start` that camera or driver dropped without a gap in the numbers."""
        return 0

    def stop(self) -> None:
        """Stop acquisition, after which settings may be changed. May be called twice."""
        ...

    def close(self) -> None:
        """Release the camera. May be called twice."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class CameraKind:
    """A kind of cameras, with functions to find and open them."""

    form: str
    """Form of the ids: common prefix with a colon, and a word for the rest: "uvc:NUMBER"."""
    find: Callable[[], list[CameraInfo]]
    """Lists the connected cameras; may raise `CameraError` if that is impossible."""
    open: Callable[[str], Camera]
    """Opens a camera by its id; may raise `InputError` for an invalid id, and `CameraError` if the
    camera is not connected or cannot be opened.
    """

    @property
    def prefix(self) -> str:
        """Common prefix of the ids."""
        return self.form[: self.form.index(":") + 1]


def check_settings(info: CameraInfo, limits: Limits, wanted: CameraSettings) -> None:
    """Check settings against a camera's limits.

    Raises
    ------
    InputError
        If settings are out of range or cannot be set; it names all of them.
    """
    problems = []
    for name, unit in NUMBERS.items():
        value, span = getattr(wanted, name), getattr(limits, name)
        if value is None:
            continue
        if span is None:
            problems.append(_cannot(info, name, value))
        elif not span.lowest <= value <= span.highest:
            bounds = f"from {span.lowest:.6g} to {span.highest:.6g} ({unit})"
            problems.append(InputError(info.id, name, value, bounds))
    if wanted.trigger is not None and wanted.trigger not in limits.triggers:
        known = "one of " + ", ".join(limits.triggers)
        problems.append(InputError(info.id, "trigger", wanted.trigger, known))
    problems += _check_region(info, limits, wanted.region)
    if problems:
        raise InputError.gather(problems)


def _check_region(info: CameraInfo, limits: Limits, region: Region | None) -> list[InputError]:
    if region is None:
        return []
    if limits.least_region is None:
        if region == (0, 0, *limits.sensor):
            return []
        return [_cannot(info, "region", region)]
    u, v, width, height = region
    least, sensor = limits.least_region, limits.sensor
    fits = min(u, v) >= 0 and u + width <= sensor[0] and v + height <= sensor[1]
    if fits and width >= least[0] and height >= least[1]:
        return []
    right = (
        f"(u, v, width, height) within {sensor[0]}×{sensor[1]} px, "
        f"at least {least[0]}×{least[1]} px"
    )
    return [InputError(info.id, "region", region, right)]


def _cannot(info: CameraInfo, name: str, value: object) -> InputError:
    return InputError(info.id, name, value, f"nothing: {info.name} does not let it be set")


def buffered(frame_byte: int, rate_hz: float | None) -> int:
    """Return the size of the frame buffer, which bridges delays of the reader."""
    wanted = round(BUFFERED_S * (rate_hz or 0.0))
    return max(LEAST_BUFFERED, min(wanted, BUFFERED_BYTE // frame_byte))
