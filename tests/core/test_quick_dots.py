"""Quick detection with the tuning of a similar frame agrees with the full detector."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from labapp.core.images.band_pass import band_pass_dots, quick_dots, tuning_of
from labapp.core.images.dots import BandPassSettings
from labapp.core.images.peaks import PEAK_GAIN, DetectorTuning
from labapp.core.values import CannotMeasure, FloatArray
from tests.scenes import gaussian_dots

SIZE_PX = 2.0
SHAPE = (480, 320)


def frame(positions: FloatArray, rng: np.random.Generator, hot: int = 0) -> FloatArray:
    """Return Gaussian dots of 40 grey levels at (u, v) in noise of σ = 1.5, and hot pixels."""
    v = np.arange(SHAPE[0])[:, None]
    image = 20.0 + 10.0 * v / SHAPE[0] + rng.normal(0.0, 1.5, SHAPE)
    image += 40.0 * gaussian_dots(SHAPE, positions, SIZE_PX)
    image[rng.integers(0, SHAPE[0], hot), rng.integers(0, SHAPE[1], hot)] += 120.0
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def places(rng: np.random.Generator) -> FloatArray:
    u, v = np.meshgrid(np.arange(20.0, 310.0, 17.0), np.arange(20.0, 470.0, 24.0))
    return np.stack([u.ravel(), v.ravel()], axis=-1) + rng.uniform(-3, 3, (u.size, 2))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_quick_dots_agree_with_the_default_detector(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, true = frame(places(rng), rng), places(rng)
    tuning = tuning_of(first, BandPassSettings())
    after = frame(true, rng, hot=6)
    quick = quick_dots(after, tuning, BandPassSettings())
    full = band_pass_dots(after, BandPassSettings(size_px=tuning.size_px))
    assert len(quick) == len(full) >= len(true) - 1  # a hot pixel may hit a dot
    distance, nearest = cKDTree(quick.image_px).query(full.image_px)
    assert np.quantile(distance / full.u_sigma_px, 0.95) < 1.0
    np.testing.assert_allclose(quick.snr[nearest], full.snr, rtol=0.25)  # noise of another frame
    np.testing.assert_allclose(quick.size_px[nearest], full.size_px, rtol=0.25)
    error = cKDTree(true).query(quick.image_px)[0]
    assert np.sqrt(np.mean(error**2)) < np.sqrt(2) * 0.08


def test_local_and_full_background_give_the_same_dots(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(5)
    image = frame(places(rng), rng)
    tuning = tuning_of(image, BandPassSettings())
    results = []
    for limit in (np.inf, 0.0):
        monkeypatch.setattr("labapp.core.images.peaks.MOST_SURROUNDINGS", limit)
        results.append(quick_dots(image, tuning, BandPassSettings()))
    np.testing.assert_allclose(results[0].image_px, results[1].image_px, atol=1e-4)
    np.testing.assert_allclose(results[0].size_px, results[1].size_px, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_search_of_a_part_finds_the_dots_of_the_full_search(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A faint dot far from the others is found even if there was none in the tuning frame."""
    rng = np.random.default_rng(seed)
    group = places(rng)
    group = group[(group[:, 0] < 160.0) & (np.abs(group[:, 1] - 180.0) < 90.0)]
    first, faint = frame(group, rng), [255.0 + seed, 431.0 + seed]
    image = frame(group, rng, hot=6).astype(float)
    image += 12.0 * gaussian_dots(SHAPE, np.array([faint]), SIZE_PX)
    tuning = tuning_of(first, BandPassSettings())
    results = []
    for halved in (0.0, np.inf):
        monkeypatch.setattr("labapp.core.images.peaks.HALVED_PX", halved)
        results += [quick_dots(each, tuning, BandPassSettings()) for each in (first, image)]
    for part, full in zip(results[:2], results[2:], strict=True):
        assert len(part) == len(full)
        assert (np.abs(part.image_px - full.image_px) < 0.01 * full.u_sigma_px[:, None]).all()
        np.testing.assert_allclose(part.size_px, full.size_px, rtol=1e-2)
    assert np.linalg.norm(results[1].image_px - faint, axis=-1).min() < 1.0


def test_quick_dots_of_the_tuning_frame_are_identical() -> None:
    rng = np.random.default_rng(9)
    image = frame(places(rng), rng, hot=6)
    cold = band_pass_dots(image, BandPassSettings())
    quick = quick_dots(image, tuning_of(image, BandPassSettings()), BandPassSettings())
    for one, other in zip(vars(cold).values(), vars(quick).values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_frame_without_dots_raises_no_dots() -> None:
    rng = np.random.default_rng(5)
    tuning = tuning_of(frame(places(rng), rng), BandPassSettings())
    for dark in (frame(np.zeros((0, 2)), rng, hot=4), np.zeros(SHAPE, np.uint8)):
        with pytest.raises(CannotMeasure) as error:
            quick_dots(dark, tuning, BandPassSettings())
        assert error.value.status == "no-dots"


def test_frame_of_another_size_is_rejected() -> None:
    tuning = tuning_of(np.zeros((40, 60), np.uint8), BandPassSettings(size_px=1.8))
    for kind in (np.uint8, np.uint16):
        with pytest.raises(ValueError, match="tuning of"):
            quick_dots(np.zeros((60, 40), kind), tuning, BandPassSettings(size_px=1.8))


@pytest.mark.slow
def test_threads_can_share_a_tuning() -> None:
    rng = np.random.default_rng(11)
    frames = [frame(places(rng), rng) for _ in range(6)]
    tuning, settings = tuning_of(frames[0], BandPassSettings()), BandPassSettings()
    alone = [quick_dots(image, tuning, settings).image_px for image in frames]
    with ThreadPoolExecutor(3) as pool:
        results = list(
            pool.map(lambda k: quick_dots(frames[k % 6], tuning, settings).image_px, range(120))
        )
    for k, result in enumerate(results):
        np.testing.assert_array_equal(result, alone[k % 6])


@pytest.mark.parametrize("size_px", [1.2, SIZE_PX])  # searched at full and at half resolution
def test_only_peaks_over_the_threshold_are_dots(size_px: float) -> None:
    rng = np.random.default_rng(12)
    image, settings = frame(places(rng), rng), BandPassSettings(size_px=size_px)
    tuning = tuning_of(image, settings)
    brightest = PEAK_GAIN * float(quick_dots(image, tuning, settings).peak.max())
    below = replace(tuning, least=0.95 * brightest)
    assert (PEAK_GAIN * quick_dots(image, below, settings).peak > 0.95 * brightest).all()
    noisy = replace(tuning, over_noise=1.05 * brightest / float(tuning.noise.min()))
    for above in (replace(tuning, least=1.05 * brightest), noisy):
        with pytest.raises(CannotMeasure, match="no-dots"):
            quick_dots(image, above, settings)


@pytest.mark.parametrize("shape", [(16, 16), (24, 600)])
def test_blank_picture_smaller_than_a_dot_raises_no_dots(shape: tuple[int, int]) -> None:
    tuning = DetectorTuning(4.0, np.ones(shape, np.float32), 1.0, 1.0)
    with pytest.raises(CannotMeasure, match="no-dots"):
        quick_dots(np.full(shape, 7, np.uint8), tuning, BandPassSettings())
