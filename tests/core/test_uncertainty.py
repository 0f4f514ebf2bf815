"""The covariance of the bench's quantities: drawing offsets, and combining changes."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.uncertainty import (
    ANGLE,
    DISTANCE,
    QUANTITIES,
    AxisPoints,
    RigUncertainty,
    covariance_of,
)

AXES = AxisPoints(
    ImageCalibration.from_three_points((44.0, 590.0), (440.0, 590.0), 69.85, (44.0, 410.0), 31.75),
    69.85,
    31.75,
)


@pytest.mark.parametrize("correlation", [0.0, 0.92, -1.0])
def test_root_of_the_covariance_draws_correlated_offsets(correlation):
    sigmas = {"imaging_plane.s_mm_sigma": 0.0, "laser.distance_mm_sigma": 0.2}
    known = RigUncertainty(AXES, *covariance_of(sigmas, correlation))
    root = known.root
    np.testing.assert_allclose(root @ root.T, known.covariance, atol=1e-9)
    drawn = np.random.default_rng(5).normal(size=(4000, len(QUANTITIES))) @ root.T
    observed = np.corrcoef(drawn[:, [ANGLE, DISTANCE]].T)[0, 1]
    assert observed == pytest.approx(correlation, abs=0.05)


def test_changes_are_combined_with_their_correlation():
    known = RigUncertainty(AXES, *covariance_of({}, 0.5))
    changes = np.zeros((2, len(QUANTITIES)))
    changes[0, [ANGLE, DISTANCE]] = 3.0, -4.0
    changes[1, [ANGLE, 5]] = 3.0, 4.0
    expected = [np.sqrt(9 + 16 - 2 * 0.5 * 12), 5.0]
    np.testing.assert_allclose(known.combined(changes), expected)
