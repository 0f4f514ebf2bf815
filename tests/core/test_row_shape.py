"""Convex and concave rows of the caps of Tables 4-4 and 4-5, and what they allow (§7.1)."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.schemes.row_shape import RowShapes, match_row_shapes, row_shapes
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
def test_row_shapes_allow_the_orientations_of_tables_4_4_and_4_5(sign: int) -> None:
    shapes = []
    for part in DEPTHS:
        for radius in RADII_MM:
            reflections = cap_reflections(radius, sign / part)
            orientation = correspondence_letters(reflections).rstrip("*")
            if orientation == "D/D":
                continue
            row, column = np.nonzero(reflections.lit)
            result = row_shapes(reflections.plane_mm[row, column], row + 1)
            assert result.allows(orientation) is True, (part, radius)
            shapes.append(result.shape)
    # With increasing depth the rows of a concave surface turn from concave to convex.
    assert shapes == (["convex"] * 16 if sign > 0 else ["concave"] * 8 + ["convex"] * 8)


@pytest.mark.parametrize(("width_mm", "height_mm"), [(6.0, 0.3), (6.0, -0.3), (6.0, -0.03)])
def test_row_shape_of_a_noisy_match(width_mm: float, height_mm: float) -> None:
    rng = np.random.default_rng(3)
    reflections = trace(spherical_cap(width_mm, height_mm), OPEN_BENCH)
    match = exact_match(reflections, sigma_mm=0.03, rng=rng)
    shapes = match_row_shapes(match)
    assert shapes.allows(match.orientation)
    assert shapes.shape == ("concave" if height_mm == -0.03 else "convex")


def test_without_rows_the_shape_is_unknown() -> None:
    empty = row_shapes(np.zeros((0, 2)), np.zeros(0, int))
    assert empty == RowShapes(0, 0)
    assert empty.shape is None
    assert empty.allows("S/S") is None
    three = row_shapes(np.array([[0.0, 0], [1, 1], [2, 0]]), np.array([1, 1, 1]))
    assert three == RowShapes(0, 0)
