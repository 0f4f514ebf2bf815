"""Values that every step shares."""

from __future__ import annotations

import math

import numpy as np
import pytest

from labapp.core.values import median


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_the_median_is_that_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(0.0, 1.0, count)
    assert median(values) == np.median(values)


@pytest.mark.parametrize("values", [[], [math.nan], [1.0, math.nan, 3.0, 2.0]])
def test_the_median_of_none_or_what_is_unknown_is_unknown(values: list[float]) -> None:
    assert math.isnan(median(np.array(values)))
