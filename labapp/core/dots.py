"""Frame → Dots: find the reflected dots and say how well each is known (§5.2.1, §5.3).

The default detector is a band-pass at the dots' own size, which is estimated from the frame. The
text's two chains are in `threshold_dots`; `detection` chooses.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze

Image = npt.NDArray[np.generic]
Grey = npt.NDArray[np.float32]
Picture = Grey | npt.NDArray[np.uint8]


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


@dataclass(frozen=True)
class BandPassSettings:
    """How the default detector decides.

    Parameters
    ----------
    size_px
        Standard deviation of a dot's light; None: estimated from the frame.
    threshold
        A dot's band-passed peak stands this many local noise σ above the background.
    contrast
        … and is at least this fraction of the frame's typical dot.
    speckle_px
        Part of the position's uncertainty that no signal-to-noise removes.
    """

    size_px: float | None = None
    threshold: float = 6.0
    contrast: float = 0.15
    speckle_px: float = 0.12


def band_pass_dots(frame: Image, settings: BandPassSettings) -> Dots:
    """Find dots as peaks of a difference of Gaussians at the dots' own size.

    Parameters
    ----------
    frame
        Grey image, shape (height, width), any real type.
    settings
        See `BandPassSettings`.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing in the frame stands out of the noise.
    """
    image = np.asarray(frame, np.float32)
    if image.ndim != 2 or min(image.shape) < 8 or not np.ptp(image) > 0:
        raise CannotMeasure("no-dots", "the frame is blank or too small to hold a dot")
    size = settings.size_px or estimate_size(image)
    band = band_pass(image, size)
    noise = local_noise(image, size)
    floor = settings.threshold * band_noise(band, noise, size)
    v, u = local_maxima(band, floor, size)
    keep = _dot_like(image, band, u, v, size)
    u, v = u[keep], v[keep]
    if len(u) == 0:
        raise CannotMeasure("no-dots", "no dot stands out of the frame's noise")
    bright = band[v, u].astype(float)
    keep = bright >= settings.contrast * typical(bright)
    keep[keep] = first_of_each(u[keep], v[keep], size)
    light = light_of(image, size)
    return describe(light, band, noise, u[keep], v[keep], size, settings.speckle_px)


FAINT = 3.0
"""A peak that is pointed at stands this many noise σ above the background: half of what one that
nobody points at must."""


def dot_at(
    frame: Image, u_px: float, v_px: float, others: Dots, settings: BandPassSettings
) -> Dots:
    """Describe the one dot that is pointed at: the nearest peak there, or else the place itself.

    Parameters
    ----------
    frame
        Grey image, shape (height, width), any real type.
    u_px, v_px
        Place in the frame, px.
    others
        The dots there are; their peaks are not taken again and their light is kept out.
    settings
        See `BandPassSettings`.

    Returns
    -------
    Dots
        One dot, with centroid and uncertainty as `band_pass_dots` gives them. Where no peak of
        its own is within two dots' sizes it is at (u_px, v_px), uncertain by a dot's size.
    """
    image = np.asarray(frame, np.float32)
    size = settings.size_px or float(np.median(others.size_px) if len(others) else 0.0)
    size = size or estimate_size(image)
    band = band_pass(image, size)
    noise = local_noise(image, size)
    v, u = local_maxima(band, FAINT * band_noise(band, noise, size), size)
    away = np.hypot(u - u_px, v - v_px)
    taken = np.full(len(u), np.inf)
    if len(others) and len(u):
        taken = np.asarray(cKDTree(others.image_px).query(np.stack([u, v], axis=1))[0])
    away[taken < max(1.5, size)] = np.inf
    if not (away <= 2.0 * size).any():
        at = round(v_px), round(u_px)
        peak = max(float(band[at]), 0.0) / _PEAK_GAIN
        snr = peak / max(float(noise[at]), 1e-3 * peak, 1e-9)
        unsure = max(size, 1.0)
        return Dots(*(np.array([x]) for x in (u_px, v_px, unsure, unsure, size, peak, snr)))
    k = int(np.argmin(away))
    limit = np.array(image.shape[::-1]) - 1
    known = np.clip(np.rint(others.image_px), 0, limit).astype(np.int64)
    u, v = np.append(known[:, 0], u[k]), np.append(known[:, 1], v[k])
    every = describe(light_of(image, size), band, noise, u, v, size, settings.speckle_px)
    return Dots(*(getattr(every, column.name)[-1:] for column in fields(every)))


# Sizes of dot that are looked for: from the sharpest a camera gives to a dozen pixels across.
_SCALES_PX = 0.75 * 2 ** (np.arange(15) / 4)


def typical(brightness: FloatArray) -> float:
    """Half of all the light is in dots brighter than this: many faint specks do not move it."""
    order = np.sort(brightness)
    light = np.cumsum(order)
    return float(order[np.searchsorted(light, 0.5 * light[-1])])


def gauss(image: Grey, sigma: float) -> Grey:
    """Blur by a Gaussian of the given standard deviation, px."""
    blurred = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, np.float32)


# What a Gaussian dot of the band's own size keeps of its height: 1/(1 + 0.8²) − 1/(1 + 1.6²).
_PEAK_GAIN = 1 / 1.64 - 1 / 3.56


# What is left of a Gaussian dot's width when its surroundings are taken off before it is measured.
_WIDTH_KEPT = 0.8


def _noise_gain(size: float) -> float:
    """White noise before the band over white noise after it, for a dot of the given size."""
    a, b = (0.8 * size) ** 2, (1.6 * size) ** 2
    power = 1 / (4 * np.pi) * (1 / a + 1 / b - 4 / (a + b))
    return float(1 / np.sqrt(power))


def band_pass(image: Grey, size: float) -> Grey:
    """Difference of Gaussians that answers most to a Gaussian dot of the given size."""
    return gauss(image, 0.8 * size) - gauss(image, 1.6 * size)


def estimate_size(image: Grey) -> float:
    """Standard deviation of the frame's dots, px: the scale at which most of its blobs peak.

    A blob is a maximum over place and scale of the scale-normalised band-pass. Hot pixels peak
    at the smallest scale and gradients at the largest, so those two do not vote.
    """
    # The scales grow by 2^¼: what is taken off one (`band_pass`) is what another begins with.
    blurred = [gauss(image, 0.8 * _SCALES_PX[0] * 2 ** (k / 4)) for k in range(len(_SCALES_PX) + 4)]
    stack = np.stack([fine - wide for fine, wide in zip(blurred, blurred[4:], strict=False)])
    best = stack.max(axis=0)
    votes = np.zeros(len(_SCALES_PX))
    some = stack[:, ::2, ::2].reshape(len(stack), -1)
    noise = 1.4826 * np.median(np.abs(some - np.median(some, axis=1, keepdims=True)), axis=1)
    for k in range(1, len(_SCALES_PX) - 1):
        v, u = local_maxima(stack[k], 8.0 * noise[k] + 1e-6, _SCALES_PX[k])
        here = stack[k - 1 : k + 2, v, u]
        peak = (here[1] >= here[0]) & (here[1] > here[2]) & (here[1] >= 0.5 * best[v, u])
        strength = here[1][peak]
        votes[k] = strength.sum()
    if not votes.any():
        return 2.5
    smooth = np.convolve(votes, [0.5, 1.0, 0.5], "same")
    k = int(np.argmax(smooth))
    window = slice(max(k - 1, 0), k + 2)
    log_size = np.average(np.log(_SCALES_PX[window]), weights=votes[window] + 1e-12)
    return float(np.exp(log_size))


def local_noise(image: Grey, size: float) -> Grey:
    """Standard deviation of the camera's noise round each pixel, grey levels.

    Taken from a difference that smooth structure, dots included, does not pass (Immerkær 1996),
    by the scaled median over tiles of some sixteen dots.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6.0
    fine = np.abs(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT))
    tile = max(24.0, 16.0 * size)
    rows, columns = (max(1, round(n / tile)) for n in fine.shape)
    medians: Grey = np.array(
        [
            [np.median(part) for part in np.array_split(strip, columns, axis=1)]
            for strip in np.array_split(fine, rows, axis=0)
        ],
        np.float32,
    )
    if min(medians.shape) >= 3:
        medians = np.asarray(cv2.medianBlur(medians, 3), np.float32)
    height, width = image.shape
    return np.asarray(1.4826 * cv2.resize(medians, (width, height)), np.float32)


def band_noise(band: Grey, noise: Grey, size: float) -> Grey:
    """Standard deviation of the noise in the band-passed frame.

    White noise passes the band with a known gain. Noise with grain (compression, a soft sensor)
    passes more; the frame's quieter half tells how much.
    """
    white = noise / _noise_gain(size)
    excess = np.median(np.abs(band)) * 1.4826 / max(float(np.median(white)), 1e-9)
    floor = 1e-3 * float(np.max(np.abs(band))) + 1e-6
    return np.asarray(np.maximum(white * min(max(1.0, excess), 3.0), floor), np.float32)


def peak_disc(size: float) -> npt.NDArray[np.uint8]:
    """Pixels round a peak that none of may be brighter: a mask, shape (side, side)."""
    reach = 2 * max(1, round(1.2 * size)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)), np.uint8)


def local_maxima(band: Grey, floor: Grey | float, size: float) -> tuple[IntArray, IntArray]:
    """Rows and columns of the pixels above ``floor`` that none nearby is brighter than."""
    peak = (band >= cv2.dilate(band, peak_disc(size))) & (band > floor)
    v, u = np.nonzero(peak)
    return v.astype(np.int64), u.astype(np.int64)


def first_of_each(u: IntArray, v: IntArray, size: float) -> BoolArray:
    """One of several pixels that share a peak: the top of a dot may be flat."""
    place = np.stack([u, v], axis=1)
    keep = np.ones(len(u), bool)
    for first, second in sorted(cKDTree(place).query_pairs(max(1.5, size))):
        if keep[first]:
            keep[second] = False
    return keep


def _dot_like(
    image: Grey,
    band: Grey,
    u: IntArray,
    v: IntArray,
    size: float,
) -> BoolArray:
    """Not a hot pixel: those answer more to a much finer band than to the dots' own."""
    fine = band_pass(image, hot_scale(size))
    strongest = np.asarray(cv2.dilate(fine, np.ones((3, 3), np.uint8)))
    return np.asarray(strongest[v, u] < HOT * band[v, u])


HOT = 1.6
"""A hot pixel answers so many times more to the finer band."""


def hot_scale(size: float) -> float:
    """Size of dot whose band a hot pixel answers to, px."""
    return max(0.4, size / 3.0)


def light_of(image: Grey, size: float) -> Grey:
    """Light over its surroundings', hardly blurred: where above 0, centroids are weighted by it."""
    return np.asarray(gauss(image, 0.5 * size) - gauss(image, 3.0 * size))


def squares(
    image: Grey, u: IntArray, v: IntArray, reach: int, beyond: int = cv2.BORDER_CONSTANT
) -> Grey:
    """Squares round pixels, dark beyond the picture unless OpenCV's ``beyond`` says otherwise.

    Returns
    -------
    Grey
        Shape (n, 2·reach + 1, 2·reach + 1).
    """
    height, width = image.shape
    side = 2 * reach + 1
    if len(u) == 0:
        return np.zeros((0, side, side), np.float32)
    if min(u.min(), v.min(), width - 1 - u.max(), height - 1 - v.max()) < reach:
        wide = cv2.copyMakeBorder(image, reach, reach, reach, reach, beyond)
        image = np.asarray(wide, np.float32)
        u, v = u + reach, v + reach
    return np.asarray(sliding_window_view(image, (side, side))[v - reach, u - reach])


def centroids(
    light: Grey, u: IntArray, v: IntArray, margin: int, width: FloatArray, reach: float
) -> tuple[FloatArray, FloatArray]:
    """Centroids of light under Gaussian windows that are moved onto them until they stay.

    Parameters
    ----------
    light
        Picture; dark where below 0.
    u, v
        Column and row of n pixels.
    margin
        Light within so many pixels is weighed.
    width
        Standard deviation of each one's window, shape (n,), px.
    reach
        A centroid is no farther from its pixel along either axis, px.

    Returns
    -------
    offset, moment
        The centroids from the pixels, shape (2, n), px; the second moments of the light under the
        windows, the sum of both axes', shape (n,), px².
    """
    across = np.arange(-margin, margin + 1.0)
    patches = np.maximum(squares(light, u, v, margin), 0.0).astype(float)
    offset = np.zeros((2, len(u)))
    for _ in range(4):
        pull = np.exp(-0.5 * ((across - offset[..., None]) / width[:, None]) ** 2)
        along_u = (pull[1][:, None] @ patches)[:, 0] * pull[0]
        along_v = (patches @ pull[0][:, :, None])[:, :, 0] * pull[1]
        total = along_u.sum(axis=1) + 1e-12
        sums = along_u, along_v
        mean = np.array([part @ across for part in sums]) / total
        # The window holds the mean back; half as much again brings it home in a few steps.
        offset = np.clip(offset + 1.5 * (mean - offset), -reach, reach)
    moment = sum(part @ across**2 for part in sums) / total - np.sum(mean**2, axis=0)
    return offset, moment


def describe(
    light: Grey, band: Grey, noise: Grey, u: IntArray, v: IntArray, size: float, speckle_px: float
) -> Dots:
    """Centroid, its uncertainty, size, peak and signal-to-noise of each peak.

    The centroid is weighted by the light above its surroundings (`light_of`).
    """
    next_px = np.full(len(u), np.inf)
    if len(u) > 1:
        place = np.stack([u, v], axis=1)
        next_px = np.asarray(cKDTree(place).query(place, k=2)[0])[:, 1]
    width = windows(next_px, size)
    found = centroids(light, u, v, margin_of(size), width, size)
    return described(band, noise, (u, v), size, speckle_px, width, found)


def windows(next_px: FloatArray, reach: float) -> FloatArray:
    """Width of the windows of dots so far from the next one, shape (n,), px.

    A window that ends half-way to the next dot keeps its light out.
    """
    return np.minimum(1.1 * reach, np.maximum(0.275 * next_px, 0.75))


def margin_of(reach: float) -> int:
    """So far from a peak, px, light is weighed."""
    return int(np.ceil(2.2 * reach)) + 1


def described(
    band: Grey,
    noise: Grey,
    peaks: tuple[IntArray, IntArray],
    size: float,
    speckle_px: float,
    width: FloatArray,
    light: tuple[FloatArray, FloatArray],
) -> Dots:
    """Dots of peaks, their columns and rows, from what `centroids` says of their light."""
    (u, v), (offset, moment) = peaks, light
    moment = np.clip(moment / 2, 1e-3, 0.95 * width**2)
    spread = (1 / (1 / moment - 1 / width**2) - (0.5 * size) ** 2) / _WIDTH_KEPT**2
    peak = band[v, u].astype(float) / _PEAK_GAIN
    snr = peak / np.maximum(noise[v, u], 1e-3 * np.max(peak))
    sigma = np.hypot(0.8 / snr, speckle_px)
    return Dots(
        u_px=u + offset[0],
        v_px=v + offset[1],
        u_sigma_px=sigma,
        v_sigma_px=sigma.copy(),
        size_px=np.sqrt(np.clip(spread, (0.3 * size) ** 2, (3.0 * size) ** 2)),
        peak=peak,
        snr=snr,
    )
