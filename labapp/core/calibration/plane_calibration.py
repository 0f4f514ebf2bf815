"""Image calibration from a picture of the target: O′ and a point on each axis (§5.1, Fig. 5-1 c).

The imaging plane shows a dot at O′ and a dark bar along each axis. The picture is levelled,
thresholded, median filtered and dilated until three objects are left; these are thinned and
distinguished by shape. The dissertation rounds their centres to whole pixels. Here each is then
measured on the grey levels with sub-pixel accuracy, and every position is checked against the
design, because a wrong calibration is worse than none. The ends and unit flags of the bars give
more than three marks: an affine map and a homography are fitted to them, and the better is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labapp.core.calibration.mark_fit import (
    UNKNOWN_PERSPECTIVE,
    MarkFits,
    Model,
    fit_marks,
    root_mean_square,
)
from labapp.core.calibration.seen_axes import POINTS, SeenAxes
from labapp.core.calibration.target_bars import (
    Bar,
    bar_marks,
    dot_center,
    local_noise,
    measured_bar,
)
from labapp.core.calibration.target_marks import (
    ColourOrGrey,
    Mark,
    Refusal,
    grey_levels,
    levelled,
    segmented,
    three_marks,
)
from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.values import CannotMeasure, FloatArray

AXES = ("O′X′", "O′Z′")

X_UNITS, Z_UNITS = (1.0, 10.0), (1.0, 4.0)
"""Where the bars on O′X′ and O′Z′ begin and end, units."""

UNIT_MM = 6.35
"""Usual length of a unit, mm."""

SCALE_TOLERANCE, ANGLE_TOLERANCE_DEG = 0.2, 30.0
"""Largest relative difference between the px/mm of the two axes, and largest deviation of the angle
between them from 90°, degrees."""

MOST_SIGMA_PX = 0.5
"""Largest accepted standard uncertainty of a point, px."""

MOST_ASIDE = 0.08
"""Largest distance of a bar's midline from O′, units."""

MIDDLE_OFF = 0.1
"""Largest distance of a bar's middle from the position expected from its length and O′, units. This
detects a partly hidden bar: its middle moves by half of the hidden length."""

MARK_OFF = 0.05
"""Largest distance of a mark from the position predicted by the others, with perspective, units."""


@dataclass(frozen=True)
class PlaneCalibration(SeenAxes):
    """Image positions of O′ and the axes, and the map from pixels to the plane.

    Parameters
    ----------
    origin_px, x_axis_px, z_axis_px
        (u, v) of O′ and of the middles of the bars on O′X′ and O′Z′, px.
    x_axis_mm, z_axis_mm
        X′ and Z′ of these middles, mm (5.5 and 2.5 units in the dissertation, Eq. 5-6).
    sigma_px
        Standard uncertainty of each of the three points along either direction, px.
    threshold
        Grey-level threshold at O′ with which the three objects were found.
    marks
        X′, Z′ (mm), u and v (px) of O′ and of the ends and flags of the bars, and the noise of
        the picture there (any unit); empty if only the three points are known.
    model
        Map in use: the three points, or a fit to the marks.
    lens
        The camera's lens, if known from another calibration (`board_calibration`).
    """

    origin_px: tuple[float, float]
    x_axis_px: tuple[float, float]
    x_axis_mm: float
    z_axis_px: tuple[float, float]
    z_axis_mm: float
    sigma_px: tuple[float, float, float]
    threshold: float
    marks: tuple[tuple[float, float, float, float, float], ...] = ()
    model: Model = "three points"
    lens: Lens | None = None

    @cached_property
    def fits(self) -> MarkFits | None:
        """Both fits to the marks; None without marks."""
        if not self.marks:
            return None
        marks = np.array(self.marks)
        image_px = marks[:, 2:4] if self.lens is None else self.lens.ideal(marks[:, 2:4])
        return fit_marks(marks[:, :2], image_px, marks[:, 4])

    @property
    def points_px(self) -> FloatArray:
        """(u, v) of O′ and of the points on O′X′ and O′Z′ by the model, shape (3, 2), px."""
        if self.fits is None or self.model == "three points":
            return np.array([self.origin_px, self.x_axis_px, self.z_axis_px])
        straight = self.fits.of(self.model).calibration.to_image(self._points_mm)
        return straight if self.lens is None else self.lens.distorted(straight)

    @property
    def points_covariance_px2(self) -> FloatArray:
        """Covariance of these points, shape (6, 6), px²."""
        return self._covariance_px2(self._points_mm)

    @property
    def affine_covariance_px2(self) -> FloatArray:
        """Covariance of these points under an affine change of the picture, shape (6, 6), px²."""
        if self.fits is None or self.fits.whole is None:
            return self.points_covariance_px2
        field = self.fits.field_mm
        return self._affine_covariance_px2(field, self._covariance_px2(field))

    def _covariance_px2(self, plane_mm: FloatArray) -> FloatArray:
        """Covariance of the image positions of (X′, Z′), with too few marks of the three points."""
        if self.fits is not None and self.fits.whole is not None:
            return self.fits.covariance_px2(self._straight, plane_mm)
        if self.fits is None or self.model == "three points":
            return np.diag(np.repeat(np.square(self.sigma_px), 2))
        return self.fits.of(self.model).covariance_px2(plane_mm)

    @property
    def _straight(self) -> ImageCalibration:
        """The map from positions without distortion."""
        return ImageCalibration(self.image_calibration.matrix)

    @property
    def image_calibration(self) -> ImageCalibration:
        """The image calibration used for measurements.

        Raises
        ------
        ValueError
            If the three points are collinear, or the marks do not determine the model.
        """
        if self.model != "three points" and self.fits is None:
            raise ValueError(f"without marks there is no {self.model}")
        # Identical to the calibration read back from the set-up's keys.
        if self.model == "homography":
            assert self.fits is not None
            matrix = self.fits.of(self.model).calibration.matrix
            return ImageCalibration(matrix / matrix[2, 2], self.lens)
        origin, on_x, on_z = (_pair(point) for point in self.points_px)
        return ImageCalibration.from_three_points(
            origin, on_x, self.x_axis_mm, on_z, self.z_axis_mm, self.lens
        )

    @property
    def setup_keys(self) -> dict[str, dict[str, object]]:
        """Calibration as setup-file keys by section, with the points' standard uncertainties.

        None for a key that must be removed.
        """
        lengths = {"x_axis_mm": self.x_axis_mm, "z_axis_mm": self.z_axis_mm}
        known = self.setup_uncertainty
        if self.model == "homography":
            rows, places = self.image_calibration.matrix.tolist(), list(lengths.values())
            keys = {**dict.fromkeys((*POINTS, *lengths)), "homography": rows, "points_mm": places}
            return {"image_calibration": keys | known}
        points = dict(zip(POINTS, self.points_px.tolist(), strict=True))
        gone = {"homography": None, "points_mm": None}
        return {"image_calibration": {**points, **lengths, **gone, **known}}

    def fit_lines(self) -> list[str]:
        """Return text lines on the residuals of the fits and the choice of the model."""
        error = [f"{'error':<10} {words}" for words in self.bound_words()]
        if self.fits is None:
            return ["used       the three points: too few marks where the target has them", *error]
        named = (("affine", self.fits.affine), ("homography", self.fits.homography))
        lines = [
            f"{name:<10} residual {root_mean_square(fit.residual_px):.3f} px, "
            f"{root_mean_square(fit.residual_mm):.4f} mm; worst "
            f"{np.hypot(*fit.residual_px.T).max():.3f} px; of a mark left out "
            f"{root_mean_square(fit.left_out_px):.3f} px"
            for name, fit in named
            if fit is not None
        ]
        why = self.fits.reason if self.model == self.fits.best else "chosen by hand"
        lines.append(f"used       {self.model}, {len(self.marks)} marks. {why}")
        return [*lines, *error]

    def bound_words(self) -> tuple[str, ...]:
        """Return text on the model's possible error at the dots."""
        if self.fits is None:
            return (UNKNOWN_PERSPECTIVE,)
        return self.fits.bound_words(self._straight)

    def with_scale(self, factor: float) -> PlaneCalibration:
        """Return the calibration for the same picture of a target scaled by a factor."""
        return replace(
            self,
            x_axis_mm=self.x_axis_mm * factor,
            z_axis_mm=self.z_axis_mm * factor,
            marks=tuple((x * factor, z * factor, u, v, noise) for x, z, u, v, noise in self.marks),
        )


def calibrate_plane(
    image: ColourOrGrey, unit_mm: float = UNIT_MM, lens: Lens | None = None
) -> PlaneCalibration:
    """Find O′ and the axes in a picture of the imaging plane (§5.1.2).

    Parameters
    ----------
    image
        Grey or BGR(A) picture, shape (rows, columns[, channels]), of any integer or float type.
    unit_mm
        Length of a unit of the target's axes, mm, "measured in advance" (§5.1.2).
    lens
        The camera's lens, if known.

    Raises
    ------
    ValueError
        If the image is not a valid picture.
    CannotMeasure
        ``no-target`` if O′ and the two bars are not found as designed; the reason states what is
        missing or does not fit.
    """
    failure = Refusal(-1, "The picture shows no dark marks on a light plane.")
    for background, darkness in levelled(grey_levels(image)):
        for threshold, binary in segmented(darkness):
            try:
                marks = three_marks(binary)
                return _measured(marks, darkness, background, threshold, unit_mm, lens)
            except Refusal as refusal:
                # The attempt that failed at the latest stage was closest: report its reason.
                if refusal.stage > failure.stage:
                    failure = refusal
    raise CannotMeasure("no-target", failure.reason)


def _measured(
    marks: tuple[Mark, Mark, Mark],
    darkness: FloatArray,
    background: FloatArray,
    level: float,
    unit_mm: float,
    lens: Lens | None,
) -> PlaneCalibration:
    """Measure the three objects and check them against the design."""
    dot, x_mark, z_mark = marks
    origin, origin_sigma = dot_center(dot, darkness)
    x_bar, z_bar = measured_bar(x_mark, darkness, "O′X′"), measured_bar(z_mark, darkness, "O′Z′")
    points = [origin, x_bar.middle, z_bar.middle]
    sigma = [origin_sigma, x_bar.sigma_px, z_bar.sigma_px]
    for name, uncertain in zip(("dot of O′", "bar on O′X′", "bar on O′Z′"), sigma, strict=True):
        if uncertain > MOST_SIGMA_PX:
            raise Refusal(
                4, f"The {name} is blurred or partly covered: known to ±{uncertain:.1f} px only."
            )
    row, column = np.round(origin[::-1]).astype(int)
    found = PlaneCalibration(
        origin_px=_pair(points[0]),
        x_axis_px=_pair(points[1]),
        x_axis_mm=sum(X_UNITS) / 2.0 * unit_mm,
        z_axis_px=_pair(points[2]),
        z_axis_mm=sum(Z_UNITS) / 2.0 * unit_mm,
        sigma_px=(sigma[0], sigma[1], sigma[2]),
        threshold=float(background[row, column]) * (1.0 - level),
        lens=lens,
    )
    bars = (x_bar, z_bar)
    for axis, bar, units in zip(AXES, bars, (X_UNITS, Z_UNITS), strict=True):
        _check_pointing(axis, origin, bar, units)
    ticks = _tick_marks(origin, bars, darkness, unit_mm)
    if not ticks:
        # Without flags, only the ends can show whether the bars are completely visible.
        for axis, bar, units in zip(AXES, bars, (X_UNITS, Z_UNITS), strict=True):
            _check_length(axis, origin, bar, units)
    if ticks is None:
        # In perspective, a bar with a hidden end can have the length of a whole one.
        raise Refusal(
            5,
            "The flags of the bars do not fit their ends: part of a bar is hidden, the lens "
            "distorts, or it is not this target.",
        )
    if ticks:
        found = replace(found, marks=ticks)
        assert found.fits is not None
        found = replace(found, model=found.fits.best)
    along_x, along_z = found.px_per_mm
    if abs(along_x / along_z - 1.0) > SCALE_TOLERANCE:
        raise Refusal(
            5,
            f"The axes' scales disagree: {along_x:.3g} px/mm along O′X′, {along_z:.3g} px/mm "
            "along O′Z′.",
        )
    if abs(found.angle_deg - 90.0) > ANGLE_TOLERANCE_DEG:
        raise Refusal(5, f"The axes are {found.angle_deg:.0f}° apart, which should be about 90°.")
    return found


def _tick_marks(
    origin: FloatArray,
    bars: tuple[Bar, Bar],
    darkness: FloatArray,
    unit_mm: float,
) -> tuple[tuple[float, float, float, float, float], ...] | None:
    """O′, the bars' ends and flags; empty if too few are seen, None if they disagree."""
    unit_px = float(np.hypot(*(bars[0].middle - origin))) / (sum(X_UNITS) / 2.0)
    places = [(0.0, 0.0, origin)]
    least = 1
    for k, units in enumerate((X_UNITS, Z_UNITS)):
        bar, other = bars[k], bars[1 - k].direction
        along = bar_marks(bar, origin, units, other, darkness)
        places += [(t, 0.0, place) if k == 0 else (0.0, t, place) for t, place in along]
        least += 2 + (int(np.ceil(units[1])) - int(np.floor(units[0])) - 1) // 2
    marks = [
        (x, z, *_pair(place), local_noise(darkness, place, 0.5 * unit_px)) for x, z, place in places
    ]
    if len(marks) < least:
        return ()
    ends = {(t, 0.0) for t in X_UNITS} | {(0.0, t) for t in Z_UNITS}
    while len(marks) >= least:
        table = np.array(marks)
        fit = fit_marks(table[:, :2] * unit_mm, table[:, 2:4], table[:, 4]).homography
        if fit is None:
            return ()
        off = np.hypot(*fit.left_out_px.T)
        worst = int(np.argmax(off))
        stray = off[worst] > max(5.0 * float(np.median(off)), 0.3)
        # A scratch or a speck can be mistaken for a flag, but for neither O′ nor an end.
        if stray and worst and marks[worst][:2] not in ends:
            del marks[worst]
            continue
        if off[worst] > MARK_OFF * unit_px:
            break
        return tuple((x * unit_mm, z * unit_mm, u, v, noise) for x, z, u, v, noise in marks)
    return None


def _check_pointing(axis: str, origin: FloatArray, bar: Bar, units: tuple[float, float]) -> None:
    """Refuse a bar that does not point at O′."""
    arm = bar.middle - origin
    unit_px = float(np.hypot(*arm)) / (sum(units) / 2.0)
    passes_by = abs(arm[0] * bar.direction[1] - arm[1] * bar.direction[0]) / unit_px
    if passes_by > MOST_ASIDE:
        raise Refusal(
            4, f"The bar on {axis} does not point at O′: it passes {passes_by:.2g} units off."
        )


def _check_length(axis: str, origin: FloatArray, bar: Bar, units: tuple[float, float]) -> None:
    """Refuse a bar whose length does not match the design."""
    begin, end = units
    unit_px = float(np.hypot(*(bar.middle - origin))) / ((begin + end) / 2.0)
    expected = (end - begin) / 2.0 * unit_px
    # If 2s of a bar is hidden, its half length is s shorter, but the expected half length also
    # shrinks by s·(end - begin) / (end + begin), as the middle moves. An end may be half a pixel
    # off even in a coarse picture.
    tolerance = max(MIDDLE_OFF * 2.0 * begin / (begin + end) * unit_px, 0.5)
    if abs(bar.half_length - expected) > tolerance:
        raise Refusal(
            5,
            f"The bar on {axis} is {2.0 * bar.half_length:.1f} px long; from its middle's distance "
            f"to O′ it should be {2.0 * expected:.1f} px: part of it is hidden, or it is not "
            "this target.",
        )


def _pair(point: FloatArray) -> tuple[float, float]:
    return float(point[0]), float(point[1])
