"""What a frame says of itself before its dots are sought: noise, spikes, the size of its dots."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image, Picture
from labapp.core.values import BoolArray, FloatArray, IntArray

TILE_PX = 40
"""Noise is taken over tiles of about this side."""

SPIKE = 6.0
"""A pixel is a spike from so many noise σ over the light of a dot on."""

DOUBTED, CERTAIN = 1.5, 6.0
"""… and from so many times that light on, beside what is certainly a spike or doubted to be a dot,
and elsewhere. Speckle makes dots much sharper than Gaussians are."""

SLENDER = 10.0
"""A peak that is curved so many times more one way than the other is a ridge's, no dot's."""

USUAL_PX = 2.5
"""Size of dots in a frame in which none is seen."""

SCALES_PX = 0.63 * 2 ** (np.arange(11) / 2)
"""Sizes that are looked at: from under the sharpest a camera gives to eighty pixels across."""

COARSE = 2
"""The finest of these scales that a picture of half the size has."""

OVER_NOISE = 8.0
"""A blob's answer stands so many times over that of the frame's noise."""

MOST_BLOBS = 3000
"""So many of a scale's blobs are looked at, those that answer most: more than a pattern has dots.

Where part of a picture is blank the noise of the rest has a blob every few pixels."""

WHOLE = 0.6
"""A blob with this share of the answer of smaller ones within it has them as its parts."""

BEST = 0.884
"""The band that answers most to a Gaussian dot is that of so much of the dot's size."""

KEPT_BYTES = 2**23
"""Larger pictures to work on are not kept for the next frame."""


def as_picture(frame: Image) -> Picture:
    """Bytes as they are, other grey levels as single precision; for OpenCV and compiled loops."""
    if frame.dtype == np.uint8:
        return np.ascontiguousarray(frame, np.uint8)
    return np.ascontiguousarray(frame, np.float32)


def local_noise(picture: Picture) -> Grey:
    """Standard deviation of the camera's noise round each pixel, grey levels.

    Taken from a difference that smooth structure, dots included, does not pass (Immerkær 1996),
    by the scaled median over tiles.
    """
    from labapp.core.images import size_kernels

    height, width = picture.shape
    rows, columns = (max(1, round(side / TILE_PX)) for side in picture.shape)
    medians = size_kernels.tile_noise(picture, rows, columns)
    if min(medians.shape) >= 3:
        medians = np.asarray(cv2.medianBlur(medians, 3), np.float32)
    return np.asarray(cv2.resize(1.4826 * medians, (width, height)), np.float32)


def mended(
    picture: Picture, noise: Grey, size: float, doubted: tuple[IntArray, IntArray] | None = None
) -> Picture:
    """Put what is beside them in the place of pixels too bright for dots of a size, px.

    Mended is what is certainly a spike, or is near one of the ``doubted`` pixels (columns and
    rows), and what hangs together with that. A picture without such is given back.
    """
    from labapp.core.images import dot_kernels

    least = 1e-3 * float(cv2.minMaxLoc(picture)[1])
    over = SPIKE * max(float(noise[::8, ::8].min()), least)
    reach = max(2, round(2.5 * size))
    (u, v), (times, beside) = dot_kernels.spikes(picture, over, size, DOUBTED, reach)
    sharp = picture[v, u] - beside > SPIKE * noise[v, u]
    u, v, times, beside = u[sharp], v[sharp], times[sharp], beside[sharp]
    begun = times > CERTAIN
    if doubted is not None:
        away = dot_kernels.two_nearest(pairs(u, v), pairs(*doubted))[0][:, 0]
        begun |= away <= 1.5 * size + 1.0
    if not begun.any():
        return picture
    hot = dot_kernels.hanging_together(u, v, begun)
    whole = picture.copy()
    whole[v[hot], u[hot]] = np.rint(beside[hot]) if picture.dtype == np.uint8 else beside[hot]
    return whole


def pairs(u: IntArray, v: IntArray) -> FloatArray:
    """Places (u, v) of pixels, shape (n, 2)."""
    return np.stack([u, v], axis=1).astype(float)


def size_of(picture: Picture, noise: Grey) -> float:
    """Size of a picture's dots, px: the scale at which most of its blobs peak.

    A blob is a maximum over place and scale of the scale-normalised band-pass, and votes by its
    answer times its size, or grains of speckle would outvote the dots they are in. A blob within a
    larger one that answers about as much is a lobe or a grain of it, and does not vote. Spikes
    peak at the smallest scale and gradients at the largest: a size that is one of those is none.

    The picture at half its size tells most sizes; the whole of it costs four times as much.
    """
    level = float(np.median(noise[::8, ::8]))
    size = _size_from(picture, level, COARSE)
    if size is None:
        size = _size_from(mended(picture, noise, SCALES_PX[0]), level, 0)
    return size or USUAL_PX


def _size_from(picture: Picture, level: float, finest: int) -> float | None:
    """Size of the dots by the scales from the finest on; None if it may be less, or is not seen."""
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
    if finest == 0:
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


@dataclass
class _Blobs:
    """Maxima of one scale's band: places, shape (n, 2), and the answers of scales there.

    Those of the next smaller scale, of its own, of the next larger one, of all the largest.
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
        """How far past its own scale each one peaks, scales, by a parabola."""
        bend = np.minimum(self.less - 2 * self.own + self.more, -1e-9)
        return np.asarray(np.clip(0.5 * (self.less - self.more) / bend, -0.5, 0.5))


def _blobs(bands: dict[int, tuple[int, Grey]], scale: int, noise: float) -> _Blobs:
    from labapp.core.images import dot_kernels, size_kernels

    step, band = bands[scale]
    white = noise / noise_gain(SCALES_PX[scale])
    every = -(-8 // step)
    floor = OVER_NOISE * with_grain(band[::every, ::every], white) + 1e-6
    disc = peak_disc(SCALES_PX[scale] / step).astype(bool)
    x, y = dot_kernels.peaks(band, np.full((1, 1), floor, np.float32), disc)
    good = ~dot_kernels.ridges(band, x, y, SLENDER)
    x, y = x[good], y[good]
    if len(x) > MOST_BLOBS:
        most = np.argpartition(-band[y, x], MOST_BLOBS)[:MOST_BLOBS]
        x, y = x[most], y[most]
    place = (pairs(x, y) + 0.5) * step - 0.5
    u, v = np.rint(place.T).astype(np.int64)
    answer = {k: size_kernels.answers(other, u, v, float(by)) for k, (by, other) in bands.items()}
    answer[scale] = band[y, x].astype(np.float64)
    less = answer.get(scale - 1, np.full(len(place), -np.inf))
    largest = np.stack(list(answer.values())).max(axis=0)
    return _Blobs(scale, place, less, answer[scale], answer[scale + 1], largest)


def _bands(picture: Picture, finest: int = 0) -> Iterator[tuple[int, tuple[int, Grey]]]:
    """Each scale's number from the finest on, how many times smaller its picture is, and its band.

    The scales grow by √2: the blur that is taken off one (`band_pass.band`) is what the next but
    one begins with. Four of them are of the first picture, and two of each smaller one.
    """
    step, scale = 2 ** (finest // 2), finest
    picture = _smaller(picture, step)
    while scale < len(SCALES_PX) and min(picture.shape) >= 8:
        count = min(4 if scale == finest else 2, len(SCALES_PX) - scale)
        lost = (1 - step**-2) / 12  # what averaging has blurred already, px²
        blurred = [
            blur(
                picture,
                float(np.sqrt((0.8 * SCALES_PX[0] * 2 ** (k / 2) / step) ** 2 - lost)),
                scratch(f"blurred {step} {k}", picture.shape),
            )
            for k in range(scale, scale + count + 2)
        ]
        for k, (fine, wide) in enumerate(zip(blurred, blurred[2:], strict=False), scale):
            # What the finer blur was written to is free for its difference.
            yield k, (step, np.asarray(cv2.subtract(fine, wide, dst=fine), np.float32))
        picture, step, scale = _smaller(picture, 2), 2 * step, scale + count


def _smaller(picture: Picture, step: int) -> Picture:
    """Make a picture so many times smaller, by the means of its pixels."""
    if step == 1:
        return picture
    height, width = picture.shape
    size = width // step, height // step
    return as_picture(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def noise_gain(size: float) -> float:
    """White noise before the band over white noise after it, for a dot of the given size."""
    a, b = (0.8 * size) ** 2, (1.6 * size) ** 2
    power = 1 / (4 * np.pi) * (1 / a + 1 / b - 4 / (a + b))
    return float(1 / np.sqrt(power))


def with_grain(band: Grey, white: float) -> float:
    """Noise of a band-passed picture in which white noise would be so much.

    Noise with grain (compression, a soft sensor) passes more; the quieter half tells how much.
    """
    excess = 1.4826 * float(np.median(np.abs(band))) / max(white, 1e-9)
    return white * min(max(1.0, excess), 3.0)


_own = threading.local()


def scratch(name: str, shape: tuple[int, int]) -> Grey:
    """Return this thread's picture of a name to write on, shape (height, width).

    Frames of one size follow on each other: made anew for each, pictures would cost as much as the
    work on them.
    """
    kept: dict[str, Grey] = _own.__dict__
    count = shape[0] * shape[1]
    if name not in kept or kept[name].size < count:
        kept.pop(name, None)
        made = np.empty(count, np.float32)
        if made.nbytes > KEPT_BYTES:
            return made.reshape(shape)
        kept[name] = made
    return kept[name][:count].reshape(shape)


def blur(picture: Picture, sigma: float, into: Grey | None = None) -> Grey:
    """Blur by a Gaussian, px; of bytes no other picture is made in between."""
    taps = kernel(sigma)
    edge = cv2.BORDER_REFLECT
    return np.asarray(
        cv2.sepFilter2D(picture, cv2.CV_32F, taps, taps, dst=into, borderType=edge), np.float32
    )


@lru_cache(maxsize=64)
def kernel(sigma: float) -> Grey:
    """Gaussian weights of pixels on a line; kept, as a recording has one size of dot."""
    taps = cv2.getGaussianKernel(round(8 * sigma + 1) | 1, sigma, cv2.CV_32F)
    line = np.asarray(taps, np.float32).ravel()
    line.flags.writeable = False
    return line


def peak_disc(size: float) -> BoolArray:
    """Pixels round a peak that none of may be brighter: a mask, shape (side, side)."""
    reach = 2 * max(1, round(1.2 * size)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)), bool)
