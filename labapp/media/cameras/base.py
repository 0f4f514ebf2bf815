"""A camera: what it is, what can be set, and its frames as they come.

Every back-end gives the same: `Camera`. What keeps one going whatever it does is `feed.Feed`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Protocol, Self

from labapp.core.values import ReadOnlyArrays
from labapp.errors import InputError
from labapp.media.base import GreyImage

Trigger = Literal["free", "software", "line"]
"""When a frame is taken: at the camera's own rate, by software, at a signal on its input."""

Region = tuple[int, int, int, int]
"""(u, v, width, height) of the part of the sensor that is read out, px."""

NUMBERS = {"exposure_us": "µs", "gain_db": "dB", "rate_hz": "frames/s"}
"""What is set by a number, and its unit."""

BUFFERED_S, BUFFERED_BYTE, LEAST_BUFFERED = 2.0, 128_000_000, 32
"""Frames that wait for their reader: a duration, s, limited by an amount of memory, bytes."""


class CameraError(Exception):
    """A camera did not do what was requested; the message says what, and what to do about it."""


class CameraLost(CameraError):
    """The camera is gone, or no longer ours: nothing more comes until it is opened again."""


class BrokenFrame(CameraError):
    """A frame arrived incomplete; the next may be complete."""


@dataclass(frozen=True)
class CameraInfo:
    """A camera that was found."""

    id: str
    """What it is opened by: "uvc:0", "aravis:Vendor-Serial", "simulated:cap.toml"."""
    name: str
    """Maker and model, as it reports them."""
    kind: str
    """How it is connected: "USB video", "GigE Vision", "USB3 Vision", "simulated"."""


@dataclass(frozen=True)
class Range:
    """What a number may be set to: from ``lowest`` to ``highest``, both included."""

    lowest: float
    highest: float


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What can be set on a camera; None for what cannot."""

    exposure_us: Range | None = None
    gain_db: Range | None = None
    rate_hz: Range | None = None
    """Lowest and highest value."""
    sensor: tuple[int, int]
    """(width, height) of the whole picture, px."""
    least_region: tuple[int, int] | None = None
    """(width, height) of the smallest region, px; None where no region can be set."""
    triggers: tuple[Trigger, ...] = ("free",)
    """The triggers it knows, "free" among them."""
    gain_unit: str = "dB"
    """Of the gain, for people; empty where it is in the driver's own steps."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """What a camera is set to, or is to be; None: unknown, or left as it is."""

    exposure_us: float | None = None
    """How long light is gathered for a frame, µs."""
    gain_db: float | None = None
    """Amplification, dB (of USB video the driver's own number)."""
    rate_hz: float | None = None
    region: Region | None = None
    trigger: Trigger | None = None

    def specified(self) -> dict[str, Any]:
        """Settings that are not None, by name."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in found.items() if value is not None}

    def describe(self) -> str:
        """Settings that are not None as text: "exposure 800 µs, rate 200 frames/s"."""
        parts = []
        for name, value in self.specified().items():
            unit = NUMBERS.get(name)
            shown = value if unit is None else f"{value:.6g} {unit}"
            parts.append(f"{name.partition('_')[0]} {shown}")
        return ", ".join(parts)


@dataclass(frozen=True)
class CameraFrame(ReadOnlyArrays):
    """A frame as a camera gave it."""

    number: int
    """The camera's own count; a gap means frames that were lost in transfer."""
    time_s: float
    """The camera's clock, s; by the computer's where the camera has none."""
    arrived_s: float
    """`time.monotonic` at its arrival, s."""
    image: GreyImage = field(repr=False)
    """Grey levels, shape (rows, columns), uint8 or uint16, read-only."""


class Camera(Protocol):
    """A camera that is open. Used by one thread at a time."""

    info: CameraInfo
    """Which it is."""
    limits: Limits
    """What can be set."""
    bit_depth: int
    """Significant bits of a grey level."""

    @property
    def settings(self) -> CameraSettings:
        """What it is set to, as the camera says: it rounds, and one setting bounds another."""
        ...

    def apply(self, wanted: CameraSettings) -> CameraSettings:
        """Set what is not None in ``wanted``; not while frames come.

        Returns
        -------
        CameraSettings
            What it is set to now.

        Raises
        ------
        InputError
            If a value is out of range or cannot be set; nothing is changed then.
        CameraError
            If the camera refuses.
        """
        ...

    def start(self) -> None:
        """Let frames come, numbered from any number on."""
        ...

    def read(self, timeout_s: float) -> CameraFrame | None:
        """Wait for the next frame; None when none came in time.

        Raises
        ------
        BrokenFrame
            If an incomplete one arrived.
        CameraLost
            If none will come any more.
        """
        ...

    def trigger(self) -> None:
        """Take a frame now; with the trigger "software" only."""
        ...

    @property
    def dropped(self) -> int:
        """Frames since `start` that camera or driver had no room for and no number shows."""
        ...

    def stop(self) -> None:
        """Let no more frames come; settings may be changed then. Twice does no harm."""
        ...

    def close(self) -> None:
        """Release the camera. Closing twice does no harm."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class CameraKind:
    """What cameras of a kind are found and opened by."""

    form: str
    """How an id is written: what all ids of the kind begin with, to the colon, and a word for the
    rest: "uvc:NUMBER".
    """
    find: Callable[[], list[CameraInfo]]
    """Lists those that are connected; may raise `CameraError` where that is unknown."""
    open: Callable[[str], Camera]
    """Opens the camera of an id; may raise `InputError` for an id that no camera has, and
    `CameraError` where the camera is not there or cannot be opened.
    """

    @property
    def prefix(self) -> str:
        """What its ids begin with."""
        return self.form[: self.form.index(":") + 1]


def check_settings(info: CameraInfo, limits: Limits, wanted: CameraSettings) -> None:
    """Refuse what a camera cannot be set to.

    Raises
    ------
    InputError
        That names every such setting.
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
    """How many frames are to wait for their reader, who comes late where a computer is busy."""
    wanted = round(BUFFERED_S * (rate_hz or 0.0))
    return max(LEAST_BUFFERED, min(wanted, BUFFERED_BYTE // frame_byte))
