"""The sample run: ``python -m labapp.simulation.sample DIR`` writes it anew, the same every time.

The set-up of §7.3 (75 A, 3 mm/s, plane at 50 mm, laser at about 31°) and a pool that fluctuates
from frame to frame as that section reports.
"""

from __future__ import annotations

import argparse
import csv
import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from labapp.core.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.values import FloatArray
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import Oscillation, Pool, egg
from labapp.simulation.render import CameraView, Frame, GreyImage, Look, ray_brightness, render
from labapp.simulation.target import Target, TargetLook, render_target, target_svg

SEED = 20070
FRAMES = 30
FRAMES_PER_SECOND = 60.0
WIDTH_MM, WIDTH_SIGMA_MM = 6.66, 0.15
LENGTH_MM, LENGTH_SIGMA_MM = 7.45, 0.46
HEIGHT_MM, HEIGHT_SIGMA_MM = 0.294, 0.019

RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(5.0),
    ImagingPlane.vertical(50.0, 45.0, 3.0),
)
TARGET = Target()
VIEW = CameraView(
    origin_px=(44.0, 590.0),
    x_axis_px=(242.01, 587.93),
    x_axis_mm=TARGET.x_middle_mm,
    z_axis_px=(43.06, 499.99),
    z_axis_mm=TARGET.z_middle_mm,
)
LOOK = Look(dot_peak=70.0, hot_pixels=2, missing=0.01)

SETUP = f"""\
# The set-up of the sample run; every number is exact.
[laser]
projection_angle_deg = {RIG.laser.projection_angle_deg}
distance_mm = {RIG.laser.distance_mm}

[pattern]
rows = {RIG.pattern.rows}
columns = {RIG.pattern.columns}
inter_beam_angle_deg = {RIG.pattern.inter_beam_angle_deg}

[electrode]
height_mm = {RIG.electrode.height_mm}

[imaging_plane]
distance_mm = 50.0
s_mm = 45.0
h_mm = 3.0
width_mm = {RIG.imaging_plane.width_mm}
height_mm = {RIG.imaging_plane.height_mm}

[image_calibration]
origin_px = {list(VIEW.origin_px)}
x_axis_px = {list(VIEW.x_axis_px)}
x_axis_mm = {VIEW.x_axis_mm}
z_axis_px = {list(VIEW.z_axis_px)}
z_axis_mm = {VIEW.z_axis_mm}
"""

README = f"""\
# A recorded run, simulated

GTAW at 75 A and 3 mm/s with the set-up of §7.3 of the dissertation, {FRAMES} frames at
{FRAMES_PER_SECOND:g} frames a second. No camera saw it: `python -m labapp.simulation.sample DIR`
makes it from exact rays on a known pool, so that every measured figure can be held to the truth.

| file | what |
| --- | --- |
| `recording.avi` | the frames, 480 × 640 grey, FFV1 (lossless) |
| `calibration.png` | the imaging plane with its marks: unit {TARGET.unit_mm:g} mm, middle of the \
X′ bar at {TARGET.x_middle_mm:g} mm (5.5 units), of the Z′ bar at {TARGET.z_middle_mm:g} mm \
(2.5 units): `labapp calibrate plane calibration.png --unit-mm {TARGET.unit_mm:g}` |
| `setup.toml` | rig and image calibration, exact |
| `truth.csv` | size of the pool in each frame |
| `dots_truth.csv` | each lit ray in each frame: where its dot is, whether it shows, where it met \
the pool |

The pool is convex and egg-shaped, its head nearer to the torch than its tail. Width
{WIDTH_MM:g} ± {WIDTH_SIGMA_MM:g}, length {LENGTH_MM:g} ± {LENGTH_SIGMA_MM:g}, height
{HEIGHT_MM:g} ± {HEIGHT_SIGMA_MM:g} mm (mean ± standard deviation over the frames).
"""


@dataclass(frozen=True)
class SampleFrame:
    """A frame of the sample with the pool and the reflections it was rendered from."""

    pool: Pool
    reflections: Reflections
    frame: Frame


@functools.cache
def sample_pools() -> tuple[Pool, ...]:
    """Build the pool of every frame: all its measures wander, smoothly, by what §7.3 reports."""
    rng = np.random.default_rng(SEED)
    width, length, height, ahead, aside = (_wander(rng) for _ in range(5))
    pools = []
    for n in range(FRAMES):
        whole = LENGTH_MM + LENGTH_SIGMA_MM * length[n]
        head = 0.4 * LENGTH_MM + 0.3 * (whole - LENGTH_MM)
        aim = HEIGHT_MM + HEIGHT_SIGMA_MM * height[n]
        swing = Oscillation(0.012, 22.0, n / FRAMES_PER_SECOND)
        peak = aim
        for _ in range(4):  # the swinging lifts the highest point a little; take that off again
            pool = egg(
                width_mm=WIDTH_MM + WIDTH_SIGMA_MM * width[n],
                head_mm=head,
                tail_mm=whole - head,
                peak_mm=peak,
                center_mm=(0.05 * aside[n], -0.7 + 0.08 * ahead[n]),
                terms=(swing,),
            )
            peak += aim - pool.size.height_mm
        pools.append(pool)
    return tuple(pools)


def sample_frame(index: int) -> SampleFrame:
    """Render frame ``index``, counted from 0, by itself."""
    pool = sample_pools()[index]
    reflections = trace(pool, RIG)
    shape = reflections.absent.shape
    brightness = ray_brightness(shape, LOOK.unevenness, np.random.default_rng([SEED, 0]))
    rng = np.random.default_rng([SEED, 1, index])
    return SampleFrame(pool, reflections, render(reflections, VIEW, LOOK, rng, brightness))


def calibration_picture() -> GreyImage:
    """Render the calibration picture."""
    return render_target(TARGET, VIEW, TargetLook(), np.random.default_rng([SEED, 2]))


def write_sample(folder: Path) -> None:
    """Write the sample run into ``folder``.

    Raises
    ------
    OSError
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frames = [sample_frame(n) for n in range(FRAMES)]
    _write_video(folder / "recording.avi", [sample.frame.image for sample in frames])
    if not cv2.imwrite(str(folder / "calibration.png"), calibration_picture()):
        raise OSError(f"cannot write {folder / 'calibration.png'}")
    (folder / "setup.toml").write_text(SETUP, encoding="utf-8")
    (folder / "README.md").write_text(README, encoding="utf-8")
    _write_csv(
        folder / "truth.csv",
        "frame,time_s,width_mm,length_mm,height_mm,depth_mm,area_mm2,volume_mm3,"
        "peak_x_mm,peak_y_mm,dots",
        (_truth_row(n, sample) for n, sample in enumerate(frames)),
    )
    _write_csv(
        folder / "dots_truth.csv",
        "frame,ray_row,ray_column,u_px,v_px,visible,x_mm,y_mm,z_mm",
        (row for n, sample in enumerate(frames) for row in _dot_rows(n, sample)),
    )


def _wander(rng: np.random.Generator) -> FloatArray:
    """Smooth random course of one value a frame, mean 0 and standard deviation 1."""
    course = gaussian_filter1d(rng.normal(size=FRAMES), 1.5, mode="wrap")
    return np.asarray((course - course.mean()) / course.std())


def _truth_row(n: int, sample: SampleFrame) -> list[str]:
    size = sample.pool.size
    area, volume = _area_and_volume(sample.pool)
    values = (size.width_mm, size.length_mm, size.height_mm, size.depth_mm, area, volume)
    numbers = [f"{value:.5f}" for value in (n / FRAMES_PER_SECOND, *values, *size.peak_mm)]
    return [
        str(n),
        *(text.replace("-0.00000", "0.00000") for text in numbers),
        str(int(sample.frame.shown.sum())),
    ]


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


def _dot_rows(n: int, sample: SampleFrame) -> Iterable[list[str]]:
    for i, j in np.argwhere(sample.reflections.lit):
        u, v = sample.frame.dot_px[i, j]
        yield [
            *map(str, (n, i + 1, j + 1)),
            *(f"{value:.3f}" for value in (u, v)),
            str(int(sample.frame.shown[i, j])),
            *(f"{value:.5f}" for value in sample.reflections.point_mm[i, j]),
        ]


def _write_csv(path: Path, header: str, rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header.split(","))
        writer.writerows(rows)


def _write_video(path: Path, images: Sequence[GreyImage]) -> None:
    """Write grey frames as FFV1, which loses nothing."""
    height, width = images[0].shape
    codec = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), codec, FRAMES_PER_SECOND, (width, height), isColor=False)
    if not writer.isOpened():
        raise OSError(f"cannot write {path}")
    for image in images:
        writer.write(image)
    writer.release()


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the sample run, and the printable target where a folder for it is named."""
    parser = argparse.ArgumentParser(prog="python -m labapp.simulation.sample", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the sample run goes")
    parser.add_argument(
        "--target", type=Path, metavar="SVG", help="also write the printable target"
    )
    chosen = parser.parse_args(arguments)
    write_sample(chosen.folder)
    if chosen.target is not None:
        chosen.target.parent.mkdir(parents=True, exist_ok=True)
        chosen.target.write_text(target_svg(TARGET), encoding="utf-8")


if __name__ == "__main__":
    main()
