"""Short recordings of the pools of ``clutter.py``: frames of one bench decide the rows together.

Run as ``python -m tests.benchmarks.clutter_recordings [--seeds N] [--seed S] [--frames N]
[--missing SHARE] [--false N] [--off TIMES] [--beside SHARE] [--jump FRAME] [KIND …]``. The set-up
is off by the same in all frames of a recording. The pool swings, and its size and place wander from
frame to frame; in a share of the frames a dot beside the marker is missing besides, and from one
frame on the pool may lie a ray's spacing further on. A line for each recording: what its frames
gave by themselves, and together. Fails where rows are wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import RowsOpen
from labapp.core.pipeline import Measurement, OpenMeasurement, Settings
from labapp.core.recording.row_vote import RowVote
from labapp.core.schemes import fit
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure
from labapp.simulation.pools import Wave
from tests.benchmarks.clutter import KINDS, draw_pool, set_up_off
from tests.benchmarks.dips import matched
from tests.scenes import SeenDots, see

JUMP_MM = 0.45
"""About the spacing of the rays on the work piece."""

BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1), (2, 0), (-2, 0))
"""Rays beside the marker whose dot may be missing."""

WRONG_ROWS = 0.2
"""Rows are wrong where a larger share of the labels is."""


@dataclass(frozen=True)
class Clutter:
    """What is wrong with the frames: most missing, a share, and false; how often one beside the
    marker is missing; from which frame on the pool lies elsewhere.
    """

    missing: float = 0.1
    false: int = 10
    beside: float = 0.0
    jump: int | None = None


def draw(kind: str, seed: int, count: int, clutter: Clutter) -> tuple[Rig, list[SeenDots]]:
    """The bench of a recording, and the dots of its frames."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), 5])
    rig, pool = draw_pool(kind, rng)
    swing = rng.uniform(0.002, 0.01), 30.0, rng.uniform(0.0, 360.0)
    sigma_px, seen = rng.uniform(0.05, 0.3), []
    for k in range(count):
        width, length, height = rng.normal(1.0, [0.01, 0.01, 0.02])
        foot, center = pool.footprint, np.add(pool.footprint.center_mm, rng.normal(0.0, 0.03, 2))
        if clutter.jump is not None and k >= clutter.jump:
            center = np.add(center, (0.0, JUMP_MM))
        foot = replace(
            foot,
            width_mm=foot.width_mm * width,
            head_mm=foot.head_mm * length,
            tail_mm=foot.tail_mm * length,
            center_mm=(float(center[0]), float(center[1])),
        )
        wave = Wave((1, 1), swing[0], frequency_hz=swing[1], turned_deg=swing[2], time_s=k / 200)
        now = replace(
            pool, footprint=foot, peak_mm=pool.peak_mm * height, terms=(*pool.terms, wave)
        )
        many = len(see(now, np.random.default_rng(0), rig=rig).ray)
        missing = round(many * rng.uniform(0.0, clutter.missing))
        false = int(rng.integers(0, clutter.false + 1))
        dots = see(now, rng, sigma_px=sigma_px, missing=missing, false=false, rig=rig)
        if rng.uniform() < clutter.beside:
            dots = _without(dots, np.add(rig.pattern.marker, BESIDE[rng.integers(len(BESIDE))]))
        seen.append(dots)
    return rig, seen


def _without(seen: SeenDots, ray: np.ndarray) -> SeenDots:
    """What is seen without the dot of a ray."""
    kept = (seen.ray != ray).any(axis=-1)
    dots = {name: values[kept] for name, values in vars(seen.dots).items()}
    return SeenDots(replace(seen.dots, **dots), seen.ray[kept])


def measured(seen: SeenDots, rig: Rig) -> Measurement:
    """What a frame gives by itself."""
    try:
        match = matched(seen, rig)
        made = fit.reconstruct(match, rig, Settings().fit)
    except RowsOpen as why:
        own = why.status, why.reason, "fit", seen.dots
        return OpenMeasurement(*own, candidates=why.candidates)
    except CannotMeasure as why:
        return Measurement(why.status, why.reason, "fit", seen.dots)
    size = measure_surface(made, match, rig)
    return Measurement("ok", "", "fit", seen.dots, None, match, made, size)


def together(frames: Sequence[Measurement], rig: Rig) -> list[Measurement]:
    """What the frames of a recording give together."""
    vote = RowVote(rig, Settings())
    ballots = [vote.add(each) for each in frames]
    return [vote.judged(ballot) for ballot in ballots]


def outcome(found: Measurement, seen: SeenDots) -> str:
    """The status, or ``wrong-rows``."""
    if found.status != "ok" or found.match is None:
        return found.status
    wrong = (seen.ray[found.match.dot] != found.match.ray).any(axis=-1)
    return "wrong-rows" if wrong.mean() > WRONG_ROWS else "ok"


def outcomes(
    kind: str, seed: int, count: int, clutter: Clutter, off: float
) -> tuple[list[str], list[str]]:
    """What the frames of a recording gave by themselves, and together."""
    rig, seen = draw(kind, seed, count, clutter)
    entered = set_up_off(rig, seed, off)
    alone = [measured(each, entered) for each in seen]
    said = together(alone, entered)
    return (
        [outcome(*each) for each in zip(alone, seen, strict=True)],
        [outcome(*each) for each in zip(said, seen, strict=True)],
    )


def main() -> int:
    """How many frames have wrong rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--missing", type=float, default=0.1)
    parser.add_argument("--false", type=int, default=10)
    parser.add_argument("--off", type=float, default=1.0)
    parser.add_argument("--beside", type=float, default=0.0)
    parser.add_argument("--jump", type=int)
    chosen = parser.parse_args()
    clutter = Clutter(chosen.missing, chosen.false, chosen.beside, chosen.jump)
    by_themselves: Counter[str] = Counter()
    all_together: Counter[str] = Counter()
    for seed in range(chosen.seed, chosen.seed + chosen.seeds):
        for kind in chosen.kinds:
            alone, said = outcomes(kind, seed, chosen.frames, clutter, chosen.off)
            by_themselves.update(alone)
            all_together.update(said)
            print(kind, seed, dict(Counter(alone)), "together", dict(Counter(said)), flush=True)
    print(f"alone {dict(by_themselves)}, together {dict(all_together)}")
    return all_together["wrong-rows"]


if __name__ == "__main__":
    sys.exit(min(main(), 1))
