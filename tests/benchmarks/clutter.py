"""Pools of every kind on benches set up otherwise, dots missing and false ones among them.

Run as ``python tests/benchmarks/clutter.py [--pools N] [--seed S] [--missing SHARE] [--false N]
[--off TIMES] [KIND …]``. Every pool is drawn from its own seed, as are its bench, the noise of the
detector, which dots are missing, up to a share, how many are false, and by how much the set-up is
off: so many times 0.2° and 0.3 mm of the laser and 0.3 mm of the imaging plane, one standard
deviation. The set-up has the uncertainties that a setup file without any has. A line for each pool
that was not answered, or answered wrongly; then, for every kind, how many were answered and the
error of their height. Fails where a label is wrong.
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
from tests.benchmarks.dips import Answer, answer, report
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
    away = tuple(rng.uniform(-1.0, 1.0, 2))
    return _egg(rng, width, center, Dent(rng.uniform(0.01, 0.06), rng.uniform(0.6, 1.6), away))


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
    """A pool of a kind, and the bench it is seen on."""
    rig = replace(
        BENCH_RIG,
        laser=Laser(rng.uniform(28.0, 33.0), rng.uniform(29.0, 35.5)),
        imaging_plane=ImagingPlane.vertical(rng.uniform(46.0, 56.0), 45.0, 3.0),
    )
    return rig, KINDS[kind](rng, rng.uniform(4.6, 6.6), tuple(rng.uniform(-0.5, 0.5, 2)))


def draw(kind: str, seed: int, missing: float, false: int) -> tuple[Rig, SeenDots, Pool]:
    """A pool of a kind, the bench it is seen on, and its dots."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    rig, pool = draw_pool(kind, rng)
    sigma_px, many = rng.uniform(0.05, 0.3), len(see(pool, np.random.default_rng(0), rig=rig).ray)
    lost = round(many * rng.uniform(0.0, missing))
    strays = int(rng.integers(0, false + 1))
    return rig, see(pool, rng, sigma_px=sigma_px, missing=lost, false=strays, rig=rig), pool


def set_up_off(rig: Rig, seed: int, times: float) -> Rig:
    """The rig as it is thought to be, off by chance; with the uncertainties that are assumed."""
    rng = np.random.default_rng([seed, 78])
    angle, distance = times * rng.normal(0.0, [0.2, 0.3])
    laser, plane = rig.laser, rig.imaging_plane
    off = replace(
        rig,
        laser=Laser(laser.projection_angle_deg + angle, laser.distance_mm + distance),
        imaging_plane=replace(plane, origin_mm=plane.origin_mm + times * rng.normal(0, 0.3, 3)),
    )
    return as_entered(off, BENCH_VIEW)


def as_entered(rig: Rig, calibration: ImageCalibration) -> Rig:
    """The rig with the uncertainties that a setup file without any has."""
    axes = AxisPoints(calibration, 60.0, 60.0)
    return replace(rig, uncertainty=RigUncertainty(axes, *covariance_of({})))


def main() -> int:
    """How many labels were wrong."""
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
        answers: list[Answer] = []
        for seed in range(chosen.seed, chosen.seed + chosen.pools):
            rig, seen, pool = draw(kind, seed, chosen.missing, chosen.false)
            answers.append(answer(pool, seen, set_up_off(rig, seed, chosen.off)))
            if answers[-1].status != "ok" or answers[-1].wrong:
                print(f"{kind} {seed}: {answers[-1]}", flush=True)
        wrong += report(kind, answers)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
