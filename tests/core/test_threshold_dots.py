"""The two detectors of the dissertation on rendered dots with known positions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from labapp.core.images.dots import Dots
from labapp.core.images.threshold_dots import (
    BlockThresholdSettings,
    WaveletSettings,
    block_threshold_dots,
    wavelet_dots,
)

Chain = Callable[[Any], Dots]
both = pytest.mark.parametrize("chain", [block_threshold_dots, wavelet_dots])


def render(
    seed: int, spacing: float = 40.0, peak: float = 45.0, noise: float = 3.0
) -> tuple[np.ndarray, np.ndarray]:
    """Draw Gaussian dots on a glow with white noise; return the frame and the true (u, v)."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:320, 0:400].astype(float)
    frame = 20.0 + 15.0 * np.exp(-((u - 200) ** 2 + (v - 320) ** 2) / 200.0**2)
    grid = np.stack(np.meshgrid(np.arange(40, 370, spacing), np.arange(30, 300, spacing)), -1)
    truth = grid.reshape(-1, 2) + rng.uniform(-4, 4, (grid.size // 2, 2))
    for center in truth:
        radius2 = (u - center[0]) ** 2 + (v - center[1]) ** 2
        frame += peak * rng.uniform(0.8, 1.2) * np.exp(-radius2 / (2 * 2.2**2))
    frame += rng.normal(0.0, noise, frame.shape)
    return np.clip(np.round(frame), 0, 255).astype(np.uint8), truth


def errors(dots: Dots, truth: np.ndarray, gate_px: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors (n, 2) of dots within the gate of a true one, and their indices."""
    distance, nearest = cKDTree(truth).query(dots.image_px)
    (hit,) = np.nonzero(distance < gate_px)
    assert len(np.unique(nearest[hit])) == len(hit), "two dots for one"
    return dots.image_px[hit] - truth[nearest[hit]], hit


@both
@pytest.mark.parametrize("seed", range(3))
def test_dots_are_found_at_their_true_positions(chain: Chain, seed: int) -> None:
    frame, truth = render(seed)
    dots = chain(frame)
    error, hit = errors(dots, truth)
    assert len(hit) == len(truth)
    assert len(dots) <= len(truth) + 2
    assert np.sqrt(np.mean(error**2)) < 0.5
    assert np.abs(error.mean(axis=0)).max() < 0.15


@both
@pytest.mark.slow
def test_uncertainty_covers_the_errors(chain: Chain) -> None:
    ratios = []
    for seed in range(4):
        frame, truth = render(seed, peak=30.0)
        dots = chain(frame)
        error, hit = errors(dots, truth)
        ratios.append(error / np.stack([dots.u_sigma_px, dots.v_sigma_px], -1)[hit])
    assert 0.4 < np.sqrt(np.mean(np.concatenate(ratios) ** 2)) < 1.3


@both
def test_peak_size_and_snr_are_the_rendered_ones(chain: Chain) -> None:
    frame, truth = render(5, peak=60.0, noise=2.0)
    dots = chain(frame)
    _, hit = errors(dots, truth)
    assert np.median(dots.peak[hit]) == pytest.approx(60.0, rel=0.15)
    assert np.median(dots.snr[hit]) == pytest.approx(30.0, rel=0.2)
    assert 2.2 / 1.5 < np.median(dots.size_px[hit]) < 2.2 * 1.5


@both
def test_16_bit_frame_gives_the_same_dots(chain: Chain) -> None:
    frame, _ = render(1)
    as_8_bit, as_16_bit = chain(frame), chain(frame.astype(np.uint16) * 257)
    assert as_16_bit.image_px == pytest.approx(as_8_bit.image_px)
    assert as_16_bit.peak == pytest.approx(257.0 * as_8_bit.peak)
    assert as_16_bit.snr == pytest.approx(as_8_bit.snr)


@both
def test_float_frame_is_read_in_256_grey_levels(chain: Chain) -> None:
    frame, _ = render(1)
    as_bytes, as_floats = chain(frame), chain(frame.astype(float))
    assert as_floats.image_px == pytest.approx(as_bytes.image_px)


@both
@pytest.mark.parametrize("shape", [(1, 1), (7, 500), (64, 64)])
def test_frame_without_dots_gives_none(chain: Chain, shape: tuple[int, int]) -> None:
    assert len(chain(np.full(shape, 30, np.uint8))) == 0


@both
def test_invalid_frames_are_rejected(chain: Chain) -> None:
    with pytest.raises(ValueError, match="rows, columns"):
        chain(np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(ValueError, match="finite"):
        chain(np.full((10, 10), np.nan))


def test_threshold_adapts_to_each_block() -> None:
    """Dots are found in dark blocks, though darker than the background of a bright block."""
    frame = np.full((80, 80), 20, np.uint8)
    frame[40:, 40:] = 150
    frame[17:24, 17:24] = 60
    frame[57:64, 57:64] = 190
    dots = block_threshold_dots(frame)
    positions = dots.image_px[np.lexsort(dots.image_px.T)]
    assert positions == pytest.approx(np.array([[20.0, 20.0], [60.0, 60.0]]))


def test_delta_is_the_least_excess_over_the_block_level() -> None:
    frame = np.full((400, 400), 20.0)
    frame[197:204, 197:204] = 27.0
    assert len(block_threshold_dots(frame)) == 1
    assert len(block_threshold_dots(frame, BlockThresholdSettings(delta_grey=8.0))) == 0


def test_small_regions_are_deleted_and_split_dots_joined() -> None:
    frame = np.full((120, 120), 10, np.uint8)
    frame[20:30, 20:29] = frame[20:30, 31:40] = 60  # one dot in two parts, 1 px apart
    frame[80:90, 80:90] = 60
    frame[100:103, 30:33] = 60  # survives the median, is smaller than S_a/6
    dots = block_threshold_dots(frame)
    positions = dots.image_px[np.argsort(dots.v_px)]
    assert positions == pytest.approx(np.array([[29.5, 24.5], [84.5, 84.5]]), abs=1e-6)


def test_full_dilation_merges_close_dots() -> None:
    frame, truth = render(2, spacing=16.0)
    full = block_threshold_dots(frame)
    gentle = block_threshold_dots(frame, BlockThresholdSettings(dilation=0.0))
    assert len(errors(full, truth)[1]) < 0.8 * len(truth)
    assert len(errors(gentle, truth)[1]) > 0.8 * len(truth)


def test_wavelet_removes_a_steep_glow() -> None:
    frame, truth = render(3, peak=30.0)
    slope = np.linspace(0, 130, frame.shape[1])
    glowing = np.clip(frame + slope, 0, 255).astype(np.uint8)
    _, hit = errors(wavelet_dots(glowing), truth)
    assert len(hit) >= len(truth) - 1
    with_background = WaveletSettings(background=1.0, window_px=401, offset_sigma=4.0)
    assert len(errors(wavelet_dots(glowing, with_background), truth)[1]) < len(hit)
