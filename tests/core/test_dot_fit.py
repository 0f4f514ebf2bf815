"""Places of dots by the joint fit: as good as said, of large dots that overlap, too."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from labapp.core.images.band_pass import crowded_dots
from labapp.core.images.dots import BandPassSettings, Dots
from labapp.core.values import FloatArray
from labapp.simulation.calibration.mirrors import FlatMirror
from labapp.simulation.forward import PoolSurface, trace
from labapp.simulation.pools import spherical_cap
from labapp.simulation.render import Look, render
from tests.core.test_bench_check import EXACT, VIEW

PLATE, TACK, POOL = FlatMirror(), spherical_cap(9.75, 0.91), spherical_cap(6.5, 0.3)


def seen(surface: PoolSurface, look: Look, seed: int) -> tuple[Dots, FloatArray, FloatArray]:
    """Dots of a picture, and their places and errors, shapes (n, 2), px."""
    frame = render(trace(surface, EXACT.rig), VIEW, look, np.random.default_rng([7, seed]))
    true = frame.dot_px[frame.shown]
    dots = crowded_dots(frame.image, BandPassSettings())
    away, own = cKDTree(true).query(dots.image_px)
    assert len(dots) > 0.97 * len(true)
    assert (away < 1.5).all()
    return dots, true[own], dots.image_px - true[own]


@pytest.mark.slow
@pytest.mark.parametrize("surface", [PLATE, TACK, POOL], ids=["plate", "tack", "pool"])
@pytest.mark.parametrize("speckle", [0.0, 0.35, 0.5])
def test_places_are_as_uncertain_as_said(surface: PoolSurface, speckle: float) -> None:
    """Mean χ² of a coordinate over three pictures."""
    square = []
    for seed in range(3):
        dots, _, error = seen(surface, Look(speckle=speckle), seed)
        square.append((error / np.stack([dots.u_sigma_px, dots.v_sigma_px], 1)) ** 2)
    assert 0.6 < np.concatenate(square).mean() < 1.4


@pytest.mark.slow
def test_dots_that_overlap_are_not_drawn_to_each_other() -> None:
    """Standard deviation 1.5 px, 5.7 px apart: neighbours once moved them by 0.4 px."""
    rms, scale = [], []
    for seed in range(4):
        _, place, error = seen(PLATE, Look(glow=0.0), seed)
        out = place - place.mean(axis=0)
        rms.append(np.sqrt(np.mean(error**2)))
        scale.append((error * out).sum() / (out**2).sum())
    assert max(rms) < 0.2
    assert abs(np.mean(scale)) < 2.5e-4  # its own standard deviation is 0.6e-4
