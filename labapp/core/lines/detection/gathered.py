"""Detection of lines that the pool gathers to spots, one above the other (a caustic).

A hollow of about the focal length's depth reflects each line to a spot of a few pixels. Ridges then
run from spot to spot, as the column of spots is longer than a spot is wide. The spots are detected
as peaks of the light along that column.
"""

from __future__ import annotations

import numpy as np
import scipy

from labapp.core.images.dots import Grey
from labapp.core.lines.detection.ridges import sampled
from labapp.core.values import FloatArray, robust_sigma

REACH_WIDTHS = 3.0
"""Half width, in line widths, over which light is summed across the column. The search extends
beyond the column's ends by four times as much."""

SHARPENED = 0.7
"""Peaks are detected in the second derivative at this share of a line's width, which separates
spots that merge in the light itself."""

LEAST_PEAK, LEAST_NOISE = 0.05, 5.0
"""Least peak of a spot, as a share of the brightest one's and as a multiple of the noise."""


def gathered_spots(
    picture: Grey, column_px: FloatArray, width_px: float
) -> list[tuple[FloatArray, float]]:
    """Return the spots of a column: (u, v), px, and the light of each, grey levels·px².

    Parameters
    ----------
    picture
        Grey levels over the background, shape (height, width).
    column_px
        Points of the lines' ridges, shape (n, 2).
    width_px
        Standard deviation of a line's light across it.
    """
    reach = REACH_WIDTHS * width_px
    u, v = column_px.T
    lean, foot = np.polyfit(v, u, 1) if np.ptp(v) > reach else (0.0, float(u.mean()))
    down = np.arange(
        max(v.min() - 4 * reach, 0.0), min(v.max() + 4 * reach, picture.shape[0] - 1.0), 0.5
    )
    sharp, light = _down(picture, foot + lean * down, down, width_px)
    # The column itself is mostly bright: estimate the noise from two strips beside it.
    dark = [
        _down(picture, foot + lean * down + side * reach, down, width_px)[0] for side in (-3.0, 3.0)
    ]
    noise = robust_sigma(dark)
    least = max(LEAST_PEAK * float(sharp.max()), LEAST_NOISE * noise)
    inner = sharp[1:-1]
    tops = 1 + np.flatnonzero((inner > sharp[:-2]) & (inner >= sharp[2:]) & (inner > least))
    half = round(2 * width_px)
    return [
        (
            np.array([foot + lean * down[k], down[k]]),
            0.5 * float(light[max(k - half, 0) : k + half + 1].sum()),
        )
        for k in tops
    ]


def _down(
    picture: Grey, u: FloatArray, v: FloatArray, width_px: float
) -> tuple[FloatArray, FloatArray]:
    """Light summed across a column at every half pixel along it: sharpened, and unfiltered."""
    beside = np.arange(-REACH_WIDTHS * width_px, REACH_WIDTHS * width_px + 0.5)
    at = np.stack(np.broadcast_arrays(u[:, None] + beside, v[:, None]), axis=-1)
    light = sampled(picture, at.reshape(-1, 2)).reshape(len(v), -1).sum(axis=1).astype(float)
    return -scipy.ndimage.gaussian_filter1d(light, 2 * SHARPENED * width_px, order=2), light
