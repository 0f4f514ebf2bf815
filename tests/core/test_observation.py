"""The dots of a frame, the cached fits to them, and the labels that follow from a fit."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from labapp.core.matching import observation
from labapp.core.matching.label_growth import matched_labels
from labapp.core.matching.observation import (
    QUICK,
    UNLABELLED,
    try_fit,
    within_rings,
)
from labapp.core.matching.prediction import predict, sure_pairs
from labapp.core.values import CannotMeasure
from labapp.simulation.pools import egg
from tests.core.test_dips import observation_of
from tests.scenes import see


def test_frame_with_failed_fits_is_freed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of megabytes once waited for garbage collection where many frames failed."""

    def fails(*_: object) -> None:
        raise CannotMeasure("no-surface", "it diverges")

    monkeypatch.setattr(observation, "fit_pool", fails)
    observed, labels = observation_of(see(egg(5.8, 2.6, 3.2, 0.28), np.random.default_rng(1)))
    assert try_fit(observed, labels) is None
    assert try_fit(observed, labels) is None
    reference = weakref.ref(observed)
    gc.disable()
    try:
        del observed
        assert reference() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("starts_near", [False, True])
def test_quick_misfits_are_those_of_single_fits(starts_near: bool) -> None:
    observed, labels = observation_of(see(egg(5.8, 2.6, 3.2, 0.28), np.random.default_rng(1)))
    near = try_fit(observed, labels) if starts_near else None
    shifted, few = np.roll(labels, 1, axis=0), np.full_like(labels, UNLABELLED)
    few[np.nonzero(labels >= 0)[0][:5], np.nonzero(labels >= 0)[1][:5]] = np.arange(5)
    single = [try_fit(observed, each, QUICK, near) for each in (labels, shifted)]
    expected = [fit.residual_rms_mm for fit in single if fit]
    found = observed.quick_misfits([labels, shifted, few], near)
    np.testing.assert_allclose(found, [*expected, np.inf], rtol=1e-9)
    assert expected[1] > expected[0]


@pytest.mark.parametrize("resolution_times", [1.0, 20.0])
def test_dots_with_one_sure_ray_next_to_labelled_ones_are_labelled(resolution_times: float) -> None:
    observed, labels = observation_of(see(egg(5.8, 2.6, 3.2, 0.28), np.random.default_rng(1)))
    observed = replace(observed, size_mm=resolution_times * observed.size_mm)
    marker, inner = tuple(np.argwhere(observed.rays.absent)[0]), labels.copy()
    inner[marker[0] + 2 : marker[0] + 5, marker[1] - 1 : marker[1] + 2] = UNLABELLED
    # A false dot where that of the absent ray would be.
    pool = try_fit(observed, labels)
    assert pool is not None
    false_mm = predict(observed, pool, observed.rays.absent).plane_mm
    observed = replace(
        observed,
        plane_mm=np.concatenate([observed.plane_mm, false_mm]),
        covariance_mm2=np.concatenate([observed.covariance_mm2, observed.covariance_mm2[:1]]),
    )
    pool = try_fit(observed, inner)
    assert pool is not None
    rays = predict(observed, pool, within_rings(inner, 2))
    dots, covariance = np.arange(len(observed.plane_mm)), rays.covariance_mm2(pool, observed.rig)
    pairs = sure_pairs(observed, dots, rays.plane_mm, covariance)
    expected, left_out = np.full(labels.shape, UNLABELLED), []
    for dot, ray in zip(*pairs, strict=True):
        at = tuple(rays.at[ray])
        if at == marker or not within_rings(inner, 1)[at]:
            left_out.append(at)
        elif rays.spacing_mm[ray] > observed.resolution_mm:
            expected[at] = dot
    np.testing.assert_array_equal(matched_labels(observed, pool, inner), expected)
    assert {marker, (marker[0] + 3, marker[1])} <= set(left_out)
    few = expected[expected != UNLABELLED].size < (labels != UNLABELLED).sum() / 2
    assert few == (resolution_times > 1)
