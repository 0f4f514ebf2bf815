"""Patterns of every kind on pools of several kinds: wrong labels, and error against density.

Run as ``python tests/benchmarks/patterns.py [--pools N] [--seed S] [PATTERN …]``. The fan of each
is about that of 19 × 19 rays at 0.77°. Pools and benches are those of ``clutter.py``, frames have
the default look of the simulation. A frame is resolvable if 95 % of its dots have their nearest
neighbour at least three dot sizes (σ) away. Prints a line for each frame with a wrong label, and
for each resolvable one that was rejected; a line for every pattern; then the error CE-D of the fit
on the caps of §8.3.1 with exact reflections, against the number of rays on the pool. Fails if any
label is wrong, or less than 90 % of the resolvable frames were measured.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern
from labapp.core.pipeline import Settings, measure
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import caps_8_3_1
from labapp.simulation.render import Look, render
from labapp.studies.correspondence_table import OPEN_BENCH
from labapp.studies.error_analysis import errors_of, off_centre, trace_once
from tests.benchmarks.clutter import as_entered, draw_pool
from tests.benchmarks.dips import height_error
from tests.benchmarks.rendered import ON_ITS_DOT_PX, PX_PER_MM, draw_view

PATTERNS = {
    "19x19": DotPattern(),
    "25x25": DotPattern(25, 25, 0.77 * 18 / 24),
    "37x37": DotPattern(37, 37, 0.385),
    "hexagonal-331": DotPattern(21, 21, 0.72, kind="hexagonal"),
    "two-markers": DotPattern(absent=frozenset({(10, 10), (8, 13)})),
    "51x51": DotPattern(51, 51, 0.77 * 18 / 50),
}
KINDS = ("cap", "concave", "ellipse", "egg", "lowrear")
LEAST_ANSWERED = 0.9


@dataclass(frozen=True)
class Outcome:
    """Result for a frame; see `dips.PoolResult`."""

    status: str
    resolvable: bool
    wrong: int = 0
    right: int = 0
    shown: int = 0
    height: float = float("nan")


def resolvable(dot_px: np.ndarray, look: Look) -> bool:
    """Whether 95 % of the dots, shape (n, 2), can be resolved."""
    sigma_px = np.hypot(look.dot_floor_mm * PX_PER_MM, look.blur_px)
    distance = scipy.spatial.cKDTree(dot_px).query(dot_px, k=2)[0][:, 1]
    return bool(np.quantile(distance, 0.05) >= 3.0 * sigma_px)


def measured(name: str, kind: str, seed: int) -> Outcome:
    """Render one frame and measure it."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 2])
    rig, pool = draw_pool(kind, rng)
    rig, look, view = replace(rig, pattern=PATTERNS[name]), Look(), draw_view(rng)
    frame = render(trace(pool, rig), view, look, rng)
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    calibration = ImageCalibration.from_three_points(*axes)
    bench = Bench(as_entered(rig, calibration), calibration)
    result, is_clear = (
        measure(frame.image, bench, Settings())[0],
        resolvable(frame.dot_px[frame.shown], look),
    )
    if result.match is None or result.measures is None or result.dots is None:
        return Outcome(result.status, is_clear, shown=int(frame.shown.sum()))
    true_px = np.where(frame.shown[..., None], frame.dot_px, np.nan)[tuple(result.match.ray.T - 1)]
    distance = np.linalg.norm(result.dots.image_px[result.match.dot] - true_px, axis=-1)
    wrong = int((~(distance < ON_ITS_DOT_PX)).sum())
    right, shown = len(distance) - wrong, int(frame.shown.sum())
    return Outcome("ok", is_clear, wrong, right, shown, height_error(pool, result.measures))


def surveyed(name: str, pools: int, first: int) -> bool:
    """Print a pattern's results; return whether no label is wrong and enough were measured."""
    outcomes = []
    for kind in KINDS:
        for seed in range(first, first + pools):
            outcome = measured(name, kind, seed)
            outcomes.append(outcome)
            if outcome.wrong or (outcome.resolvable and outcome.status != "ok"):
                print(f"{name} {kind} {seed}: {outcome}", flush=True)
    clear = [outcome for outcome in outcomes if outcome.resolvable]
    answered = [outcome for outcome in outcomes if outcome.status == "ok"]
    share = sum(outcome.status == "ok" for outcome in clear) / max(len(clear), 1)
    wrong = sum(outcome.wrong for outcome in outcomes)
    heights = np.abs([outcome.height for outcome in answered])
    labelled = sum(outcome.right for outcome in answered) / max(
        sum(outcome.shown for outcome in answered), 1
    )
    others = Counter(outcome.status for outcome in outcomes if not outcome.resolvable)
    print(
        f"{name}: {len(clear)} of {len(outcomes)} resolvable, {100 * share:.1f} % answered; "
        f"{wrong} wrong labels, {labelled:.4f} labelled; height "
        f"{100 * np.median(heights):.2f} % median, {100 * heights.max():.2f} % worst; "
        f"not resolvable: {dict(others)}",
        flush=True,
    )
    return wrong == 0 and share >= LEAST_ANSWERED


def density_line(name: str) -> str:
    """Return a line with the depth error on the caps of §8.3.1, and the number of rays."""
    rig, errors, rays = replace(OPEN_BENCH, pattern=PATTERNS[name]), [], []
    for cap in off_centre(caps_8_3_1(), 1):
        reflections = trace_once(cap, rig)
        match = exact_match(reflections)
        rays.append(len(match.ray))
        errors.append(errors_of(match, reflections, rig, cap, "fit")[0])
    lost = int(np.isnan(errors).sum())
    return (
        f"{name:14} {np.median(rays):5.0f} rays  CE-D {100 * np.nanmean(errors):.2f} % mean, "
        f"{100 * np.nanmax(errors):.2f} % worst, {lost} without a surface"
    )


def main() -> int:
    """Return 0 if every pattern passes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patterns", nargs="*", default=list(PATTERNS))
    parser.add_argument("--pools", type=int, default=30, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    passed = [surveyed(name, chosen.pools, chosen.seed) for name in chosen.patterns]
    for name in chosen.patterns:
        print(density_line(name), flush=True)
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
