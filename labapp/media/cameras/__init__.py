"""Cameras, whatever they are connected by: `find_cameras`, `open_camera`, and `Feed`."""

from __future__ import annotations

from labapp.errors import InputError
from labapp.media.cameras import aravis, uvc
from labapp.media.cameras.base import (
    BrokenFrame,
    Camera,
    CameraError,
    CameraFrame,
    CameraInfo,
    CameraLost,
    CameraSettings,
    Limits,
    Range,
    Region,
    Trigger,
)
from labapp.media.cameras.feed import Counts, Feed
from labapp.media.cameras.simulated import Faults, SimulatedDevice, there_and_back

__all__ = [
    "BrokenFrame",
    "Camera",
    "CameraError",
    "CameraFrame",
    "CameraInfo",
    "CameraLost",
    "CameraSettings",
    "Counts",
    "Faults",
    "Feed",
    "Limits",
    "Range",
    "Region",
    "SimulatedDevice",
    "Trigger",
    "find_cameras",
    "open_camera",
    "there_and_back",
]


def find_cameras() -> tuple[list[CameraInfo], list[str]]:
    """Cameras that are connected, and why some kinds could not be looked for; about a second."""
    found, problems = uvc.find_uvc(), []
    try:
        found += aravis.find_genicam()
    except CameraError as error:
        problems.append(str(error))
    return found, problems


def open_camera(id: str) -> Camera:
    """Open a camera by its id, as `find_cameras` has it.

    Raises
    ------
    InputError
        If there is no such kind of camera.
    CameraError
        If it is not there or cannot be opened: what to do about it.
    """
    if id.startswith(aravis.PREFIX):
        named = next((info for info in aravis.find_genicam() if info.id == id), None)
        if named is None:
            raise CameraLost(f"{id} is not connected")
        return aravis.GenicamCamera(named)
    number = id.removeprefix(uvc.PREFIX)
    if id.startswith(uvc.PREFIX) and number.isdecimal():
        known = (info for info in uvc.find_uvc() if info.id == id)
        return uvc.UvcCamera(next(known, CameraInfo(id, id, uvc.KIND)))
    expected = f"{uvc.PREFIX}NUMBER or {aravis.PREFIX}NAME, as labapp cameras lists them"
    raise InputError(id, "camera", id, expected)
