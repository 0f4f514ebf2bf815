"""The adviser's choice of a dot pattern: the densest whose dots can be resolved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.rig import DotPattern
from labapp.studies.adviser.bench_limits import BenchLimits, Place
from labapp.studies.adviser.dense_patterns import (
    compare_patterns,
    densest,
    pattern_table,
    same_fan,
)
from labapp.studies.adviser.expected_pools import ExpectedPools

POOLS = ExpectedPools((6.0, 6.5), (6.5, 7.0), (0.2, 0.25))
PLACE = Place(30.0, 30.0, 60.0, 50.8, 0.0)
PATTERNS = (DotPattern(), DotPattern(25, 25, 0.77 * 18 / 24), DotPattern(37, 37, 0.385))


def test_denser_dots_are_closer_and_need_a_sharper_camera() -> None:
    limits = BenchLimits()
    fits = compare_patterns(POOLS, limits, PLACE, PATTERNS)
    spacing = [one.spacing_px for one in fits]
    assert spacing == sorted(spacing, reverse=True)
    # The angle between rays decides: twice the rows, half the spacing.
    assert spacing[0] / spacing[2] == pytest.approx(2.0, rel=0.05)
    chosen = densest(fits)
    assert chosen is not None
    assert chosen.spacing_px >= limits.spacing_px
    sharper = compare_patterns(POOLS, replace(limits, spacing_px=2.0), PLACE, PATTERNS)
    best = densest(sharper)
    assert best is not None
    assert best.pattern == PATTERNS[2]
    assert best.least_dots > chosen.least_dots
    assert densest(compare_patterns(POOLS, replace(limits, spacing_px=50), PLACE, PATTERNS)) is None


def test_same_fan_patterns_have_the_same_fan() -> None:
    fan = np.radians(18 * 0.77)
    for pattern in same_fan(DotPattern()):
        present = [
            (i - 1, j - 1)
            for i in range(1, pattern.rows + 1)
            for j in range(1, pattern.columns + 1)
            if (i, j) not in pattern.absent_rays
        ]
        up = np.array([pattern.tangents[ray][1] for ray in present])
        assert np.arctan(up.max()) - np.arctan(up.min()) == pytest.approx(fan, rel=0.05)


def test_table_marks_the_densest_pattern() -> None:
    table = pattern_table(compare_patterns(POOLS, BenchLimits(), PLACE, PATTERNS[:1]))
    assert "square 19 × 19" in table.caption
    assert table.rows[0][-1] == "yes"
