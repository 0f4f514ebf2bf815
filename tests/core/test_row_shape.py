"""Convex and concave rows on the caps of Tables 4-4 and 4-5, and what they allow (§7.1)."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.matching.row_shape import RowShapes, match_row_shapes, row_shapes
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import spherical_cap
from labapp.studies.correspondence_table import (
    DEPTHS,
    OPEN_BENCH,
    RADII_MM,
    cap_reflections,
    correspondence_letters,
)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_rule_allows_what_tables_4_4_and_4_5_have(sign: int) -> None:
    shapes = []
    for part in DEPTHS:
        for radius in RADII_MM:
            seen = cap_reflections(radius, sign / part)
            orientation = correspondence_letters(seen).rstrip("*")
            if orientation == "D/D":
                continue
            row, column = np.nonzero(seen.lit)
            found = row_shapes(seen.plane_mm[row, column], row + 1)
            assert found.allows(orientation) is True, (part, radius)
            shapes.append(found.shape)
    # From shallow to deep the picture of a concave surface turns from concave to convex.
    assert shapes == (["convex"] * 16 if sign > 0 else ["concave"] * 8 + ["convex"] * 8)


@pytest.mark.parametrize(("width_mm", "height_mm"), [(6.0, 0.3), (6.0, -0.3), (6.0, -0.03)])
def test_a_match_with_noise(width_mm: float, height_mm: float) -> None:
    rng = np.random.default_rng(3)
    seen = trace(spherical_cap(width_mm, height_mm), OPEN_BENCH)
    match = exact_match(seen, OPEN_BENCH, sigma_mm=0.03, rng=rng)
    found = match_row_shapes(match)
    assert found.allows(match.orientation)
    assert found.shape == ("concave" if height_mm == -0.03 else "convex")


def test_without_rows_nothing_is_said() -> None:
    nothing = row_shapes(np.zeros((0, 2)), np.zeros(0, int))
    assert nothing == RowShapes(0, 0)
    assert nothing.shape is None
    assert nothing.allows("S/S") is None
    three = row_shapes(np.array([[0.0, 0], [1, 1], [2, 0]]), np.array([1, 1, 1]))
    assert three == RowShapes(0, 0)
