"""What is the same, although NaN equals nothing."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from labapp.core.surface.measures import Measures


def assert_same(one: Measures | None, other: Measures | None) -> None:
    """Assert that two frames have the same sizes to the last bit, or that neither has any."""
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        np.testing.assert_equal(asdict(one), asdict(other))
