"""Dot positions by the joint fit: errors match their uncertainty, also for overlapping dots."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from labapp.core.images.band_pass import crowded_dots
from labapp.core.images.dots import BandPassSettings, Dots
from labapp.core.values import FloatArray
from labapp.simulation.forward import PoolSurface, trace
from labapp.simulation.pools import spherical_cap
from labapp.simulation.render import Look, render
from tests.core.test_bench_check import EXACT, VIEW
from tests.mirrors import FlatMirror

PLATE, TACK, POOL = FlatMirror(), spherical_cap(9.75, 0.91), spherical_cap(6.5, 0.3)


def detected_dots(
    surface: PoolSurface, look: Look, seed: int
) -> tuple[Dots, FloatArray, FloatArray]:
    """Return the dots of a picture, their true positions and errors, shapes (n, 2), px."""
    frame = render(trace(surface, EXACT.rig), VIEW, look, np.random.default_rng([7, seed]))
    true = frame.dot_px[frame.shown]
    dots = crowded_dots(frame.image, BandPassSettings())
    distance, nearest = cKDTree(true).query(dots.image_px)
    assert len(dots) > 0.97 * len(true)
    assert (distance < 1.5).all()
    return dots, true[nearest], dots.image_px - true[nearest]


@pytest.mark.slow
@pytest.mark.parametrize("surface", [PLATE, TACK, POOL], ids=["plate", "tack", "pool"])
@pytest.mark.parametrize("speckle", [0.0, 0.35, 0.5])
def test_position_errors_match_their_uncertainty(surface: PoolSurface, speckle: float) -> None:
    """The mean χ² per coordinate over three pictures is near 1."""
    chi_square = []
    for seed in range(3):
        dots, _, error = detected_dots(surface, Look(speckle=speckle), seed)
        chi_square.append((error / np.stack([dots.u_sigma_px, dots.v_sigma_px], 1)) ** 2)
    assert 0.6 < np.concatenate(chi_square).mean() < 1.4


@pytest.mark.slow
def test_overlapping_dots_do_not_attract_each_other() -> None:
    """Dot size 1.5 px (σ), 5.7 px apart: neighbours once moved them by 0.4 px."""
    rms, scale = [], []
    for seed in range(4):
        _, true, error = detected_dots(PLATE, Look(glow=0.0), seed)
        radius = true - true.mean(axis=0)
        rms.append(np.sqrt(np.mean(error**2)))
        scale.append((error * radius).sum() / (radius**2).sum())
    assert max(rms) < 0.2
    assert abs(np.mean(scale)) < 2.5e-4  # its own standard deviation is 0.6e-4
