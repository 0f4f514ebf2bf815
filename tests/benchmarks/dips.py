"""Pools with a dip under the torch: wrong labels, and the number of pools measured.

Run as ``python tests/benchmarks/dips.py [--pools N] [--seed S] [--missing N] [--false N]``. Each
pool is drawn from its own seed, traced and detected perfectly with 0.06 px of noise. Prints a line
for each pool that was rejected or has wrong labels; then how many were measured and the error of
their height. Fails if any label is wrong.

A dip moves the dots under the torch like a shift by one row: the hardest case for identifying rows,
as the absent centre ray is there as well.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.matching.match_rays import match_rays
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import Observation
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice
from labapp.core.schemes import fit
from labapp.core.schemes.fit import FitSettings
from labapp.core.surface.measures import Measures, measure_surface
from labapp.core.values import CannotMeasure
from labapp.simulation.pools import Dent, Pool, egg
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, SeenDots, see

NOISE_PX = 0.06


def draw(seed: int, missing: int = 0, false: int = 0) -> tuple[Pool, SeenDots]:
    """Return a pool with a dip 10–60 µm deep, σ 0.6–1.6 mm, near the torch, and its dots."""
    rng = np.random.default_rng(seed)
    width, center = rng.uniform(4.8, 6.6), rng.uniform(-0.4, 0.4, 2)
    head, tail = width * rng.uniform(0.42, 0.52), width * rng.uniform(0.5, 0.66)
    distance, angle = 1.5 * np.sqrt(rng.uniform()), rng.uniform(0.0, 2 * np.pi)
    position = distance * np.array([np.cos(angle), np.sin(angle)])
    dent = Dent(rng.uniform(0.01, 0.06), rng.uniform(0.6, 1.6), tuple(position - center))
    pool = egg(width, head, tail, width * rng.uniform(0.04, 0.06), tuple(center), (dent,))
    return pool, see(pool, rng, sigma_px=NOISE_PX, missing=missing, false=false)


@dataclass(frozen=True)
class PoolResult:
    """Result for one pool: status, wrong and right labels, dots shown, error of the height.

    The error is a share of the true height; NaN if the pool was rejected.
    """

    status: str
    wrong: int = 0
    right: int = 0
    shown: int = 0
    height: float = float("nan")


def measure_pool(pool: Pool, seen: SeenDots, rig: Rig = BENCH_RIG) -> PoolResult:
    """Match the dots, fit the surface, and compare both with the truth."""
    shown = int((seen.ray[:, 0] > 0).sum())
    try:
        match = matched(seen, rig)
        size = measure_surface(fit.reconstruct(match, rig, FitSettings()), match, rig)
    except CannotMeasure as error:
        return PoolResult(error.status, shown=shown)
    wrong = int((seen.ray[match.dot] != match.ray).any(axis=-1).sum())
    return PoolResult("ok", wrong, len(match.dot) - wrong, shown, height_error(pool, size))


def height_error(pool: Pool, size: Measures) -> float:
    """Return the relative error of a pool's height, or of its depth if that is larger."""
    name = "height_mm" if pool.size.height_mm > -pool.size.depth_mm else "depth_mm"
    return float(getattr(size, name) / getattr(pool.size, name) - 1)


def matched(seen: SeenDots, rig: Rig = BENCH_RIG) -> Match:
    """Return the match of seen dots."""
    try:
        lattice = grow_lattice(seen.dots, GrowSettings())
    except CannotMeasure:
        lattice = None
    observed = Observation.of(seen.dots, Bench(rig, BENCH_VIEW), FRAME_SHAPE)
    return match_rays(observed, lattice, MatchSettings())[0]


def report(kind: str, results: list[PoolResult]) -> int:
    """Print the results for the pools of a kind; return the number of wrong labels."""
    measured = [one for one in results if one.status == "ok"]
    error_pct = 100 * np.abs([one.height for one in measured] or [np.nan])
    wrong, right = sum(one.wrong for one in measured), sum(one.right for one in measured)
    print(
        f"{kind}: {len(measured)} of {len(results)} answered, {wrong} labels wrong, "
        f"{right / max(sum(one.shown for one in measured), 1):.3f} labelled, height off by "
        f"{np.median(error_pct):.2f} % in the median, {error_pct.max():.2f} % at worst",
        flush=True,
    )
    return wrong


def main() -> int:
    """Print the results; return the number of wrong labels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pools", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--missing", type=int, default=0)
    parser.add_argument("--false", type=int, default=0)
    chosen = parser.parse_args()
    results = []
    for seed in range(chosen.seed, chosen.seed + chosen.pools):
        results.append(measure_pool(*draw(seed, chosen.missing, chosen.false)))
        if results[-1].status != "ok" or results[-1].wrong:
            print(f"{seed}: {results[-1]}", flush=True)
    wrong = report("dips", results)
    print(dict(Counter(one.status for one in results)))
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
