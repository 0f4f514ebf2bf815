"""Estimates from a frame before its dots are detected: noise and dot size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image, Picture
from labapp.core.images.filters import (
    NARROW,
    blur,
    noise_gain,
    pairs,
    peak_disc,
    scratch,
    without_spikes,
)
from labapp.core.values import BoolArray, FloatArray, robust_sigma

TILE_PX = 40
"""Noise is estimated in tiles of about this side."""

LEAST_BYTE_NOISE = 0.5
"""Least noise of a picture of bytes, grey levels. Compression leaves flat areas without visible
noise; measured against none, ripples would count as thousands of peaks."""

SLENDER = 10.0
"""A peak with a larger ratio of principal curvatures is part of a ridge, not a dot."""

USUAL_PX = 2.5
"""Dot size assumed for a frame in which none can be estimated."""

SCALES_PX = 0.63 * 2 ** (np.arange(11) / 2)
"""Scales that are searched: from below the sharpest dots of a camera to dots 80 px across."""

COARSE = 2
"""Index of the finest of these scales that is computed at half resolution."""

OVER_NOISE = 8.0
"""Least response of a blob over that of the frame's noise."""

MOST_BLOBS = 3000
"""Number of a scale's strongest blobs that are used; more than a pattern has dots.

If part of a picture is blank, noise in the rest makes a blob every few pixels."""

WHOLE = 0.6
"""Smaller blobs within a blob are its parts if it has at least this share of their response."""

SHARP = 20.0
"""Dots are of the smallest scale if its blobs have more than so many times the votes of all others
and are no hot pixels (`_are_dots`)."""

LEAST_SHARP, WIDER = 50, 0.7
"""Least number of such blobs; least median ratio of their responses at the next scale and at the
smallest. It is 0.5 for single pixels and 0.9 for Gaussian dots of the smallest scale."""

LEAST_DOTS = 9
"""Least number of blobs at the dots' scale and the next ones, unless no scale has as many: a few
reflections of the arc may be brighter and larger than all dots together."""

BEST = 0.884
"""Scale of the band with the largest response to a Gaussian dot, over the dot's size: about
1/√(NARROW · WIDE)."""


def as_picture(frame: Image) -> Picture:
    """Convert to a contiguous array of bytes, if it is one, or else of single precision."""
    if frame.dtype == np.uint8:
        return np.ascontiguousarray(frame, np.uint8)
    return np.ascontiguousarray(frame, np.float32)


def local_noise(picture: Picture) -> Grey:
    """Estimate the local standard deviation of the camera's noise, grey levels.

    From a difference operator that suppresses smooth structure, dots included (Immerkær 1996), by
    the scaled median over tiles; at least `LEAST_BYTE_NOISE` for bytes.
    """
    from labapp.core.images import size_kernels

    height, width = picture.shape
    rows, columns = (max(1, round(side / TILE_PX)) for side in picture.shape)
    medians = size_kernels.tile_noise(picture, rows, columns)
    if min(medians.shape) >= 3:
        medians = np.asarray(cv2.medianBlur(medians, 3), np.float32)
    sigma = 1.4826 * medians
    if picture.dtype == np.uint8:
        sigma = np.maximum(sigma, np.float32(LEAST_BYTE_NOISE))
    return np.asarray(cv2.resize(sigma, (width, height)), np.float32)


def estimate_size(picture: Picture, noise: Grey) -> float:
    """Estimate the size of a picture's dots, px: the scale at which most of its blobs peak.

    A blob is a maximum over position and scale of the scale-normalised band-pass. It votes with
    its response times its size, since speckle grains would otherwise outvote the dots they are in.
    A blob within a larger one of about the same response is a lobe or a grain of it and does not
    vote. Spikes peak at the smallest scale and gradients at the largest, which are not accepted,
    except that the smallest is if nearly all blobs peak there (`SHARP`).

    Half resolution is sufficient for most sizes; full resolution costs four times as much.
    """
    level = float(np.median(noise[::8, ::8]))
    size = _size_from(picture, level, COARSE)
    if size is None:
        size = _size_from(without_spikes(picture, noise, SCALES_PX[0]), level, 0)
    return size or USUAL_PX


def _size_from(picture: Picture, level: float, finest: int) -> float | None:
    """Estimate the dot size from scales ≥ ``finest``; None if it may be smaller or has no blobs."""
    from labapp.core.images import size_kernels

    bands = dict(_bands(picture, finest))
    kinds = [_blobs(bands, scale, level) for scale in sorted(bands)[:-1]]
    for k, few in enumerate(kinds):
        for large in kinds[k + 1 :]:
            few.votes &= ~size_kernels.parts(
                few.place_px,
                few.own,
                large.place_px[large.tops],
                large.own[large.tops],
                1.5 * SCALES_PX[large.scale],
                WHOLE,
            )
    votes = np.array([SCALES_PX[some.scale] * some.own[some.votes].sum() for some in kinds])
    counts = np.pad([np.count_nonzero(some.votes) for some in kinds], 1)
    is_few = counts[:-2] + counts[1:-1] + counts[2:] < LEAST_DOTS
    if not is_few.all():
        votes[is_few] = 0.0
    if finest == 0:
        if votes[0] > SHARP * votes[1:].sum() and _are_dots(kinds[0]):
            return float(SCALES_PX[0] / BEST)
        votes[:1] = 0.0
    if not votes.any():
        return None
    most = int(np.argmax(np.convolve(votes, [0.5, 1.0, 0.5], "same")))
    if most == 0:
        return None
    near = [some for some in kinds[1:] if abs(some.scale - kinds[most].scale) <= 1]
    scale = np.concatenate([some.scale + some.beyond()[some.votes] for some in near])
    weight = np.concatenate([some.own[some.votes] for some in near])
    return float(SCALES_PX[0] * 2 ** (np.average(scale, weights=weight) / 2) / BEST)


def _are_dots(sharpest: _Blobs) -> bool:
    """Whether blobs of the smallest scale are dots rather than hot pixels."""
    wider = sharpest.more[sharpest.votes] / sharpest.own[sharpest.votes]
    return len(wider) >= LEAST_SHARP and float(np.median(wider)) > WIDER


@dataclass
class _Blobs:
    """Maxima of one scale's band: positions, shape (n, 2), and responses there, shape (n,) each.

    The responses are at the next smaller scale, at this one, at the next larger one, and the
    largest of all scales.
    """

    scale: int
    place_px: FloatArray
    less: FloatArray
    own: FloatArray
    more: FloatArray
    largest: FloatArray

    def __post_init__(self) -> None:
        top = (self.own >= self.less) & (self.own > self.more)
        self.tops: BoolArray = top & (self.own >= 0.5 * self.largest)
        self.votes = self.tops.copy()

    def beyond(self) -> FloatArray:
        """Offset of each peak from this scale, in scale steps, by a parabola."""
        bend = np.minimum(self.less - 2 * self.own + self.more, -1e-9)
        return np.asarray(np.clip(0.5 * (self.less - self.more) / bend, -0.5, 0.5))


def _blobs(bands: dict[int, tuple[int, Grey]], scale: int, noise: float) -> _Blobs:
    from labapp.core.images import band_pass_kernels, size_kernels

    step, band = bands[scale]
    white = noise * noise_gain(SCALES_PX[scale])
    every = -(-8 // step)
    floor = OVER_NOISE * band_noise(band[::every, ::every], white) + 1e-6
    disc = peak_disc(SCALES_PX[scale] / step).astype(bool)
    x, y = band_pass_kernels.peaks(band, np.full((1, 1), floor, np.float32), disc)
    good = ~band_pass_kernels.ridges(band, x, y, SLENDER)
    x, y = x[good], y[good]
    if len(x) > MOST_BLOBS:
        most = np.argpartition(-band[y, x], MOST_BLOBS)[:MOST_BLOBS]
        x, y = x[most], y[most]
    place = (pairs(x, y) + 0.5) * step - 0.5
    u, v = np.rint(place.T).astype(np.int64)
    response = {
        k: size_kernels.responses(other, u, v, float(by)) for k, (by, other) in bands.items()
    }
    response[scale] = band[y, x].astype(np.float64)
    less = response.get(scale - 1, np.full(len(place), -np.inf))
    largest = np.stack(list(response.values())).max(axis=0)
    return _Blobs(scale, place, less, response[scale], response[scale + 1], largest)


def _bands(picture: Picture, finest: int = 0) -> Iterator[tuple[int, tuple[int, Grey]]]:
    """Yield each scale's index from the finest on, its downsampling factor, and its band.

    The scales grow by √2, so that the wide blur of one is the narrow blur of the next but one.
    Four of them are computed from the first picture, and two from each smaller one.
    """
    step, scale = 2 ** (finest // 2), finest
    picture = _smaller(picture, step)
    while scale < len(SCALES_PX) and min(picture.shape) >= 8:
        count = min(4 if scale == finest else 2, len(SCALES_PX) - scale)
        lost = (1 - step**-2) / 12  # variance of the averaging in downsampling, px²
        blurred = [
            blur(
                picture,
                float(np.sqrt((NARROW * SCALES_PX[0] * 2 ** (k / 2) / step) ** 2 - lost)),
                scratch(f"blurred {step} {k}", picture.shape),
            )
            for k in range(scale, scale + count + 2)
        ]
        for k, (fine, wide) in enumerate(zip(blurred, blurred[2:], strict=False), scale):
            # The finer blur is no longer needed and is overwritten by the difference.
            yield k, (step, np.asarray(cv2.subtract(fine, wide, dst=fine), np.float32))
        picture, step, scale = _smaller(picture, 2), 2 * step, scale + count


def _smaller(picture: Picture, step: int) -> Picture:
    """Downsample a picture by a factor, by averaging pixels."""
    if step == 1:
        return picture
    height, width = picture.shape
    size = width // step, height // step
    return as_picture(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def band_noise(band: Grey, white: float) -> float:
    """Estimate the noise of a band-passed picture; ``white`` is what white noise would give.

    Correlated noise (compression, a soft sensor) passes the band more; the excess is estimated
    from the median absolute value.
    """
    excess = robust_sigma(band) / max(white, 1e-9)
    return white * min(max(1.0, excess), 3.0)
