"""Where dots may be invisible: how far they are above the limit of the detector, and glare."""

from __future__ import annotations

import cv2
import numpy as np

from labapp.core.images.dots import BandPassSettings, Dots, Image
from labapp.core.images.filters import noise_gain, saturated_light
from labapp.core.images.peaks import PEAK_GAIN, DetectorTuning, typical
from labapp.core.values import BoolArray, FloatArray, median

GLARE_CELL_PX = 8
"""Side of the cells into which `glare` divides a frame, px."""

HIDDEN_SHARE = 0.25
"""Noise hides dots where more than this share of those found would not be found."""

GLARE_REACH = 5.0
"""Dots nearer to saturated light than this, in dot sizes, may be hidden by it."""

View = tuple[FloatArray, FloatArray, FloatArray, BoolArray]
"""Where dots are visible, see `Observation.view_with`."""


def over_limit(dots: Dots) -> FloatArray:
    """Return the logarithm of each dot's brightness over the limit of the detector, shape (n,).

    The limit is that of the default detector with its usual settings, or the brightness of the
    faintest dot if that is less. It is 0 or more; NaN for dots entered by hand where no light is.
    """
    over, lit = np.full(len(dots), np.nan), (dots.peak > 0) & (dots.snr > 0)
    if lit.any():
        usual, peak = BandPassSettings(), dots.peak[lit]
        snr = usual.threshold * noise_gain(median(dots.size_px[lit])) / PEAK_GAIN
        least = np.maximum(usual.contrast * typical(peak), snr * peak / dots.snr[lit])
        over[lit] = np.log(peak / least)
        over[lit] -= min(float(over[lit].min()), 0.0)
    return over


def glare(image: Image, dots: Dots, tuning: DetectorTuning | None = None) -> FloatArray:
    """Return the places of a frame where light may hide dots, shape (k, 2), px.

    The light is saturated, or its noise exceeds many of the dots. The places are the centres (u, v)
    of square cells of `GLARE_CELL_PX`.

    Parameters
    ----------
    image
        The frame, shape (height, width).
    dots
        Its dots.
    tuning
        Tuning with which they were found; None: places with noise are not included.
    """
    if len(dots) == 0:
        return np.zeros((0, 2))
    size, cell = median(dots.size_px), GLARE_CELL_PX
    hidden = np.zeros([-(-length // cell) for length in image.shape[:2]], bool)
    if (saturated := saturated_light(image, size)) is not None:
        side = 2 * round(GLARE_REACH * size) + 1
        near = cv2.dilate(saturated.astype(np.uint8), np.ones((side, side), np.uint8))
        v, u = np.nonzero(near)
        hidden[v // cell, u // cell] = True
    if tuning is not None:
        floor = tuning.floor(tuning.noise[::cell, ::cell])
        hidden |= floor > PEAK_GAIN * np.quantile(dots.peak, HIDDEN_SHARE)
    v, u = np.nonzero(hidden)
    return np.asarray(np.stack([u, v], axis=-1) * float(cell) + (cell - 1) / 2, float)
