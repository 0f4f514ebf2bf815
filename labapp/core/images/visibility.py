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
