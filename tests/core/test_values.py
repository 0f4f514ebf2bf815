"""Functions shared by all steps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from labapp.core.values import median


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_median_agrees_with_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(0.0, 1.0, count)
    assert median(values) == np.median(values)


@pytest.mark.parametrize("values", [[], [math.nan], [1.0, math.nan, 3.0, 2.0]])
def test_median_of_no_values_or_nan_is_nan(values: list[float]) -> None:
    assert math.isnan(median(np.array(values)))
