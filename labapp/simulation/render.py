"""Render camera frames: reflected dots on the imaging plane, arc glow and noise (§3.2).

The frames are grey and of low contrast, like the dissertation's pictures. Every dot's true centre
is known to rounding. Light is in grey levels of an 8-bit camera, regardless of the depth in which
the picture is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import Reflections

GreyImage = npt.NDArray[np.uint8]
Picture = npt.NDArray[np.uint8 | np.uint16]


@dataclass(frozen=True)
class Look:
    """Appearance of a frame."""

    dot_peak: float = 55.0
    """Grey levels of a dot of median brightness above the background."""
    unevenness: float = 0.22
    """Standard deviation of the logarithm of the rays' brightness."""
    beam_fraction: float = 0.045
    """Standard deviation of a beam's light as a fraction of the inter-beam angle. A dot is widened
    as much as the pool spreads the pattern there.
    """
    dot_floor_mm: float = 0.28
    dot_ceiling_mm: float = 0.55
    """Smallest and largest standard deviation of a dot on the plane, mm: the blur from diffraction
    and scattering in the plane, and the limit beyond which spread light is no longer a dot.
    """
    speckle: float = 0.35
    """Contrast of the speckle inside dots, 0 … 1."""
    blur_px: float = 0.8
    """Standard deviation of the camera's blur, px."""
    background: float = 18.0
    glow: float = 18.0
    """Grey levels of the dark plane, and of the arc's glow on it where it is brightest."""
    read_noise: float = 1.2
    photon_noise: float = 0.08
    """Standard deviation in darkness, grey levels; variance per grey level of light."""
    hot_pixels: int = 0
    false_dots: int = 0
    missing: float = 0.0
    """Probability that a dot which should be visible is missing."""
    full_scale: float = 255.0
    """Light at which a pixel saturates."""
    bits: int = 8
    """Depth of the picture: 255 is scaled to the largest value of this depth."""


@dataclass(frozen=True)
class RenderedFrame(ReadOnlyArrays):
    """A rendered frame and its dots."""

    image: Picture
    """Shape (height, width), 8 bit, or 16 if the look has more or exposures were added up."""
    dot_px: FloatArray
    """(u, v) of each ray's dot, in the picture or not, shape (rows, columns, 2), px: the mean
    position over the exposure if it moves; NaN if the ray has no dot.
    """
    shown: BoolArray
    """Rays whose dot was drawn with its centre in the picture for at least half of the exposure,
    shape (rows, columns).
    """


def ray_brightness(
    shape: tuple[int, ...], unevenness: float, rng: np.random.Generator
) -> FloatArray:
    """Draw the brightness of every ray relative to the median; it is fixed for a lens."""
    return np.exp(rng.normal(0.0, unevenness, shape))


def render(
    reflections: Reflections | Sequence[Reflections],
    view: CameraView,
    look: Look,
    rng: np.random.Generator,
    brightness: FloatArray | None = None,
) -> RenderedFrame:
    """Render one frame.

    Parameters
    ----------
    reflections
        Results of the forward model; for a moving pool, at evenly spaced times over the exposure.
    view, look
        The camera's view of the plane, and the appearance of the frame.
    rng
        Source of all random numbers.
    brightness
        Brightness of every ray, shape (rows, columns), from `ray_brightness`. None draws it anew.
        All frames of a video have the same.
    """
    moments = [reflections] if isinstance(reflections, Reflections) else list(reflections)
    places = np.stack([view.to_image(moment.plane_mm) for moment in moments])
    inside = ((places >= -0.5) & (places < (view.width_px - 0.5, view.height_px - 0.5))).all(-1)
    drawn = np.stack([moment.visible for moment in moments]) & inside
    drawn &= rng.random(inside.shape[1:]) >= look.missing
    if brightness is None:
        brightness = ray_brightness(inside.shape[1:], look.unevenness, rng)
    spread = np.stack([_dot_covariance_px(moment, view, look) for moment in moments])
    centers, spreads = [places[drawn]], [spread[drawn]]
    peaks = [np.broadcast_to(look.dot_peak * brightness / len(moments), drawn.shape)[drawn]]
    if look.false_dots:
        size = np.array([view.width_px, view.height_px])
        round_px = (look.dot_floor_mm * np.sqrt(abs(np.linalg.det(view.px_per_mm)))) ** 2
        centers.append(rng.random((look.false_dots, 2)) * size)
        spreads.append(np.tile(round_px * np.eye(2), (look.false_dots, 1, 1)))
        peaks.append(look.dot_peak * rng.uniform(0.3, 0.9, look.false_dots))
    shape = (view.height_px, view.width_px)
    dots = _draw(shape, *(np.concatenate(part) for part in (centers, spreads, peaks)))
    light = gaussian_filter(dots * speckle_field(shape, look.speckle, rng), look.blur_px)
    image = expose(light + arc_glow(shape, look), look, rng)
    return RenderedFrame(image, _middle(places, drawn), np.asarray(drawn.mean(axis=0) >= 1 / 2))


def _middle(places: FloatArray, drawn: BoolArray) -> FloatArray:
    """Mean of each dot's positions, (moments, …, 2): of the drawn ones, or of all if none is."""
    counted = np.where(drawn.any(axis=0), drawn, np.isfinite(places[..., 0]))
    total = np.where(counted[..., None], places, 0.0).sum(axis=0)
    count = counted.sum(axis=0)[..., None]
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _dot_covariance_px(reflections: Reflections, view: CameraView, look: Look) -> FloatArray:
    """Second moments of each dot's light, shape (rows, columns, 2, 2), px².

    A beam's round profile is spread like the pattern: by the derivative of the dot's position with
    respect to the ray's number, taken from neighbouring dots.
    """
    dots = np.where(reflections.hit[..., None], reflections.plane_mm, np.nan)
    spread = np.stack([_step_to_neighbours(dots, axis) for axis in (0, 1)], axis=-1)
    stretch, size, _ = np.linalg.svd(look.beam_fraction * np.nan_to_num(spread))
    size = np.clip(np.hypot(size, look.dot_floor_mm), None, look.dot_ceiling_mm)
    to_image = view.px_per_mm @ (stretch * size[..., None, :])
    return np.asarray(to_image @ np.swapaxes(to_image, -1, -2))


def _step_to_neighbours(dots: FloatArray, axis: int) -> FloatArray:
    """Mean step from the previous and to the next dot, NaN where there is neither."""
    step = np.diff(dots, axis=axis)
    edge = np.full_like(np.take(dots, [0], axis=axis), np.nan)
    both = np.stack([np.concatenate(p, axis=axis) for p in ((edge, step), (step, edge))])
    known = np.isfinite(both)
    count = known.sum(axis=0)
    total = np.where(known, both, 0.0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _draw(
    shape: tuple[int, int], centers: FloatArray, covariances: FloatArray, peaks: FloatArray
) -> FloatArray:
    """Sum of Gaussian dots, each drawn as far as five standard deviations."""
    image = np.zeros(shape)
    for (u, v), covariance, peak in zip(centers, covariances, peaks, strict=True):
        reach = int(np.ceil(5 * np.sqrt(covariance.diagonal().max())))
        left, right = max(round(u) - reach, 0), min(round(u) + reach + 1, shape[1])
        top, bottom = max(round(v) - reach, 0), min(round(v) + reach + 1, shape[0])
        du, dv = np.arange(left, right) - u, (np.arange(top, bottom) - v)[:, None]
        inverse = np.linalg.inv(covariance)
        distance = inverse[0, 0] * du**2 + 2 * inverse[0, 1] * du * dv + inverse[1, 1] * dv**2
        image[top:bottom, left:right] += peak * np.exp(-distance / 2)
    return image


def speckle_field(shape: tuple[int, int], contrast: float, rng: np.random.Generator) -> FloatArray:
    """Fine-grained field of mean 1 and the given contrast: developed speckle plus a constant."""
    grain_px = 0.7
    wave = [gaussian_filter(rng.normal(size=shape), grain_px) for _ in range(2)]
    intensity = wave[0] ** 2 + wave[1] ** 2
    return np.asarray(1 + contrast * (intensity / intensity.mean() - 1))


def arc_glow(shape: tuple[int, int], look: Look) -> FloatArray:
    """Light of the plane itself: dark, with a broad glow of the arc from below."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    across = (u - 0.55 * shape[1]) / (0.7 * shape[1])
    upward = (v - 1.05 * shape[0]) / (0.55 * shape[0])
    return np.asarray(look.background + look.glow * np.exp(-(across**2 + upward**2) / 2))


def expose(light: FloatArray, look: Look, rng: np.random.Generator) -> Picture:
    """Add photon noise, read noise and hot pixels, clip at saturation, and round."""
    variance = look.read_noise**2 + look.photon_noise * np.maximum(light, 0)
    seen = light + np.sqrt(variance) * rng.normal(size=light.shape)
    hot = rng.integers(0, light.size, look.hot_pixels)
    seen.flat[hot] += rng.uniform(40, 200, look.hot_pixels)
    white = 2**look.bits - 1
    levels = np.rint(np.clip(seen, 0, min(look.full_scale, 255)) * (white / 255))
    return np.asarray(levels, np.uint8 if look.bits == 8 else np.uint16)
