"""The dots of a frame, and the cached fits to them."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from labapp.core.matching import observation
from labapp.core.matching.observation import QUICK, UNLABELLED, try_fit
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
