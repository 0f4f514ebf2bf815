"""Opening of cameras by id, including simulated ones."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from labapp.config.scenario import read_scenario
from labapp.errors import InputError
from labapp.media import GreyImage, open_source
from labapp.media.cameras import (
    Camera,
    SimulatedDevice,
    open_camera,
    there_and_back,
)
from labapp.simulated.simulate import simulate
from labapp.simulation.parallel import Progress

SIMULATED = "simulated:"

FRAMES = 48
"""Number of frames rendered of a scenario, which are played forwards and backwards."""

MOST_BYTE = 400_000_000
"""Limits of the frames of a recording that a simulated camera loads; it plays the first ones."""

USUAL_HZ = 60.0


def camera_opener(id: str, progress: Progress | None = None) -> Callable[[], Camera]:
    """Function that opens a camera at each call; for `Feed`.

    Parameters
    ----------
    id
        Id from `find_cameras`; or "simulated:FILE", a scenario or any recording that is played like
        the pictures of a camera, forwards and backwards endlessly.
    progress
        Called for each rendered frame of a scenario.

    Raises
    ------
    InputError
        If there is no such kind of camera, or a file cannot be played.
    """
    if id.startswith(SIMULATED):
        return simulated_device(Path(id.removeprefix(SIMULATED)), progress).open
    return partial(open_camera, id)


def simulated_device(path: Path, progress: Progress | None = None) -> SimulatedDevice:
    """Create a camera that plays a file; see `camera_opener`."""
    if path.suffix == ".toml":
        images, depth, rate_hz = _rendered(path, progress)
    else:
        images, depth, rate_hz = _recorded(path)
    return SimulatedDevice(
        str(path),
        there_and_back(images),
        bit_depth=depth,
        rate_hz=rate_hz or USUAL_HZ,
    )


def _rendered(path: Path, progress: Progress | None) -> tuple[list[GreyImage], int, float | None]:
    scenario = read_scenario(path, frames=FRAMES)
    with tempfile.TemporaryDirectory(prefix="labapp-") as folder:
        simulate(scenario, Path(folder) / "run", progress=progress)
        return _recorded(Path(folder) / "run" / scenario.recording.file)


def _recorded(path: Path) -> tuple[list[GreyImage], int, float | None]:
    with open_source(path) as source:
        images: list[GreyImage] = []
        for frame in source:
            if frame.image.dtype not in (np.uint8, np.uint16):
                expected = "a recording with 8 or 16 bits, like that of a camera"
                raise InputError(path, "grey levels", frame.image.dtype, expected)
            images.append(frame.image)
            if len(images) * frame.image.nbytes > MOST_BYTE:
                break
        return images, source.bit_depth, source.frame_rate_hz
