"""Sample recordings of line patterns: a penetration run (§3.2.1) and pulsed GMAW (§3.3)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from labapp.core.geometry.line_pattern import LinePattern, LineRig
from labapp.core.geometry.rig import Electrode, ImagingPlane, Laser
from labapp.simulation.camera import CameraView
from labapp.simulation.recording import write_video
from labapp.simulation.render import Picture
from labapp.text import csv_text
from tests.line_truth.frames import LineLook, render_lines
from tests.line_truth.runs import gmaw_run, penetration_run

Rendered = tuple[list[Picture], list[list[str]]]
"""Frames, and their rows in the truth table."""


@dataclass(frozen=True)
class LineSample:
    """A sample recording of a line pattern, with its truth and a README."""

    name: str
    file: str
    """The recording's name: ``.avi`` or ``.tif``."""
    frame_rate_hz: float
    about: str
    """Text of the README."""
    rig: LineRig
    view: CameraView
    columns: tuple[str, ...]
    """Columns of the truth table."""
    render: Callable[[LineRig, CameraView], Rendered]

    def setup(self) -> str:
        """Return the text of the setup file."""
        rig, view = self.rig, self.view
        x, y, z = map(float, rig.imaging_plane.origin_mm)
        return f"""\
# The set-up of the sample run; every number is exact.
[laser]
projection_angle_deg = {rig.laser.projection_angle_deg}
distance_mm = {rig.laser.distance_mm}
aim_y_mm = {rig.laser.aim_y_mm}

[pattern]
kind = "lines"
count = {rig.pattern.count}
interline_angle_deg = {rig.pattern.interline_angle_deg}
fan_angle_deg = {rig.pattern.fan_angle_deg}

[electrode]
height_mm = {rig.electrode.height_mm}

[imaging_plane]
distance_mm = {-y}
s_mm = {-x}
h_mm = {z}
width_mm = {rig.imaging_plane.width_mm}
height_mm = {rig.imaging_plane.height_mm}

[image_calibration]
origin_px = {list(view.origin_px)}
x_axis_px = {list(view.x_axis_px)}
x_axis_mm = {view.x_axis_mm}
z_axis_px = {list(view.z_axis_px)}
z_axis_mm = {view.z_axis_mm}
"""

    def write(self, folder: Path) -> None:
        """Write recording, setup file, truth and README into ``folder``.

        Raises
        ------
        OSError
            If the folder or a file in it cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        images, rows = self.render(self.rig, self.view)
        path = folder / self.file
        if path.suffix == ".tif":
            tifffile.imwrite(path, np.array(images), photometric="minisblack", compression="zlib")
        else:
            size = (self.view.width_px, self.view.height_px)
            write_video(path, images, self.frame_rate_hz, size)
        (folder / "setup.toml").write_text(self.setup(), encoding="utf-8")
        truth = csv_text([self.columns, *rows])
        (folder / "truth.csv").write_text(truth, encoding="utf-8")
        (folder / "README.md").write_text(self.about, encoding="utf-8")


@functools.cache
def line_samples() -> tuple[LineSample, ...]:
    """Return every sample recording of lines."""
    return FIVE, GMAW


def _five(rig: LineRig, view: CameraView) -> Rendered:
    rng = np.random.default_rng(2007)
    images, rows = [], []
    for k, one in enumerate(penetration_run(64, rng)):
        images.append(render_lines(one.pool, rig, view, LineLook(), rng).image)
        size = None if one.pool is None else one.pool.size
        sizes = (0.0, 0.0, 0.0) if size is None else (size.width_mm, size.height_mm, size.depth_mm)
        rows.append([str(k), one.state, *(f"{value:.5f}" for value in sizes)])
    return images, rows


def _gmaw(rig: LineRig, view: CameraView) -> Rendered:
    images, rows = [], []
    for k, one in enumerate(gmaw_run(96, rig, view, np.random.default_rng(33))):
        images.append(one.image)
        rows.append([str(k), "on" if one.on else "off", f"{one.line_px[:, 1].mean():.3f}"])
    return images, rows


FIVE = LineSample(
    name="five_lines",
    file="recording.avi",
    frame_rate_hz=15.0,
    about="""\
# Five lines, simulated

The pattern of §3.2.1 of the dissertation, 0.23° apart with a fan of 5°, on a pool that grows,
hollow, to full penetration, stays, rises, and ends convex and smaller (Fig. 3-11 … 3-14):
64 frames, 15 a second. Made by `python -m tests.samples DIR`.

| file | what |
| --- | --- |
| `recording.avi` | the frames, 288 × 384 grey, FFV1 (lossless) |
| `setup.toml` | rig and image calibration, exact |
| `truth.csv` | state and size of the pool in each frame; zeros where there is none yet |

`labapp lines recording.avi --setup setup.toml --out DIR` measures it. Between concave and
convex the pool gathers the lines (`folded-lines`, a caustic): these frames show no shape.
""",
    rig=LineRig(
        Laser(27.0, 90.0),
        LinePattern(5, 0.23, 5.0),
        Electrode(5.0),
        ImagingPlane.vertical(53.6, 32.0, -5.0, 64.0, 84.0),
    ),
    view=CameraView((2.0, 382.0), (272.0, 382.0), 60.0, (2.0, 112.0), 60.0, 288, 384),
    columns=("frame", "state", "width_mm", "height_mm", "depth_mm"),
    render=_five,
)

GMAW = LineSample(
    name="gmaw",
    file="recording.tif",
    frame_rate_hz=1500.0,
    about="""\
# One line on a GMAW pool, simulated

One line on the steep front of a GMAW pool, 1500 frames a second, the current pulsed at 120 Hz
(§3.3 of the dissertation, Fig. 3-20): while a pulse is on, the arc outshines the line; spatter and
glare disturb the other frames. The pool swings at 34 Hz. Made by `python -m tests.samples DIR`.

| file | what |
| --- | --- |
| `recording.tif` | 96 frames, 240 × 180 grey, TIFF (deflate, lossless); without a time base |
| `setup.toml` | rig and image calibration, exact |
| `truth.csv` | whether the pulse is on, and the mean v of the line, px |

`labapp lines recording.tif --setup setup.toml --out DIR` follows the line. In the session, pulses
have a colour of their own on the timeline, and Trends shows how the line moves.
""",
    rig=LineRig(
        Laser(70.0, 60.0, aim_y_mm=-2.4),
        LinePattern(1, 0.23, 4.0),
        Electrode(15.0),
        ImagingPlane.vertical(20.0, 32.0, -4.0, 64.0, 48.0),
    ),
    view=CameraView((0.0, 179.0), (225.0, 179.0), 60.0, (0.0, 29.0), 40.0, 240, 180),
    columns=("frame", "pulse", "line_v_px"),
    render=_gmaw,
)
