"""Sub-pixel measurement of the target's three marks and of the unit flags of its bars (§5.1).

`target_marks` finds the dot and the two bars. Here each is measured to a fraction of a pixel. The
dot, the ends and the flags of the bars are the marks to which a map is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy

from labapp.core.calibration.target_marks import Mark, Refusal
from labapp.core.values import FloatArray, ReadOnlyArrays, robust_sigma

END_PX = 4.0
"""Largest distance of a bar's end from its first estimate, px."""

FLAG_UNITS = 0.19
"""Length by which a flag protrudes on at least one side of its bar, units."""


@dataclass(frozen=True)
class Bar(ReadOnlyArrays):
    """A bar measured on the grey levels.

    Parameters
    ----------
    middle, direction
        (u, v) of its middle, px; unit vector along its midline.
    half_length, half_width, sigma_px
        Half its length and width; standard uncertainty of the middle, px.
    darkness
        Darkness of the bar, as a fraction of the light.
    midline
        Cross-sections, shape (m, 2): position along the bar from its middle, and the deviation of
        the cross-section's middle from the straight midline; px.
    """

    middle: FloatArray
    direction: FloatArray
    half_length: float
    half_width: float
    sigma_px: float
    darkness: float
    midline: FloatArray

    @property
    def normal(self) -> FloatArray:
        """Unit vector across it."""
        return np.array([-self.direction[1], self.direction[0]])


def dot_center(dot: Mark, darkness: FloatArray) -> tuple[FloatArray, float]:
    """(u, v) of the dot's centre and its standard uncertainty, px.

    A pixel is weighted by the fraction of it that the dot covers: 0 below a fifth, 1 above four
    fifths of the dot's darkness, linear between, so that uneven light does not bias the centre.
    """
    v, u = np.nonzero(cv2.dilate(dot.mask.astype(np.uint8), np.ones((5, 5), np.uint8)))
    dark = darkness[v, u]
    full = float(np.median(np.sort(dark)[len(dark) // 2 :]))
    span = 0.6 * full
    weight = np.clip((dark - 0.2 * full) / span, 0.0, 1.0)
    total = float(weight.sum())
    if total <= 0.0:
        raise Refusal(4, "The dot of O′ is too faint to be measured.")
    place = np.stack([u, v], -1).astype(float)
    center = weight @ place / total
    edge = (weight > 0.0) & (weight < 1.0)
    spread = np.sum((place[edge] - center) ** 2) / 2.0
    noise = robust_sigma(darkness - np.median(darkness))
    return center, float(np.hypot(noise / span * np.sqrt(spread) / total, 0.05))


def measured_bar(mark: Mark, darkness: FloatArray, axis: str) -> Bar:
    """Measure a bar: midline from cross-sections, ends where its darkness falls to half.

    Unlike a centroid, the middle between the ends does not depend on the light along the bar.
    Cross-sections through unit flags are outliers of the midline and are rejected.
    """
    step = 0.5
    margin = max(1.5 * mark.width, 2.0 * END_PX)
    along = np.arange(-mark.length / 2.0 - margin, mark.length / 2.0 + margin, step)
    across = np.arange(-mark.width, mark.width + step / 2.0, step)
    normal = np.array([-mark.direction[1], mark.direction[0]])
    grid = mark.center + along[:, None, None] * mark.direction + across[None, :, None] * normal
    cut = scipy.ndimage.map_coordinates(
        darkness, [grid[..., 1], grid[..., 0]], order=1, mode="nearest"
    )
    cut = scipy.ndimage.gaussian_filter1d(cut, 1.0 / step, axis=0)

    core = np.abs(along) < 0.4 * mark.length
    full = float(np.median(cut[core].max(axis=1)))
    weight = np.clip((cut - 0.2 * full) / (0.6 * full), 0.0, 1.0)
    total = weight.sum(axis=1)
    core &= total > 0.0
    if full <= 0.0 or core.sum() < 10:
        raise Refusal(4, f"The bar on {axis} is too faint to be measured.")
    offset = weight @ across / np.maximum(total, 1e-12)
    slope, intercept, scatter = _robust_line(along[core], offset[core])

    # Ends are measured on the bar's inner part, which flags do not affect.
    half_width = float(np.median(total[core])) * step / 2.0
    midline = np.abs(across[None, :] - intercept - slope * along[:, None])
    inner = midline < max(0.65 * half_width, step)
    profile = (cut * inner).sum(axis=1) / np.maximum(inner.sum(axis=1), 1)
    low, low_sigma = _end(-along[::-1], profile[::-1], mark.length / 2.0, axis)
    high, high_sigma = _end(along, profile, mark.length / 2.0, axis)
    middle = (high - low) / 2.0
    # The noise of neighbouring cross-sections is correlated: about a third are independent.
    midline_sigma = scatter / np.sqrt(max(core.sum() * step / 3.0, 1.0))
    sigma = np.sqrt((low_sigma**2 + high_sigma**2) / 8.0 + midline_sigma**2 / 2.0)
    direction = mark.direction + slope * normal
    stretch = float(np.hypot(1.0, slope))
    seen = (along > -low) & (along < high) & (total > 0.0)
    deviation = offset[seen] - intercept - slope * along[seen]
    return Bar(
        middle=mark.center + middle * mark.direction + (intercept + slope * middle) * normal,
        direction=direction / stretch,
        half_length=(high + low) / 2.0 * stretch,
        half_width=half_width,
        sigma_px=float(np.hypot(sigma, 0.05)),
        darkness=full,
        midline=np.stack([(along[seen] - middle) * stretch, deviation / stretch], axis=-1),
    )


def _robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Slope, intercept and scatter of a line through points with outliers."""
    use = np.ones(len(x), bool)
    for _ in range(4):
        slope, intercept = np.polyfit(x[use], y[use], 1)
        residual = y - intercept - slope * x
        scatter = robust_sigma(residual)
        use = np.abs(residual) <= max(2.5 * scatter, 1e-6)
    return float(slope), float(intercept), scatter


def _end(
    along: FloatArray, profile: FloatArray, half_length: float, axis: str
) -> tuple[float, float]:
    """First position along a profile where it falls to half its level inside the bar, and σ, px.

    The level is that of the bar's last part on this side, as the light may vary along the bar. The
    position is then refined between the levels on either side of the end, as the background differs
    there: O′ and both bars lie close together.
    """
    begin, end = 0.5 * half_length, 0.8 * half_length
    part = profile[(along >= begin) & (along <= end)]
    half = float(np.median(part)) / 2.0
    beyond = np.flatnonzero((along[1:] > begin) & (profile[1:] < half) & (profile[:-1] >= half))
    if half <= 0.0 or beyond.size == 0:
        raise Refusal(4, f"The bar on {axis} has no clear end.")
    i = int(beyond[0])
    fall = profile[i] - profile[i + 1]
    place = along[i] + (profile[i] - half) / fall * (along[i + 1] - along[i])
    slope = fall / (along[i + 1] - along[i])
    off = along - place
    sides = [profile[(side * off > END_PX) & (side * off < 3.0 * END_PX)] for side in (-1, 1)]
    if not all(levels.size for levels in sides):
        raise Refusal(4, f"The bar on {axis} has no clear end.")
    inside, outside = (float(np.median(levels)) for levels in sides)
    share = (profile - outside) / max(inside - outside, 1e-6)
    covered = np.clip((share - 0.2) / 0.6, 0.0, 1.0)
    place += END_PX * (float(np.trapezoid(covered, np.clip(off / END_PX, -1.0, 1.0))) - 1.0)
    return float(place), float(part.std() / slope)


def bar_marks(
    bar: Bar,
    origin: FloatArray,
    units: tuple[float, float],
    flags_along: FloatArray,
    darkness: FloatArray,
) -> list[tuple[float, FloatArray]]:
    """Return both ends of a bar and its visible unit flags.

    Parameters
    ----------
    bar, origin
        The bar, and (u, v) of O′, px.
    units
        Begin and end of the bar, units.
    flags_along
        Direction of the flags in the picture: that of the other axis.
    darkness
        Missing fraction of the light, shape (rows, columns).

    Returns
    -------
    list
        (units from O′, (u, v) in px) of each mark.
    """
    if (bar.middle - origin) @ bar.direction < 0.0:
        bar = replace(bar, direction=-bar.direction, midline=-bar.midline)
    begin, end = units
    near, far = (
        float((bar.middle - origin) @ bar.direction + side * bar.half_length) for side in (-1, 1)
    )
    # O′ and both ends determine the projection along the axis: s = a·t / (1 + k·t).
    k = (end * near / begin - far) / (end * (far - near))
    a = near / begin * (1.0 + k * begin)
    unit_px = (far - near) / (end - begin)
    start = bar.middle - bar.half_length * bar.direction
    found = [(begin, 0.0), (end, 2.0 * bar.half_length)]
    for n in range(int(np.floor(begin)) + 1, int(np.ceil(end))):
        guess = a * n / (1.0 + k * n) - near
        at = _flag(bar, start + guess * bar.direction, unit_px, flags_along, darkness)
        if at is not None:
            found.append((float(n), guess + at))
    place, deviation = bar.midline.T
    marks = []
    for t, along in sorted(found):
        # Beside the flag, which may protrude on one side only and would bias the middle.
        beside = np.abs(place + bar.half_length - along) / unit_px
        near_by = deviation[(beside > 0.1) & (beside < 0.45)]
        across = float(np.median(near_by)) if near_by.size else 0.0
        marks.append((t, start + along * bar.direction + across * bar.normal))
    return marks


def _flag(
    bar: Bar,
    guess: FloatArray,
    unit_px: float,
    flags_along: FloatArray,
    darkness: FloatArray,
) -> float | None:
    """Displacement of a flag along the bar from an initial guess, px; None if it is not visible."""
    step = 0.25
    along = np.arange(-0.35 * unit_px, 0.35 * unit_px + step / 2, step)
    # Avoid the bar with its blur, and the flag's end.
    clear = bar.half_width / abs(float(flags_along @ bar.normal))
    out = clear + np.arange(1.0, max(0.85 * FLAG_UNITS * unit_px, 1.5), 0.5)
    profile = np.zeros_like(along)
    for side in (out, -out):
        grid = guess + along[:, None, None] * bar.direction + side[None, :, None] * flags_along
        profile += scipy.ndimage.map_coordinates(
            darkness, [grid[..., 1], grid[..., 0]], order=1, mode="nearest"
        ).mean(axis=1)
    profile -= np.median(profile)
    noise = robust_sigma(profile)
    peak = int(np.argmax(scipy.ndimage.gaussian_filter1d(profile, 0.7 / step)))
    if profile[peak] < max(0.1 * bar.darkness, 4.0 * noise):
        return None
    reach = max(0.1 * unit_px, 3.0)
    at = float(along[peak])
    profile = np.maximum(profile - 0.2 * profile[peak], 0.0)
    for _ in range(5):  # centroid of the surroundings of the previous one
        weight = profile * np.clip(reach + 0.5 - np.abs(along - at), 0.0, 1.0)
        at = float(weight @ along / weight.sum())
    return at if abs(at) < 0.35 * unit_px - reach else None


def local_noise(darkness: FloatArray, place_px: FloatArray, reach_px: float) -> float:
    """Relative noise of the darkness around a position, from differences of neighbouring pixels."""
    u, v = np.round(place_px).astype(int)
    reach = max(round(reach_px), 5)
    near_by = darkness[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
    steps = np.sort(np.abs(np.diff(near_by, axis=1)).ravel())
    # Exclude the edges of marks. Mean, not median: grey levels are quantised.
    return float(steps[: int(0.7 * len(steps))].mean())
