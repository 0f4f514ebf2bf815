"""Comparison of measures in which NaN equals NaN."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from labapp.core.surface.measures import SIZES, Measures, sigma_name


def assert_same(one: Measures | None, other: Measures | None) -> None:
    """Assert that two frames have the same sizes to the last bit, or that neither has any."""
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        np.testing.assert_equal(asdict(one), asdict(other))


def assert_alike(one: Measures | None, other: Measures | None) -> None:
    """Assert that sizes are the same to a hundredth of their ±, and these to a twentieth."""
    assert one is not None
    assert other is not None
    for name in SIZES:
        sigma = getattr(one, sigma_name(name))
        off = abs(getattr(one, name) - getattr(other, name))
        assert off <= 0.01 * np.nan_to_num(sigma) + 1e-9
        np.testing.assert_allclose(getattr(other, sigma_name(name)), sigma, rtol=0.05, atol=1e-9)
