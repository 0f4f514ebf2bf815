"""Frame and its dots → whether the exposure is right, in words, before anything is measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import scipy

from labapp.core.images.dots import Dots, Grey, Image
from labapp.core.values import BoolArray, FloatArray

Verdict = Literal["blank", "no dots", "too dark", "saturated", "dots merge", "low contrast", "good"]

CLIPPED_DOTS = 0.05
"""A frame is saturated if more than this part of its dots is clipped …"""

CLIPPED_PIXELS = 0.02
"""… or, where none is found, of its pixels."""

FAINT_SNR = 7.0
"""Below it the noise moves a dot by more than its speckle does: 0.8/SNR > 0.12 px."""

DARK = 0.25
"""Faint dots whose brightest level is below this part of the full scale are under-exposed."""

MERGING = 0.4
"""Dots begin to be lost when the valley between a tenth of them and their neighbours is flatter."""

AROUND = 4.0
"""The background of a dot is the darkest place within this many distances to neighbours."""

ADVICE: dict[Verdict, str] = {
    "blank": "All pixels are alike: is the shutter open, the camera connected?",
    "no dots": "No dot stands out: is the laser on, and the imaging plane in the picture?",
    "too dark": "The dots hardly leave the noise: expose longer, or open the lens.",
    "saturated": "Dots are clipped, and their centres are inaccurate: expose less.",
    "dots merge": "Neighbouring dots run together: focus, or move the imaging plane away.",
    "low contrast": "The background outshines the dots: shield the arc's light, or use the filter.",
    "good": "The dots stand out well.",
}


@dataclass(frozen=True)
class Exposure:
    """How a frame is exposed.

    Parameters
    ----------
    level
        Level of the bright dots (of the bright pixels, where there is no dot) as part of the full
        scale, 0 … 1.
    clipped
        Part of the dots (of the pixels) that is clipped, 0 … 1.
    contrast
        A typical dot's height above its background as part of its level, 0 … 1; 0 without dots.
    snr
        A typical dot's height over the noise; 0 without dots.
    valley
        Depth of the valley between close neighbours as part of their height: 1 where they stand
        apart, 0 where they have run together; NaN without neighbours.
    verdict
        One or two words.
    """

    level: float
    clipped: float
    contrast: float
    snr: float
    valley: float
    verdict: Verdict

    @property
    def advice(self) -> str:
        """What it means, or what to do, in a sentence."""
        return ADVICE[self.verdict]


def judge_exposure(image: Image, dots: Dots | None, bit_depth: int | None) -> Exposure:
    """Judge a frame's exposure by its grey levels and the dots found in it.

    Parameters
    ----------
    image
        Grey levels, shape (rows, columns).
    dots
        The dots found in it; None or no dot where none stands out.
    bit_depth
        Significant bits of a grey level; None (or 32, of float levels) where the full scale is not
        known: then the brightest pixel stands for it.
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
    verdict: Verdict = "good"
    if part > CLIPPED_DOTS:
        verdict = "saturated"
    elif valley < MERGING:
        verdict = "dots merge"
    elif snr < FAINT_SNR:
        verdict = "too dark" if level < DARK else "low contrast"
    return Exposure(min(level, 1.0), part, contrast, snr, valley, verdict)


def _without_dots(grey: Grey, level: float, clipped: float) -> Verdict:
    if not np.ptp(grey) > 0:
        return "blank"
    if clipped > CLIPPED_PIXELS:
        return "saturated"
    return "too dark" if level < DARK else "no dots"


def _clipped(grey: Grey, full: float) -> BoolArray:
    """Pixels at full scale, and plateaus at the brightest level: a 12-bit camera's 16-bit file."""
    top = (grey == grey.max(initial=0.0)) & (np.ptp(grey) > 0 if grey.size else False)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    plateau = cv2.erode(top.astype(np.uint8), cross, borderValue=0).astype(bool)
    return np.asarray((grey >= full) | plateau)


def _valley(grey: Grey, dots: Dots) -> float:
    """Tenth percentile of the depths half-way between each dot and its nearest neighbour."""
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
