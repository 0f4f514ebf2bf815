"""Dots of live frames, for display, and the assessment of frames."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from labapp.core.images.band_pass import quick_dots, tuning_of
from labapp.core.images.dots import Dots
from labapp.core.images.exposure import Exposure, judge_exposure
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.images.peaks import DetectorTuning
from labapp.core.pipeline import Measurement
from labapp.core.quality import UNMEASURED, Quality, judge_quality
from labapp.core.values import CannotMeasure, FloatArray
from labapp.media import GreyImage

LIGHT_S = 1.0
"""Interval of estimating noise and size of the dots, which takes a seventh of a second."""


@dataclass(frozen=True)
class JudgedFrame:
    """Results for a frame."""

    dots_px: FloatArray | None
    """(u, v) of its dots, shape (n, 2), none of lines; None if they come with the shown frames."""
    quality: Quality | Exposure
    """Whether it can be measured; only how bright it is, where lines are filmed."""


@dataclass(frozen=True)
class _Light:
    """Tuning of the detector to a frame."""

    settings: DotSettings
    tuning: DetectorTuning
    until_s: float
    """`time.monotonic` at which it is estimated anew."""

    def fits(self, settings: DotSettings, image: GreyImage) -> bool:
        """Whether dots of an image can be found with it."""
        return self.settings == settings and self.tuning.noise.shape == image.shape


class LiveDots:
    """Finds dots quickly, and assesses frames.

    A method must always be called from the same thread.

    Attributes
    ----------
    settings
        The detector. None: the frames show lines, of which only the exposure is assessed. Another
        thread may replace it.
    """

    def __init__(self, settings: DotSettings | None) -> None:
        self.settings = settings
        self._light: _Light | None = None

    def find_quickly(self, image: GreyImage) -> FloatArray | None:
        """Return (u, v) of the dots, shape (n, 2); None if they come with the judged frames."""
        settings, light = self.settings, self._light
        if settings is None or light is None or not light.fits(settings, image):
            return None
        try:
            return quick_dots(image, light.tuning, settings.band_pass).image_px
        except CannotMeasure:
            return _places_px(None)

    def judge(self, image: GreyImage, bit_depth: int | None, rays: int | None) -> JudgedFrame:
        """Assess a frame; the parameters are those of `judge_quality`."""
        settings = self.settings
        if settings is None:
            return JudgedFrame(_places_px(None), judge_exposure(image, None, bit_depth))
        quick, dots = settings.method == "band-pass", None
        try:
            if quick:
                dots = quick_dots(image, self._tuning(settings, image), settings.band_pass)
            else:
                dots = find_dots(image, settings)
        except CannotMeasure:
            pass
        found = Measurement(UNMEASURED, "it is only looked at", "fit", dots=dots)
        quality = judge_quality(image, found, bit_depth, rays)
        return JudgedFrame(None if quick else _places_px(dots), quality)

    def _tuning(self, settings: DotSettings, image: GreyImage) -> DetectorTuning:
        """Return the tuning for a frame; estimated anew if it is old or does not fit."""
        light, now_s = self._light, time.monotonic()
        if light is None or now_s > light.until_s or not light.fits(settings, image):
            tuning = tuning_of(image, settings.band_pass)
            light = self._light = _Light(settings, tuning, now_s + LIGHT_S)
        return light.tuning


def _places_px(dots: Dots | None) -> FloatArray:
    return np.zeros((0, 2)) if dots is None else dots.image_px
