"""Pools of every kind on various benches, with missing and false dots.

Run as ``python tests/benchmarks/clutter.py [--pools N] [--seed S] [--missing SHARE] [--false N]
[--off TIMES] [KIND …]``. Each pool is drawn from its own seed, together with its bench, the noise
of the detector, the missing dots (up to a share), the number of false ones, and the setup errors:
TIMES 0.2° and 0.3 mm of the laser and 0.3 mm of the imaging plane (standard deviations). The setup
has the default uncertainties of a setup file. Prints a line for each pool that was rejected or has
wrong labels; then, for every kind, how many were measured and the error of their height. Fails if
any label is wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from labapp.simulation.pools import Dent, LowRear, Pool, Wave, egg, ellipsoidal_cap, spherical_cap
from tests.benchmarks.dips import PoolResult, measure_pool, report
from tests.scenes import BENCH_RIG, BENCH_VIEW, SeenDots, see

MODES = ((1, 1), (2, 1), (0, 2), (3, 1))

Draw = Callable[[np.random.Generator, float, tuple[float, float]], Pool]


def cap(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return spherical_cap(width, width * rng.uniform(0.03, 0.06), center)


def concave(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return spherical_cap(width, -width * rng.uniform(0.07, 0.12), center)


def ellipse(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    length = width * rng.uniform(0.85, 1.3)
    return ellipsoidal_cap(width, length, width * rng.uniform(0.03, 0.06), center)


def _egg(rng: np.random.Generator, width: float, center: tuple[float, float], *terms) -> Pool:
    head, tail = width * rng.uniform(0.42, 0.52), width * rng.uniform(0.5, 0.7)
    return egg(width, head, tail, width * rng.uniform(0.03, 0.06), center, terms)


def dented(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    offset = tuple(rng.uniform(-1.0, 1.0, 2))
    return _egg(rng, width, center, Dent(rng.uniform(0.01, 0.06), rng.uniform(0.6, 1.6), offset))


def lowrear(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return _egg(rng, width, center, LowRear(rng.uniform(0.02, 0.1)))


def rippled(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    mode = MODES[rng.integers(len(MODES))]
    turned, amplitude = rng.uniform(0.0, 360.0), rng.uniform(0.003, 0.015)
    return _egg(rng, width, center, Wave(mode, amplitude, turned_deg=turned))


KINDS: dict[str, Draw] = {
    "cap": cap,
    "concave": concave,
    "ellipse": ellipse,
    "egg": _egg,
    "dented": dented,
    "lowrear": lowrear,
    "rippled": rippled,
}


def draw_pool(kind: str, rng: np.random.Generator) -> tuple[Rig, Pool]:
    """Return a bench, and a pool of a kind."""
    rig = replace(
        BENCH_RIG,
        laser=Laser(rng.uniform(28.0, 33.0), rng.uniform(29.0, 35.5)),
        imaging_plane=ImagingPlane.vertical(rng.uniform(46.0, 56.0), 45.0, 3.0),
    )
    return rig, KINDS[kind](rng, rng.uniform(4.6, 6.6), tuple(rng.uniform(-0.5, 0.5, 2)))


def draw(kind: str, seed: int, missing: float, false: int) -> tuple[Rig, SeenDots, Pool]:
    """Return a bench, the dots of a pool of a kind, and the pool."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    rig, pool = draw_pool(kind, rng)
    sigma_px, dot_count = (
        rng.uniform(0.05, 0.3),
        len(see(pool, np.random.default_rng(0), rig=rig).ray),
    )
    missing_count = round(dot_count * rng.uniform(0.0, missing))
    false_count = int(rng.integers(0, false + 1))
    return (
        rig,
        see(pool, rng, sigma_px=sigma_px, missing=missing_count, false=false_count, rig=rig),
        pool,
    )


def with_setup_errors(rig: Rig, seed: int, times: float) -> Rig:
    """Return the rig with random setup errors, and the default uncertainties."""
    return as_entered(displaced(rig, np.random.default_rng([seed, 78]), times), BENCH_VIEW)


def displaced(rig: Rig, rng: np.random.Generator, times: float) -> Rig:
    """Return the rig with random errors of the laser and the imaging plane."""
    angle, distance = times * rng.normal(0.0, [0.2, 0.3])
    laser, plane = rig.laser, rig.imaging_plane
    return replace(
        rig,
        laser=replace(
            laser,
            projection_angle_deg=laser.projection_angle_deg + angle,
            distance_mm=laser.distance_mm + distance,
        ),
        imaging_plane=replace(plane, origin_mm=plane.origin_mm + times * rng.normal(0, 0.3, 3)),
    )


def as_entered(rig: Rig, calibration: ImageCalibration) -> Rig:
    """Return the rig with the default uncertainties of a setup file."""
    axes = AxisPoints(calibration, 60.0, 60.0)
    return replace(rig, uncertainty=RigUncertainty(axes, *covariance_of({})))


def main() -> int:
    """Print the results; return the number of wrong labels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--pools", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--missing", type=float, default=0.05)
    parser.add_argument("--false", type=int, default=12)
    parser.add_argument("--off", type=float, default=0.0)
    chosen = parser.parse_args()
    wrong = 0
    for kind in chosen.kinds:
        results: list[PoolResult] = []
        for seed in range(chosen.seed, chosen.seed + chosen.pools):
            rig, seen, pool = draw(kind, seed, chosen.missing, chosen.false)
            results.append(measure_pool(pool, seen, with_setup_errors(rig, seed, chosen.off)))
            if results[-1].status != "ok" or results[-1].wrong:
                print(f"{kind} {seed}: {results[-1]}", flush=True)
        wrong += report(kind, results)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
