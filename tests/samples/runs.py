"""The sample recordings: pools, benches, cameras, and the README of each."""

from __future__ import annotations

import functools

import numpy as np
from scipy.ndimage import gaussian_filter1d

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.values import FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import Footprint, Pool, egg, spherical_cap
from labapp.simulation.recording import TARGET
from labapp.simulation.render import Look
from labapp.simulation.torch import ConeTorch
from tests.oscillation import Oscillation
from tests.samples.recording import Sample

WIDTH_MM, WIDTH_SIGMA_MM = 6.66, 0.15
LENGTH_MM, LENGTH_SIGMA_MM = 7.45, 0.46
HEIGHT_MM, HEIGHT_SIGMA_MM = 0.294, 0.019
RUN_HZ = 60.0

TACK_DIAMETER_MM, TACK_HEIGHT_MM = 9.75, 0.91

BENT_MM = (0.2, -1.2)
"""Lateral offset of the bent electrode's tip in the sample of blocked rows, along X and Y."""

TIP_MM = (5.0, 5.0, 1.2, 1.15, 1.1, 1.05)
"""Height of its tip in each frame, at one frame per second."""

SWING_HZ = 22.0

BENCH = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(5.0),
    ImagingPlane.vertical(50.0, 45.0, 3.0),
)


@functools.cache
def samples() -> tuple[Sample, ...]:
    """Return every sample recording."""
    return gtaw(), thumb_tack(), blocked_rows(), concave()


@functools.cache
def gtaw() -> Sample:
    """Return the run of §7.3: 75 A, 3 mm/s, and a pool that fluctuates as reported there."""
    return Sample(
        name="gtaw",
        file="recording.avi",
        codec="FFV1 (lossless)",
        about=f"""\
# A recorded run, simulated

GTAW at 75 A and 3 mm/s with the set-up of §7.3 of the dissertation, 30 frames at
{RUN_HZ:g} frames a second. No camera saw it: `python -m tests.samples DIR`
makes it from exact rays on a known pool, so that every measured figure can be held to the truth.

{{files}}

The pool is convex and egg-shaped, its head nearer to the torch than its tail. Width
{WIDTH_MM:g} ± {WIDTH_SIGMA_MM:g}, length {LENGTH_MM:g} ± {LENGTH_SIGMA_MM:g}, height
{HEIGHT_MM:g} ± {HEIGHT_SIGMA_MM:g} mm (mean ± standard deviation over the frames).
""",
        rig=BENCH,
        view=CameraView(
            origin_px=(44.0, 590.0),
            x_axis_px=(242.01, 587.93),
            x_axis_mm=TARGET.x_middle_mm,
            z_axis_px=(43.06, 499.99),
            z_axis_mm=TARGET.z_middle_mm,
        ),
        look=Look(dot_peak=70.0, hot_pixels=2, missing=0.01),
        pools=_gtaw_pools(30),
        seed=20070,
        frame_rate_hz=RUN_HZ,
    )


@functools.cache
def thumb_tack() -> Sample:
    """Return the thumb tack of §8.2, which does not move."""
    count = 3
    return Sample(
        name="thumb_tack",
        file="recording.tif",
        codec="TIFF stack, 16 bit (deflate, lossless)",
        about=f"""\
# A thumb tack, simulated

The thumb tack of §8.2 of the dissertation in that section's set-up: diameter \
{TACK_DIAMETER_MM:g} mm,
height {TACK_HEIGHT_MM:g} mm, part of a sphere. It stands still: the {count} frames differ by \
their noise alone,
and each is the sum of 16 exposures of 8 bit. A picture stack has no time base, so `time_s` is
empty. What the section does not say is chosen here: electrode 5 mm above the paper, O′ 45 mm to
the left and 3 mm up. Made by `python -m tests.samples DIR`.

{{files}}

The tack is steep at its rim: a third of the rays that meet it pass by the imaging plane or are
hidden by the torch, and its rear reflects below the plane. The dissertation's own schemes measured
the real one with height errors of 17.77 % (IRS) and 9.12 % (ERS) and a diameter error of 1.49 %;
`labapp reconstruct recording.tif --setup setup.toml --out DIR` answers every frame, within 3 % in
height.
""",
        rig=Rig(
            Laser(30.56, 46.4),
            DotPattern(),
            Electrode(5.0),
            ImagingPlane.vertical(40.69, 45.0, 3.0),
        ),
        view=_view((22.0, 456.0), 4.6, 0.4, 460, 480),
        look=Look(dot_peak=60.0),
        pools=(spherical_cap(TACK_DIAMETER_MM, TACK_HEIGHT_MM),) * count,
        seed=20082,
        exposures=16,
    )


@functools.cache
def blocked_rows() -> Sample:
    """Return a run in which a bent electrode is lowered until it hides the reference."""
    seed = 20053
    count = len(TIP_MM)
    return Sample(
        name="blocked_rows",
        file="recording.mkv",
        codec="FFV1 (lossless)",
        about=BLOCKED_ROWS,
        rig=BENCH,
        view=_view((30.0, 462.0), 5.5, -0.5, 480, 480),
        look=Look(dot_peak=65.0, hot_pixels=1),
        pools=_swinging(seed, count, Footprint(6.7, 3.0, 4.4, (0.05, -0.6)), 0.225),
        seed=seed,
        frame_rate_hz=1.0,
        torches=tuple(ConeTorch((*BENT_MM, height)) for height in TIP_MM),
    )


@functools.cache
def concave() -> Sample:
    """Return a run with a concave pool, whose dots are inverted in rows and columns."""
    seed = 20044
    return Sample(
        name="concave",
        file="recording",
        codec="PNG files, in the order of their numbers",
        about="""\
# A concave pool, simulated

A pool that is pressed down to a hollow 0.6 mm deep, as at high current: its reflection is turned
round both ways (correspondence I/I: rows and columns of the dots run against those of the rays,
Table 4-4). Six pictures cut out of a longer run, hence their numbers; pictures have no time base,
so `time_s` is empty. Made by `python -m tests.samples DIR`.

{files}

The pool swings: its depth and outline differ from frame to frame (`depth_mm`, the smallest z, is
what measures it; `height_mm` is 0, that of the boundary).
`labapp reconstruct recording --setup setup.toml --out DIR` answers every frame, within 3 % in
depth.
""",
        rig=BENCH,
        view=_view((20.0, 456.0), 4.8, 0.7, 480, 480),
        look=Look(dot_peak=60.0, hot_pixels=2, false_dots=1),
        pools=_swinging(seed, 6, Footprint(5.6, 2.6, 3.5, (0.05, -0.4)), -0.6),
        seed=seed,
        first_number=7,
    )


BLOCKED_ROWS = f"""\
# Rows blocked by the torch, simulated

A convex pool on the bench of §7.3, one frame a second. After two frames with the tip of the
electrode at {TIP_MM[0]:g} mm, where `setup.toml` has it, the torch comes down to {TIP_MM[2]:g} mm \
and then further,
to {TIP_MM[-1]:g} mm. The electrode is bent as well: its tip stands {BENT_MM[0]:g} mm to the right \
of the origin and
{-BENT_MM[1]:g} mm behind it. So it hides the middle of the front rows and of the rear ones, and \
with them
a dot next to the absent centre dot: another hole in the rows could be the reference. Made by
`python -m tests.samples DIR`.

{{files}}

`labapp reconstruct recording.mkv --setup setup.toml --out DIR` measures all frames (height
within 3 %). From frame 2 on another hole could be the reference, but only on a bench half a
millimetre from the one in `setup.toml`, which explains the dots as well: each frame is measured by
itself, too. `blocked_rows.labsession` was measured by an earlier version, which refused the frames
from 2 on; frame 2 was then corrected by hand. Rows are counted from the bottom up, columns from
left to right, both from 1, as the program finds them here.

| frame | by itself | reference (row, column) | on the picture (u, v) | rows to mark as blocked |
| --- | --- | --- | --- | --- |
| 0 | `ok` | (6, 8) is found | (278, 282) px | none |
| 1 | `ok` | (6, 8) is found | (278, 281) px | none |
| 2 | `ok` | (6, 8) is found | (278, 281) px | 1, 2, 6, 7, 8 |
| 3 | `ok` | (6, 8) is found | (278, 281) px | 1, 2, 6, 7, 8 |
| 4 | `ok` | (6, 8) is found | (278, 281) px | 1, 2, 6, 7, 8 |
| 5 | `ok` | (6, 8) is found | (278, 282) px | 1, 2, 6, 7 |

With the reference and the rows given, height comes within 2 % in every frame.
"""


def _view(
    origin_px: tuple[float, float], px_per_mm: float, roll_deg: float, width: int, height: int
) -> CameraView:
    """Return the view of a rolled camera, with axis points in the middle of the target's bars."""
    rolled = CameraView.rolled(
        origin_px, px_per_mm, roll_deg, TARGET.x_middle_mm, TARGET.z_middle_mm
    )
    (u, v), (w, z) = rolled.x_axis_px, rolled.z_axis_px
    return CameraView(
        origin_px=origin_px,
        x_axis_px=(round(u, 2), round(v, 2)),
        x_axis_mm=TARGET.x_middle_mm,
        z_axis_px=(round(w, 2), round(z, 2)),
        z_axis_mm=TARGET.z_middle_mm,
        width_px=width,
        height_px=height,
    )


def _gtaw_pools(count: int) -> tuple[Pool, ...]:
    """Return the pool of every frame: its sizes vary smoothly, by the amounts of §7.3."""
    rng = np.random.default_rng(20070)
    width, length, height, ahead, aside = (_wander(rng, count) for _ in range(5))
    pools = []
    for n in range(count):
        whole = LENGTH_MM + LENGTH_SIGMA_MM * length[n]
        head = 0.4 * LENGTH_MM + 0.3 * (whole - LENGTH_MM)
        aim = HEIGHT_MM + HEIGHT_SIGMA_MM * height[n]
        swing = Oscillation(0.012, SWING_HZ, n / RUN_HZ)
        peak = aim
        for _ in range(
            4
        ):  # compensate for the oscillation, which raises the highest point slightly
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


def _swinging(seed: int, count: int, foot: Footprint, peak_mm: float) -> tuple[Pool, ...]:
    """Return the pools of a short run: they oscillate, and their size varies by 1 or 2 %."""
    rng = np.random.default_rng(seed)
    width, length, peak = (_wander(rng, count) for _ in range(3))
    return tuple(
        egg(
            width_mm=foot.width_mm * (1 + 0.01 * width[n]),
            head_mm=foot.head_mm * (1 + 0.01 * length[n]),
            tail_mm=foot.tail_mm * (1 + 0.02 * length[n]),
            peak_mm=peak_mm * (1 + 0.02 * peak[n]),
            center_mm=foot.center_mm,
            terms=(Oscillation(0.01 * abs(peak_mm), SWING_HZ, n / RUN_HZ),),
        )
        for n in range(count)
    )


def _wander(rng: np.random.Generator, count: int) -> FloatArray:
    """Return a smooth random series of mean 0 and standard deviation 1, a value per frame."""
    course = gaussian_filter1d(rng.normal(size=count), 1.5, mode="wrap")
    return np.asarray((course - course.mean()) / course.std())
