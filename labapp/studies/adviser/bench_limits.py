"""Limits of a bench, and margins of a set-up within them (§4.2.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from labapp.config.bench_check import semidefinite
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from labapp.core.values import FloatArray
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import Pool
from labapp.studies.adviser.expected_pools import ExpectedPools, Range
from labapp.studies.parameter_deviation import NOMINAL

Constraint = Literal["torch", "across", "up", "spacing", "once", "dots"]

CONSTRAINTS: dict[Constraint, tuple[str, str]] = {
    "torch": ("rays pass below the electrode's tip", "mm"),
    "across": ("dots on the imaging plane, left and right", "mm"),
    "up": ("dots on the imaging plane, above and below", "mm"),
    "spacing": ("neighbouring dots apart", "px"),
    "once": ("no ray meets the pool twice", "rays"),
    "dots": ("dots that a surface needs", "dots"),
}
"""Text of each constraint on a set-up, and unit of its margin, which is negative if violated."""

RINGS, AROUND = np.linspace(0.4, 1.0, 7), 48
"""Ellipses on a pool, and points on each, from which rays are traced to find the dots' extent."""

FAR_MM = 1e3
"""Distance assumed for a dot that does not exist and for a ray parallel to the plane."""

LEAST_DOTS = 16
"""Fewest dots: with fewer, the middle of the smallest pool depends on only a few slopes."""


@dataclass(frozen=True)
class Place:
    """Position of laser and imaging plane; mm and degrees as in a setup file."""

    projection_angle_deg: float
    distance_mm: float
    plane_mm: float
    s_mm: float
    h_mm: float


@dataclass(frozen=True)
class BenchLimits:
    """Ranges of the adjustable quantities, and values of the fixed ones."""

    angle_deg: Range = (25.0, 35.0)
    distance_mm: Range = (25.0, 35.0)
    """Ranges of the laser's projection angle and distance."""
    plane_mm: Range = (30.0, 100.0)
    """Range of the imaging plane's distance."""
    s_mm: Range = (0.0, 101.6)
    h_mm: Range = (0.0, 20.0)
    """Ranges of the position of O′: to the left of the electrode, and above the work piece."""
    plate_mm: tuple[float, float] = (101.6, 101.6)
    """Width and height of the imaging plane."""
    edge_mm: float = 1.0
    """Minimum distance of dots from the edges of the plane."""
    electrode_mm: float = 5.0
    """Height of the tip."""
    pattern: DotPattern = field(default_factory=DotPattern)
    px_per_mm: float = 4.7
    """Scale of the camera on the imaging plane."""
    spacing_px: float = 6.0
    """Minimum distance of neighbouring dots that can be resolved."""
    dot_sigma_px: float = 0.3
    """Standard uncertainty of a dot's position."""
    sigma: Mapping[str, float] = field(default_factory=lambda: dict(NOMINAL))
    """Standard uncertainties of the bench's quantities, by `Quantity.sigma_key`."""
    angle_distance_correlation: float = 0.0
    """Correlation of the laser's projection angle and distance."""
    points_covariance_px2: Sequence[Sequence[float]] | None = None
    """Covariance of the points of the image calibration (`covariance_of`), 6 × 6, px²."""

    @property
    def dot_sigma_mm(self) -> float:
        """Standard uncertainty of a dot's position on the plane, mm."""
        return self.dot_sigma_px / self.px_per_mm

    @property
    def axes(self) -> AxisPoints:
        """The image calibration of a camera perpendicular to the plate (§5.1)."""
        across, up = self.plate_mm
        scale = self.px_per_mm
        calibration = ImageCalibration.from_three_points(
            (0.0, up * scale), (across / 2 * scale, up * scale), across / 2,
            (0.0, up / 2 * scale), up / 2,
        )  # fmt: skip
        return AxisPoints(calibration, across / 2, up / 2)

    @property
    def uncertainty(self) -> RigUncertainty:
        """Uncertainty of the bench, independent of the positions of laser and plane."""
        of_points = self.points_covariance_px2
        known = None if of_points is None else semidefinite(np.array(of_points, float))
        covariance = covariance_of(self.sigma, self.angle_distance_correlation, known)
        return RigUncertainty(self.axes, *covariance)

    def rig(self, place: Place) -> Rig:
        """The bench with laser and plane at a position."""
        return Rig(
            Laser(place.projection_angle_deg, place.distance_mm),
            self.pattern,
            Electrode(self.electrode_mm),
            ImagingPlane.vertical(place.plane_mm, place.s_mm, place.h_mm, *self.plate_mm),
        )


class LaserPlace:
    """Reflections from the expected pools for a position of the laser, for any plane position.

    Rays are traced to points on the extreme pools instead of along the pattern's rays: a slightly
    shifted pool has a ray right at its edge.
    """

    def __init__(
        self, expected: ExpectedPools, limits: BenchLimits, angle_deg: float, distance_mm: float
    ) -> None:
        self.limits, self.laser = limits, Laser(angle_deg, distance_mm)
        ways = [self._followed(pool) for pool in expected.corners(shifted=True)]
        self.points, self.away, self.tip_mm = (
            np.concatenate([way[k] for way in ways]) for k in range(3)
        )
        rig = limits.rig(Place(angle_deg, distance_mm, limits.plane_mm[0], 0.0, 0.0))
        self.seen = [trace(pool, rig) for pool in expected.corners(shifted=False)]

    def _followed(self, pool: Pool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points on a pool in the pattern's reach, shape (n, 3), their reflected rays, and Z.

        Z is the height at which the incident or the reflected ray crosses y = 0.
        """
        rim = pool.boundary_mm(AROUND)[:, :2]
        center = np.array(pool.footprint.center_mm)
        x, y = (center + RINGS[:, None, None] * (rim - center)).reshape(-1, 2).T
        points = np.column_stack([x, y, pool.height(x, y)])
        incident = points - self.laser.position_mm
        within = self._in_fan(incident)
        points, incident = points[within], incident[within]
        slope = pool.gradient(points[:, 0], points[:, 1])
        normal = np.column_stack([-slope, np.ones(len(slope))])
        turn = 2 * np.sum(incident * normal, axis=-1) / np.sum(normal**2, axis=-1)
        away = incident - turn[:, None] * normal
        behind = points[:, 1] < 0
        way = np.where(behind[:, None], -incident, away)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -points[:, 1] / way[:, 1]
            crossing = points[:, 2] + along * way[:, 2]
        return points, away, np.where(along > 0, crossing, 0.0)

    def _in_fan(self, incident: FloatArray) -> FloatArray:
        alpha, pattern = np.radians(self.laser.projection_angle_deg), self.limits.pattern
        beam = np.array([0.0, -np.cos(alpha), -np.sin(alpha)])
        up = np.array([0.0, -np.sin(alpha), np.cos(alpha)])
        forward = incident @ beam
        # Half a step beyond the outermost rays, for points between rays.
        across, along = (
            np.tan(np.radians(pattern.inter_beam_angle_deg)) * count / 2
            for count in (pattern.columns, pattern.rows)
        )
        inside = np.abs(incident[:, 0]) <= across * forward
        return np.asarray(inside & (np.abs(incident @ up) <= along * forward))

    def best_plate(self, plane_mm: float) -> Place:
        """Place the plate such that the dots are farthest from its edges, within s and h."""
        x, z = _dots(self.points, self.away, plane_mm).T
        across, up = self.limits.plate_mm
        s = float(np.clip((across - x.min() - x.max()) / 2, *self.limits.s_mm))
        h = float(np.clip((z.min() + z.max() - up) / 2, *self.limits.h_mm))
        return Place(self.laser.projection_angle_deg, self.laser.distance_mm, plane_mm, s, h)

    def margins(self, place: Place) -> dict[Constraint, float]:
        """Margin of each of `CONSTRAINTS`; negative if violated."""
        limits = self.limits
        x, z = _dots(self.points, self.away, place.plane_mm).T
        x, z = x + place.s_mm, z - place.h_mm
        across, up = limits.plate_mm
        lit = [one.lit for one in self.seen]
        closest = min((self._closest(one, place.plane_mm) for one in self.seen), default=0.0)
        return {
            "torch": limits.electrode_mm - float(self.tip_mm.max()),
            "across": float(min(x.min(), across - x.max())) - limits.edge_mm,
            "up": float(min(z.min(), up - z.max())) - limits.edge_mm,
            "spacing": closest * limits.px_per_mm - limits.spacing_px,
            "once": -float(max((one.hits_again & one.lit).sum() for one in self.seen)),
            "dots": float(min(one.sum() for one in lit)) - LEAST_DOTS,
        }

    def _closest(self, seen: Reflections, plane_mm: float) -> float:
        dots = _dots(seen.point_mm[seen.lit], seen.reflected[seen.lit], plane_mm)
        if len(dots) < 2:
            return 0.0
        apart = np.linalg.norm(dots[:, None] - dots, axis=-1)
        return float(apart[np.triu_indices(len(dots), 1)].min())


def _dots(points: FloatArray, away: FloatArray, plane_mm: float) -> FloatArray:
    """X and Z at y = −plane_mm, shape (n, 2), mm."""
    toward = np.minimum(away[:, 1], -1e-9)
    along = (-plane_mm - points[:, 1]) / toward
    return np.asarray(np.clip(points[:, ::2] + along[:, None] * away[:, ::2], -FAR_MM, FAR_MM))


def broken(margins: dict[Constraint, float]) -> float:
    """Sum of the violated margins; 0 if the set-up is possible."""
    return -sum(min(margin, 0.0) for margin in margins.values())
