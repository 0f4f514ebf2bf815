"""Assessment of a frame's exposure from its grey levels and dots, before it is measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import scipy

from labapp.core.images.dots import Dots, Grey, Image
from labapp.core.values import BoolArray, FloatArray

ExposureVerdict = Literal[
    "blank", "no dots", "too dark", "saturated", "dots merge", "low contrast", "good"
]

CLIPPED_DOTS = 0.05
"""A frame is saturated if more than this share of its dots is clipped."""

CLIPPED_PIXELS = 0.02
"""A frame without dots is saturated if more than this share of its pixels is clipped."""

FAINT_SNR = 7.0
"""Below this, noise shifts a dot by more than speckle does: 0.8/SNR > 0.12 px."""

DARK = 0.25
"""Faint dots whose brightest level is below this fraction of full scale are under-exposed."""

MERGING = 0.4
"""Dots begin to be lost if a tenth of the valleys between neighbours are shallower than this."""

AROUND = 4.0
"""The background of a dot is the darkest place within this many distances to neighbours."""

ADVICE: dict[ExposureVerdict, str] = {
    "blank": "All pixels are alike: is the shutter open, the camera connected?",
    "no dots": "No dot stands out: is the laser on, and the imaging plane in the picture?",
    "too dark": "The dots hardly leave the noise: expose longer, or open the lens.",
    "saturated": "Dots are clipped, and their centres are inaccurate: expose less.",
    "dots merge": "Neighbouring dots run together: focus, or move the imaging plane away.",
    "low contrast": "The background outshines the dots: shield the arc's light, or use the filter.",
    "good": "The dots stand out well.",
}

GOOD_BUT_DARK = "The dots stand out well, though they are far below full scale."


@dataclass(frozen=True)
class Exposure:
    """How a frame is exposed.

    Parameters
    ----------
    level
        Level of the bright dots (of the bright pixels, if there are no dots) as a fraction of full
        scale, 0 … 1.
    clipped
        Fraction of the dots (of the pixels) that is clipped, 0 … 1.
    contrast
        A typical dot's height above its background over its level, 0 … 1; 0 without dots.
    snr
        A typical dot's height over the noise; 0 without dots.
    valley
        Depth of the valley between close neighbours over their height: 1 if they are separate, 0
        if they have merged; NaN without neighbours.
    verdict
        The result, in one or two words.
    """

    level: float
    clipped: float
    contrast: float
    snr: float
    valley: float
    verdict: ExposureVerdict

    @property
    def advice(self) -> str:
        """Advice to the operator, in a sentence."""
        if self.verdict == "good" and self.level < DARK:
            return GOOD_BUT_DARK
        return ADVICE[self.verdict]


def judge_exposure(image: Image, dots: Dots | None, bit_depth: int | None) -> Exposure:
    """Assess a frame's exposure from its grey levels and the dots found in it.

    Parameters
    ----------
    image
        Grey levels, shape (rows, columns).
    dots
        The dots found in it; None or empty if there are none.
    bit_depth
        Significant bits of a grey level. None (or 32, for float levels) if full scale is unknown;
        the brightest pixel is then used.
    """
    grey = np.asarray(image, np.float32)
    top = float(grey.max(initial=0.0))
    known = bit_depth is not None and bit_depth < 32
    full = 2.0**bit_depth - 1 if known and bit_depth is not None else max(top, 1e-9)
    clipped = _clipped(grey, full if known else np.inf)
    if dots is None or not len(dots):
        level = float(np.percentile(grey, 99.9)) / full if grey.size else 0.0
        part = float(clipped.mean()) if grey.size else 0.0
        return Exposure(min(level, 1.0), part, 0.0, 0.0, np.nan, _without_dots(grey, level, part))
    beside = np.ones((3, 3), np.uint8)
    brightest = _at(cv2.dilate(grey, beside), dots.image_px)
    level = float(np.quantile(brightest, 0.9)) / full
    part = float(_at(cv2.dilate(clipped.astype(np.float32), beside), dots.image_px).mean())
    contrast = float(np.clip(np.median(dots.peak / np.maximum(brightest, 1e-9)), 0.0, 1.0))
    snr, valley = float(np.median(dots.snr)), _valley(grey, dots)
    verdict: ExposureVerdict = "good"
    if part > CLIPPED_DOTS:
        verdict = "saturated"
    elif valley < MERGING:
        verdict = "dots merge"
    elif snr < FAINT_SNR:
        verdict = "too dark" if level < DARK else "low contrast"
    return Exposure(min(level, 1.0), part, contrast, snr, valley, verdict)


def _without_dots(grey: Grey, level: float, clipped: float) -> ExposureVerdict:
    if not np.ptp(grey) > 0:
        return "blank"
    if clipped > CLIPPED_PIXELS:
        return "saturated"
    return "too dark" if level < DARK else "no dots"


def _clipped(grey: Grey, full: float) -> BoolArray:
    """Pixels at full scale, or on plateaus at the brightest level (12-bit data in 16-bit files)."""
    top = (grey == grey.max(initial=0.0)) & (np.ptp(grey) > 0 if grey.size else False)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    plateau = cv2.erode(top.astype(np.uint8), cross, borderValue=0).astype(bool)
    return np.asarray((grey >= full) | plateau)


def _valley(grey: Grey, dots: Dots) -> float:
    """Tenth percentile of the valley depths half-way between dots and their nearest neighbours."""
    if len(dots) < 2:
        return float("nan")
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    distance, neighbour = scipy.spatial.cKDTree(dots.image_px).query(dots.image_px, k=2)
    reach = 2 * round(AROUND * float(np.median(distance[:, 1]))) + 1
    reach = min(reach, 2 * max(grey.shape) + 1)
    low = cv2.erode(smooth, np.ones((reach, 1), np.uint8))
    low = cv2.erode(low, np.ones((1, reach), np.uint8))
    here, there = dots.image_px, dots.image_px[neighbour[:, 1]]
    half = (here + there) / 2
    height = np.minimum(_at(smooth, here), _at(smooth, there))
    depth = (height - _at(smooth, half)) / np.maximum(height - _at(low, half), 1e-9)
    return float(np.clip(np.quantile(depth, 0.1), 0.0, 1.0))


def _at(grey: npt.NDArray[Any], place_px: FloatArray) -> FloatArray:
    u, v = np.rint(place_px).astype(int).T
    rows, columns = grey.shape
    return np.asarray(grey[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)], np.float64)
