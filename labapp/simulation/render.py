"""Render what the camera sees: reflected dots on the imaging plane, arc glow and noise (§3.2).

Grey, 8 bit, portrait like the dissertation's pictures, of low contrast. The pictures are made to
be measured, not to be admired: every dot's true centre is known to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from labapp.core.values import BoolArray, FloatArray, freeze
from labapp.simulation.forward import Reflections

GreyImage = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class CameraView:
    """Where the camera sees the imaging plane: O′ and one point on each axis, and the picture.

    The points are those of the set-up file's ``image_calibration``, so that it can be filled in
    from here. The camera stands far off and square to the plane: the map is affine.

    Parameters
    ----------
    origin_px, x_axis_px, z_axis_px
        (u, v) of O′, of a point on O′X′ and of a point on O′Z′, px.
    x_axis_mm, z_axis_mm
        X′ of the former, Z′ of the latter, mm.
    width_px, height_px
        Size of the picture.
    """

    origin_px: tuple[float, float]
    x_axis_px: tuple[float, float]
    x_axis_mm: float
    z_axis_px: tuple[float, float]
    z_axis_mm: float
    width_px: int = 480
    height_px: int = 640

    @classmethod
    def rolled(
        cls,
        origin_px: tuple[float, float] = (44.0, 590.0),
        px_per_mm: float = 5.67,
        roll_deg: float = 0.0,
        x_axis_mm: float = 69.85,
        z_axis_mm: float = 31.75,
    ) -> CameraView:
        """Build the view of a camera that is turned about its axis, counter-clockwise."""
        roll = np.radians(roll_deg)
        x_step = px_per_mm * x_axis_mm * np.array([np.cos(roll), -np.sin(roll)])
        z_step = px_per_mm * z_axis_mm * np.array([-np.sin(roll), -np.cos(roll)])
        u, v = origin_px
        return cls(
            origin_px=origin_px,
            x_axis_px=(u + float(x_step[0]), v + float(x_step[1])),
            x_axis_mm=x_axis_mm,
            z_axis_px=(u + float(z_step[0]), v + float(z_step[1])),
            z_axis_mm=z_axis_mm,
        )

    @property
    def px_per_mm(self) -> FloatArray:
        """∂(u, v)/∂(X′, Z′), shape (2, 2), px/mm."""
        origin = np.array(self.origin_px)
        return np.stack(
            [
                (np.array(self.x_axis_px) - origin) / self.x_axis_mm,
                (np.array(self.z_axis_px) - origin) / self.z_axis_mm,
            ],
            axis=-1,
        )

    def to_image(self, plane_mm: FloatArray) -> FloatArray:
        """IPCS (X′, Z′), shape (…, 2), mm, to (u, v), shape (…, 2), px."""
        return np.asarray(plane_mm @ self.px_per_mm.T + np.array(self.origin_px))

    def to_plane(self, image_px: FloatArray) -> FloatArray:
        """(u, v), shape (…, 2), px, to IPCS (X′, Z′), shape (…, 2), mm."""
        return np.asarray((image_px - np.array(self.origin_px)) @ np.linalg.inv(self.px_per_mm).T)


@dataclass(frozen=True)
class Look:
    """What a frame looks like.

    Parameters
    ----------
    dot_peak
        Grey levels of a dot of middling brightness over the background.
    unevenness
        Standard deviation of the logarithm of the rays' brightness.
    beam_fraction
        Standard deviation of a beam's light over the angle between beams: a dot is as much wider
        as the pool spreads the pattern there.
    dot_floor_mm, dot_ceiling_mm
        Least and largest standard deviation of a dot on the plane, mm: what diffraction and
        scattering in the plane add, and where a spread dot stops being one.
    speckle
        Contrast of the speckle inside dots, 0 … 1.
    blur_px
        Standard deviation of the camera's blur, px.
    background, glow
        Grey levels of the dark plane, and of the arc's glow on it where it is brightest.
    read_noise, photon_noise
        Standard deviation in the dark, grey levels; variance per grey level of light.
    hot_pixels, false_dots
        How many there are.
    missing
        Probability that a dot which should show does not.
    """

    dot_peak: float = 55.0
    unevenness: float = 0.22
    beam_fraction: float = 0.045
    dot_floor_mm: float = 0.28
    dot_ceiling_mm: float = 0.55
    speckle: float = 0.35
    blur_px: float = 0.8
    background: float = 18.0
    glow: float = 18.0
    read_noise: float = 1.2
    photon_noise: float = 0.08
    hot_pixels: int = 0
    false_dots: int = 0
    missing: float = 0.0


@dataclass(frozen=True)
class Frame:
    """A rendered frame and what is in it.

    Parameters
    ----------
    image
        Grey levels, shape (height, width).
    dot_px
        (u, v) of each ray's dot, in the picture or not, shape (rows, columns, 2), px; NaN where
        the ray makes none.
    shown
        Rays whose dot was drawn with its centre in the picture, shape (rows, columns).
    """

    image: GreyImage
    dot_px: FloatArray
    shown: BoolArray

    def __post_init__(self) -> None:
        freeze(self)


def ray_brightness(
    shape: tuple[int, ...], unevenness: float, rng: np.random.Generator
) -> FloatArray:
    """Draw the brightness of every ray relative to the middling one; a lens keeps its own."""
    return np.exp(rng.normal(0.0, unevenness, shape))


def render(
    reflections: Reflections,
    view: CameraView,
    look: Look,
    rng: np.random.Generator,
    brightness: FloatArray | None = None,
) -> Frame:
    """Render one frame.

    Parameters
    ----------
    reflections
        What the forward model gave.
    view, look
        Where the camera sees the plane, and what the frame looks like.
    rng
        Source of everything that is random.
    brightness
        Brightness of every ray, shape (rows, columns), from `ray_brightness`; None draws it
        anew. A video passes the same to every frame.
    """
    dot_px = view.to_image(reflections.plane_mm)
    inside = ((dot_px >= -0.5) & (dot_px < (view.width_px - 0.5, view.height_px - 0.5))).all(-1)
    shown = reflections.visible & inside & (rng.random(inside.shape) >= look.missing)
    if brightness is None:
        brightness = ray_brightness(inside.shape, look.unevenness, rng)
    centers = [dot_px[shown]]
    spreads = [_dot_covariance_px(reflections, view, look)[shown]]
    peaks = [look.dot_peak * brightness[shown]]
    if look.false_dots:
        size = np.array([view.width_px, view.height_px])
        round_px = (look.dot_floor_mm * np.sqrt(abs(np.linalg.det(view.px_per_mm)))) ** 2
        centers.append(rng.random((look.false_dots, 2)) * size)
        spreads.append(np.tile(round_px * np.eye(2), (look.false_dots, 1, 1)))
        peaks.append(look.dot_peak * rng.uniform(0.3, 0.9, look.false_dots))
    shape = (view.height_px, view.width_px)
    dots = _draw(shape, *(np.concatenate(part) for part in (centers, spreads, peaks)))
    light = gaussian_filter(dots * _speckle(shape, look.speckle, rng), look.blur_px)
    return Frame(_expose(light + _glow(shape, look), look, rng), dot_px, shown)


def _dot_covariance_px(reflections: Reflections, view: CameraView, look: Look) -> FloatArray:
    """Second moments of each dot's light, shape (rows, columns, 2, 2), px².

    A beam's round profile is spread like the pattern is: by the derivative of the dot's place
    with respect to the ray's number, taken from neighbouring dots.
    """
    dots = np.where(reflections.hit[..., None], reflections.plane_mm, np.nan)
    spread = np.stack([_step_to_neighbours(dots, axis) for axis in (0, 1)], axis=-1)
    stretch, size, _ = np.linalg.svd(look.beam_fraction * np.nan_to_num(spread))
    size = np.clip(np.hypot(size, look.dot_floor_mm), None, look.dot_ceiling_mm)
    to_image = view.px_per_mm @ (stretch * size[..., None, :])
    return np.asarray(to_image @ np.swapaxes(to_image, -1, -2))


def _step_to_neighbours(dots: FloatArray, axis: int) -> FloatArray:
    """Mean step from the dot before and to the dot after, NaN where there is neither."""
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


def _speckle(shape: tuple[int, int], contrast: float, rng: np.random.Generator) -> FloatArray:
    """Fine-grained field of mean 1 and the given contrast: fully grown speckle over a constant."""
    grain_px = 0.7
    wave = [gaussian_filter(rng.normal(size=shape), grain_px) for _ in range(2)]
    intensity = wave[0] ** 2 + wave[1] ** 2
    return np.asarray(1 + contrast * (intensity / intensity.mean() - 1))


def _glow(shape: tuple[int, int], look: Look) -> FloatArray:
    """Light of the plane itself: dark, with the arc's glow broad and from below."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    across = (u - 0.55 * shape[1]) / (0.7 * shape[1])
    upward = (v - 1.05 * shape[0]) / (0.55 * shape[0])
    return np.asarray(look.background + look.glow * np.exp(-(across**2 + upward**2) / 2))


def _expose(light: FloatArray, look: Look, rng: np.random.Generator) -> GreyImage:
    """Add photon and read noise and hot pixels, and round to grey levels."""
    variance = look.read_noise**2 + look.photon_noise * np.maximum(light, 0)
    seen = light + np.sqrt(variance) * rng.normal(size=light.shape)
    hot = rng.integers(0, light.size, look.hot_pixels)
    seen.flat[hot] += rng.uniform(40, 200, look.hot_pixels)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)
