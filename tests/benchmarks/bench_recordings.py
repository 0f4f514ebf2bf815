"""Recordings of pools of every kind on benches of every kind.

Run as ``python -m tests.benchmarks.bench_recordings [--recordings N] [--frames N] [--seed S]
[--off TIMES] [KIND …]``. Benches, pools and looks are those of ``benches.py``. Between frames, 5 ms
apart, the pool sways, grows and shrinks, and the dots that are missing or false are others. Frames
are followed and judged together, as by ``labapp reconstruct --warm``. Prints a line for each frame
with wrong labels, or with a size off by more than 4 of its σ, and for each recording of which
frames were refused or measured without a prior; then, for every kind, a line as ``benches.py``.
Fails if any frame was measured wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from labapp.core.pipeline import Settings
from labapp.core.recording.chain import WarmChain
from labapp.core.recording.row_vote import RowVote
from labapp.simulation.forward import trace
from labapp.simulation.pools import Pool
from labapp.simulation.render import render
from tests.benchmarks.benches import (
    FEWEST,
    Scene,
    SceneResult,
    compared,
    draw_scene,
    image_of,
    summary,
)
from tests.benchmarks.clutter import KINDS
from tests.benchmarks.rendered import draw_look

SWAY, HEAVE = 0.02, 0.05
"""Amplitudes of the sizes along the work piece and of the height, as shares of them."""

WANDER_MM = 0.02
"""Standard deviation of the pool's displacement from one frame to the next, along X and Y."""


def draw_motion(pool: Pool, count: int, rng: np.random.Generator) -> Iterator[Pool]:
    """Yield the pool of each frame: its sizes oscillate, and its centre wanders."""
    period, phases = rng.uniform(5.0, 30.0), rng.uniform(0.0, 2.0 * np.pi, 3)
    center = np.array(pool.footprint.center_mm)
    for number in range(count):
        swing = np.sin(2.0 * np.pi * number / period + phases)
        foot = replace(pool.footprint, center_mm=(float(center[0]), float(center[1])))
        sizes = 1.0 + np.array([SWAY, SWAY, HEAVE]) * swing
        yield replace(pool, footprint=foot).scaled(*sizes.tolist())
        center = center + rng.normal(0.0, WANDER_MM, 2)


def draw_frames(first: Scene, count: int, seed: int) -> Iterator[Scene]:
    """Yield the scene of each frame of a recording on the bench of the first."""
    rng = np.random.default_rng([seed, count])
    look = draw_look(rng)
    for pool in draw_motion(first.pool, count, rng):
        frame = render(trace(pool, first.rig), first.view, look, rng)
        if frame.shown.sum() >= FEWEST:
            yield replace(first, frame=frame, pool=pool)


def measured(scenes: list[Scene]) -> tuple[list[SceneResult], list[str]]:
    """Measure a recording.

    Returns
    -------
    results, lost
        Of each frame; and why frames were not tracked.
    """
    bench, settings = scenes[0].bench, Settings()
    chain, vote = WarmChain(bench, settings), RowVote(bench.rig, settings)
    ballots, lost = [], []
    for scene in scenes:
        if vote.is_outvoted:
            chain = WarmChain(bench, settings)
        result = chain.measure(image_of(scene))
        is_tracked = chain.track_lost is None
        lost += [] if is_tracked else [str(chain.track_lost)]
        ballots.append(vote.add(result, is_tracked))
    judged = [vote.judged(ballot) for ballot in ballots]
    return [compared(*pair) for pair in zip(scenes, judged, strict=True)], lost


def main() -> int:
    """Print the results; return the number of frames with a wrong surface."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--recordings", type=int, default=5)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--off", type=float, default=0.0)
    chosen = parser.parse_args()
    wrong = 0
    for kind in chosen.kinds:
        results = []
        for seed in range(chosen.seed, chosen.seed + chosen.recordings):
            scenes = list(draw_frames(draw_scene(kind, seed, chosen.off), chosen.frames, seed))
            if not scenes:
                continue
            found, lost = measured(scenes)
            for number, one in enumerate(found):
                if one.is_wrong:
                    print(f"{kind} {seed}, frame {number}: {one}", flush=True)
            refused = sum(one.status != "ok" for one in found)
            if refused or len(lost) > 1:
                words = f"of {len(found)} frames {refused} refused, {len(lost)} not tracked"
                print(f"{kind} {seed}: {words}: {', '.join(sorted(set(lost)))}", flush=True)
            results += found
        wrong += sum(one.is_wrong for one in results)
        print(summary(kind, results), flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
