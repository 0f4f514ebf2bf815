"""Dot patterns that are resolvable on a bench, for the expected pools.

A denser pattern covers the pool with more rays, but its dots are closer to each other. Where dots
merge, they have no positions and give no labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from labapp.core.geometry.rig import DotPattern
from labapp.simulation.forward import trace
from labapp.studies.adviser.bench_limits import BenchLimits, Place
from labapp.studies.adviser.expected_pools import ExpectedPools
from labapp.studies.tables import Table

SQUARE_ROWS = (13, 19, 25, 31, 37, 43, 51)
"""Rows of the compared square patterns; the hexagonal one has two rows more than 19."""

CROWDED_SHARE = 0.05
"""Share of a pool's dots that may be closer to the next one."""


@dataclass(frozen=True)
class PatternFit:
    """Properties of a pattern on the extreme expected pools.

    Parameters
    ----------
    least_dots, most_dots
        Dots on the plane for the pools with the fewest and with the most.
    spacing_px
        Minimum distance to the next dot for 95 % of the dots, on the pool where it is smallest, px.
    resolvable
        Whether this distance is at least that required by the camera (`BenchLimits.spacing_px`).
    """

    pattern: DotPattern
    least_dots: int
    most_dots: int
    spacing_px: float
    resolvable: bool

    @property
    def name(self) -> str:
        """Kind, rows and columns, angle."""
        size = f"{self.pattern.rows} × {self.pattern.columns}"
        return f"{self.pattern.kind} {size}, {self.pattern.inter_beam_angle_deg:.3g}°"


def same_fan(pattern: DotPattern) -> tuple[DotPattern, ...]:
    """Square patterns and a hexagonal one with the fan of a pattern, the coarsest first."""
    fan_deg = (pattern.rows - 1) * pattern.inter_beam_angle_deg
    square = [DotPattern(n, n, fan_deg / (n - 1)) for n in SQUARE_ROWS]
    hexagonal = DotPattern(21, 21, fan_deg / (20 * np.sqrt(3) / 2), kind="hexagonal")
    return tuple(sorted([*square, hexagonal], key=lambda one: -one.inter_beam_angle_deg))


def compare_patterns(
    expected: ExpectedPools,
    limits: BenchLimits,
    place: Place,
    patterns: Sequence[DotPattern] | None = None,
) -> tuple[PatternFit, ...]:
    """Compare patterns with laser and imaging plane at a position.

    Parameters
    ----------
    expected, limits, place
        The pools, of which the extreme ones are traced; the bench; its position.
    patterns
        Patterns to compare. None: the pattern of the bench and its `same_fan`.
    """
    own = limits.pattern
    chosen = patterns if patterns is not None else dict.fromkeys([*same_fan(own), own])
    made = []
    for pattern in chosen:
        rig = replace(limits.rig(place), pattern=pattern)
        dots, spacing = [], []
        for pool in expected.corners(shifted=False):
            seen = trace(pool, rig)
            plane_mm = seen.plane_mm[seen.visible]
            dots.append(len(plane_mm))
            if len(plane_mm) > 1:
                apart = cKDTree(plane_mm).query(plane_mm, k=2)[0][:, 1]
                spacing.append(float(np.quantile(apart, CROWDED_SHARE)))
        least = min(spacing, default=0.0) * limits.px_per_mm
        made.append(PatternFit(pattern, min(dots), max(dots), least, least >= limits.spacing_px))
    return tuple(made)


def densest(fits: Sequence[PatternFit]) -> PatternFit | None:
    """The resolvable pattern with the most dots on the smallest pool; None if there is none."""
    return max(
        (one for one in fits if one.resolvable),
        key=lambda one: (one.least_dots, one.most_dots),
        default=None,
    )


def pattern_table(fits: Sequence[PatternFit]) -> Table:
    """The comparison, the coarsest pattern first."""
    best = densest(fits)
    return Table.of(
        "patterns",
        "Dot patterns with the same fan at the recommended position: dots of the pools with the "
        "fewest and the most, and minimum distance to the next dot for 95 % of the dots"
        + (f". Densest resolvable pattern: {best.name}" if best else ". None is resolvable"),
        [
            {
                "pattern": one.name,
                "least_dots": one.least_dots,
                "most_dots": one.most_dots,
                "spacing_px": one.spacing_px,
                "resolvable": "yes" if one.resolvable else "no",
            }
            for one in fits
        ],
    )
