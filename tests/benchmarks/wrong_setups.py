"""Seven wrong set-ups, before and after a check against known mirrors.

Run as ``python -m tests.benchmarks.wrong_setups [--seeds N] [--pictures N] [NAME …]``. The bench
stands as the set-up of `bench_check` has it but for one thing. Pools are measured on it with the
set-up as entered, with the adjusted one and with the true one, whose errors are those of noise and
level alone: the mean difference of the last two is what the check has left of the set-up's. Where
the check names quantities, the likeliest is freed and the check repeated, as an operator would.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from labapp.core.bench_check.check import BenchCheck, check_bench
from labapp.core.bench_check.labelling import Picture
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.values import CannotMeasure, FloatArray
from labapp.simulation.benches import SimulatedBench
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
    seen,
    surface_like,
)

POOLS = tuple(spherical_cap(*size) for size in ((6.7, 0.3), (6.2, 0.2), (7.1, 0.3), (6.5, 0.25)))
MIRRORS = (Plate(), Cap(9.75, 0.91), Plate(2.0))


def _laser(**off: float) -> SimulatedBench:
    """The bench whose laser is off by so much."""
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
"""How the bench truly stands; the set-up is `RIG` and `CALIBRATION` in all."""


def errors(bench: SimulatedBench, rig: Rig, to_plane: ToPlane, seed: int) -> FloatArray:
    """Error of each pool's height, and its ±, in % of the height, shape (pools, 2)."""
    found = [measured(one, bench, rig, to_plane, [seed, 1]) for one in POOLS]
    true = np.array([one.peak_mm for one in POOLS])
    return 100 * (np.array(found) - np.outer(true, [1.0, 0.0])) / true[:, None]


def summary(made: FloatArray) -> str:
    """Mean of the errors, the largest, and the ± of one."""
    made = made[np.isfinite(made[:, 0])]
    if not len(made):
        return f"{'no surface':>19}"
    (mean, sigma), worst = made.mean(axis=0), max(made[:, 0].tolist(), key=abs)
    return f"{mean:+6.2f} {worst:+6.1f} ± {sigma:4.1f}"


def checked(
    bench: SimulatedBench, mirrors: Sequence[Mirror], seed: int
) -> tuple[BenchCheck | None, str]:
    """The check that the operator ends with, if any, and what was named on the way."""
    rng = np.random.default_rng([18, seed])
    pictures = [
        Picture(m.name, m, dots_at(seen(surface_like(m, rng), bench, rng)[0]), SHAPE)
        for m in mirrors
    ]
    try:
        check = check_bench(pictures, RIG, CALIBRATION)
        named = [one.key for one in check.suspects]
        said = f"{check.status} {' or '.join(named)}".strip()
        if check.status == "quantity-off":
            check = check_bench(pictures, RIG, CALIBRATION, named[:1])
            said += f"; freed {named[0]}: {check.status}"
    except CannotMeasure as why:
        return None, why.status
    return check, said


def main() -> None:
    """Run it and print a line for each set-up and seed."""
    ask = argparse.ArgumentParser()
    ask.add_argument("--seeds", type=int, default=2)
    ask.add_argument("--pictures", type=int, default=len(MIRRORS))
    ask.add_argument("names", nargs="*", default=list(WRONG))
    given = ask.parse_args()
    mirrors = MIRRORS[: given.pictures]
    print(f"{len(POOLS)} pools, height %: mean and largest error, ± of one; mirrors:")
    print(", ".join(one.name for one in mirrors))
    columns = "".join(f"{name:21}" for name in ("entered", "checked", "true"))
    print(f"{'wrong in the set-up':23} seed {columns}set-up  check")
    for name in given.names:
        for seed in range(given.seeds):
            bench = WRONG[name]()
            check, said = checked(bench, mirrors, seed)
            before = summary(errors(bench, RIG, CALIBRATION.to_plane, seed))
            true = errors(bench, bench.rig, bench.view.to_plane, seed)
            after, left = f"{'refused':>19}", np.nan
            if check is not None:
                found = errors(bench, check.rig, check.calibration.to_plane, seed)
                after, left = summary(found), float(np.nanmean(found[:, 0] - true[:, 0]))
            line = f"{name:23} {seed:4} {before}  {after}  {summary(true)}  {left:+6.2f}  {said}"
            print(line, flush=True)


if __name__ == "__main__":
    main()
