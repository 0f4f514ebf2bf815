"""Cameras of all kinds: `find_cameras`, `open_camera`, and `Feed`."""

from __future__ import annotations

from labapp.errors import InputError
from labapp.media.cameras import aravis, uvc
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
    Region,
    Trigger,
)
from labapp.media.cameras.feed import Counts, Feed
from labapp.media.cameras.simulated import SimulatedDevice, there_and_back

__all__ = [
    "KINDS",
    "BrokenFrame",
    "Camera",
    "CameraError",
    "CameraFrame",
    "CameraInfo",
    "CameraKind",
    "CameraLost",
    "CameraSettings",
    "Counts",
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


KINDS: list[CameraKind] = [uvc.USB_VIDEO, aravis.GENICAM]
"""The kinds of cameras, in the order of listing."""


def find_cameras() -> tuple[list[CameraInfo], list[str]]:
    """Return the connected cameras, and problems of kinds that cannot be searched; takes 1 s."""
    found: list[CameraInfo] = []
    problems: list[str] = []
    for kind in KINDS:
        try:
            found += kind.find()
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
        If it is not connected or cannot be opened; the message says what to do.
    """
    for kind in KINDS:
        if id.startswith(kind.prefix):
            return kind.open(id)
    forms = " or ".join(kind.form for kind in KINDS)
    raise InputError(id, "camera", id, f"{forms}, as labapp cameras lists them")
