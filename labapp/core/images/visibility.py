"""How far dots are above the limit below which the detector finds none."""

from __future__ import annotations

import numpy as np

from labapp.core.images.dots import BandPassSettings, Dots
from labapp.core.images.filters import noise_gain
from labapp.core.images.peaks import PEAK_GAIN, typical
from labapp.core.values import FloatArray, median


def over_limit(dots: Dots) -> FloatArray:
    """Return the logarithm of each dot's brightness over the limit of the detector, shape (n,).

    The limit is that of the default detector with its usual settings, or the brightness of the
    faintest dot if that is less. It is 0 or more.
    """
    if not len(dots):
        return np.zeros(0)
    usual = BandPassSettings()
    snr = usual.threshold * noise_gain(median(dots.size_px)) / PEAK_GAIN
    least = np.maximum(usual.contrast * typical(dots.peak), snr * dots.peak / dots.snr)
    over = np.log(dots.peak / least)
    return np.asarray(over - min(float(over.min()), 0.0))
