"""The dissertation's two dot detectors: block threshold (§5.2.1) and wavelet (§5.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.images.dots import Dots
from labapp.core.values import BoolArray, FloatArray, robust_sigma

Frame = npt.NDArray[Any]


@dataclass(frozen=True)
class BlockThresholdSettings:
    """Settings of the block threshold; defaults of §5.2.1 for 480 × 640 frames of 256 grey levels.

    Parameters
    ----------
    block_px
        Side of a block R_i, px; the frame is divided evenly into blocks of about this size.
    delta_grey
        ΔI of Eq. 5-9, in 256ths of the range of the frame's type: it is multiplied by 257 for a
        16-bit frame and used unchanged for a frame of floats.
    median_px
        Side of the median filter, px (odd).
    size_divisor
        Regions smaller than the average size divided by this are noise (Eq. 5-11).
    dilation
        Dilation as a fraction of L_a and W_a. The text uses 1, which merges dots that are closer
        than about twice their width.
    """

    block_px: int = 40
    delta_grey: float = 5.0
    median_px: int = 3
    size_divisor: float = 6.0
    dilation: float = 1.0


@dataclass(frozen=True)
class WaveletSettings:
    """Settings of the improved detector of §5.3; the text names the steps but not the values.

    Parameters
    ----------
    denoise_px
        Side of the Gaussian filter that reduces the camera's noise, px (odd).
    wavelet, levels
        Wavelet and number of levels; 2**levels px is the scale above which light is background.
    background
        Factor on the coarsest approximation: 0 removes it.
    soft_threshold
        Soft threshold for the details, in standard deviations of the camera's noise.
    window_px
        Side of the adaptive threshold's window, px (odd).
    offset_sigma
        Offset of the adaptive threshold above the mean of its window, in standard deviations of
        the camera's noise.
    median_px, closing_px
        Sides of the median filter and of the square that dilates, then erodes, px (odd).
    """

    denoise_px: int = 3
    wavelet: str = "sym4"
    levels: int = 4
    background: float = 0.0
    soft_threshold: float = 1.0
    window_px: int = 41
    offset_sigma: float = 4.0
    median_px: int = 3
    closing_px: int = 3


def block_threshold_dots(frame: Frame, settings: BlockThresholdSettings | None = None) -> Dots:
    """Find dots by block threshold, size filter and dilation (§5.2.1, Eq. 5-7 … 5-14).

    Parameters
    ----------
    frame
        Grey levels, shape (rows, columns), of any integer or float type.
    settings
        None for those of the text.

    Returns
    -------
    Dots
        One for each connected region; none where nothing exceeds the thresholds.

    Raises
    ------
    ValueError
        If the frame is not a two-dimensional array of finite numbers.
    """
    settings = settings or BlockThresholdSettings()
    grey = _checked(frame)
    delta = settings.delta_grey * _grey_levels(frame) / 256.0
    binary: Frame = (grey > _block_means(grey, settings.block_px) + delta).astype(np.uint8)
    binary = cv2.medianBlur(binary, settings.median_px)

    # Eq. 5-10 and 5-11. S_a is the average after the median filter; before it, most regions are
    # the small noise regions that the filter removes.
    labels, boxes = _components(binary)
    if len(boxes) == 0:
        return _dots(binary, grey, frame.dtype)
    size = boxes[:, cv2.CC_STAT_AREA]
    kept = size > size.mean() / settings.size_divisor
    binary = np.concatenate([[False], kept])[labels].astype(np.uint8)

    # Eq. 5-12 and 5-13: extents are largest minus smallest coordinate, so one less than counts.
    length = float((boxes[kept, cv2.CC_STAT_HEIGHT] - 1).mean())
    width = float((boxes[kept, cv2.CC_STAT_WIDTH] - 1).mean())
    binary = cv2.dilate(binary, np.ones((_odd(settings.dilation * length), 1), np.uint8))
    binary = cv2.dilate(binary, np.ones((1, _odd(settings.dilation * width)), np.uint8))
    return _dots(binary, grey, frame.dtype)


def wavelet_dots(frame: Frame, settings: WaveletSettings | None = None) -> Dots:
    """Find dots by wavelet enhancement and adaptive threshold (§5.3, Fig. 5-22).

    Parameters
    ----------
    frame
        Grey levels, shape (rows, columns), of any integer or float type.
    settings
        None for the defaults.

    Returns
    -------
    Dots
        One for each connected region; none where nothing exceeds the threshold.

    Raises
    ------
    ValueError
        If the frame is not a two-dimensional array of finite numbers.
    """
    settings = settings or WaveletSettings()
    grey = _checked(frame)
    shifted = grey - grey.mean()
    smooth = np.asarray(
        cv2.GaussianBlur(shifted, (settings.denoise_px, settings.denoise_px), 0), float
    )
    noise = _noise(grey, frame.dtype)
    enhanced = _enhance(smooth, noise, settings)
    mean = cv2.blur(enhanced, (settings.window_px, settings.window_px))
    binary: Frame = (enhanced > mean + settings.offset_sigma * noise).astype(np.uint8)
    binary = cv2.medianBlur(binary, settings.median_px)
    square = np.ones((settings.closing_px, settings.closing_px), np.uint8)
    return _dots(cv2.erode(cv2.dilate(binary, square), square), grey, frame.dtype)


def _enhance(grey: FloatArray, noise: float, settings: WaveletSettings) -> FloatArray:
    """Attenuate the coarsest approximation and soft-threshold the details, shape as given."""
    import pywt  # not needed by the default detector

    levels = min(settings.levels, pywt.dwtn_max_level(grey.shape, settings.wavelet))
    if levels < 1:
        return grey
    # Symmetric extension keeps the frame's edges from looking like bright lines.
    approximation, *details = pywt.wavedec2(grey, settings.wavelet, mode="symmetric", level=levels)
    limit = settings.soft_threshold * noise
    coefficients = [settings.background * approximation] + [
        tuple(pywt.threshold(band, limit, mode="soft") for band in level) for level in details
    ]
    restored = pywt.waverec2(coefficients, settings.wavelet, mode="symmetric")
    return np.asarray(restored[: grey.shape[0], : grey.shape[1]], np.float64)


def _checked(frame: Frame) -> FloatArray:
    if frame.ndim != 2 or frame.size == 0:
        raise ValueError(f"a frame has shape (rows, columns), not {frame.shape}")
    grey = np.asarray(frame, np.float64)
    if not np.isfinite(grey).all():
        raise ValueError("a frame holds finite grey levels only")
    return grey


def _grey_levels(frame: Frame) -> float:
    """Number of grey levels of an integer type; 256 for floats."""
    if np.issubdtype(frame.dtype, np.integer):
        return float(np.iinfo(frame.dtype).max) * 256.0 / 255.0
    return 256.0


def _block_means(grey: FloatArray, block_px: int) -> FloatArray:
    """Average intensity of the block each pixel is in, shape as given (Eq. 5-7, 5-9)."""
    means: Frame = grey
    for axis, length in enumerate(grey.shape):
        blocks = max(1, round(length / block_px))
        edges = np.arange(blocks + 1) * length // blocks
        sums = np.add.reduceat(means, edges[:-1], axis=axis)
        sizes = np.diff(edges)
        shape = (-1, 1) if axis == 0 else (1, -1)
        means = np.repeat(sums / sizes.reshape(shape), sizes, axis=axis)
    return means


def _odd(extent: float) -> int:
    """Return the odd length nearest to an extent, so that a dilation is symmetric."""
    return 2 * int(extent / 2.0) + 1


def _components(binary: Frame) -> tuple[npt.NDArray[np.int32], Any]:
    """Label connected regions from 1, with the statistics of each, without the background's."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
    return np.asarray(labels, np.int32), boxes[1:]


def _noise(grey: FloatArray, dtype: np.dtype[Any]) -> float:
    """Standard deviation of white noise, from the frame minus its 3 × 3 mean.

    Estimated by the median absolute deviation, which is robust to dots. Not less than the
    rounding error of integer grey levels.
    """
    fine = grey - cv2.blur(grey, (3, 3))
    sigma = robust_sigma(fine - np.median(fine)) / np.sqrt(8.0 / 9.0)
    floor = 1.0 / np.sqrt(12.0) if np.issubdtype(dtype, np.integer) else 1e-12
    return float(max(sigma, floor))


def _local_background(grey: FloatArray, dark: BoolArray, window_px: int = 41) -> FloatArray:
    """Mean of the pixels outside dots in a window about each pixel, shape as given."""
    window = (window_px, window_px)
    weight = cv2.blur(dark.astype(np.float64), window)
    light = cv2.blur(np.where(dark, grey, 0.0), window)
    overall = float(grey[dark].mean()) if dark.any() else float(grey.min())
    return np.where(weight > 1e-6, light / np.maximum(weight, 1e-6), overall)


def _dots(binary: Frame, grey: FloatArray, dtype: np.dtype[Any]) -> Dots:
    """Measure each connected region (Eq. 5-14).

    The position is the mean of the region's pixels. Its standard uncertainty along u is

        σ_u = sqrt(1/12 + (w / snr)²),  w² = variance of the region's pixels along u:

    the region's ends are whole pixels (1/12), and noise moves its contour by a fraction of its
    width that falls with the signal-to-noise ratio. On rendered frames this covers the errors of
    both detectors if a region is one dot; it does not account for merged dots. The size is that of
    the light within the region, which is a third too small if the region is tight.
    """
    labels, boxes = _components(binary)
    count = len(boxes)
    if count == 0:
        return Dots(*(np.empty(0) for _ in range(7)))
    v, u = np.nonzero(labels)
    label = labels[v, u] - 1
    area = np.bincount(label, minlength=count)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(label, values, minlength=count) / area)

    u_px, v_px = mean(u.astype(float)), mean(v.astype(float))
    u_variance = mean((u - u_px[label]) ** 2)
    v_variance = mean((v - v_px[label]) ** 2)

    excess = (grey - _local_background(grey, labels == 0))[v, u]
    peak = np.full(count, -np.inf)
    np.maximum.at(peak, label, excess)
    light = np.maximum(excess, 0.0)
    total = np.maximum(np.bincount(label, light, minlength=count), 1e-12)
    radius2 = (u - u_px[label]) ** 2 + (v - v_px[label]) ** 2
    size = np.sqrt(np.bincount(label, light * radius2, minlength=count) / total / 2.0)

    peak = np.maximum(peak, 0.0)
    snr = peak / _noise(grey, dtype)
    per_snr = 1.0 / np.maximum(snr, 1.0)
    return Dots(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=np.sqrt(1.0 / 12.0 + u_variance * per_snr**2),
        v_sigma_px=np.sqrt(1.0 / 12.0 + v_variance * per_snr**2),
        size_px=size,
        peak=peak,
        snr=snr,
    )
