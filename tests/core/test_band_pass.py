"""The default detector: completeness, position error and stated uncertainty."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from labapp.core.images import dot_size
from labapp.core.images.band_pass import (
    _tuned,
    band_pass_dots,
    crowded_dots,
    dot_at,
    tuning_of,
)
from labapp.core.images.dots import BandPassSettings, Dots
from labapp.core.values import CannotMeasure, FloatArray
from tests.scenes import gaussian_dots

SHAPE = (240, 320)


def grid(spacing: float = 24.0) -> FloatArray:
    """Return positions at varying subpixel offsets, shape (n, 2)."""
    u, v = np.meshgrid(
        np.arange(30.0, 300.0, spacing + 0.37), np.arange(30.0, 220.0, spacing - 0.21)
    )
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def draw(positions: FloatArray, size: float, peak: float) -> FloatArray:
    return peak * gaussian_dots(SHAPE, positions, size)


def offsets(detected: FloatArray, true: FloatArray) -> FloatArray:
    """Return the vectors from each true position to the nearest detected one, shape (n, 2)."""
    difference = detected[None] - true[:, None]
    nearest = np.argmin(np.linalg.norm(difference, axis=-1), axis=1)
    return difference[np.arange(len(true)), nearest]


@pytest.mark.parametrize("size", [1.0, 2.0, 3.5, 6.0])
def test_dots_of_any_size_are_found_and_measured(size: float) -> None:
    places = grid(max(24.0, 8.0 * size))
    noise = np.random.default_rng(1).normal(20.0, 1.0, SHAPE)
    dots = band_pass_dots(draw(places, size, 40.0) + noise, BandPassSettings())
    assert len(dots) == len(places)
    assert np.abs(offsets(dots.image_px, places)).max() < 0.3
    assert np.median(dots.size_px) == pytest.approx(size, rel=0.15)
    assert np.median(dots.peak) == pytest.approx(40.0, rel=0.15)


@pytest.mark.parametrize("step", [7.0, 9.0])
def test_dots_of_little_more_than_a_pixel_are_found(step: float) -> None:
    places = grid(step)
    noise = np.random.default_rng(1).normal(20.0, 3.0, SHAPE)
    dots = band_pass_dots(draw(places, 0.7, 100.0) + noise, BandPassSettings())
    assert len(dots) == len(places)
    assert np.linalg.norm(offsets(dots.image_px, places), axis=1).max() < 0.5


@pytest.mark.parametrize("noise", [1.0, 4.0, 10.0])
def test_hot_pixels_alone_give_no_dot_size(noise: float) -> None:
    rng = np.random.default_rng(2)
    frame = rng.normal(40.0, noise, SHAPE)
    frame.ravel()[rng.integers(0, frame.size, 400)] = rng.uniform(120.0, 255.0, 400)
    picture = dot_size.as_picture(np.clip(frame, 0, 255).astype(np.uint8))
    size = dot_size.estimate_size(picture, dot_size.local_noise(picture))
    assert size == dot_size.USUAL_PX


@pytest.mark.parametrize("snr", [6.0, 12.0, 25.0])
@pytest.mark.slow
def test_position_error_is_at_white_noise_limit_and_matches_sigma(snr: float) -> None:
    rng = np.random.default_rng(2)
    settings = BandPassSettings(speckle_px=0.0)
    errors, sigmas = [], []
    for _ in range(6):
        frame = draw(grid(), 2.2, 10.0 * snr) + rng.normal(100.0, 10.0, SHAPE)
        dots = band_pass_dots(frame, settings)
        errors.append(offsets(dots.image_px, grid()))
        sigmas.append(np.median(dots.u_sigma_px))
    rms_px = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    assert rms_px < 1.25 * 0.80 / snr  # the white-noise limit
    assert np.mean(sigmas) == pytest.approx(rms_px, rel=0.25)


@pytest.mark.slow
def test_noise_adds_no_dots() -> None:
    rng = np.random.default_rng(3)
    false = 0
    for _ in range(10):
        frame = draw(grid(), 2.0, 30.0) + rng.normal(0.0, 3.0, SHAPE)
        false += len(band_pass_dots(frame, BandPassSettings())) - len(grid())
    assert false == 0


def test_hot_pixels_and_a_glow_are_not_dots() -> None:
    rng = np.random.default_rng(4)
    frame = draw(grid(), 2.2, 40.0) + rng.normal(10.0, 1.0, SHAPE)
    frame += np.linspace(0.0, 80.0, SHAPE[0])[:, None]
    hot = rng.integers(5, 200, (12, 2))
    frame[hot[:, 0], hot[:, 1]] = 255.0
    dots = band_pass_dots(frame, BandPassSettings())
    assert np.abs(offsets(dots.image_px, grid())).max() < 0.5
    assert len(dots) == len(grid())


@pytest.mark.slow
@pytest.mark.parametrize("size", [2.5, 5.5])
@pytest.mark.parametrize("grain", [0.0, 0.3])
def test_lobes_and_speckle_of_a_dot_are_not_separate_dots(size: float, grain: float) -> None:
    rng = np.random.default_rng(8)
    places = grid(5.0 * size)
    angle = np.linspace(0.0, 2 * np.pi, 5)[:4] + 0.3
    lobes = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * 1.15 * size
    frame = 0.7 * draw(places, 0.45 * size, 130.0)
    for lobe in lobes:
        frame += draw(places + lobe, 0.45 * size, 130.0)
    speckle = cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), 0.8)
    frame = np.maximum(frame * (1 + grain * speckle / speckle.std()), 0.0)
    dots = band_pass_dots(frame + rng.normal(20.0, 1.5, SHAPE), BandPassSettings())
    assert np.abs(offsets(places, dots.image_px)).max() < size  # no false dots
    distance = np.abs(offsets(dots.image_px, places)).max(axis=1)
    assert np.mean(distance < size) > 0.98
    assert np.median(distance) < 0.2 * size
    assert len(dots) <= len(places)


@pytest.mark.parametrize("wide", [1, 2])
@pytest.mark.parametrize("side", ["left", "right", "top", "bottom", "amid"])
@pytest.mark.slow
def test_bright_line_of_pixels_is_not_detected_as_dots(side: str, wide: int) -> None:
    rng = np.random.default_rng(7)
    frame = draw(grid(), 1.6, 60.0) + rng.normal(10.0, 3.0, SHAPE)
    line = {
        "left": np.s_[:, :wide],
        "right": np.s_[:, -wide:],
        "top": np.s_[:wide],
        "bottom": np.s_[-wide:],
        "amid": np.s_[:, 140 : 140 + wide],
    }[side]
    frame[line] = rng.normal(80.0, 4.0, frame[line].shape)
    dots = band_pass_dots(np.clip(frame, 0, 255).astype(np.uint8), BandPassSettings())
    assert len(dots) == len(grid())
    assert np.abs(offsets(dots.image_px, grid())).max() < 0.6


@pytest.mark.parametrize("height", [60.0, 150.0, 230.0])
@pytest.mark.parametrize("size", [1.4, 2.4])
def test_hot_pixel_on_a_dot_does_not_remove_it(size: float, height: float) -> None:
    rng = np.random.default_rng(12)
    frame = draw(grid(), size, 50.0) + rng.normal(15.0, 1.5, SHAPE)
    for u, v in grid()[::3]:
        du, dv = rng.integers(-2, 3, 2)
        frame[round(v) + dv, round(u) + du] += height
    frame = np.clip(frame, 0, 255).astype(np.uint8)
    dots = band_pass_dots(frame, BandPassSettings())
    assert len(dots) == len(grid())
    assert np.abs(offsets(dots.image_px, grid())).max() < 0.6


def test_close_dots_do_not_bias_each_other() -> None:
    places = np.array(
        [[100.0, 100.0], [110.4, 100.3], [120.7, 100.9], [160.0, 140.0], [60.0, 60.0]]
    )
    frame = draw(places, 2.1, 60.0) + np.random.default_rng(5).normal(0.0, 0.5, SHAPE)
    dots = band_pass_dots(frame, BandPassSettings())
    assert len(dots) == len(places)
    assert np.abs(offsets(dots.image_px, places)).max() < 0.15


def test_faint_dot_does_not_drift_onto_bright_neighbour() -> None:
    """The fit window once moved repeatedly, 7 px in total."""
    bright, faint = np.array([120.0, 120.0]), np.array([128.0, 117.6])
    others = np.array([[60.0, 60.0], [250.0, 60.0], [60.0, 180.0], [250.0, 180.0], [200.0, 120.0]])
    frame = draw(np.vstack([others, bright]), 2.6, 60.0) + draw(faint[None], 2.6, 26.0)
    frame += np.random.default_rng(5).normal(30.0, 0.5, SHAPE)
    dots = band_pass_dots(frame, BandPassSettings())
    assert len(dots) == 7
    distance = np.linalg.norm(dots.image_px - bright, axis=-1)
    assert np.sum(distance < np.linalg.norm(bright - faint) / 2) == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_dtype_of_the_frame_does_not_matter(dtype: type) -> None:
    frame = draw(grid(), 2.0, 60.0) + np.random.default_rng(6).normal(40.0, 2.0, SHAPE)
    scale = 200.0 if dtype is np.uint16 else 1.0
    dots = band_pass_dots((frame * scale).astype(dtype), BandPassSettings())
    assert np.abs(offsets(dots.image_px, grid())).max() < 0.2
    assert np.median(dots.snr) == pytest.approx(30.0, rel=0.2)


def test_saturated_dot_is_detected_once() -> None:
    places = np.array([[100.5, 100.0], [150.0, 120.5], [60.0, 180.0], [220.0, 60.0]])
    frame = np.minimum(draw(places, 2.5, 400.0), 255.0)
    dots = band_pass_dots(frame, BandPassSettings())
    assert len(dots) == len(places)
    assert np.abs(offsets(dots.image_px, places)).max() < 0.1


@pytest.mark.parametrize("frame", [np.zeros((1, 1)), np.zeros((5, 400)), np.full((200, 200), 7.0)])
def test_frame_without_dots_raises_no_dots(frame: FloatArray) -> None:
    with pytest.raises(CannotMeasure) as error:
        band_pass_dots(frame, BandPassSettings())
    assert error.value.status == "no-dots"


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 400)])
def test_frame_too_small_for_a_dot_is_rejected(shape: tuple[int, int]) -> None:
    frame, settings = np.random.default_rng(1).normal(size=shape), BandPassSettings()
    for find in (crowded_dots, tuning_of):
        with pytest.raises(CannotMeasure) as error:
            find(frame, settings)
        assert error.value.status == "no-dots"
    with pytest.raises(ValueError, match="too small"):
        dot_at(frame, 0.0, 0.0, Dots(*[np.empty(0)] * 7), settings)


def test_number_of_blobs_is_limited_beside_a_blank_area() -> None:
    """Most of the frame has no noise, so every noise peak in the rest exceeds the threshold."""
    frame = np.full((640, 480), 20.0, np.float32)
    frame[:300] += np.random.default_rng(2).normal(0.0, 3.0, (300, 480)).astype(np.float32)
    bands = dict(dot_size._bands(frame))
    counts = [len(dot_size._blobs(bands, scale, 0.0).own) for scale in sorted(bands)[:-1]]
    assert max(counts) == dot_size.MOST_BLOBS


def test_compression_ripples_are_neither_peaks_nor_spikes() -> None:
    """Compression leaves flat areas without noise, in which every ripple would stand out."""
    noise = np.random.default_rng(3).normal(20.0, 1.5, SHAPE)
    image = np.clip(np.rint(draw(grid(), 2.0, 40.0) + noise), 0, 255).astype(np.uint8)
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])[1]
    frame = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE))
    assert np.median(np.abs(np.diff(frame.astype(int)))) == 0
    tuning, view = _tuned(frame, BandPassSettings())
    assert len(view.peaks(tuning)[0]) <= 1.5 * len(grid())
    assert np.mean(view.picture != frame) < 0.001
    dots = band_pass_dots(frame, BandPassSettings())
    assert len(dots) == len(grid())
    assert np.abs(offsets(dots.image_px, grid())).max() < 0.5
