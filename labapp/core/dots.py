"""Frame → Dots: find the reflected dots and say how well each is known (§5.2.1, §5.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.values import FloatArray, freeze


@dataclass(frozen=True)
class Dots:
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

    def __post_init__(self) -> None:
        freeze(self)

    def __len__(self) -> int:
        return len(self.u_px)

    @property
    def image_px(self) -> FloatArray:
        """(u, v) of each dot, shape (n, 2), px."""
        return np.stack([self.u_px, self.v_px], axis=-1)
