"""The dots of a frame, and the cached fits to them."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from labapp.core.matching import observation
from labapp.core.matching.observation import try_fit
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
