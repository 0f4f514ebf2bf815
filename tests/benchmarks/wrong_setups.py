"""Seven wrong set-ups, before and after a check against a plate and a thumb tack.

Run as ``python -m tests.benchmarks.wrong_setups [--seeds N] [NAME …]``. The bench stands as the
set-up of `bench_check` has it but for one thing, and a pool of the usual size is measured on it:
with the set-up as entered, and with the adjusted one. Where the check names quantities, the
likeliest is freed and the check repeated, as an operator would.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from labapp.core.bench_check.check import BenchCheck, check_bench
from labapp.core.bench_check.labelling import Picture
from labapp.core.bench_check.mirrors import Cap, Plate
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.values import CannotMeasure
from labapp.simulation.benches import SimulatedBench
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import spherical_cap
from tests.benchmarks.bench_check import (
    CALIBRATION,
    RIG,
    SHAPE,
    VIEW,
    dots_at,
    measured,
    seen,
    surface_like,
)

POOL = spherical_cap(6.7, 0.3)
MIRRORS = (Plate(), Cap(9.75, 0.91))


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


def height(bench: SimulatedBench, check: BenchCheck | None, seed: int) -> str:
    """Error of the pool's height and its ±, in % of the height, and the status of the set-up."""
    rig: Rig = RIG if check is None else check.rig
    calibration = CALIBRATION if check is None else check.calibration
    true, known = POOL.peak_mm, rig.uncertainty
    assert known is not None
    found, sigma = measured(POOL, bench, rig, calibration, [seed, 1])
    if not np.isfinite(found):
        return f"{'no surface':>15} {known.status:10}"
    return f"{100 * (found / true - 1):+6.1f} ± {100 * sigma / true:4.1f} % {known.status:10}"


def checked(bench: SimulatedBench, seed: int) -> tuple[BenchCheck | None, str]:
    """The check that the operator ends with, if any, and what was named on the way."""
    rng = np.random.default_rng([18, seed])
    pictures = [
        Picture(m.name, m, dots_at(seen(surface_like(m, rng), bench, rng)[0]), SHAPE)
        for m in MIRRORS
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
    ask.add_argument("names", nargs="*", default=list(WRONG))
    given = ask.parse_args()
    print(f"{'wrong in the set-up':24} seed {'before':26} {'after':26} check")
    for name in given.names:
        for seed in range(given.seeds):
            bench = WRONG[name]()
            check, said = checked(bench, seed)
            after = "refused" if check is None else height(bench, check, seed)
            print(
                f"{name:24} {seed:4} {height(bench, None, seed):26} {after:26} {said}", flush=True
            )


if __name__ == "__main__":
    main()
