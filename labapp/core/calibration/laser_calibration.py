"""Angle, distance and height of the laser from the lengths of a projected cross (Appendix I).

A cross-hair lens with a known fan angle θ draws a cross on the work piece. With α = θ/2, the
half lengths of the cross are, by the law of sines in the beam's plane,

    l₁ = x·sin α / sin(α₅ + α)      along the beam, on the laser's side
    l₂ = x·sin α / sin(α₅ − α)      along the beam, away from the laser
    l₃ = x·tan α                    across the beam, each side

for a laser at distance x from the centre of the cross, its beam at elevation α₅.

Every ± is a standard uncertainty u such that ±1.96·u covers 95 %, even for few readings: the
standard uncertainty from their scatter is multiplied by Student's factor over 1.96, with the
effective degrees of freedom of Welch and Satterthwaite (JCGM 100, G.4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from labapp.core.geometry.rig import Laser
from labapp.core.values import FloatArray

LONGEST_MM = 1e4
"""Lengths of a cross-hair are shorter."""

COVERAGE_FACTOR = 1.959964
"""Half width of the 95 % interval of a normal distribution, in units of σ."""

DOUBT_SIGMA, REFUSE_SIGMA, REFUSE_FRACTION = 2.0, 4.0, 0.05
"""Lengths that disagree by more standard uncertainties than the first cause a warning; by more than
the second, and by more than this fraction of the length, they are refused."""

READINGS_APART = 6.0
"""Readings of a length that are farther apart than this many standard deviations of a reading cause
a warning. One set of ten correct readings in a thousand scatters so much."""


@dataclass(frozen=True)
class LaserCalibration:
    """Position and orientation of the laser, with standard uncertainties.

    Parameters
    ----------
    angle_deg, angle_sigma_deg
        Elevation α₅ of the beam above the work piece, degrees.
    distance_mm, distance_sigma_mm
        Slant distance x_l from the diode to the centre of the cross (the origin), mm.
    height_mm, height_sigma_mm
        Height h_l of the diode above the work piece, mm.
    horizontal_mm, horizontal_sigma_mm
        Horizontal distance d_l from the diode to the origin, mm.
    expected_l1_mm
        l₁ computed from l₂, l₃ and the fan angle, mm; compared with the measured l₁.
    warnings
        Sentences for the operator about inconsistent lengths and about assumptions.
    correlation
        Correlation of angle and distance, which both depend on l₃ and the fan angle.
    """

    angle_deg: float
    angle_sigma_deg: float
    distance_mm: float
    distance_sigma_mm: float
    height_mm: float
    height_sigma_mm: float
    horizontal_mm: float
    horizontal_sigma_mm: float
    expected_l1_mm: float
    warnings: tuple[str, ...] = ()
    correlation: float = 0.0

    @property
    def laser(self) -> Laser:
        """The laser of the rig."""
        return Laser(projection_angle_deg=self.angle_deg, distance_mm=self.distance_mm)

    @property
    def setup_keys(self) -> dict[str, object]:
        """Keys of the section ``[laser]`` of a setup file, with their uncertainties."""
        return {
            "projection_angle_deg": self.angle_deg,
            "projection_angle_deg_sigma": self.angle_sigma_deg,
            "distance_mm": self.distance_mm,
            "distance_mm_sigma": self.distance_sigma_mm,
            "angle_distance_correlation": self.correlation,
        }


@dataclass(frozen=True)
class LaserCalibrationSettings:
    """Uncertainties of the lengths and of the fan angle.

    Parameters
    ----------
    resolution_mm
        Resolution of the callipers or ruler, mm. The uncertainty of a length is at least that of
        a uniform distribution of this width, however many readings there are.
    reading_sigma_mm
        Standard deviation of a reading, mm, assumed if there is only one.
    fan_angle_sigma_deg
        Standard uncertainty of the lens's fan angle, degrees; the default is an assumption, as
        manufacturers seldom state it.
    """

    resolution_mm: float = 0.05
    reading_sigma_mm: float = 0.1
    fan_angle_sigma_deg: float = 0.1


def calibrate_laser(
    l1_mm: npt.ArrayLike,
    l2_mm: npt.ArrayLike,
    l3_mm: npt.ArrayLike,
    fan_angle_deg: float = 10.0,
    settings: LaserCalibrationSettings | None = None,
) -> LaserCalibration:
    """Determine the laser's position from its cross on the work piece (Appendix I, Fig. A-1).

    Angle and distance come from l₂ and l₃ as in Appendix I; l₁ then follows and is compared with
    the measured one. A beam perpendicular to the work piece (l₁ = l₂ = l₃) has α₅ = 90°.

    Parameters
    ----------
    l1_mm, l2_mm, l3_mm
        Half lengths of the cross: laser's side, far side, across; one reading or repeated
        readings, shape () or (n,), mm.
    fan_angle_deg
        Fan angle θ of the cross-hair lens, degrees.
    settings
        Uncertainties; None for the defaults.

    Raises
    ------
    ValueError
        If a reading is not a positive length, or the lengths contradict each other. The message
        names the length, its value and the accepted values.
    """
    settings = settings or LaserCalibrationSettings()
    if not 0.0 < fan_angle_deg < 90.0:
        raise ValueError(
            f"fan_angle_deg = {fan_angle_deg:g}: the fan angle lies between 0 and 90 degrees"
        )
    names = ("l1_mm", "l2_mm", "l3_mm")
    l1, l2, l3 = (
        _length(readings, name, settings)
        for readings, name in zip((l1_mm, l2_mm, l3_mm), names, strict=True)
    )
    once = [name for name, one in zip(names, (l1, l2, l3), strict=True) if one.readings == 1]
    warnings = (
        [
            f"One reading of {', '.join(once)}: ±{settings.reading_sigma_mm:g} mm is assumed; "
            "take three readings or more."
        ]
        if once
        else []
    )
    for name, readings in zip(names, (l1_mm, l2_mm, l3_mm), strict=True):
        low, high = float(np.min(readings)), float(np.max(readings))
        if high - low > READINGS_APART * settings.reading_sigma_mm:
            warnings.append(
                f"The readings of {name} are {high - low:.2g} mm apart ({low:g} to {high:g}): one "
                "of them may be wrong. Their scatter makes every ± larger."
            )
    for name, length in (("l1_mm", l1), ("l3_mm", l3)):
        apart = float(np.hypot(length.expanded, l2.expanded))
        _check_order(name, length.mean_mm, l2.mean_mm, apart, warnings)

    values, jacobian = _appendix_i(l2.mean_mm, l3.mean_mm, float(np.radians(fan_angle_deg / 2.0)))
    half_sigma = np.radians(settings.fan_angle_sigma_deg / 2.0)
    inputs = np.array([l2.sigma_mm, l3.sigma_mm, half_sigma])
    parts = jacobian * inputs
    freedom = np.array([l2.freedom, l3.freedom, np.inf])
    sigma = np.array([_expanded(own, freedom) for own in parts])
    shared, alone = parts[0] @ parts[1], np.linalg.norm(parts[:2], axis=1).prod()
    angle, distance, height, horizontal, expected_l1 = (float(v) for v in values)
    _check_l1(l1.mean_mm, expected_l1, float(np.hypot(l1.expanded, sigma[4])), warnings)
    return LaserCalibration(
        angle_deg=float(np.degrees(angle)),
        angle_sigma_deg=float(np.degrees(sigma[0])),
        distance_mm=distance,
        distance_sigma_mm=float(sigma[1]),
        height_mm=height,
        height_sigma_mm=float(sigma[2]),
        horizontal_mm=horizontal,
        horizontal_sigma_mm=float(sigma[3]),
        expected_l1_mm=expected_l1,
        warnings=tuple(warnings),
        correlation=float(shared / alone) if alone else 0.0,
    )


def _appendix_i(l2: float, l3: float, half: float) -> tuple[FloatArray, FloatArray]:
    """Angle, distance, height, horizontal distance, l₁; and their Jacobian w.r.t. (l₂, l₃, α).

    Shapes (5,) and (5, 3); radians and mm. With α₂ = 90° + α, the law of sines gives
    sin α₃ = (l₃/l₂)·sin α₂, and the elevation is α₅ = α₃ + α.
    """
    ratio = min(l3 / l2, 1.0)  # l₃ > l₂ within their uncertainty: beam perpendicular to the plane
    sine = ratio * np.cos(half)
    angle = np.arcsin(sine) + half
    d_angle = np.array([-sine / l2, sine / l3, -ratio * np.sin(half)]) / np.sqrt(1.0 - sine**2)
    d_angle[2] += 1.0

    distance = l3 / np.tan(half)
    d_distance = np.array([0.0, 1.0 / np.tan(half), -l3 / np.sin(half) ** 2])

    height, horizontal = distance * np.sin(angle), distance * np.cos(angle)
    d_height = d_distance * np.sin(angle) + horizontal * d_angle
    d_horizontal = d_distance * np.cos(angle) - height * d_angle

    near = angle + half
    l1 = distance * np.sin(half) / np.sin(near)
    d_half = np.array([0.0, 0.0, 1.0])
    d_l1 = l1 * (d_distance / distance + d_half / np.tan(half) - (d_angle + d_half) / np.tan(near))
    return (
        np.array([angle, distance, height, horizontal, l1]),
        np.stack([d_angle, d_distance, d_height, d_horizontal, d_l1]),
    )


class _Length(NamedTuple):
    """Mean of the readings, its standard uncertainty, its degrees of freedom, and their number."""

    mean_mm: float
    sigma_mm: float
    freedom: float
    readings: int

    @property
    def expanded(self) -> float:
        """Standard uncertainty with Student's factor, mm."""
        return self.sigma_mm * _student(self.freedom)


def _length(readings: npt.ArrayLike, name: str, settings: LaserCalibrationSettings) -> _Length:
    values = np.atleast_1d(np.asarray(readings, float)).ravel()
    if values.size == 0:
        raise ValueError(f"{name} is empty: give at least one reading in mm")
    for value in values:
        if not 0.0 < value < LONGEST_MM:
            allowed = f"a reading is a positive number of mm, below {LONGEST_MM:g}"
            raise ValueError(f"{name} = {value:g}: {allowed}")
    mean, count = float(values.mean()), values.size
    # Averaging reduces the rounding error of readings only if they scatter beyond the resolution.
    least = settings.resolution_mm / np.sqrt(12.0)
    if count == 1:
        return _Length(mean, max(settings.reading_sigma_mm, least), np.inf, count)
    scatter = float(values.std(ddof=1)) / np.sqrt(count)
    return _Length(mean, max(scatter, least), count - 1, count)


def _expanded(parts: FloatArray, freedom: FloatArray) -> float:
    """Standard uncertainty of a sum of independent parts, shape (n,), with Student's factor.

    The factor, with the effective degrees of freedom, applies to the parts estimated from scatter.
    Parts with infinite degrees of freedom are added in quadrature without it.
    """
    squares = parts**2
    scatter = float(squares[np.isfinite(freedom)].sum())
    spread = float(np.sum(squares**2 / freedom))
    factor = _student(scatter**2 / spread) if spread > 0.0 else 1.0
    return float(np.sqrt(scatter * factor**2 + squares.sum() - scatter))


def _student(freedom: float) -> float:
    """95 % quantile factor of Student's distribution over that of the normal distribution."""
    if np.isinf(freedom):
        return 1.0
    return float(scipy.special.stdtrit(freedom, 0.975)) / COVERAGE_FACTOR


def _check_order(name: str, length: float, l2: float, sigma: float, warnings: list[str]) -> None:
    """Refuse a length greater than l₂, the longest half; warn if it is only slightly greater."""
    excess = length - l2
    if excess > REFUSE_SIGMA * sigma:
        raise ValueError(
            f"{name} = {length:.4g} is longer than l2_mm = {l2:.4g}: l2 is the half that points "
            f"away from the laser and is the longest; {name} is at most {l2:.4g}"
        )
    if excess > 1e-9 * l2:
        warnings.append(
            f"{name} = {length:.4g} is longer than l2_mm = {l2:.4g} by no more than their "
            "uncertainty; the beam is taken to be nearly square to the work piece."
        )


def _check_l1(l1: float, expected: float, sigma: float, warnings: list[str]) -> None:
    """Compare the measured l₁ with that computed from l₂, l₃ and the fan angle."""
    off = abs(l1 - expected)
    if off > REFUSE_SIGMA * sigma and off > REFUSE_FRACTION * expected:
        raise ValueError(
            f"l1_mm = {l1:.4g} contradicts l2_mm and l3_mm: with these and the fan angle it "
            f"should be {expected:.4g} ± {sigma:.2g}; measure the three lengths again and check "
            "that the cross is aligned with the tilt of the laser"
        )
    if off > DOUBT_SIGMA * sigma:
        warnings.append(
            f"l1_mm = {l1:.4g} differs from the {expected:.4g} ± {sigma:.2g} that follow from "
            "l2_mm, l3_mm and the fan angle."
        )
