"""The scene of the simulated camera: an oscillating pool on the session's bench."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from labapp.config.scenario import read_scenario
from labapp.errors import InputError
from labapp.media import GreyImage
from labapp.media.cameras import SimulatedDevice, there_and_back
from labapp.session.session import Session

POOL = """\
# An oscillating pool

[pool]
shape = "egg"
width_mm = 6.66
head_mm = 3.0
tail_mm = 4.4
height_mm = 0.29
center_mm = [0.0, -0.6]
wander_percent = 0.3

[[pool.wave]]
mode = [0, 1]
amplitude_mm = 0.03
frequency_hz = 2.727
kind = "standing"

[look]
hot_pixels = 2
missing = 0.01

[recording]
frames = 12
frame_rate_hz = 60.0
exposure_ms = 0.5
seed = 4801
"""

BENCH = """
[laser]
projection_angle_deg = 31.14
distance_mm = 31.48

[pattern]
rows = 19
columns = 19
inter_beam_angle_deg = 0.77

[electrode]
height_mm = 5.0

[imaging_plane]
distance_mm = 50.0
s_mm = 45.0
h_mm = 3.0
width_mm = 101.6
height_mm = 101.6

[image_calibration]
origin_px = [44.0, 590.0]
x_axis_px = [242.02, 590.0]
x_axis_mm = 34.925
z_axis_px = [44.0, 499.99]
z_axis_mm = 15.875
"""
"""Bench if the session's set-up is incomplete or its camera cannot be simulated."""


def simulated_pool(session: Session) -> str:
    """Text of a scenario of a pool on the session's bench, or on the default bench without one."""
    try:
        return f"{POOL}\n{session.setup.text}"
    except InputError:
        return f"{POOL}{BENCH}"


def pool_camera(text: str, progress: Callable[[int, int], None]) -> SimulatedDevice:
    """Create a camera that films the pool of a scenario endlessly.

    The pool oscillates equally fast at every frame rate: a faster camera repeats some frames.

    Parameters
    ----------
    text
        Text from `simulated_pool`; the default bench replaces one that cannot be simulated.
    progress
        Called with the number of frames rendered and in total; an exception ends the rendering.
    """
    with tempfile.TemporaryDirectory(prefix="labapp-") as folder:
        path = Path(folder) / "pool.toml"
        path.write_text(text, encoding="utf-8")
        try:
            recording = read_scenario(path).recording
        except InputError:  # a homography
            path.write_text(f"{POOL}{BENCH}", encoding="utf-8")
            recording = read_scenario(path).recording
    images: list[GreyImage] = []
    for number in range(len(recording.pools)):
        progress(number, len(recording.pools))
        images.append(recording.frame(number).image)
    rate_hz, film = recording.frame_rate_hz or 60.0, there_and_back(images)

    def filmed(number: int) -> GreyImage:
        return film(int(number * rate_hz / (device.settings.rate_hz or rate_hz)))

    device = SimulatedDevice("pool", film, rate_hz=rate_hz)
    device.picture = filmed
    return device
