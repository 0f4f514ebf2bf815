"""Detection of the reflected lines of a frame: joined and smoothed ridges, with their ends.

`numbering` distinguishes the pattern's own lines from the diffraction fringes beside them (§3.2.1,
Fig. 3-9).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image
from labapp.core.lines.detection.chains import (
    END_WIDTHS,
    LEAST_FOLDED,
    is_upright,
    join_chains,
    spread_of,
)
from labapp.core.lines.detection.gathered import gathered_spots
from labapp.core.lines.detection.ridges import SCALE_PX, Ridges, find_ridges
from labapp.core.lines.detection.smooth_path import SmoothPath
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays, robust_sigma

END_PX, END_REACH_PX = 10.0, 30.0
"""Length over which the light near a line's end is averaged (median), and length beyond the ridge
within which the end is searched, px."""


GAP_SHARE = 0.4
"""A line has a gap where its ridge falls below this share of its median strength."""


STRIP_WIDTHS = 2.6
"""Half width of the strip along a line in which its light is read, in standard deviations of the
light; the line's middle is unknown where the strip extends beyond the picture."""

CENTER_ROUNDS = 4
"""Iterations of the window that follows the middle of a line's light."""

BEND_SHARE, LEAST_WINDOW_PX, WIDER = 0.4, 3.0, 1.8
"""In the second pass a line's light is averaged over this share of its radius of curvature, at
least this many pixels and at most this multiple of the first pass's length."""

PATH_SMOOTHER = 1.8
"""Ratio of the smoothing length of the path to the length over which light is averaged along it."""

SPOT_WIDTHS = 6.0
"""A line shorter than this many times its width is a spot without a direction."""

SPECK_WIDTHS, SPECK_LIGHT = 2.0, 0.15
"""A line within this many of its widths of another, with at most this share of its total light, is
a speck on the flank of the other."""

GATHERED_WIDTHS, GATHERED_LIGHT = (14.0, 36.0), 0.15
"""Largest extent across and up, in line widths, of lines that the pool gathers to spots, and least
share of the brightest line's light of a line that counts."""

GLOW_ROUNDS = 5
"""Iterations of the fit of the background light."""

GRAIN_COLUMNS = 3.3
"""Correlation length of the speckle along a line, pixel columns."""

LEAST_SCALE_PX, MOST_SCALE_PX = 1.6, 4.0
"""Limits of the smoothing in the second pass, which is the measured width of the lines, px."""

OBLIQUE_PX = 3.5
"""The path of a wider line is extrapolated to its ends from where the oblique edge of the pool does
not displace it, px."""

COARSER, LEAST_WIDE = 2.0, 4.0
"""Ratio of the scale of wide lines to that of the others, which break wide lines into pieces; and
the length of the shortest chain of a wide line, in multiples of its scale."""

WIDE, BENEATH = 1.33, 2.0
"""Least spread of a wide line's smoothed light, in multiples of its scale. Its ridge, normalised by
the scale to the power of 3/2 (T. Lindeberg, Int. J. Computer Vision 30 (1998) 117-154), is also
stronger than those of the finer scale within this many coarser scales of it: it is not a group of
narrow lines."""

LEAST_PX = 7.0
"""Length of the shortest chain of ridge points and of the shortest line, px."""

SMOOTH_PX, SMOOTH_WIDTHS, SMOOTH_SHARE = 6.0, (3.0, 4.5), 0.05
"""Standard deviation of the Gaussian weights that smooth a line along its length: at least this
many px; otherwise a share of its length, limited to the two multiples of its width."""

EDGE_PX = 6.0
"""A line that ends within this distance of the picture's edge is cut off there, px; the distance is
larger for a wide line."""


@dataclass(frozen=True)
class LightLine(ReadOnlyArrays):
    """A reflected line, from its left end to its right end.

    Parameters
    ----------
    image_px
        (u, v) of its ridge at about every pixel, without gaps, shape (n, 2), px.
    tangent
        Unit vector along it, shape (n, 2).
    sigma_px
        Standard uncertainty of the ridge across the line, shape (n,), px.
    curvature
        Of the ridge, 1/px, shape (n,); positive where it turns to the right (clockwise as seen).
    ends_px
        (u, v) where its light falls to half, shape (2, 2), px.
    cut
        Whether each end is cut off and not a true end of the line, shape (2,).
    width_px
        Standard deviation of its light across it, px.
    light
        Light per length: integral across the line, median over its points, grey levels·px.
    gap_px
        Length of its longest gap, px.
    smoothed_px
        Standard deviation of the Gaussian weights that smooth it along its length, px.
    """

    image_px: FloatArray
    tangent: FloatArray
    sigma_px: FloatArray
    curvature: FloatArray
    ends_px: FloatArray
    cut: BoolArray
    width_px: float
    light: float
    gap_px: float
    smoothed_px: float

    @property
    def length_px(self) -> float:
        """Length along the ridge, px."""
        return float(np.linalg.norm(np.diff(self.image_px, axis=0), axis=-1).sum())

    @property
    def folded(self) -> bool:
        """Whether the line is folded onto itself or gathered to a spot (a caustic)."""
        return is_upright(self.image_px) or self.length_px < SPOT_WIDTHS * self.width_px


def find_lines(frame: Image) -> tuple[LightLine, ...]:
    """Find all bright lines in a grey frame, shape (height, width), including fringes."""
    ridges = find_ridges(frame)
    long = _long_chains(ridges)
    if not len(long):
        return ()
    of_long = np.concatenate([np.arange(*ridges.starts[k : k + 2]) for k in long])
    ratio = ridges.height[of_long] / ridges.strength[of_long]
    width = float(np.sqrt(max(np.median(ratio) - SCALE_PX**2, 0.0)))
    scale = float(np.clip(width, LEAST_SCALE_PX, MOST_SCALE_PX))
    ridges = find_ridges(frame, scale)
    long = _long_chains(ridges)
    coarse = find_ridges(frame, COARSER * scale)
    wide = _wide_chains(coarse, ridges, long, COARSER * scale)
    picture = np.ascontiguousarray(frame, np.float32)
    picture = picture - glow(picture)
    found = [
        _line(picture, of, points, at)
        for of, chosen, at in (
            (ridges, _outside(ridges, long, coarse, wide, COARSER * scale), scale),
            (coarse, wide, COARSER * scale),
        )
        for points in join_chains(of, chosen, at)
    ]
    lines = tuple(one for one in found if one is not None)
    if _is_gathered(lines):
        return _spots(picture, lines)
    return _without_specks(lines)


def _bright(lines: tuple[LightLine, ...]) -> list[LightLine]:
    """Return the lines with at least a share of the brightest line's light."""
    total = np.array([one.light * one.length_px for one in lines])
    return [
        one for one, light in zip(lines, total, strict=True) if light > GATHERED_LIGHT * max(total)
    ]


def _is_gathered(lines: tuple[LightLine, ...]) -> bool:
    """Whether all bright lines are in a small column."""
    if not lines:
        return False
    bright = _bright(lines)
    extent = np.ptp(np.concatenate([one.image_px for one in bright]), axis=0)
    width = float(np.median([one.width_px for one in bright]))
    return bool((extent < np.array(GATHERED_WIDTHS) * width).all())


def _spots(picture: Grey, lines: tuple[LightLine, ...]) -> tuple[LightLine, ...]:
    """Return folded lines at the spots of a column of light."""
    bright = _bright(lines)
    width = float(np.median([one.width_px for one in bright]))
    column = np.concatenate([one.image_px for one in bright])
    side = np.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    return tuple(
        LightLine(
            image_px=place + side,
            tangent=np.tile([1.0, 0.0], (3, 1)),
            sigma_px=np.full(3, width),
            curvature=np.zeros(3),
            ends_px=place + width * side[[0, 2]],
            cut=np.zeros(2, bool),
            width_px=width,
            light=light / 2.0,
            gap_px=0.0,
            smoothed_px=0.0,
        )
        for place, light in gathered_spots(picture, column, width)
    )


def _without_specks(lines: tuple[LightLine, ...]) -> tuple[LightLine, ...]:
    """Remove specks on the flank of a brighter line."""

    def is_speck(one: LightLine, other: LightLine) -> bool:
        if one.length_px * one.light > SPECK_LIGHT * other.length_px * other.light:
            return False
        away = np.linalg.norm(one.image_px[:, None] - other.image_px, axis=-1)
        return bool(away.min() < SPECK_WIDTHS * one.width_px)

    return tuple(one for one in lines if not any(is_speck(one, other) for other in lines))


def glow(picture: Grey) -> Grey:
    """Background light of a picture: a cubic in u and v, fitted without the bright lines.

    Its gradient would bias the middle of a line's light to the brighter side.
    """
    height, width = picture.shape
    size = max(width // 8, 8), max(height // 8, 8)
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    u, v = np.meshgrid(*(np.linspace(-1, 1, count) for count in size))
    terms = np.stack(
        [u.ravel() ** i * v.ravel() ** j for i in range(4) for j in range(4 - i)], axis=-1
    )
    light, weights = small.ravel().astype(float), np.ones(small.size)
    for _ in range(GLOW_ROUNDS):
        fitted = np.linalg.lstsq(terms * weights[:, None], light * weights, rcond=None)[0]
        off = light - terms @ fitted
        limit = 3.0 * robust_sigma(off) + 1e-6
        weights = (off < limit).astype(float)
    smooth = (terms @ fitted).reshape(small.shape).astype(np.float32)
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR))


def _long_chains(ridges: Ridges) -> IntArray:
    return np.flatnonzero(np.diff(ridges.starts) >= LEAST_PX)


# --- wide lines -----------------------------------------------------------------------------------


def _wide_chains(coarse: Ridges, fine: Ridges, long: IntArray, scale: float) -> IntArray:
    """Indices of the coarse chains that are wide lines, and not a group of narrow ones."""
    place, strength = (_of_chains(fine, each, long) for each in (fine.image_px, fine.strength))
    wide = []
    for k in np.flatnonzero(np.diff(coarse.starts) >= LEAST_WIDE * scale):
        points = np.arange(*coarse.starts[k : k + 2])
        near = _distance(place, coarse.image_px[points]) < BENEATH * scale
        least = float(np.median(strength[near])) if near.any() else 0.0
        is_stronger = COARSER**1.5 * np.median(coarse.strength[points]) > least
        if is_stronger and spread_of(coarse, points) > WIDE * scale:
            wide.append(k)
    return np.array(wide, np.int64)


def _outside(
    fine: Ridges, long: IntArray, coarse: Ridges, wide: IntArray, scale: float
) -> IntArray:
    """Indices of the long fine chains that are not pieces of wide lines."""
    place = _of_chains(coarse, coarse.image_px, wide)
    if not len(place):
        return long
    beneath = [
        np.median(_distance(fine.image_px[slice(*fine.starts[k : k + 2])], place)) < BENEATH * scale
        for k in long
    ]
    return np.asarray(long[~np.array(beneath, bool)], np.int64)


def _of_chains(ridges: Ridges, values: FloatArray, chosen: IntArray) -> FloatArray:
    """Values of the points of some chains."""
    parts = [values[slice(*ridges.starts[k : k + 2])] for k in chosen]
    return np.concatenate([values[:0], *parts])


def _distance(place: FloatArray, others: FloatArray) -> FloatArray:
    """Distance of points, shape (n, 2), from the nearest of others, shape (m, 2), shape (n,)."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(place)[0], np.float64)


# --- a line ---------------------------------------------------------------------------------------


def _line(picture: Grey, ridges: Ridges, points: IntArray, scale: float) -> LightLine | None:
    """Measure a line of ordered ridge points; None if it is too short."""
    strength = ridges.strength[points]
    points = points[strength > GAP_SHARE * np.median(strength)]
    place, strength = ridges.image_px[points], ridges.strength[points]
    spread2 = spread_of(ridges, points) ** 2
    least = LEAST_FOLDED / 2 if is_upright(place) else LEAST_PX
    if len(points) < least:
        return None
    first, last = place[0], place[-1]
    if first[1] > last[1] if is_upright(place) else first[0] > last[0]:
        points, place = points[::-1], place[::-1]
    width = float(np.sqrt(max(spread2 - scale**2, (0.75 * scale) ** 2)))
    low, high = (each * width for each in SMOOTH_WIDTHS)
    wanted = float(np.clip(SMOOTH_SHARE * len(place), low, high))
    smooth_px = min(max(wanted, SMOOTH_PX), len(place) / 8)
    # Fluctuations of the path would remain in the line: the path is smoothed more.
    path = SmoothPath.through(place, PATH_SMOOTHER * smooth_px)
    seen = path.seen & _within(path.place, STRIP_WIDTHS * width, picture)
    if seen.sum() < least:
        return None
    path = replace(path, seen=seen)
    window: FloatArray = np.full(len(path.place), smooth_px)
    for _ in range(2):
        off, sigma = _centers(picture, path, width, window)
        # Blur moves the ridge of a curved line to the inner side by σ²κ/2, if its radius exceeds σ.
        bend = np.clip(path.curvature, -1 / width, 1 / width)
        path = path.moved(off - bend * width**2 / 2, SMOOTH_PX)
        # The second pass corrects the bias of smoothing at bends with a narrower window.
        radius = 1.0 / (np.abs(path.curvature) + 1e-9)
        window = np.clip(BEND_SHARE * radius, LEAST_WINDOW_PX, WIDER * smooth_px)
    light = float(np.median(strength) * spread2**1.5 * np.sqrt(2 * np.pi))
    near, heights = round(END_PX), ridges.height[points]
    tips = float(np.median(heights[:near])), float(np.median(heights[-near:]))
    places = _ends(ridges.smooth, path, tips)
    size = np.array(picture.shape[::-1])
    # Near an end that the pool's edge cuts obliquely, the light is not symmetric about the line.
    away = np.linalg.norm(path.place[:, None] - places, axis=-1).min(axis=-1)
    clear = seen & (away > END_WIDTHS * np.sqrt(spread2))
    if clear.sum() >= least:
        seen = clear
        if width > OBLIQUE_PX:
            first, *_, last = np.flatnonzero(clear).tolist()
            places = _ends(ridges.smooth, path.part(first, last + 1), tips)
    edge = max(EDGE_PX, STRIP_WIDTHS * width)
    cut = ((places < edge) | (places > size - 1 - edge)).any(axis=-1)
    return LightLine(
        image_px=path.place[seen],
        tangent=path.tangent[seen],
        sigma_px=np.full(int(seen.sum()), sigma),
        curvature=path.curvature[seen],
        ends_px=places,
        cut=np.asarray(cut),
        width_px=width,
        light=light,
        gap_px=path.longest_gap,
        smoothed_px=smooth_px,
    )


def _within(place: FloatArray, room_px: float, picture: Grey) -> BoolArray:
    """Whether positions (u, v), shape (n, 2), are inside a picture by a margin, shape (n,)."""
    last = np.array(picture.shape[::-1]) - 1 - room_px
    return np.asarray(((place >= room_px) & (place <= last)).all(axis=-1))


def _centers(
    picture: Grey, path: SmoothPath, width: float, window_px: FloatArray
) -> tuple[FloatArray, float]:
    """Offset of the light's middle across a path, shape (n,), px, and its standard uncertainty.

    The light beside the path is resampled to a straight strip, weighted by a Gaussian window that
    follows its middle, and averaged along the path with Gaussian weights of standard deviation
    ``window_px``, shape (n,).
    """
    reach = STRIP_WIDTHS * width + 1.0
    side = np.arange(-reach, reach + 0.25, 0.5)
    at = (path.place[:, None] + side[:, None] * path.across[:, None]).astype(np.float32)
    strip = np.asarray(
        cv2.remap(
            picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ),
        float,
    )
    edge = max(2, len(side) // 8)
    low, high = strip[:, :edge].mean(axis=1), strip[:, -edge:].mean(axis=1)
    along = np.arange(len(strip), dtype=float)
    bell = np.exp(-(((along - along[:, None]) / window_px[:, None]) ** 2) / 2) * path.seen
    bell /= bell.sum(axis=1, keepdims=True) + 1e-12
    strip -= (bell @ np.minimum(low, high))[:, None]
    off = np.zeros(len(strip))
    for _ in range(CENTER_ROUNDS):
        away = side - off[:, None]
        window = np.exp(-((away / width) ** 2) / 4)  # its variance is twice that of the light
        weight = (window * strip).sum(axis=1)
        moment = (window * strip * away).sum(axis=1)
        total = np.maximum(bell @ weight, 1e-9 + 0.1 * np.median(np.abs(weight)))
        step = bell @ moment / total
        off = np.clip(off + 1.5 * step, -width, width)  # (2 + 1)/2: the window biases it back
    scatter = 1.5 * (moment - (bell @ moment / total) * weight)
    variance = GRAIN_COLUMNS * (bell**2 @ scatter**2) / total**2
    return off, float(np.sqrt(np.median(variance[path.seen])))


def _ends(smooth: Grey, path: SmoothPath, heights: tuple[float, float]) -> FloatArray:
    """Positions beyond both ends of a path where the light falls to half, shape (2, 2), px."""
    return np.array([_end(smooth, path, end, heights[end]) for end in (0, -1)])


def _end(smooth: Grey, path: SmoothPath, end: int, height: float) -> FloatArray:
    """Position beyond a path's end where the light falls to half, (u, v), px."""
    sign = -1.0 if end == 0 else 1.0
    inward = slice(0, round(END_PX)) if end == 0 else slice(-round(END_PX), None)
    curvature = float(np.median(path.curvature[inward]))
    place, tangent, across = path.place[end], sign * path.tangent[end], sign * path.across[end]
    step = np.arange(0.0, END_REACH_PX, 0.5)
    bend = sign * curvature * sign * step**2 / 2
    ahead = place + step[:, None] * tangent + bend[:, None] * across
    inside = path.place[inward]
    at = np.concatenate([inside, ahead]).astype(np.float32)[None]
    light = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR)[0]
    level = float(np.median(light[: len(inside)])) - height / 2
    below = light[len(inside) :] < level
    if not below.any() or below[0]:
        return np.asarray(ahead[0 if below.any() else -1])
    k = int(np.argmax(below))
    before, after = light[len(inside) + k - 1 : len(inside) + k + 1]
    share = float((before - level) / (before - after))
    return np.asarray(ahead[k - 1] + share * (ahead[k] - ahead[k - 1]))
