"""Recordings of line patterns, pool by pool: a penetration run (Fig. 3-11 … 3-14)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.simulation.pools import Pool, Wave, egg

PHASES = ("no-pool", "growing", "concave", "flattening", "convex")
"""States of the run in order: up to point A, AB, BC, CD, DE of Fig. 3-11."""


@dataclass(frozen=True)
class RunFrame:
    """A frame of a run.

    Parameters
    ----------
    pool
        The pool; None: there is none yet.
    state
        One of `PHASES`.
    """

    pool: Pool | None
    state: str


def penetration_run(frames: int, rng: np.random.Generator) -> tuple[RunFrame, ...]:
    """Draw a run like that of Fig. 3-11: the pool grows to full penetration, then becomes convex.

    From A to B it grows, hollow; from B to C it stays; from C to D, faster, it shrinks and its
    surface rises; from D to E it is convex and small, so that an outer line is lost. It swings a
    little all the time (Fig. 3-12).

    Parameters
    ----------
    frames
        How many there are.
    rng
        Source of sizes and of where the phases end.
    """
    shares = np.array([0.08, 0.2, 0.26, 0.18, 0.28]) * rng.uniform(0.85, 1.15, 5)
    ends = np.rint(np.cumsum(shares / shares.sum()) * frames).astype(int)
    large, small = rng.uniform(5.8, 6.6), rng.uniform(4.2, 4.8)
    deep, high = rng.uniform(-0.3, -0.2), rng.uniform(0.16, 0.24)
    phase_deg = rng.uniform(0, 360)
    made = []
    for k in range(frames):
        phase = int(np.searchsorted(ends, k, side="right"))
        start = 0 if phase == 0 else int(ends[phase - 1])
        part = (k + 0.5 - start) / (ends[phase] - start)
        if phase == 0:
            made.append(RunFrame(None, PHASES[0]))
            continue
        grown = part if phase == 1 else 1.0
        changed = (0.0, 0.0, 0.0, part, 1.0)[phase]
        width = (2.2 + (large - 2.2) * grown) * (1 - changed) + small * changed
        height = deep * grown * (1 - changed) + high * changed
        head = width * (0.46 * (1 - changed) + 0.31 * changed)
        wave = Wave((1, 1), 0.004 * grown, turned_deg=90.0, phase_deg=phase_deg + 67.0 * k)
        made.append(RunFrame(egg(width, head, 0.5 * width, height, terms=(wave,)), PHASES[phase]))
    return tuple(made)
