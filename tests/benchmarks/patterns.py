"""Patterns of every kind on pools of several kinds: wrong labels, answers, and error with density.

Run as ``python tests/benchmarks/patterns.py [--pools N] [--seed S] [PATTERN …]``. The fan of each
is about that of 19 × 19 rays at 0.77°. Pools and benches are those of ``clutter.py``, frames have
the twin's usual look. A frame is resolvable where 95 % of its dots have their next one at least
three of their standard deviations away. A line for each frame that has a wrong label, and for each
resolvable one that was not answered; a line for every pattern; then the error CE-D of the fit on
the caps of §8.3.1 with exact reflections, against the rays on the pool. Fails where a label is
wrong, or less than nine in ten resolvable frames were answered.
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
from labapp.studies.error_analysis import aside, errors_of, trace_once
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
    """What came of a frame; see `rendered.Answer`."""

    status: str
    resolvable: bool
    wrong: int = 0
    right: int = 0
    shown: int = 0
    height: float = float("nan")


def resolvable(dot_px: np.ndarray, look: Look) -> bool:
    """Whether 95 % of the dots, shape (n, 2), lie apart."""
    sigma_px = np.hypot(look.dot_floor_mm * PX_PER_MM, look.blur_px)
    apart = scipy.spatial.cKDTree(dot_px).query(dot_px, k=2)[0][:, 1]
    return bool(np.quantile(apart, 0.05) >= 3.0 * sigma_px)


def measured(name: str, kind: str, seed: int) -> Outcome:
    """Render one frame and measure it."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 2])
    rig, pool = draw_pool(kind, rng)
    rig, look, view = replace(rig, pattern=PATTERNS[name]), Look(), draw_view(rng)
    frame = render(trace(pool, rig), view, look, rng)
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    calibration = ImageCalibration.from_three_points(*axes)
    bench = Bench(as_entered(rig, calibration), calibration)
    found, apart = (
        measure(frame.image, bench, Settings())[0],
        resolvable(frame.dot_px[frame.shown], look),
    )
    if found.match is None or found.measures is None or found.dots is None:
        return Outcome(found.status, apart, shown=int(frame.shown.sum()))
    own = np.where(frame.shown[..., None], frame.dot_px, np.nan)[tuple(found.match.ray.T - 1)]
    off = np.linalg.norm(found.dots.image_px[found.match.dot] - own, axis=-1)
    wrong = int((~(off < ON_ITS_DOT_PX)).sum())
    right, shown = len(off) - wrong, int(frame.shown.sum())
    return Outcome("ok", apart, wrong, right, shown, height_error(pool, found.measures))


def surveyed(name: str, pools: int, first: int) -> bool:
    """Whether a pattern has no wrong label and enough answers; says what it has."""
    outcomes = []
    for kind in KINDS:
        for seed in range(first, first + pools):
            one = measured(name, kind, seed)
            outcomes.append(one)
            if one.wrong or (one.resolvable and one.status != "ok"):
                print(f"{name} {kind} {seed}: {one}", flush=True)
    apart = [one for one in outcomes if one.resolvable]
    answered = [one for one in outcomes if one.status == "ok"]
    share = sum(one.status == "ok" for one in apart) / max(len(apart), 1)
    wrong = sum(one.wrong for one in outcomes)
    heights = np.abs([one.height for one in answered])
    labelled = sum(one.right for one in answered) / max(sum(one.shown for one in answered), 1)
    others = Counter(one.status for one in outcomes if not one.resolvable)
    print(
        f"{name}: {len(apart)} of {len(outcomes)} resolvable, {100 * share:.1f} % answered; "
        f"{wrong} wrong labels, {labelled:.4f} labelled; height "
        f"{100 * np.median(heights):.2f} % median, {100 * heights.max():.2f} % worst; "
        f"not resolvable: {dict(others)}",
        flush=True,
    )
    return wrong == 0 and share >= LEAST_ANSWERED


def density_line(name: str) -> str:
    """Error of the depth on the caps of §8.3.1, and how many rays come back."""
    rig, errors, rays = replace(OPEN_BENCH, pattern=PATTERNS[name]), [], []
    for cap in aside(caps_8_3_1(), 1):
        seen = trace_once(cap, rig)
        match = exact_match(seen, rig)
        rays.append(len(match.ray))
        errors.append(errors_of(match, seen, rig, cap, "fit")[0])
    lost = int(np.isnan(errors).sum())
    return (
        f"{name:14} {np.median(rays):5.0f} rays  CE-D {100 * np.nanmean(errors):.2f} % mean, "
        f"{100 * np.nanmax(errors):.2f} % worst, {lost} without a surface"
    )


def main() -> int:
    """0 if every pattern holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patterns", nargs="*", default=list(PATTERNS))
    parser.add_argument("--pools", type=int, default=30, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    held = [surveyed(name, chosen.pools, chosen.seed) for name in chosen.patterns]
    for name in chosen.patterns:
        print(density_line(name), flush=True)
    return 0 if all(held) else 1


if __name__ == "__main__":
    sys.exit(main())
