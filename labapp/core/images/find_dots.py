"""Frame → Dots, by the default detector or by one of the dissertation's two (§5.2.1, §5.3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from labapp.core.images.band_pass import band_pass_dots, crowded_dots
from labapp.core.images.dots import BandPassSettings, Dots, Image
from labapp.core.images.threshold_dots import (
    BlockThresholdSettings,
    WaveletSettings,
    block_threshold_dots,
    wavelet_dots,
)
from labapp.core.values import CannotMeasure


@dataclass(frozen=True)
class DotSettings:
    """Choice of the detector, and the settings of each.

    Parameters
    ----------
    method
        ``band-pass`` (the default), ``block-threshold`` (§5.2.1) or ``wavelet`` (§5.3).
    band_pass, block_threshold, wavelet
        Settings of each; only those of ``method`` are used.
    """

    method: Literal["band-pass", "block-threshold", "wavelet"] = "band-pass"
    band_pass: BandPassSettings = field(default_factory=BandPassSettings)
    block_threshold: BlockThresholdSettings = field(default_factory=BlockThresholdSettings)
    wavelet: WaveletSettings = field(default_factory=WaveletSettings)


def find_dots(frame: Image, settings: DotSettings) -> Dots:
    """Find the reflected dots of a grey frame, shape (height, width).

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise.
    """
    if settings.method == "block-threshold":
        dots = block_threshold_dots(frame, settings.block_threshold)
    elif settings.method == "wavelet":
        dots = wavelet_dots(frame, settings.wavelet)
    else:
        dots = band_pass_dots(frame, settings.band_pass)
    if len(dots) == 0:
        raise CannotMeasure("no-dots", "no dot is brighter than the frame's background")
    return dots


def find_mirror_dots(frame: Image, settings: DotSettings) -> Dots:
    """Find the dots of a flat mirror, ball or cap; the default detector fits them jointly.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise.
    """
    if settings.method != "band-pass":
        return find_dots(frame, settings)
    return crowded_dots(frame, settings.band_pass)
