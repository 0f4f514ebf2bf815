"""Which detector and which search: frame → Dots → Lattice by the default or as the text has it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from labapp.core.images.band_pass import band_pass_dots
from labapp.core.images.dots import BandPassSettings, Dots, Image
from labapp.core.images.threshold_dots import (
    BlockThresholdSettings,
    WaveletSettings,
    block_threshold_dots,
    wavelet_dots,
)
from labapp.core.rows.lattice import GrowSettings, Lattice, grow_lattice
from labapp.core.rows.row_search import MaskRowsSettings, RowSearchSettings, mask_rows, search_rows
from labapp.core.values import CannotMeasure


@dataclass(frozen=True)
class DotSettings:
    """Which detector finds the dots, and how each decides.

    Parameters
    ----------
    method
        ``band-pass`` (the default), ``block-threshold`` (§5.2.1) or ``wavelet`` (§5.3).
    """

    method: Literal["band-pass", "block-threshold", "wavelet"] = "band-pass"
    band_pass: BandPassSettings = field(default_factory=BandPassSettings)
    block_threshold: BlockThresholdSettings = field(default_factory=BlockThresholdSettings)
    wavelet: WaveletSettings = field(default_factory=WaveletSettings)


@dataclass(frozen=True)
class LatticeSettings:
    """Which search finds rows and columns, and how each decides.

    Parameters
    ----------
    method
        ``grow`` (the default), ``rows`` (§5.2.2) or ``masks`` (§5.3).
    """

    method: Literal["grow", "rows", "masks"] = "grow"
    grow: GrowSettings = field(default_factory=GrowSettings)
    rows: RowSearchSettings = field(default_factory=RowSearchSettings)
    masks: MaskRowsSettings = field(default_factory=MaskRowsSettings)


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
        raise CannotMeasure("no-dots", "no dot stands out of the frame's background")
    return dots


def find_lattice(dots: Dots, frame_shape: tuple[int, int], settings: LatticeSettings) -> Lattice:
    """Find the rows and columns of dots in a frame of the given height and width, px.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` or ``no-rows`` if there are none to be told.
    """
    if settings.method == "rows":
        return search_rows(dots, settings.rows)
    if settings.method == "masks":
        return mask_rows(dots, frame_shape, settings.masks)
    return grow_lattice(dots, settings.grow)
