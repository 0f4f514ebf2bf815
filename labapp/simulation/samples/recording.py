"""A simulated recording, its truth, and the folder that holds both."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from labapp.core.rig import Electrode, Rig
from labapp.core.values import BoolArray, FloatArray, freeze
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import Pool
from labapp.simulation.render import CameraView, GreyImage, Look, ray_brightness, render
from labapp.simulation.samples.torch import Torch
from labapp.simulation.target import Target, TargetLook, render_target

TARGET = Target()

TRUTH_HEADER = (
    "frame,time_s,width_mm,length_mm,height_mm,depth_mm,area_mm2,volume_mm3,"
    "peak_x_mm,peak_y_mm,dots"
)
DOTS_HEADER = "frame,ray_row,ray_column,u_px,v_px,visible,x_mm,y_mm,z_mm"

FILES = f"""\
| file | what |
| --- | --- |
| `{{file}}` | the frames, {{width}} × {{height}} grey, {{codec}} |
| `calibration.png` | the imaging plane with its marks: unit {TARGET.unit_mm:g} mm, middle of the \
X′ bar at {TARGET.x_middle_mm:g} mm (5.5 units), of the Z′ bar at {TARGET.z_middle_mm:g} mm \
(2.5 units): `labapp calibrate plane calibration.png --unit-mm {TARGET.unit_mm:g}` |
| `setup.toml` | rig and image calibration, exact |
| `truth.csv` | size of the pool in each frame |
| `dots_truth.csv` | each lit ray in each frame: where its dot is, whether it shows, where it met \
the pool |
"""
"""What the files of every sample are; `file` and `codec` are the recording's."""


@dataclass(frozen=True)
class SampleFrame:
    """A frame with what it was rendered from.

    Parameters
    ----------
    pool, reflections
        The truth.
    image
        Grey levels, shape (height, width), 8 bit; 16 bit where exposures were added up.
    dot_px
        (u, v) of each ray's dot, shape (rows, columns, 2), px; NaN where the ray makes none.
    shown
        Rays whose dot is in the picture, shape (rows, columns).
    """

    pool: Pool
    reflections: Reflections
    image: npt.NDArray[np.uint8 | np.uint16]
    dot_px: FloatArray
    shown: BoolArray

    def __post_init__(self) -> None:
        freeze(self)


@dataclass(frozen=True)
class Sample:
    """A recording to be simulated; everything random in it follows from its seed.

    Parameters
    ----------
    name
        Of its folder.
    file, codec
        The recording's: a video (``.avi``, ``.mkv``), a TIFF stack (``.tif``), or a folder of
        PNG files (no suffix); and what to call that.
    about
        The README, with ``{files}`` where the table of files goes.
    rig, view, look
        The bench, where the camera sees the imaging plane, and what the frames look like.
    pools
        The pool of each frame.
    seed
        Source of the noise.
    frame_rate_hz
        None where the recording has no time base.
    torches
        Where the torch stands in each frame; empty: wherever the rig has it.
    exposures
        How many exposures a frame is the sum of.
    first_number
        Number in the first PNG file's name.
    """

    name: str
    file: str
    codec: str
    about: str
    rig: Rig
    view: CameraView
    look: Look
    pools: tuple[Pool, ...]
    seed: int
    frame_rate_hz: float | None = None
    torches: tuple[Torch, ...] = ()
    exposures: int = 1
    first_number: int = 0

    def frame(self, index: int) -> SampleFrame:
        """Render frame ``index``, counted from 0, by itself."""
        pool = self.pools[index]
        if self.torches:
            clear = replace(self.rig, electrode=Electrode(float("inf")))
            reflections = self.torches[index].shade(trace(pool, clear))
        else:
            reflections = trace(pool, self.rig)
        shape = reflections.absent.shape
        brightness = ray_brightness(
            shape, self.look.unevenness, np.random.default_rng([self.seed, 0])
        )
        rng = np.random.default_rng([self.seed, 1, index])
        exposed = [
            render(reflections, self.view, self.look, rng, brightness)
            for _ in range(self.exposures)
        ]
        image = exposed[0].image
        if self.exposures > 1:
            image = np.sum([one.image for one in exposed], axis=0, dtype=np.uint16)
        return SampleFrame(pool, reflections, image, exposed[0].dot_px, exposed[0].shown)

    def calibration_picture(self) -> GreyImage:
        """Render the calibration picture."""
        rng = np.random.default_rng([self.seed, 2])
        return render_target(TARGET, self.view, TargetLook(), rng)

    def setup(self) -> str:
        """Write the setup file's text."""
        rig, view = self.rig, self.view
        x, y, z = map(float, rig.imaging_plane.origin_mm)
        return f"""\
# The set-up of the sample run; every number is exact.
[laser]
projection_angle_deg = {rig.laser.projection_angle_deg}
distance_mm = {rig.laser.distance_mm}

[pattern]
rows = {rig.pattern.rows}
columns = {rig.pattern.columns}
inter_beam_angle_deg = {rig.pattern.inter_beam_angle_deg}

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

    def readme(self) -> str:
        """Write the README's text."""
        name = self.file if Path(self.file).suffix else f"{self.file}/"
        files = FILES.format(
            file=name, codec=self.codec, width=self.view.width_px, height=self.view.height_px
        )
        return self.about.format(files=files.rstrip())

    def write(self, folder: Path) -> None:
        """Write recording, calibration picture, setup file, truth and README into ``folder``.

        Raises
        ------
        OSError
            If the folder or a file in it cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        frames = [self.frame(n) for n in range(len(self.pools))]
        self._write_recording(folder / self.file, [frame.image for frame in frames])
        _write_png(folder / "calibration.png", self.calibration_picture())
        (folder / "setup.toml").write_text(self.setup(), encoding="utf-8")
        (folder / "README.md").write_text(self.readme(), encoding="utf-8")
        truth = (self._truth_row(n, frame) for n, frame in enumerate(frames))
        _write_csv(folder / "truth.csv", TRUTH_HEADER, truth)
        dots = (row for n, frame in enumerate(frames) for row in _dot_rows(n, frame))
        _write_csv(folder / "dots_truth.csv", DOTS_HEADER, dots)

    def _write_recording(
        self, path: Path, images: Sequence[npt.NDArray[np.uint8 | np.uint16]]
    ) -> None:
        if path.suffix == ".tif":
            tifffile.imwrite(path, np.stack(images), photometric="minisblack", compression="zlib")
        elif path.suffix:
            assert self.frame_rate_hz is not None
            write_video(path, images, self.frame_rate_hz)
        else:
            path.mkdir(exist_ok=True)
            for n, image in enumerate(images, self.first_number):
                _write_png(path / f"frame_{n}.png", image)

    def _truth_row(self, n: int, frame: SampleFrame) -> list[str]:
        size = frame.pool.size
        area, volume = _area_and_volume(frame.pool)
        values = (size.width_mm, size.length_mm, size.height_mm, size.depth_mm, area, volume)
        # As `labapp reconstruct` has it: of a hollow, the lowest point.
        peak = size.peak_mm if size.height_mm >= -size.depth_mm else size.bottom_mm
        time = "" if self.frame_rate_hz is None else f"{n / self.frame_rate_hz:.5f}"
        return [
            str(n),
            time,
            *(_number(value) for value in (*values, *peak)),
            str(int(frame.shown.sum())),
        ]


def write_video(
    path: Path, images: Sequence[npt.NDArray[np.uint8 | np.uint16]], frame_rate_hz: float
) -> None:
    """Write 8-bit grey frames as FFV1, which loses nothing.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    height, width = images[0].shape
    codec = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), codec, frame_rate_hz, (width, height), isColor=False)
    if not writer.isOpened():
        raise OSError(f"cannot write {path}")
    for image in images:
        writer.write(image)
    writer.release()


def _number(value: float) -> str:
    return f"{value:.5f}".replace("-0.00000", "0.00000")


def _area_and_volume(pool: Pool) -> tuple[float, float]:
    """Area inside the boundary and volume under the surface, by a grid of 0.02 mm."""
    rim = pool.boundary_mm()
    step = 0.02
    x, y = np.meshgrid(*(np.arange(rim[:, n].min(), rim[:, n].max(), step) for n in range(2)))
    x, y = x + step / 2, y + step / 2
    return (
        float(pool.inside(x, y).sum()) * step**2,
        float(np.nansum(pool.height(x, y))) * step**2,
    )


def _dot_rows(n: int, frame: SampleFrame) -> Iterable[list[str]]:
    for i, j in np.argwhere(frame.reflections.lit):
        u, v = frame.dot_px[i, j]
        yield [
            *map(str, (n, i + 1, j + 1)),
            *(f"{value:.3f}" for value in (u, v)),
            str(int(frame.shown[i, j])),
            *(f"{value:.5f}" for value in frame.reflections.point_mm[i, j]),
        ]


def _write_png(path: Path, image: npt.NDArray[np.uint8 | np.uint16]) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}")


def _write_csv(path: Path, header: str, rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header.split(","))
        writer.writerows(rows)
