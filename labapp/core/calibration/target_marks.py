"""Detection of the three marks of the imaging plane, a dot and two bars, in a picture (§5.1.2).

The steps of the dissertation: segmentation, median filter, dilation until three objects are left,
thinning. `plane_calibration` measures the marks and checks them against the design.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.values import BoolArray, CannotMeasure, FloatArray, ReadOnlyArrays, robust_sigma

ColourOrGrey = npt.NDArray[Any]
EightBit = npt.NDArray[np.uint8]

MEDIAN_PX, DILATIONS = 7, 12
"""Side of the median filter, and largest number of dilations by 3 × 3, in a picture of 640 px; both
are scaled with the picture."""

SPECK_FRACTION = 0.02
"""An object smaller than this fraction of the largest is a speck."""

MOST_AROUND = 0.7
"""What surrounds the plane in the picture is darker than this share of the plane's light."""

LEAST_AROUND = 0.04
"""A smaller share of the picture may be a bar that runs out of it."""

DARKEST = 4
"""Levels of 0 to 255 below this one are taken for equal."""

MOST_ROLL_DEG = 30.0
"""Largest rotation of the bars from the horizontal and the vertical, degrees."""


class Refusal(Exception):
    """No calibration with one threshold: the stage that failed, and the reason."""

    def __init__(self, stage: int, reason: str) -> None:
        super().__init__(reason)
        self.stage = stage
        self.reason = reason


@dataclass(frozen=True)
class Mark(ReadOnlyArrays):
    """One of the three objects.

    Parameters
    ----------
    mask
        Its pixels after dilation, shape of the picture.
    center, direction
        (u, v) of its centre, px; unit vector of its longest extent. At first from all pixels, then
        from the thinned ones.
    length, width
        Extents along and across this direction, px.
    """

    mask: BoolArray
    center: FloatArray
    direction: FloatArray
    length: float
    width: float


def grey_levels(image: ColourOrGrey) -> FloatArray:
    """Return the grey levels of a picture without impulse noise, shape (rows, columns).

    Raises
    ------
    ValueError
        If the image is not a valid picture.
    CannotMeasure
        ``no-target`` if it is too small to contain a target.
    """
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] in (1, 3, 4):
        # Rec. 601 luminance of blue, green, red, as in OpenCV.
        weights = np.array([0.114, 0.587, 0.299]) if image.shape[2] > 1 else np.ones(1)
        image = image[..., : len(weights)].astype(np.float64) @ weights
    if image.ndim != 2:
        raise ValueError(f"a picture has shape (rows, columns[, channels]), not {image.shape}")
    grey = image.astype(np.float64)
    if not np.isfinite(grey).all():
        raise ValueError("a picture holds finite grey levels only")
    if min(grey.shape) < 60:
        raise CannotMeasure(
            "no-target", f"A picture of {grey.shape[1]} × {grey.shape[0]} px is too small."
        )
    # Impulse noise (Eq. 5-2) would bias sub-pixel positions; the filter keeps straight edges.
    return np.asarray(cv2.medianBlur(grey.astype(np.float32), 3), np.float64)


def levelled(grey: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Background light of the plane, and the fraction missing at each pixel; both shaped as given.

    The background is the median over a window of which any mark fills less than half. What is dark
    around a plane that does not fill the picture would darken the background of the marks near its
    edge: it is left out, and a second pair has it, as it may be a part of the plane.
    """
    height, width = grey.shape
    factor = max(2, max(height, width) // 160)
    small = cv2.resize(
        grey, (max(1, width // factor), max(1, height // factor)), interpolation=cv2.INTER_AREA
    )
    low, high = float(small.min()), float(small.max())
    if high - low < 1e-9:
        yield grey, np.zeros_like(grey)
        return
    eight_bit = np.round((small - low) / (high - low) * 255.0).astype(np.uint8)
    around = _around_plane(eight_bit, small)
    for outside in (around, None) if around.any() else (None,):
        plane = eight_bit if outside is None else _filled(eight_bit, outside)
        background = low + (high - low) / 255.0 * cv2.resize(
            _background(plane), (width, height), interpolation=cv2.INTER_LINEAR
        )
        background = np.maximum(background, 1e-3 * high)
        darkness = 1.0 - grey / background
        if outside is not None:
            enlarged = cv2.resize(outside, (width, height), interpolation=cv2.INTER_NEAREST)
            darkness[enlarged > 0] = 0.0
        yield background, darkness


def _background(levels: EightBit) -> FloatArray:
    window = _odd(max(levels.shape) / 7.0)
    median = cv2.medianBlur(levels, window).astype(np.float64)
    return np.asarray(cv2.GaussianBlur(median, (0, 0), window / 6.0), np.float64)


def _filled(levels: EightBit, outside: EightBit) -> EightBit:
    """Replace the masked part by levels like those beside it."""
    return np.asarray(cv2.inpaint(levels, outside, 3.0, cv2.INPAINT_TELEA), np.uint8)


def _around_plane(levels: EightBit, grey: npt.NDArray[Any]) -> EightBit:
    """Return a mask of what is dark and runs out of the picture, with the blur of its edge."""
    # Uneven light multiplies: the logarithms of plane and bench stay apart.
    log = np.log(np.arange(256).clip(DARKEST) / DARKEST)
    log_levels = np.round(log / log[-1] * 255.0).astype(np.uint8)[levels]
    _, dark = cv2.threshold(log_levels, 0, 1, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    if np.mean(grey[dark > 0]) > MOST_AROUND * np.mean(grey[dark == 0]):
        return np.zeros_like(levels)
    _, labels = cv2.connectedComponents(np.asarray(dark, np.uint8), connectivity=4)
    at_edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    around = np.isin(labels, at_edge[at_edge > 0]).astype(np.uint8)
    if np.mean(around) < LEAST_AROUND:
        return np.zeros_like(levels)
    return np.asarray(cv2.dilate(around, np.ones((5, 5), np.uint8)), np.uint8)


def segmented(darkness: FloatArray) -> list[tuple[float, EightBit]]:
    """Return binary pictures to try, the dissertation's filter first (Eq. 5-1, 5-3).

    Parameters
    ----------
    darkness
        Missing fraction of the light, shape (rows, columns).

    Returns
    -------
    list
        (threshold of the missing fraction; picture of 0 and 1).
    """
    scale = max(darkness.shape) / 640.0
    median = _odd(MEDIAN_PX * scale)
    smooth = np.asarray(cv2.GaussianBlur(darkness, (0, 0), max(scale, 0.5)), np.float64)
    binaries = [(level, (smooth > level).astype(np.uint8)) for level in _levels(smooth)]
    # The dissertation's filter first; half its size for thin bars that it would remove.
    return [
        (level, _binary_median(binary, side))
        for side in dict.fromkeys((median, _odd(median / 2.0)))
        for level, binary in binaries
    ]


def _binary_median(binary: EightBit, side: int) -> npt.NDArray[np.uint8]:
    """Return what `cv2.medianBlur` does for a picture of 0 and 1, many times as fast: a count."""
    count = cv2.boxFilter(
        binary, cv2.CV_16U, (side, side), normalize=False, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(2 * count > side * side, np.uint8)


def _levels(darkness: FloatArray) -> list[float]:
    """Thresholds to try: Otsu's method, the triangle method, then fixed shares of the darkness."""
    low, high = 0.0, float(np.quantile(darkness, 0.998))
    noise = robust_sigma(darkness)
    if high <= 3.0 * noise or high < 1e-6:
        return []
    eight_bit = np.clip(np.round((darkness - low) / (high - low) * 255.0), 0, 255)
    named = [
        low + (high - low) * cv2.threshold(eight_bit.astype(np.uint8), 0, 255, kind)[0] / 255.0
        for kind in (cv2.THRESH_OTSU, cv2.THRESH_TRIANGLE)
    ]
    steps = [part * high for part in (0.5, 0.4, 0.6, 0.3, 0.7, 0.2)]
    return [float(level) for level in named + steps if level > 2.0 * noise]


def three_marks(binary: EightBit) -> tuple[Mark, Mark, Mark]:
    """Return the dot, the bar on O′X′ and the bar on O′Z′ in a binary picture.

    Raises
    ------
    Refusal
        If the picture does not contain exactly these three.
    """
    labels, touching = _three_objects(binary)
    marks = [_mark(labels == label) for label in (1, 2, 3)]
    dots = [mark for mark in marks if mark.length < 1.8 * mark.width]
    bars = [mark for mark in marks if mark.length > 3.0 * mark.width]
    note = " One object runs out of the picture." if touching else ""
    if not dots:
        raise Refusal(2, "The dot of O′ was not found: no mark is as wide as long." + note)
    if len(dots) > 1 or len(bars) != 2:
        raise Refusal(
            2, f"{len(bars)} bars of an axis were found beside the dot of O′, not 2." + note
        )
    tilt = [abs(np.degrees(np.arctan2(bar.direction[1], bar.direction[0]))) for bar in bars]
    flat = [min(angle, 180.0 - angle) for angle in tilt]
    x_bar, z_bar = (bars[k] for k in np.argsort(flat))
    if min(flat) > MOST_ROLL_DEG or max(flat) < 90.0 - MOST_ROLL_DEG:
        raise Refusal(
            3,
            "The two bars are not one across and one upright: they are "
            f"{flat[0]:.0f}° and {flat[1]:.0f}° from the horizontal.",
        )
    (dot,) = dots
    if x_bar.center[0] < dot.center[0] or z_bar.center[1] > dot.center[1]:
        raise Refusal(
            3,
            "O′ is not at the lower left of its bars: the picture is mirrored or upside down, or "
            "something else dark is in it.",
        )
    return _thin(dot), _thin(x_bar), _thin(z_bar)


def _three_objects(binary: EightBit) -> tuple[npt.NDArray[np.int32], bool]:
    """Labels 1, 2, 3 of the objects, and whether another is cut by the picture's edge."""
    kept, touching = _without_specks(binary)
    square = np.ones((3, 3), np.uint8)
    count, labels = cv2.connectedComponents(kept, connectivity=8)
    for _ in range(round(DILATIONS * max(binary.shape) / 640.0)):
        if count <= 4:
            break
        kept = np.asarray(cv2.dilate(kept, square), np.uint8)
        count, labels = cv2.connectedComponents(kept, connectivity=8)
    if count != 4:
        note = ", and one runs out of the picture" if touching else ""
        raise Refusal(
            1 if count > 1 else 0,
            f"Three marks are expected (dot and two bars), {count - 1} were found{note}.",
        )
    return np.asarray(labels, np.int32), touching


def _without_specks(binary: EightBit) -> tuple[npt.NDArray[np.uint8], bool]:
    """Remove specks and objects at the edge; also return whether a large one touches the edge."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
    left, top, width, height, area = boxes[1:].T
    if area.size == 0:
        return binary, False
    rows, columns = binary.shape
    inside = (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows)
    sizeable = area >= SPECK_FRACTION * area[inside].max(initial=1)
    keep = np.concatenate([[False], inside & sizeable])
    return keep[labels].astype(np.uint8), bool((~inside & sizeable).any())


def _mark(mask: BoolArray) -> Mark:
    v, u = np.nonzero(mask)
    center = np.array([u.mean(), v.mean()])
    _, axes = np.linalg.eigh(np.cov(np.stack([u, v])) if len(u) > 1 else np.eye(2))
    direction = axes[:, 1]
    length = float(np.ptp(np.stack([u, v], -1) @ direction)) + 1.0
    return Mark(mask, center, direction, length, len(u) / length)


def _thin(mark: Mark) -> Mark:
    """Take centre and direction of the mark from its thinned pixels (Eq. 5-5, unrounded)."""
    v, u = np.nonzero(mark.mask)
    top, left = int(v.min()), int(u.min())
    line = _mark(thinned(mark.mask[top : v.max() + 1, left : u.max() + 1]))
    bar = line.length > 1.0
    return replace(
        mark,
        center=line.center + np.array([left, top]),
        direction=line.direction if bar else mark.direction,
    )


def thinned(mask: BoolArray) -> BoolArray:
    """Thin an object to lines of one pixel, until nothing changes (§5.1.2, step 3).

    Algorithm of Zhang and Suen, each pass on all pixels at once. OpenCV has thinning in its contrib
    modules only.

    Parameters
    ----------
    mask
        The object, shape (rows, columns).
    """
    image = np.pad(np.asarray(mask, bool), 1)
    changed = True
    while changed:
        changed = False
        for first in (True, False):
            around = [
                np.roll(image, shift, (0, 1))
                for shift in [(1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1)]
            ]  # p2 … p9: north, then clockwise
            count = np.sum(around, axis=0)
            begins = np.sum(
                [~a & b for a, b in zip(around, [*around[1:], around[0]], strict=True)], axis=0
            )
            north, _, east, _, south, _, west, _ = around
            if first:
                open_side = ~(north & east & south) & ~(east & south & west)
            else:
                open_side = ~(north & east & west) & ~(north & south & west)
            remove = image & (count >= 2) & (count <= 6) & (begins == 1) & open_side
            # The passes would delete a 2 × 2 square, which cannot be thinned further.
            if remove.any() and (image & ~remove).any():
                image = image & ~remove
                changed = True
    return np.asarray(image[1:-1, 1:-1])


def _odd(side: float) -> int:
    """Return the odd number nearest to a side, 3 at least."""
    return max(3, 2 * int(side / 2.0) + 1)
