"""Dots of live frames and their assessment, without widgets."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from labapp.core.images.dots import BandPassSettings
from labapp.core.images.exposure import Exposure
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.quality import Quality
from labapp.gui.live.live_dots import LiveDots
from labapp.media import GreyImage, open_source
from tests.gui.conftest import SAMPLES

SMALL, LARGE = (DotSettings(band_pass=BandPassSettings(size_px=px)) for px in (1.5, 4.0))
WAVELET = DotSettings("wavelet")


@pytest.fixture(scope="module")
def image() -> GreyImage:
    with open_source(SAMPLES / "gtaw" / "recording.avi") as video:
        return video.frame(0).image


def test_changed_detector_holds_from_the_next_frame(image: GreyImage):
    dots = LiveDots(SMALL)
    assert dots.judge(image, 8, 361).dots_px is None
    former = dots.find_quickly(image)
    dots.settings = LARGE
    assert dots.find_quickly(image) is None  # not with the tuning of the former one
    assert dots.judge(image, 8, 361).dots_px is None
    found, expected = dots.find_quickly(image), LiveDots(LARGE)
    expected.judge(image, 8, 361)
    assert np.array_equal(found, expected.find_quickly(image))
    assert len(found) != len(former)
    dots.settings = WAVELET
    assert dots.find_quickly(image) is None
    judged = dots.judge(image, 8, 361)
    assert np.array_equal(judged.dots_px, find_dots(image, WAVELET).image_px)
    assert dots.find_quickly(image) is None


def test_lines_have_no_dots_and_only_an_exposure(image: GreyImage):
    dots = LiveDots(SMALL)
    dots.judge(image, 8, 361)
    dots.settings = None
    assert dots.find_quickly(image) is None
    judged = dots.judge(image, 8, None)
    assert len(judged.dots_px) == 0  # removes rings from before the change
    assert isinstance(judged.quality, Exposure)


def test_detector_may_be_replaced_at_any_moment(image: GreyImage, monkeypatch: pytest.MonkeyPatch):
    """Each use finds another detector, as if another thread had replaced it before."""

    def replaced() -> Iterator[DotSettings | None]:
        while True:
            yield from (SMALL, None, WAVELET, LARGE, None)

    settings = replaced()
    dots = LiveDots(SMALL)
    monkeypatch.setattr(LiveDots, "settings", property(lambda _: next(settings)), raising=False)
    kinds = set()
    for _ in range(10):
        dots.find_quickly(image)
        kinds.add(type(dots.judge(image, 8, 361).quality))
    assert kinds == {Quality, Exposure}


def test_frame_too_small_for_a_dot_is_assessed():
    noise = np.random.default_rng(3).integers(90, 110, (4, 64)).astype(np.uint8)
    judged = LiveDots(DotSettings()).judge(noise, 8, 361)
    assert judged.dots_px is None
    assert judged.quality.exposure.verdict == "no dots"
