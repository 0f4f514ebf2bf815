"""Rendered frames of pools of every kind, with missing and false dots, low contrast and speckle.

Run as ``python tests/benchmarks/rendered.py [--pools N] [--seed S] [KIND …]``. Pools and benches
are those of ``clutter.py``; each frame has its own contrast (dots of 22 to 60 grey levels), noise,
speckle, up to 5 % of the dots missing, up to 12 false ones, and a camera rolled by up to 1.5°. It
is measured from the image, as ``labapp reconstruct`` does. A label is right if the dot is that of
its ray. Prints a line for each frame that was rejected or has wrong labels; then, for every kind,
how many were measured, the time per frame, and the error of their height. Fails if any label is
wrong.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Settings, measure
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import trace
from labapp.simulation.render import Look, render
from tests.benchmarks.clutter import KINDS, as_entered, draw_pool
from tests.benchmarks.dips import PoolResult, height_error, report
from tests.scenes import FRAME_SHAPE

ON_ITS_DOT_PX = 2.0
"""A false dot this close to a ray's true one cannot be distinguished from it by any detector."""

PX_PER_MM, MOST_ROLLED_DEG = 5.67, 1.5


def draw_look(rng: np.random.Generator) -> Look:
    """Draw the look of a frame."""
    return Look(
        dot_peak=rng.uniform(22.0, 60.0),
        read_noise=rng.uniform(2.0, 4.0),
        speckle=rng.uniform(0.2, 0.5),
        missing=rng.uniform(0.0, 0.05),
        false_dots=int(rng.integers(0, 13)),
    )


def draw_view(rng: np.random.Generator) -> CameraView:
    """Draw a slightly rolled camera."""
    rolled = np.radians(rng.uniform(-MOST_ROLLED_DEG, MOST_ROLLED_DEG))
    along = np.array([np.cos(rolled), np.sin(rolled)])
    up = np.array([np.sin(rolled), -np.cos(rolled)])
    origin, length = np.array([44.0, 590.0]), 60.0
    return CameraView(
        tuple(origin),
        tuple(origin + PX_PER_MM * length * along),
        length,
        tuple(origin + PX_PER_MM * length * up),
        length,
        width_px=FRAME_SHAPE[1],
        height_px=FRAME_SHAPE[0],
    )


def measured(kind: str, seed: int, *, is_exact: bool = False) -> tuple[PoolResult, float]:
    """Return the result for one frame, with an exact or an uncertain set-up, and its time, s."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), 1])
    rig, pool = draw_pool(kind, rng)
    view = draw_view(rng)
    frame = render(trace(pool, rig), view, draw_look(rng), rng)
    shown = int(frame.shown.sum())
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    calibration = ImageCalibration.from_three_points(*axes)
    bench = Bench(rig if is_exact else as_entered(rig, calibration), calibration)
    start_s = time.process_time()
    result = measure(frame.image, bench, Settings())[0]
    took_s = time.process_time() - start_s
    if result.match is None or result.measures is None or result.dots is None:
        return PoolResult(result.status, shown=shown), took_s
    dots = np.column_stack([result.dots.u_px, result.dots.v_px])[result.match.dot]
    true_px = np.where(frame.shown[..., None], frame.dot_px, np.nan)[tuple(result.match.ray.T - 1)]
    wrong = int((~(np.linalg.norm(dots - true_px, axis=-1) < ON_ITS_DOT_PX)).sum())
    error = height_error(pool, result.measures)
    return PoolResult("ok", wrong, len(dots) - wrong, shown, error), took_s


def main() -> int:
    """Print the results; return the number of wrong labels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--pools", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    wrong = 0
    for kind in chosen.kinds:
        results, times_s = [], []
        for seed in range(chosen.seed, chosen.seed + chosen.pools):
            one, took_s = measured(kind, seed)
            results.append(one)
            times_s.append(took_s)
            if one.status != "ok" or one.wrong:
                print(f"{kind} {seed}: {one}", flush=True)
        print(f"{kind}: {np.median(times_s):.2f} s in the median, {max(times_s):.2f} s at worst")
        wrong += report(kind, results)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
