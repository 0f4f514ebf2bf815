"""Reflected dots and their uncertainties (§5.2.1, §5.3).

`find_dots` finds them, by the default detector, `band_pass`, or by one of the dissertation's two in
`threshold_dots`. The default detector's settings are here, so that reading them does not load it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray, ReadOnlyArrays

Image = npt.NDArray[np.generic]
"""Grey levels of a frame, shape (height, width), of any real type."""

Grey = npt.NDArray[np.float32]
"""The same as 32-bit floats."""

Picture = Grey | npt.NDArray[np.uint8]
"""The same as the compiled loops accept it."""


@dataclass(frozen=True, repr=False)
class Dots(ReadOnlyArrays):
    """Reflected dots found in one frame; every array has shape (n,).

    Parameters
    ----------
    u_px, v_px
        Position, px (u right, v down, first pixel's centre is 0, 0).
    u_sigma_px, v_sigma_px
        Standard uncertainty of the position, px.
    size_px
        Standard deviation of the dot's light distribution, px.
    peak
        Height of the dot above its background, grey levels of the frame.
    snr
        Peak over the local noise.
    """

    u_px: FloatArray
    v_px: FloatArray
    u_sigma_px: FloatArray
    v_sigma_px: FloatArray
    size_px: FloatArray
    peak: FloatArray
    snr: FloatArray

    def __len__(self) -> int:
        return len(self.u_px)

    @property
    def image_px(self) -> FloatArray:
        """(u, v) of each dot, shape (n, 2), px."""
        return np.stack([self.u_px, self.v_px], axis=-1)


@dataclass(frozen=True)
class BandPassSettings:
    """Settings of the default detector.

    Parameters
    ----------
    size_px
        Standard deviation of a dot's light; None: estimated from the frame.
    threshold
        Least height of a dot's band-passed peak above the background, in local noise σ.
    contrast
        Least height of that peak as a fraction of the frame's typical dot.
    speckle_px
        Part of the position's uncertainty that does not depend on the signal-to-noise ratio, px.
    """

    size_px: float | None = None
    threshold: float = 6.0
    contrast: float = 0.15
    speckle_px: float = 0.12
