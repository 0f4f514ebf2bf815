"""Calibration picture → image calibration: O′ and a point on each axis (§5.1, Fig. 5-1 c).

The imaging plane shows a dot at O′ and a dark bar along each axis. The picture is levelled,
thresholded, median filtered and dilated until three objects are left; these are thinned and
told apart by shape. The text takes their centres to a whole pixel; by default each is then
measured on the grey levels to a fraction of one, and every place is checked against the design:
a wrong calibration is worse than none.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates

from labapp.core.coordinates import ImageCalibration
from labapp.core.target_marks import (
    Image,
    Mark,
    MarkSettings,
    Refusal,
    grey_levels,
    levelled,
    segmented,
    three_marks,
)
from labapp.core.values import CannotMeasure, FloatArray


@dataclass(frozen=True)
class PlaneCalibrationSettings(MarkSettings):
    """The target's design and how far it may be off; how it is looked for is inherited.

    Parameters
    ----------
    unit_mm
        Length of a unit of the axes, mm, "measured in advance" (§5.1.2).
    x_units, z_units
        Where the bars on O′X′ and O′Z′ begin and end, units.
    subpixel
        Measure on grey levels; False gives the whole pixels of Eq. 5-5.
    scale_tolerance
        The px/mm of the two axes may differ by this part.
    angle_tolerance_deg
        The angle between the axes may differ from 90° by this much.
    sigma_limit_px
        Largest standard uncertainty of a point that is accepted, px.
    pointing_tolerance
        A bar's line may pass by O′ this many units off.
    middle_tolerance
        A bar's middle may be this many units from where its length and O′ have it. This tells a
        bar that is partly hidden: its middle moves by half of what is.
    """

    unit_mm: float = 12.7
    x_units: tuple[float, float] = (1.0, 10.0)
    z_units: tuple[float, float] = (1.0, 4.0)
    subpixel: bool = True
    scale_tolerance: float = 0.2
    angle_tolerance_deg: float = 30.0
    sigma_limit_px: float = 0.5
    pointing_tolerance: float = 0.08
    middle_tolerance: float = 0.1


@dataclass(frozen=True)
class PlaneCalibration:
    """Where O′ and the axes are in the picture.

    Parameters
    ----------
    origin_px, x_axis_px, z_axis_px
        (u, v) of O′ and of the middles of the bars on O′X′ and O′Z′, px.
    x_axis_mm, z_axis_mm
        X′ and Z′ of these middles, mm (5.5 and 2.5 units in the text, Eq. 5-6).
    sigma_px
        Standard uncertainty of each of the three points along either direction, px.
    threshold
        Grey level at O′ below which the three objects were found.
    """

    origin_px: tuple[float, float]
    x_axis_px: tuple[float, float]
    x_axis_mm: float
    z_axis_px: tuple[float, float]
    z_axis_mm: float
    sigma_px: tuple[float, float, float]
    threshold: float

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """Scale along O′X′ and along O′Z′ (Eq. 4-6), px/mm."""
        x_arm, z_arm = self._arms
        return float(np.hypot(*x_arm)) / self.x_axis_mm, float(np.hypot(*z_arm)) / self.z_axis_mm

    @property
    def angle_deg(self) -> float:
        """Angle from O′X′ to O′Z′ as the picture shows it, anticlockwise, degrees."""
        x_arm, z_arm = self._arms
        turn = np.arctan2(-z_arm[1], z_arm[0]) - np.arctan2(-x_arm[1], x_arm[0])
        return float(np.degrees(turn) % 360.0)

    @property
    def image_calibration(self) -> ImageCalibration:
        """The calibration that the measurement uses."""
        return ImageCalibration.from_three_points(
            self.origin_px, self.x_axis_px, self.x_axis_mm, self.z_axis_px, self.z_axis_mm
        )

    @property
    def _arms(self) -> tuple[FloatArray, FloatArray]:
        origin = np.array(self.origin_px)
        return np.array(self.x_axis_px) - origin, np.array(self.z_axis_px) - origin


def calibrate_plane(
    image: Image, settings: PlaneCalibrationSettings | None = None
) -> PlaneCalibration:
    """Find O′ and the axes in a picture of the imaging plane (§5.1.2).

    Parameters
    ----------
    image
        Grey or BGR(A) picture, shape (rows, columns[, channels]), of any integer or float type.
    settings
        The target's design and limits; None for the defaults.

    Raises
    ------
    ValueError
        If the image is no picture.
    CannotMeasure
        ``no-target`` if O′ and the two bars are not found where the design has them; the reason
        says what is missing or does not fit.
    """
    settings = settings or PlaneCalibrationSettings()
    grey = grey_levels(image)
    background, darkness = levelled(grey)
    failure = Refusal(-1, "The picture shows no dark marks on a light plane.")
    for threshold, binary in segmented(grey, darkness, settings):
        try:
            marks = three_marks(binary, settings)
            return _measured(marks, darkness, background, threshold, settings)
        except Refusal as refusal:
            # What failed last in the chain came closest: its reason helps the operator most.
            if refusal.stage > failure.stage:
                failure = refusal
    raise CannotMeasure("no-target", failure.reason)


@dataclass(frozen=True)
class _Bar:
    """A bar measured on the grey levels.

    Parameters
    ----------
    middle, direction
        (u, v) of its middle, px; unit vector along its midline.
    half_length, sigma_px
        Half its length; standard uncertainty of the middle, px.
    """

    middle: FloatArray
    direction: FloatArray
    half_length: float
    sigma_px: float


def _measured(
    marks: tuple[Mark, Mark, Mark],
    darkness: FloatArray,
    background: FloatArray,
    level: float | None,
    settings: PlaneCalibrationSettings,
) -> PlaneCalibration:
    """Measure the three objects and hold them to the design."""
    dot, x_mark, z_mark = marks
    origin, origin_sigma = _dot_center(dot, darkness)
    x_bar, z_bar = _bar(x_mark, darkness, "O′X′"), _bar(z_mark, darkness, "O′Z′")
    points = [origin, x_bar.middle, z_bar.middle]
    sigma = [origin_sigma, x_bar.sigma_px, z_bar.sigma_px]
    for name, uncertain in zip(("dot of O′", "bar on O′X′", "bar on O′Z′"), sigma, strict=True):
        if uncertain > settings.sigma_limit_px:
            raise Refusal(
                4, f"The {name} is blurred or partly covered: known to ±{uncertain:.1f} px only."
            )
    if not settings.subpixel:
        points = [np.floor(mark.center) for mark in marks]
        sigma = [float(np.hypot(s, 1.0 / np.sqrt(12.0))) for s in sigma]
    row, column = np.round(origin[::-1]).astype(int)
    bare = float(background[row, column])
    found = PlaneCalibration(
        origin_px=_pair(points[0]),
        x_axis_px=_pair(points[1]),
        x_axis_mm=sum(settings.x_units) / 2.0 * settings.unit_mm,
        z_axis_px=_pair(points[2]),
        z_axis_mm=sum(settings.z_units) / 2.0 * settings.unit_mm,
        sigma_px=(sigma[0], sigma[1], sigma[2]),
        threshold=bare * (1.0 - level) if level is not None else float(settings.threshold or 0.0),
    )
    _check_bar("O′X′", origin, x_bar, settings.x_units, settings)
    _check_bar("O′Z′", origin, z_bar, settings.z_units, settings)
    along_x, along_z = found.px_per_mm
    if abs(along_x / along_z - 1.0) > settings.scale_tolerance:
        raise Refusal(
            5,
            f"The axes' scales disagree: {along_x:.3g} px/mm along O′X′, {along_z:.3g} px/mm "
            "along O′Z′.",
        )
    if abs(found.angle_deg - 90.0) > settings.angle_tolerance_deg:
        raise Refusal(5, f"The axes are {found.angle_deg:.0f}° apart, which should be about 90°.")
    return found


def _dot_center(dot: Mark, darkness: FloatArray) -> tuple[FloatArray, float]:
    """(u, v) of the dot's centre and its standard uncertainty, px.

    A pixel weighs by the part of it that the dot covers: 0 below a fifth, 1 above four fifths of
    the dot's darkness, linear between, so that uneven light does not pull the centre.
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
    noise = 1.4826 * float(np.median(np.abs(darkness - np.median(darkness))))
    return center, float(np.hypot(noise / span * np.sqrt(spread) / total, 0.05))


def _bar(mark: Mark, darkness: FloatArray, axis: str) -> _Bar:
    """Measure a bar: midline from cuts across it, ends where its darkness falls to half.

    The middle between the ends does not depend on how the light falls along the bar, as a
    centroid would. Cuts through unit flags are outliers of the midline and are left out.
    """
    step = 0.5
    margin = 1.5 * mark.width
    along = np.arange(-mark.length / 2.0 - margin, mark.length / 2.0 + margin, step)
    across = np.arange(-mark.width, mark.width + step / 2.0, step)
    normal = np.array([-mark.direction[1], mark.direction[0]])
    grid = mark.center + along[:, None, None] * mark.direction + across[None, :, None] * normal
    cut = map_coordinates(darkness, [grid[..., 1], grid[..., 0]], order=1, mode="nearest")
    cut = gaussian_filter1d(cut, 1.0 / step, axis=0)

    core = np.abs(along) < 0.4 * mark.length
    full = float(np.median(cut[core].max(axis=1)))
    weight = np.clip((cut - 0.2 * full) / (0.6 * full), 0.0, 1.0)
    total = weight.sum(axis=1)
    core &= total > 0.0
    if full <= 0.0 or core.sum() < 10:
        raise Refusal(4, f"The bar on {axis} is too faint to be measured.")
    offset = (weight @ across)[core] / total[core]
    slope, intercept, scatter = _robust_line(along[core], offset)

    # Ends on the bar's inner half: the midline is there even where flags stand out.
    midline = np.abs(across[None, :] - intercept - slope * along[:, None])
    inner = midline < max(0.2 * mark.width, step)
    profile = (cut * inner).sum(axis=1) / np.maximum(inner.sum(axis=1), 1)
    low, low_sigma = _end(-along[::-1], profile[::-1], mark.length / 2.0, axis)
    high, high_sigma = _end(along, profile, mark.length / 2.0, axis)
    middle = (high - low) / 2.0
    # Cuts 1 px and a blur apart share their noise: about a third of them are independent.
    midline_sigma = scatter / np.sqrt(max(core.sum() * step / 3.0, 1.0))
    sigma = np.sqrt((low_sigma**2 + high_sigma**2) / 8.0 + midline_sigma**2 / 2.0)
    direction = mark.direction + slope * normal
    return _Bar(
        middle=mark.center + middle * mark.direction + (intercept + slope * middle) * normal,
        direction=direction / np.hypot(*direction),
        half_length=float((high + low) / 2.0 * np.hypot(1.0, slope)),
        sigma_px=float(np.hypot(sigma, 0.05)),
    )


def _robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Slope, intercept and scatter of a line through points with outliers."""
    use = np.ones(len(x), bool)
    for _ in range(4):
        slope, intercept = np.polyfit(x[use], y[use], 1)
        residual = y - intercept - slope * x
        scatter = 1.4826 * float(np.median(np.abs(residual)))
        use = np.abs(residual) <= max(2.5 * scatter, 1e-6)
    return float(slope), float(intercept), scatter


def _end(
    along: FloatArray, profile: FloatArray, half_length: float, axis: str
) -> tuple[float, float]:
    """Where a profile first falls to half of what it is within, going up; with its σ, px.

    The level is that of the bar's last part on this side: light may fall along the bar.
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
    return float(place), float(part.std() / slope)


def _check_bar(
    axis: str,
    origin: FloatArray,
    bar: _Bar,
    units: tuple[float, float],
    settings: PlaneCalibrationSettings,
) -> None:
    """Refuse a bar that does not point at O′, or does not begin and end where it should."""
    arm = bar.middle - origin
    begin, end = units
    unit_px = float(np.hypot(*arm)) / ((begin + end) / 2.0)
    passes_by = abs(arm[0] * bar.direction[1] - arm[1] * bar.direction[0]) / unit_px
    if passes_by > settings.pointing_tolerance:
        raise Refusal(
            4, f"The bar on {axis} does not point at O′: it passes {passes_by:.2g} units off."
        )
    expected = (end - begin) / 2.0 * unit_px
    # With 2s of it hidden a bar's half is s shorter, but s·(end - begin) / (end + begin) of that
    # is expected of its new middle. Half a pixel an end may be off even in a coarse picture.
    tolerance = max(settings.middle_tolerance * 2.0 * begin / (begin + end) * unit_px, 0.5)
    if abs(bar.half_length - expected) > tolerance:
        raise Refusal(
            5,
            f"The bar on {axis} is {2.0 * bar.half_length:.1f} px long; from its middle's distance "
            f"to O′ it should be {2.0 * expected:.1f} px: part of it is hidden, or it is not "
            "this target.",
        )


def _pair(point: FloatArray) -> tuple[float, float]:
    return float(point[0]), float(point[1])
