"""Seven wrong setups, before and after a check with known mirrors.

Run as ``python -m tests.benchmarks.wrong_setups [--seeds N] [--pictures N] [NAME …]``. The bench
differs from the setup of `bench_check` in one quantity. Pools are measured on it with the setup as
entered, with the adjusted one and with the true one, where only noise and level contribute errors:
the mean difference of the last two is the setup error that remains after the check. Where the check
names quantities, the most likely is freed and the check repeated, as an operator would.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from labapp.core.bench_check.check import BenchCheck, check_bench
from labapp.core.bench_check.labelling import MirrorDots
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.values import CannotMeasure, FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import spherical_cap
from tests.benchmarks.bench_check import (
    CALIBRATION,
    RIG,
    SHAPE,
    VIEW,
    ToPlane,
    dots_at,
    measured,
    seen_dots,
    surface_like,
)
from tests.simulated_benches import SimulatedBench

POOLS = tuple(spherical_cap(*size) for size in ((6.7, 0.3), (6.2, 0.2), (7.1, 0.3), (6.5, 0.25)))
MIRRORS = (Plate(), Cap(9.75, 0.91), Plate(2.0))


def _laser(**off: float) -> SimulatedBench:
    """Return a bench with the given errors of the laser."""
    laser = replace(RIG.laser, **{key: getattr(RIG.laser, key) + by for key, by in off.items()})
    return SimulatedBench(replace(RIG, laser=laser, uncertainty=None), VIEW)


def _pattern(share: float) -> SimulatedBench:
    angle = RIG.pattern.inter_beam_angle_deg / share
    pattern = replace(RIG.pattern, inter_beam_angle_deg=angle)
    return SimulatedBench(replace(RIG, pattern=pattern, uncertainty=None), VIEW)


def _pitched(angle_deg: float) -> SimulatedBench:
    plane = ImagingPlane.of_angles(RIG.imaging_plane.origin_mm, (angle_deg, 0.0, 0.0))
    return SimulatedBench(replace(RIG, imaging_plane=plane, uncertainty=None), VIEW)


def _shifted(u_px: float, v_px: float) -> SimulatedBench:
    def shifted(point: tuple[float, float]) -> tuple[float, float]:
        return point[0] + u_px, point[1] + v_px

    view = CameraView(
        shifted(VIEW.origin_px), shifted(VIEW.x_axis_px), VIEW.x_axis_mm,
        shifted(VIEW.z_axis_px), VIEW.z_axis_mm, VIEW.width_px, VIEW.height_px,
    )  # fmt: skip
    return SimulatedBench(replace(RIG, uncertainty=None), view)


WRONG: Mapping[str, Callable[[], SimulatedBench]] = {
    "laser distance x 0.8": lambda: _laser(distance_mm=RIG.laser.distance_mm / 4),
    "frame 30 px along u": lambda: _shifted(30.0, 0.0),
    "frame 30 px along v": lambda: _shifted(0.0, 30.0),
    "inter-beam angle x 0.8": lambda: _pattern(0.8),
    "laser angle 5 deg low": lambda: _laser(projection_angle_deg=5.0),
    "plane pitch 5 deg": lambda: _pitched(5.0),
    "laser aim 0.5 mm, Y": lambda: _laser(aim_y_mm=0.5),
}
"""The true benches; the setup is always `RIG` and `CALIBRATION`."""


def errors(bench: SimulatedBench, rig: Rig, to_plane: ToPlane, seed: int) -> FloatArray:
    """Return the error of each pool's height, and its ±, in % of the height, shape (pools, 2)."""
    heights = [measured(one, bench, rig, to_plane, [seed, 1]) for one in POOLS]
    true = np.array([one.peak_mm for one in POOLS])
    return 100 * (np.array(heights) - np.outer(true, [1.0, 0.0])) / true[:, None]


def summary(rows: FloatArray) -> str:
    """Return the text of the mean error, the largest, and the mean ±."""
    rows = rows[np.isfinite(rows[:, 0])]
    if not len(rows):
        return f"{'no surface':>19}"
    (mean, sigma), worst = rows.mean(axis=0), max(rows[:, 0].tolist(), key=abs)
    return f"{mean:+6.2f} {worst:+6.1f} ± {sigma:4.1f}"


def checked(
    bench: SimulatedBench, mirrors: Sequence[Mirror], seed: int
) -> tuple[BenchCheck | None, str]:
    """Return the final check, if any, and the quantities named before."""
    rng = np.random.default_rng([18, seed])
    pictures = [
        MirrorDots(m.name, m, dots_at(seen_dots(surface_like(m, rng), bench, rng)[0]), SHAPE)
        for m in mirrors
    ]
    try:
        check = check_bench(pictures, Bench(RIG, CALIBRATION))
        named = [one.key for one in check.suspects]
        verdict = f"{check.status} {' or '.join(named)}".strip()
        if check.status == "quantity-off":
            check = check_bench(pictures, Bench(RIG, CALIBRATION), named[:1])
            verdict += f"; freed {named[0]}: {check.status}"
    except CannotMeasure as error:
        return None, error.status
    return check, verdict


def main() -> None:
    """Print a line for each setup and seed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--pictures", type=int, default=len(MIRRORS))
    parser.add_argument("names", nargs="*", default=list(WRONG))
    chosen = parser.parse_args()
    mirrors = MIRRORS[: chosen.pictures]
    print(f"{len(POOLS)} pools, height %: mean and largest error, ± of one; mirrors:")
    print(", ".join(one.name for one in mirrors))
    columns = "".join(f"{name:21}" for name in ("entered", "checked", "true"))
    print(f"{'wrong in the set-up':23} seed {columns}set-up  check")
    for name in chosen.names:
        for seed in range(chosen.seeds):
            bench = WRONG[name]()
            check, said = checked(bench, mirrors, seed)
            before = summary(errors(bench, RIG, CALIBRATION.to_plane, seed))
            true = errors(bench, bench.rig, bench.view.to_plane, seed)
            after, remainder = f"{'refused':>19}", np.nan
            if check is not None:
                checked_errors = errors(bench, check.rig, check.calibration.to_plane, seed)
                after, remainder = (
                    summary(checked_errors),
                    float(np.nanmean(checked_errors[:, 0] - true[:, 0])),
                )
            line = (
                f"{name:23} {seed:4} {before}  {after}  {summary(true)}  {remainder:+6.2f}  {said}"
            )
            print(line, flush=True)


if __name__ == "__main__":
    main()
