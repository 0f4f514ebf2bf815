"""GenICam cameras, GigE Vision and USB3 Vision, through Aravis."""

from __future__ import annotations

import contextlib
import ctypes
import time
from ctypes import byref, c_int, c_size_t
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labapp.errors import InputError
from labapp.media.base import GreyImage
from labapp.media.cameras.base import (
    BrokenFrame,
    Camera,
    CameraError,
    CameraFrame,
    CameraInfo,
    CameraKind,
    CameraLost,
    CameraSettings,
    Limits,
    Range,
    Trigger,
    buffered,
    check_settings,
)
from labapp.media.cameras.genicam import ControlLost, aravis

PREFIX = "aravis:"

KINDS = {"GigEVision": "GigE Vision", "USB3Vision": "USB3 Vision", "Fake": "Aravis's own"}

DEPTHS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono14": 14, "Mono16": 16}
"""Supported pixel formats, by GenICam's names, and their bits."""

BROKEN = {
    2: "its end did not arrive in time",
    3: "packets are missing",
    4: "its packets have wrong numbers",
    5: "it is larger than announced",
    7: "it was aborted",
}
"""Problem of a frame, by Aravis's status."""

SOFTWARE, USUAL_LINE = b"Software", b"Line1"
"""Sources of a trigger, by GenICam's names."""

LARGEST_SHORT_ID = 0xFFFF
"""Largest frame number of GigE Vision without 64-bit numbers, after which 1 follows."""


def find_genicam() -> list[CameraInfo]:
    """Return the cameras that Aravis finds; takes about 1 s.

    Raises
    ------
    CameraError
        If Aravis is not installed.
    """
    arv = aravis().arv
    arv.arv_update_device_list()
    found = []
    for k in range(arv.arv_get_n_devices()):
        texts = (
            getattr(arv, f"arv_get_device_{name}")(k)
            for name in ("id", "vendor", "model", "protocol")
        )
        id_, vendor, model, protocol = ((text or b"").decode(errors="replace") for text in texts)
        kind = KINDS.get(protocol, protocol)
        found.append(CameraInfo(f"{PREFIX}{id_}", f"{vendor} {model}".strip(), kind))
    return found


class GenicamCamera(Camera):
    """An open GenICam camera; see `Camera`.

    Raises
    ------
    CameraError
        If it is not connected, is used by another program, or has no greyscale format.
    """

    def __init__(self, info: CameraInfo) -> None:
        self.info = info
        self._aravis = aravis()
        try:
            self._camera = self._aravis.open(info.id.removeprefix(PREFIX))
        except CameraError as error:
            raise CameraLost(f"{info.name} cannot be opened: {error}") from error
        self._stream: _Stream | None = None
        self._is_lost = False
        self._line = b""
        """Input for the trigger signal; empty if there is none."""
        self._hook = 0
        self._on_lost = ControlLost(self._note_loss)
        try:
            self._hook = self._aravis.when_lost(self._camera, self._on_lost)
            self._check_control()
            self.bit_depth = self._choose_format()
            for name in ("exposure", "gain"):
                self._switch_auto_off(name)
            sources = self._aravis.texts(self._camera, "dup_available_trigger_sources")
            lines = [name for name in sources if name.startswith(b"Line")]
            self._line = USUAL_LINE if USUAL_LINE in lines else b"".join(lines[:1])
            self.limits = self._limits()
        except BaseException:
            self.close()
            raise

    # --- settings -----------------------------------------------------------------------------

    @property
    def settings(self) -> CameraSettings:
        """Present settings, as reported by the camera."""
        limits = self.limits
        sides = [c_int() for _ in range(4)]
        self._ask("get_region", *map(byref, sides))
        u, v, width, height = (side.value for side in sides)
        return CameraSettings(
            exposure_us=self._ask("get_exposure_time") if limits.exposure_us else None,
            gain_db=self._ask("get_gain") if limits.gain_db else None,
            rate_hz=self._ask("get_frame_rate") if limits.rate_hz else None,
            region=(u, v, width, height),
            trigger=self._trigger(),
        )

    def apply(self, wanted: CameraSettings) -> CameraSettings:
        """Apply settings; see `Camera.apply`."""
        if self._stream is not None:
            raise CameraError(f"{self.info.name} is running: stop it before it is set")
        check_settings(self.info, self.limits, replace(wanted, rate_hz=None))
        before = self.settings
        try:
            self._set(wanted)
        except (CameraError, InputError):
            self._restore(before, set(wanted.specified()))
            raise
        return self.settings

    def _set(self, wanted: CameraSettings) -> None:
        if wanted.region is not None:
            self._ask("set_region", *wanted.region)
        if wanted.exposure_us is not None:
            self._ask("set_exposure_time", wanted.exposure_us)
        if wanted.gain_db is not None:
            self._ask("set_gain", wanted.gain_db)
        if wanted.rate_hz is not None:
            # The highest frame rate depends on frame size and exposure.
            self.limits = self._limits()
            check_settings(self.info, self.limits, CameraSettings(rate_hz=wanted.rate_hz))
            self._ask("set_frame_rate", wanted.rate_hz)
        if wanted.trigger is not None and wanted.trigger != "free":
            self._ask("set_trigger", SOFTWARE if wanted.trigger == "software" else self._line)
        elif wanted.trigger is not None and len(self.limits.triggers) > 1:
            self._ask("clear_triggers")
        self.limits = self._limits()

    def _restore(self, before: CameraSettings, names: set[str]) -> None:
        """Restore changed settings one by one, as far as possible."""
        if "trigger" in names:
            names.add("rate_hz")  # replaced by a trigger
        for name in ("region", "exposure_us", "gain_db", "rate_hz", "trigger"):
            if name in names:
                with contextlib.suppress(CameraError, InputError):
                    self._set(CameraSettings(**{name: getattr(before, name)}))

    def _limits(self) -> Limits:
        def span(name: str, feature: str) -> Range | None:
            if not self._ask(f"is_{feature}_available"):
                return None
            return Range(*self._aravis.pair(self._camera, f"get_{name}_bounds"))

        triggers: list[Trigger] = ["free"]
        if self._ask("is_feature_available", b"TriggerMode"):
            if self._ask("is_software_trigger_supported"):
                triggers.append("software")
            if self._line:
                triggers.append("line")
        width, _ = self._aravis.pair(self._camera, "get_width_bounds")
        height, _ = self._aravis.pair(self._camera, "get_height_bounds")
        return Limits(
            exposure_us=span("exposure_time", "exposure_time"),
            gain_db=span("gain", "gain"),
            rate_hz=span("frame_rate", "frame_rate"),
            sensor=self._aravis.pair(self._camera, "get_sensor_size"),
            least_region=(width, height),
            triggers=tuple(triggers),
        )

    def _trigger(self) -> Trigger:
        if "line" not in self.limits.triggers or self._ask("get_string", b"TriggerMode") != b"On":
            return "free"
        source = self._ask("get_string", b"TriggerSource")
        return "software" if source == SOFTWARE else "line"

    def _choose_format(self) -> int:
        """Set Mono8 unless the format is greyscale already; returns the bits of the format."""
        name = self._ask("get_pixel_format_as_string").decode()
        if name not in DEPTHS:
            try:
                self._ask("set_pixel_format_from_string", b"Mono8")
            except CameraError as error:
                words = f"{self.info.name} has the format {name} and no greyscale (Mono8)"
                raise CameraError(words) from error
            name = "Mono8"
        return DEPTHS[name]

    def _switch_auto_off(self, name: str) -> None:
        if self._ask(f"is_{name}_auto_available"):
            self._ask(f"set_{'exposure_time' if name == 'exposure' else name}_auto", 0)

    def _check_control(self) -> None:
        arv = self._aravis.arv
        if arv.arv_camera_is_gv_device(self._camera):
            device = arv.arv_camera_get_device(self._camera)
            if not arv.arv_gv_device_is_controller(device):
                raise CameraError(f"{self.info.name} is used by another program: close that")

    def _ask(self, name: str, *given: object) -> Any:
        if self._is_lost:
            raise CameraLost(f"{self.info.name} does not answer any more")
        return self._aravis.ask(self._camera, name, *given)

    # --- frames -------------------------------------------------------------------------------

    def start(self) -> None:
        """Start acquisition."""
        if self._stream is not None:
            return
        self._ask("set_acquisition_mode", 0)
        stream = self._ask("create_stream", None, None)
        frame_byte = self._ask("get_payload")
        for _ in range(buffered(frame_byte, self.settings.rate_hz)):
            buffer = self._aravis.arv.arv_buffer_new_allocate(frame_byte)
            self._aravis.arv.arv_stream_push_buffer(stream, buffer)
        self._stream = _Stream(stream)
        self._ask("start_acquisition")

    def read(self, timeout_s: float) -> CameraFrame | None:
        """Wait for the next frame; see `Camera.read`."""
        stream, arv = self._stream, self._aravis.arv
        if stream is None:
            raise CameraError(f"{self.info.name} was not started")
        buffer = arv.arv_stream_timeout_pop_buffer(stream.handle, round(timeout_s * 1e6))
        if not buffer:
            if self._is_lost:
                raise CameraLost(f"{self.info.name} does not answer any more")
            return None
        try:
            status = arv.arv_buffer_get_status(buffer)
            if status != 0:
                raise BrokenFrame(BROKEN.get(status, f"its status is {status}"))
            number = stream.number(arv.arv_buffer_get_frame_id(buffer))
            clock = arv.arv_buffer_get_timestamp(buffer)
            time_s = (clock or arv.arv_buffer_get_system_timestamp(buffer)) / 1e9
            return CameraFrame(number, time_s, time.monotonic(), self._image(buffer))
        finally:
            arv.arv_stream_push_buffer(stream.handle, buffer)

    def _image(self, buffer: int) -> GreyImage:
        arv, size = self._aravis.arv, c_size_t()
        place = arv.arv_buffer_get_data(buffer, byref(size))
        rows = arv.arv_buffer_get_image_height(buffer)
        columns = arv.arv_buffer_get_image_width(buffer)
        kind = np.dtype(np.uint8 if self.bit_depth <= 8 else np.uint16)
        needed = rows * columns * kind.itemsize
        if not place or size.value < needed:
            raise BrokenFrame(f"it has {size.value} bytes, not {needed}")
        content = ctypes.string_at(place, needed)
        return np.frombuffer(content, kind).reshape(rows, columns)

    def trigger(self) -> None:
        """Take a frame now."""
        self._ask("software_trigger")

    def stop(self) -> None:
        """Stop acquisition."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        with contextlib.suppress(CameraError):  # it may be disconnected
            self._ask("stop_acquisition")
        self._aravis.release(stream.handle)

    def close(self) -> None:
        """Release the camera."""
        self.stop()
        camera, self._camera = self._camera, 0
        if camera:
            if self._hook:
                self._aravis.unhook(camera, self._hook)
            self._aravis.release(camera)

    def _note_loss(self, *_: object) -> None:
        """Note the loss of the camera; called in a thread of Aravis."""
        self._is_lost = True


@dataclass
class _Stream:
    """A stream of frames, with the state of their numbers."""

    handle: int
    turns: int = 0
    last: int = -1

    def number(self, frame_id: int) -> int:
        """Return the number of a frame, continued after an overflow of 16 bits."""
        if frame_id < self.last <= LARGEST_SHORT_ID and self.last - frame_id > LARGEST_SHORT_ID / 2:
            self.turns += 1
        self.last = frame_id
        return frame_id + self.turns * LARGEST_SHORT_ID


def _open(id: str) -> Camera:
    named = next((info for info in find_genicam() if info.id == id), None)
    if named is None:
        raise CameraLost(f"{id} is not connected")
    return GenicamCamera(named)


GENICAM = CameraKind(f"{PREFIX}NAME", find_genicam, _open)
