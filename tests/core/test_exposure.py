from __future__ import annotations

import cv2
import numpy as np
import pytest

from labapp.core.images.exposure import ADVICE, Exposure, judge_exposure
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.values import CannotMeasure

SPACING_PX, SIZE_PX = 14.0, 2.0


def picture(
    peak: float,
    background: float = 20.0,
    size_px: float = SIZE_PX,
    noise: float = 2.0,
    full: int = 255,
) -> np.ndarray:
    """Return a frame of 8 × 8 dots 14 px apart, from a camera of the given full scale."""
    v, u = np.mgrid[0:150, 0:150].astype(float)
    centre = 26 + SPACING_PX * np.arange(8)
    light = np.full(u.shape, float(background))
    for a in centre:
        for b in centre:
            light += peak * np.exp(-((u - a) ** 2 + (v - b) ** 2) / (2 * size_px**2))
    light += np.random.default_rng(5).normal(0, noise, u.shape)
    return np.clip(np.rint(light), 0, full).astype(np.uint8 if full == 255 else np.uint16)


def judged(image: np.ndarray, bit_depth: int | None = 8) -> Exposure:
    try:
        dots = find_dots(image, DotSettings())
    except CannotMeasure:
        dots = None
    return judge_exposure(image, dots, bit_depth)


def test_well_exposed_frame_is_good() -> None:
    exposure = judged(picture(150))
    assert exposure.verdict == "good"
    assert exposure.clipped == 0
    assert exposure.level == pytest.approx(170 / 255, abs=0.05)
    assert exposure.contrast == pytest.approx(150 / 170, abs=0.1)
    assert exposure.snr > 20


@pytest.mark.parametrize(
    ("image", "verdict"),
    [
        (picture(600), "saturated"),
        (picture(7), "too dark"),
        (picture(60, background=150, noise=9), "low contrast"),
        (picture(150, size_px=4.6), "dots merge"),
        (np.full((60, 60), 17, np.uint8), "blank"),
        (picture(0, background=2, noise=1), "too dark"),
        (picture(0, background=120), "no dots"),
        (picture(0, background=400, noise=80), "saturated"),
    ],
)
def test_exposure_problem_is_named(image: np.ndarray, verdict: str) -> None:
    exposure = judged(image)
    assert exposure.verdict == verdict
    assert exposure.advice == ADVICE[exposure.verdict]
    assert 0 <= exposure.level <= 1
    assert 0 <= exposure.clipped <= 1


def test_clipping_of_12_bits_in_a_16_bit_file_is_detected() -> None:
    image = picture(9000, background=300, noise=20, full=4095)
    assert judged(image, bit_depth=16).verdict == "saturated"
    assert judged(picture(2500, background=300, noise=20, full=4095), 16).verdict == "good"


def test_float_levels_have_no_full_scale() -> None:
    image = (picture(150) / 255).astype(np.float32)
    assert judged(image, 32).verdict == "good"
    assert judged(image, None).verdict == "good"


def test_dots_are_lost_where_the_verdict_is_dots_merge() -> None:
    sharp = picture(150, noise=1.0)
    fewest_dots = {}
    for blur in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        blurred = cv2.GaussianBlur(sharp, (0, 0), blur)
        verdict = judged(blurred).verdict
        fewest_dots[verdict] = min(
            fewest_dots.get(verdict, 64), len(find_dots(blurred, DotSettings()))
        )
    assert fewest_dots["good"] >= 62
    assert "dots merge" in fewest_dots


def test_single_dot_and_tiny_frame_are_judged() -> None:
    one = picture(0, noise=1.0)
    one[70:75, 70:75] += 100
    assert judged(one).verdict in {"good", "saturated"}
    dark = judged(np.zeros((4, 4), np.uint8))
    assert (dark.verdict, dark.clipped) == ("blank", 0)
