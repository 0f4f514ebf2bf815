"""Short recordings of the pools of ``clutter.py``: frames of one bench decide the rows together.

Run as ``python -m tests.benchmarks.clutter_recordings [--seeds N] [--seed S] [--frames N]
[--missing SHARE] [--false N] [--off TIMES] [--beside SHARE] [--jump FRAME] [KIND …]``. The setup
errors are the same in all frames of a recording. The pool oscillates, and its size and position
vary between frames; in a share of the frames a dot beside the marker is missing as well, and from
one frame on the pool may be moved by the spacing of the rays. Prints a line for each recording: the
results of single frames, and of all together. Fails if rows are wrong.
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
from tests.benchmarks.clutter import KINDS, draw_pool, with_setup_errors
from tests.benchmarks.dips import matched
from tests.scenes import SeenDots, see

JUMP_MM = 0.45
"""About the spacing of the rays on the work piece."""

BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1), (2, 0), (-2, 0))
"""Rays beside the marker whose dot may be missing."""

WRONG_ROWS = 0.2
"""Rows count as wrong if a larger share of the labels is wrong."""


@dataclass(frozen=True)
class Clutter:
    """Defects of the frames: the largest share of missing dots, and number of false ones; how often
    a dot beside the marker is missing; the frame from which on the pool is moved.
    """

    missing: float = 0.1
    false: int = 10
    beside: float = 0.0
    jump: int | None = None


def draw(kind: str, seed: int, count: int, clutter: Clutter) -> tuple[Rig, list[SeenDots]]:
    """Return the bench of a recording, and the dots of its frames."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), 5])
    rig, pool = draw_pool(kind, rng)
    swing = rng.uniform(0.002, 0.01), 30.0, rng.uniform(0.0, 360.0)
    sigma_px, scenes = rng.uniform(0.05, 0.3), []
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
        current = replace(
            pool, footprint=foot, peak_mm=pool.peak_mm * height, terms=(*pool.terms, wave)
        )
        dot_count = len(see(current, np.random.default_rng(0), rig=rig).ray)
        missing = round(dot_count * rng.uniform(0.0, clutter.missing))
        false = int(rng.integers(0, clutter.false + 1))
        dots = see(current, rng, sigma_px=sigma_px, missing=missing, false=false, rig=rig)
        if rng.uniform() < clutter.beside:
            dots = _without(dots, np.add(rig.pattern.marker, BESIDE[rng.integers(len(BESIDE))]))
        scenes.append(dots)
    return rig, scenes


def _without(seen: SeenDots, ray: np.ndarray) -> SeenDots:
    """Return the scene without the dot of a ray."""
    others = (seen.ray != ray).any(axis=-1)
    dots = {name: values[others] for name, values in vars(seen.dots).items()}
    return SeenDots(replace(seen.dots, **dots), seen.ray[others])


def measured(seen: SeenDots, rig: Rig) -> Measurement:
    """Return the measurement of a single frame."""
    try:
        match = matched(seen, rig)
        reconstruction = fit.reconstruct(match, rig, Settings().fit)
    except RowsOpen as error:
        common = error.status, error.reason, "fit", seen.dots
        return OpenMeasurement(*common, candidates=error.candidates)
    except CannotMeasure as error:
        return Measurement(error.status, error.reason, "fit", seen.dots)
    size = measure_surface(reconstruction, match, rig)
    return Measurement("ok", "", "fit", seen.dots, None, match, reconstruction, size)


def together(frames: Sequence[Measurement], rig: Rig) -> list[Measurement]:
    """Return the measurements of all frames of a recording, judged together."""
    vote = RowVote(rig, Settings())
    ballots = [vote.add(each) for each in frames]
    return [vote.judged(ballot) for ballot in ballots]


def outcome(result: Measurement, seen: SeenDots) -> str:
    """Return the status, or ``wrong-rows``."""
    if result.status != "ok" or result.match is None:
        return result.status
    wrong = (seen.ray[result.match.dot] != result.match.ray).any(axis=-1)
    return "wrong-rows" if wrong.mean() > WRONG_ROWS else "ok"


def outcomes(
    kind: str, seed: int, count: int, clutter: Clutter, setup_errors: float
) -> tuple[list[str], list[str]]:
    """Return the outcomes of a recording's frames measured singly, and together."""
    rig, scenes = draw(kind, seed, count, clutter)
    entered = with_setup_errors(rig, seed, setup_errors)
    alone = [measured(each, entered) for each in scenes]
    judged = together(alone, entered)
    return (
        [outcome(*each) for each in zip(alone, scenes, strict=True)],
        [outcome(*each) for each in zip(judged, scenes, strict=True)],
    )


def main() -> int:
    """Print the results; return the number of frames with wrong rows."""
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
            alone, judged = outcomes(kind, seed, chosen.frames, clutter, chosen.off)
            by_themselves.update(alone)
            all_together.update(judged)
            print(kind, seed, dict(Counter(alone)), "together", dict(Counter(judged)), flush=True)
    print(f"alone {dict(by_themselves)}, together {dict(all_together)}")
    return all_together["wrong-rows"]


if __name__ == "__main__":
    sys.exit(min(main(), 1))
