"""Sub-pixel detection of ridges in a grey frame: Steger's detector of curvilinear structures.

C. Steger, "An unbiased detector of curvilinear structures", IEEE PAMI 20 (1998) 113-125. At each
pixel the Gaussian-smoothed frame is approximated by a parabola along the direction of strongest
curvature. Its maximum is a ridge point if it lies in the pixel. Points are linked to chains along
the ridge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays, robust_sigma

WITHIN_PX = 0.6
"""Largest distance of a ridge point from its pixel's centre along u and v: slightly above half."""

REMAP_LIMIT = 32766
"""Largest number of columns that `cv2.remap` accepts."""

FLANKS = 2.5
"""Distance from a ridge at which its background is read, in standard deviations of the smoothed
line."""

SCALE_PX = 2.0
"""Standard deviation of the smoothing Gaussian unless the lines' width is known, px: about that of
a line's light across it, and not below 1/√3 of it."""

SEED, FLOOR = 7.0, 3.0
"""Least ratio of the curvature across the ridge to its noise, for the first point of a chain and
for all its points."""


@dataclass(frozen=True)
class Ridges(ReadOnlyArrays):
    """Chains of ridge points; every array but ``starts`` has n rows.

    Parameters
    ----------
    image_px
        (u, v), shape (n, 2), px.
    strength
        Curvature across the ridge of the smoothed frame, grey levels/px², shape (n,).
    height
        Height of the smoothed frame's ridge over its background, grey levels, shape (n,).
    starts
        Start index of each of k chains, and n, shape (k + 1,).
    smooth
        The smoothed frame, shape (height, width).
    """

    image_px: FloatArray
    strength: FloatArray
    height: FloatArray
    starts: IntArray
    smooth: Grey


@lru_cache(maxsize=8)
def _derivative_kernels(scale_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sampled Gaussian and its first two derivatives, normalised to be exact for a parabola."""
    reach = int(np.ceil(4 * scale_px))
    x = np.arange(-reach, reach + 1.0)
    bell = np.exp(-(x**2) / (2 * scale_px**2))
    bell /= bell.sum()
    slope = x * bell / np.sum(x**2 * bell)  # correlated, not convolved: rises with x
    bend = (x**2 - np.sum(x**2 * bell)) * bell
    bend *= 2 / np.sum(x**2 * bend)
    return bell, slope, bend


def find_ridges(frame: Image, scale_px: float = SCALE_PX) -> Ridges:
    """Find bright ridges in a grey frame, shape (height, width), and link them to chains.

    ``scale_px`` is the standard deviation of the smoothing Gaussian.
    """
    from labapp.core.lines.detection import ridge_kernels

    picture = np.ascontiguousarray(frame, np.float32)
    bell, slope, bend = _derivative_kernels(scale_px)

    def filtered(along_u: FloatArray, along_v: FloatArray) -> Grey:
        return np.asarray(cv2.sepFilter2D(picture, cv2.CV_32F, along_u, along_v))

    smooth, uu = filtered(bell, bell), filtered(bend, bell)
    vv, uv = filtered(bell, bend), filtered(slope, slope)
    noise = robust_sigma(uu[::3, ::3] - np.median(uu[::3, ::3])) + 1e-9
    # Smaller eigenvalue of the Hessian: the strongest curvature of a maximum.
    half, root = (uu + vv) / 2, np.sqrt(((uu - vv) / 2) ** 2 + uv * uv)
    v, u = np.nonzero(half - root < -FLOOR * noise)
    h, r = half[v, u].astype(float), root[v, u].astype(float)
    strength = r - h
    # Unit vector across the ridge: the eigenvector of the eigenvalue half − root.
    angle = 0.5 * np.arctan2(2.0 * uv[v, u], (uu - vv)[v, u].astype(float)) + np.pi / 2
    across = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    du, dv = filtered(slope, bell)[v, u], filtered(bell, slope)[v, u]
    shift = (du * across[:, 0] + dv * across[:, 1]) / strength
    offset = shift[:, None] * across
    on = np.abs(offset).max(axis=-1, initial=0.0) <= WITHIN_PX
    pixel = np.ascontiguousarray(np.stack([u, v], axis=-1)[on].astype(np.int64))
    place, across, strength = pixel + offset[on], across[on], strength[on]
    index: Any = np.full(picture.shape, -1, np.int32)
    index[pixel[:, 1], pixel[:, 0]] = np.arange(len(pixel))
    order = np.argsort(-strength, kind="stable")
    seeds = int(np.sum(strength > SEED * noise))
    along = np.zeros((len(place) + 1, 2))
    along[:-1, 0], along[:-1, 1] = -across[:, 1], across[:, 0]
    chosen, starts = ridge_kernels.link(index, pixel, place, along, order, seeds)
    place, along, strength = place[chosen], along[chosen], strength[chosen]
    height = _height(smooth, place, along, scale_px)
    return Ridges(place, strength, height, starts, smooth)


def sampled(picture: Grey, place: FloatArray) -> Grey:
    """Interpolated grey levels at (u, v), shape (n, 2); outside, those of the edge; shape (n,)."""
    rows = -(-len(place) // REMAP_LIMIT)  # limit of cv2.remap
    at = np.resize(place, (rows, -(-len(place) // max(rows, 1)), 2)).astype(np.float32)
    light = cv2.remap(
        picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(light, np.float32).ravel()[: len(place)]


def _height(smooth: Grey, place: FloatArray, along: FloatArray, scale_px: float) -> FloatArray:
    """Height of a smoothed frame's ridges over the darker flank, shape (n,)."""
    reach = FLANKS * np.sqrt(2.0) * scale_px
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    if not len(place):
        return np.zeros(0)
    left, top, right = (sampled(smooth, place + side * reach * across) for side in (-1.0, 0.0, 1.0))
    # The darker flank, as a neighbouring line may lie on the other.
    return np.asarray(top - np.minimum(left, right), float)
