"""Pool edges from lines reflected by the solid metal beside the pool (§3.2.1, Fig. 3-10 b).

Solid stainless steel reflects the lines as a flat mirror at z = 0, so the landing point of each ray
is known. The straight lines overlap on the imaging plane; their brightness along the fan is
determined jointly. Where a line's light ends, from outside inwards, its ray meets the boundary:
this gives a point (x, y) of the pool's edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.line_pattern import LineRig, line_directions
from labapp.core.geometry.optics import intersect_imaging_plane, intersect_level, reflect
from labapp.core.images.dots import Grey, Image
from labapp.core.lines.detection.find_lines import LightLine
from labapp.core.lines.detection.ridges import sampled
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

FAN_STEPS = 241
"""Number of positions along the fan at which the lines' light is determined."""

OUTER_STEPS = 12
"""A line on the metal must be lit within this many steps of the end of its fan; the width of the
lines is determined at these steps."""

WIDTHS_PX = (0.8, 1.2, 1.6, 2.0, 2.5, 3.0)
"""Trial standard deviations of a line's light across it; the best-fitting one is used."""

BESIDE_PX = 6.0
"""Distance beyond the outermost straight lines over which light is read."""

SMOOTHED_STEPS = 1.5
"""Standard deviation of the smoothing along the fan, steps."""

LEAST_LIGHT = 5.0
"""Least ratio of the light of a line on the metal to its noise."""

FRINGES = 2
"""Number of diffraction fringes fitted on either side of the pattern (Fig. 3-9)."""

METAL_WIDTHS, METAL_SHARE = 2.5, 0.7
"""A line is reflected by the metal if at least this share of it is within this many widths of the
straight lines."""

LEAST_LINES = 4
"""Least number of lines to test for a smooth boundary: a parabola passes through any three ends."""

MOST_OFF_MM, FLOOR_MM = 0.15, 0.1
"""Largest RMS distance of the ends on one side from a smooth boundary, mm (lines of the pool that
cross the straight ones end elsewhere); and the least uncertainty of an end, mm, due to blur."""


@dataclass(frozen=True)
class PoolEdges(ReadOnlyArrays):
    """Ends of lines on the solid metal at the pool: n points of its edge.

    Parameters
    ----------
    line
        Number of the line in the pattern, shape (n,).
    side
        −1: the edge towards −X; 1: the other, shape (n,).
    point_mm
        (x, y) on the work piece, shape (n, 2), mm.
    sigma_mm
        Standard uncertainty along the line, from the noise of its light, shape (n,), mm.
    width_px
        Standard deviation of a straight line's light across it, px.
    """

    line: IntArray
    side: IntArray
    point_mm: FloatArray
    sigma_mm: FloatArray
    width_px: float


def pool_edges(image: Image, rig: LineRig, calibration: ImageCalibration) -> PoolEdges | None:
    """Find the pool's edges in a frame, shape (height, width); None if the metal reflects no lines.

    Also None for a pattern of fewer than `LEAST_LINES`.

    Parameters
    ----------
    image
        A grey frame of a line pattern.
    rig, calibration
        The bench; the work piece is at z = 0.
    """
    if rig.pattern.count < LEAST_LINES:
        return None
    fan = np.linspace(-rig.pattern.half_fan, rig.pattern.half_fan, FAN_STEPS)
    number = np.arange(1.0 - FRINGES, rig.pattern.count + 1 + FRINGES)
    point, path = _straight_lines(rig, calibration, number, fan)
    if not np.isfinite(path).all() or np.ptp(path, axis=0).max() > sum(image.shape):
        return None  # at no place are all lines in the picture
    picture = np.ascontiguousarray(image, np.float32)
    light, noise, width = _light_along(picture, path)
    own = slice(FRINGES, -FRINGES)
    point, light = point[own], light[own]
    smooth = scipy.ndimage.gaussian_filter1d(light, SMOOTHED_STEPS, axis=1, mode="nearest")
    found = [
        (k, side, *end)
        for k in range(rig.pattern.count)
        for side in (-1, 1)
        if (end := _end(smooth[k][::-side], noise)) is not None
    ]
    if len(found) < 2 * rig.pattern.count:
        return None
    line, side = (np.array(column) for column in list(zip(*found, strict=True))[:2])
    step = np.array([one[2] for one in found])
    at = np.where(side < 0, step, FAN_STEPS - 1 - step)
    places = np.stack(
        [
            [np.interp(each, np.arange(FAN_STEPS), point[k, :, axis]) for axis in (0, 1)]
            for k, each in zip(line.tolist(), at.tolist(), strict=True)
        ]
    )
    a_step = np.linalg.norm(np.diff(point[line, :, :2], axis=1), axis=-1).mean(axis=1)
    slope = np.array([one[4] for one in found])
    if any(_bends(places[side == one]) > MOST_OFF_MM for one in (-1, 1)):
        return None
    sigma = np.hypot(a_step * noise / slope, FLOOR_MM)
    return PoolEdges(line + 1, side, places, sigma, width)


def without_metal(
    lines: tuple[LightLine, ...], edges: PoolEdges, rig: LineRig, calibration: ImageCalibration
) -> tuple[LightLine, ...]:
    """Remove lines that were reflected by the metal: most of each lies on a straight line."""
    half = rig.pattern.half_fan
    number = np.arange(1.0, rig.pattern.count + 1)
    path = _straight_lines(rig, calibration, number, np.linspace(-half, half, FAN_STEPS))[1]
    near = METAL_WIDTHS * edges.width_px
    return tuple(
        one
        for one in lines
        if np.mean(_away(one.image_px, path.reshape(-1, 2)) < near) < METAL_SHARE
    )


def _away(place: FloatArray, others: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(place[:, None] - others, axis=-1).min(axis=1))


def _bends(place_mm: FloatArray) -> float:
    """RMS distance along X of points (x, y) from a fitted parabola, mm."""
    x, y = place_mm.T
    return float(np.std(x - np.polyval(np.polyfit(y, x, 2), y)) * np.sqrt(len(x) / (len(x) - 3)))


def _straight_lines(
    rig: LineRig, calibration: ImageCalibration, number: FloatArray, fan: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points of rays on the work piece, shape (k, f, 3), mm, and in the image, (k, f, 2), px."""
    direction = line_directions(rig.laser, rig.pattern, number[:, None], fan)
    point = intersect_level(rig.laser.position_mm, direction)
    away = reflect(direction, np.array([0.0, 0.0, 1.0]))
    return point, calibration.to_image(intersect_imaging_plane(point, away, rig.imaging_plane))


def _light_along(picture: Grey, path: FloatArray) -> tuple[FloatArray, float, float]:
    """Light of each line along the fan, shape (k, f), its noise, and the lines' width, px.

    At each step of the fan, the light across all lines is modelled as the sum of their profiles and
    a linear background.
    """
    count, steps, _ = path.shape
    middle = path.mean(axis=0)
    along = np.gradient(middle, axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    place = np.vecdot(path - middle, across)
    reach = float(np.abs(place).max()) + BESIDE_PX
    side = np.arange(-reach, reach + 0.5)
    at = middle[:, None] + side[:, None] * across[:, None]
    seen = sampled(picture, at.reshape(-1, 2)).astype(np.float64).reshape(steps, -1)
    outer = np.r_[:OUTER_STEPS, steps - OUTER_STEPS : steps]
    misfits = [_fitted(seen[outer], side, place.T[outer], width)[1] for width in WIDTHS_PX]
    width = WIDTHS_PX[int(np.argmin(misfits))]
    grain = np.sqrt(min(misfits) / (len(outer) * (len(side) - count - 2)))
    light, _, gain = _fitted(seen, side, place.T, width)
    return light.T, float(grain * gain), width


def _fitted(
    seen: FloatArray, side: FloatArray, place: FloatArray, width: float
) -> tuple[FloatArray, float, float]:
    """Least-squares fit of profiles on a linear background at each step of the fan.

    Parameters
    ----------
    seen
        Grey levels across the lines, shape (f, s).
    side
        Positions of the grey levels, shape (s,), px.
    place
        Positions of the lines, shape (f, k), px.
    width
        Standard deviation of the profiles, px.

    Returns
    -------
    light, misfit, gain
        Amplitudes of the profiles, shape (f, k); the sum of all squared residuals; and the RMS
        noise of an amplitude relative to the noise of a pixel.
    """
    count = place.shape[1]
    bells = np.exp(-(((side[:, None] - place[:, None]) / width) ** 2) / 2)
    background = np.stack([np.ones_like(side), side / np.abs(side).max()], axis=-1)
    background = np.broadcast_to(background, (len(seen), *background.shape))
    design = np.concatenate([bells, background], axis=-1)
    inverse = np.linalg.pinv(design)
    solved = (inverse @ seen[..., None])[..., 0]
    rest = seen - (design @ solved[..., None])[..., 0]
    gain = np.sqrt((inverse[:, :count] ** 2).sum(axis=-1).mean())
    return solved[:, :count], float(np.sum(rest**2)), float(gain)


def _end(light: FloatArray, noise: float) -> tuple[float, float, float] | None:
    """End of a line's light, from outside inwards: the step, its level and its slope there.

    None if there is no light, or if it does not end.
    """
    top = np.maximum.accumulate(light)
    ends = np.flatnonzero((top > LEAST_LIGHT * noise) & (light < top / 2))
    if not len(ends) or not np.any(light[:OUTER_STEPS] > LEAST_LIGHT * noise / 2):
        return None
    k, level = int(ends[0]), float(top[ends[0]])
    slope = float(light[k - 1] - light[k])
    return k - 1 + float((light[k - 1] - level / 2) / slope), level, slope
