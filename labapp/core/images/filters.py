"""Filters of pictures: Gaussian blurs in scratch memory, the noise that they leave, and spikes."""

from __future__ import annotations

import threading
from functools import lru_cache

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image, Picture
from labapp.core.values import BoolArray, FloatArray, IntArray

NARROW, WIDE = 0.8, 1.6
"""Standard deviations of the two blurs whose difference is the band-pass, in dot sizes."""

LEAST_NOISE = 1e-3
"""Least noise, as a share of the brightest light, for frames without noise."""

SPIKE = 6.0
"""A spike exceeds the light that a dot could have by at least this many noise σ."""

DOUBTED, CERTAIN = 1.5, 6.0
"""Least ratio of a spike's fall of light to that of a dot: next to a certain spike or a suspect
peak, and elsewhere. The latter is large since speckle makes dots much sharper than Gaussians."""

SATURATED_AREA = 60.0
"""Connected saturated pixels hide dots if their area is larger, in squared dot sizes; that of a
saturated dot is a fifth of it."""

ROUND_PX2 = 0.25
"""Variance that downsampling and upsampling add, px² of the downsampled picture."""

LEAST_PX2 = 0.8
"""Least variance of a blur that is computed on a downsampled picture, px² of that picture."""

KEPT_BYTES = 2**23
"""Larger scratch pictures are not kept for the next frame."""


def noise_gain(size: float) -> float:
    """Standard deviation of white noise after the band-pass over that before, for a dot size."""
    a, b = (NARROW * size) ** 2, (WIDE * size) ** 2
    power = 1 / (4 * np.pi) * (1 / a + 1 / b - 4 / (a + b))
    return float(np.sqrt(power))


def saturated_light(picture: Image, size: float) -> BoolArray | None:
    """Return the pixels in saturated light larger than a dot, which hides dots; None if none is.

    Parameters
    ----------
    picture
        Grey levels, shape (height, width).
    size
        Dot size, px.

    Returns
    -------
    BoolArray or None
        Shape (height, width).
    """
    at_most, least = picture == picture.max(), SATURATED_AREA * size**2
    if not least < np.count_nonzero(at_most) < at_most.size:  # a blank picture is not saturated
        return None
    _, part, found, _ = cv2.connectedComponentsWithStats(at_most.astype(np.uint8))
    is_large = found[:, cv2.CC_STAT_AREA] > least
    is_large[0] = False  # the other pixels
    return np.asarray(is_large[part]) if is_large.any() else None


_local = threading.local()


def scratch(name: str, shape: tuple[int, int]) -> Grey:
    """Return this thread's scratch picture of the given name, shape (height, width).

    It is reused for frames of the same size, since allocation would take as long as the filters.
    """
    buffers: dict[str, Grey] = _local.__dict__
    count = shape[0] * shape[1]
    if name not in buffers or buffers[name].size < count:
        buffers.pop(name, None)
        buffer = np.empty(count, np.float32)
        if buffer.nbytes > KEPT_BYTES:
            return buffer.reshape(shape)
        buffers[name] = buffer
    return buffers[name][:count].reshape(shape)


def blur(picture: Picture, sigma: float, into: Grey | None = None) -> Grey:
    """Blur by a Gaussian of the given standard deviation, px, without an intermediate copy."""
    taps = kernel(sigma)
    edge = cv2.BORDER_REFLECT
    return np.asarray(
        cv2.sepFilter2D(picture, cv2.CV_32F, taps, taps, dst=into, borderType=edge), np.float32
    )


@lru_cache(maxsize=64)
def kernel(sigma: float) -> Grey:
    """One-dimensional Gaussian kernel; cached, as the dot size is constant in a recording."""
    taps = cv2.getGaussianKernel(round(8 * sigma + 1) | 1, sigma, cv2.CV_32F)
    line = np.asarray(taps, np.float32).ravel()
    line.flags.writeable = False
    return line


def peak_disc(size: float) -> BoolArray:
    """Neighbourhood in which a peak must be the maximum: a disc mask, shape (side, side)."""
    reach = 2 * max(1, round(1.2 * size)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)), bool)


def without_spikes(
    picture: Picture, noise: Grey, size: float, suspects: tuple[IntArray, IntArray] | None = None
) -> Picture:
    """Replace pixels that are too bright for dots of a size, px, by their surroundings.

    These are certain spikes, spikes near one of the ``suspects`` pixels (columns and rows), and
    spikes connected to either. A picture without spikes is returned unchanged.
    """
    from labapp.core.images import band_pass_kernels

    least = LEAST_NOISE * float(picture.max())
    over = SPIKE * max(float(noise[::8, ::8].min()), least)
    reach = max(2, round(2.5 * size))
    (u, v), (times, beside) = band_pass_kernels.spikes(picture, over, size, DOUBTED, reach)
    begun = times > CERTAIN
    if suspects is not None:
        away = band_pass_kernels.two_nearest(pairs(u, v), pairs(*suspects))[0][:, 0]
        begun |= away <= 1.5 * size + 1.0
    if begun.any():
        sharp = picture[v, u] - beside > SPIKE * noise[v, u]
        u, v, beside, begun = u[sharp], v[sharp], beside[sharp], begun[sharp]
    if not begun.any():
        return picture
    hot = band_pass_kernels.connected_pixels(u, v, begun)
    result = picture.copy()
    result[v[hot], u[hot]] = np.rint(beside[hot]) if picture.dtype == np.uint8 else beside[hot]
    return result


def pairs(u: IntArray, v: IntArray) -> FloatArray:
    """Places (u, v) of pixels, shape (n, 2)."""
    return np.array([u, v], float).T


def widen(image: Grey, into: Grey, variance_px2: float) -> None:
    """Blur by a Gaussian of the given variance, px², computed on a downsampled picture."""
    cv2.resize(smaller_blurred(image, variance_px2), image.shape[::-1], dst=into)


def smaller_blurred(image: Grey, variance_px2: float) -> Grey:
    """Downsample an image and blur it by a Gaussian of the given variance, px² of the image.

    It is not downsampled if the blur is narrow or the picture's sides are not divisible.
    """
    (height, width), scale = image.shape, 1
    while (
        variance_px2 / (2 * scale) ** 2 - ROUND_PX2 > LEAST_PX2
        and height % (2 * scale) == width % (2 * scale) == 0
    ):
        scale *= 2
    shape, variance = (height // scale, width // scale), variance_px2 / scale**2
    small, blurred = (scratch(f"{name} {scale}", shape) for name in ("small", "small blurred"))
    if scale > 1:
        image = np.asarray(cv2.resize(image, shape[::-1], small, 0, 0, cv2.INTER_AREA), np.float32)
        variance -= ROUND_PX2
    return blur(image, float(np.sqrt(variance)), blurred)
