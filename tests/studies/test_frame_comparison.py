"""IRS by algorithm, correspondence and base height on a known pool (Fig. 6-10, 6-13)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg
from labapp.studies.correspondence_table import OPEN_BENCH
from labapp.studies.frame_comparison import comparison_tables, shape_table, with_orientation

MATCH = exact_match(trace(egg(6.0, 2.7, 3.4, 0.3), OPEN_BENCH))


def test_rays_are_mirrored_around_the_marker() -> None:
    assert MATCH.orientation == "S/S"
    turned = with_orientation(MATCH, OPEN_BENCH, "I/I")
    assert turned.orientation == "I/I"
    np.testing.assert_array_equal(turned.ray, 20 - MATCH.ray)
    back = with_orientation(turned, OPEN_BENCH, "S/S")
    np.testing.assert_array_equal(back.ray, MATCH.ray)
    rows = with_orientation(MATCH, OPEN_BENCH, "S/I")
    np.testing.assert_array_equal(rows.ray, np.abs(MATCH.ray - [20, 0]))


def test_rows_of_a_convex_pool_agree_with_its_correspondence() -> None:
    (row,) = shape_table(MATCH).rows
    named = dict(zip(shape_table(MATCH).columns, row, strict=True))
    assert named["rows"] == "convex"
    assert named["by_residual"] == "S/S"
    assert named["agree"] == "yes"
    # The same dots with an orientation that their rows do not allow.
    (row,) = shape_table(replace(MATCH, orientation="S/I")).rows
    assert row[-1] == "no"


@pytest.mark.slow
def test_true_correspondence_has_the_least_error() -> None:
    edge, one = comparison_tables(MATCH, OPEN_BENCH)
    assert len(edge.rows) == 9
    assert len(one.rows) == 3 * 11
    for algorithm in ("epa-r", "epa-c", "epa-rc"):
        errors = {row[0]: row[2] for row in edge.rows if row[1] == algorithm}
        assert min(errors, key=lambda way: errors[way] or np.inf) == "S/S"
    for height in {row[1] for row in one.rows}:
        errors = {row[0]: row[2] for row in one.rows if row[1] == height}
        assert min(errors, key=lambda way: errors[way] or np.inf) == "S/S"
    # Inner points have smaller errors than those at the edges (Fig. 6-16).
    true_errors = np.array([row[2:] for row in one.rows if row[0] == "S/S"], float)
    assert (true_errors[:, 2] < true_errors[:, 0]).all()
    assert (true_errors[:, 3] <= true_errors[:, 1]).all()
