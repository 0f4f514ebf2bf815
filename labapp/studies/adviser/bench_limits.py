"""What a bench lets be chosen, and how far a set-up stays within it (§4.2.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

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
    "across": ("dots on the plate, left and right", "mm"),
    "up": ("dots on the plate, above and below", "mm"),
    "spacing": ("neighbouring dots apart", "px"),
    "once": ("no ray meets the pool twice", "rays"),
    "dots": ("dots that a surface needs", "dots"),
}
"""What a set-up must keep: in words, and the unit of its margin, which is negative if broken."""

RINGS, AROUND = np.linspace(0.4, 1.0, 7), 48
"""Where on a pool rays are followed to see how far their dots go: ellipses, points on each."""

FAR_MM = 1e3
"""A dot that never comes, or a ray that runs along the plane, counts as so far off."""

LEAST_DOTS = 16
"""With fewer the middle of the smallest pool hangs on a handful of slopes."""


@dataclass(frozen=True)
class Place:
    """Where laser and imaging plane stand; mm and degrees as in a setup file."""

    projection_angle_deg: float
    distance_mm: float
    plane_mm: float
    s_mm: float
    h_mm: float


@dataclass(frozen=True)
class BenchLimits:
    """What can be moved how far, and what is as it is."""

    angle_deg: Range = (25.0, 35.0)
    distance_mm: Range = (25.0, 35.0)
    """Laser: projection angle and distance, from the least to the most."""
    plane_mm: Range = (30.0, 100.0)
    """Distance of the imaging plane."""
    s_mm: Range = (0.0, 101.6)
    h_mm: Range = (0.0, 20.0)
    """Where O′ can stand: to the left of the electrode, and above the work piece."""
    plate_mm: tuple[float, float] = (101.6, 101.6)
    """Width and height of the imaging plane."""
    edge_mm: float = 1.0
    """Least distance of dots from its edges."""
    electrode_mm: float = 5.0
    """Height of the tip."""
    pattern: DotPattern = field(default_factory=DotPattern)
    px_per_mm: float = 4.7
    """Of the camera, on the imaging plane."""
    spacing_px: float = 6.0
    """Neighbouring dots that lie closer cannot be resolved."""
    dot_sigma_px: float = 0.3
    """Standard uncertainty of a dot's place."""
    sigma: Mapping[str, float] = field(default_factory=lambda: dict(NOMINAL))
    """Standard uncertainties of the bench's quantities, by `Quantity.sigma_key`."""
    angle_distance_correlation: float = 0.0
    """Of the laser's projection angle and distance."""

    @property
    def dot_sigma_mm(self) -> float:
        """Standard uncertainty of a dot's place on the plane, mm."""
        return self.dot_sigma_px / self.px_per_mm

    @property
    def axes(self) -> AxisPoints:
        """The image calibration of a camera that looks straight at the plate (§5.1)."""
        across, up = self.plate_mm
        scale = self.px_per_mm
        calibration = ImageCalibration.from_three_points(
            (0.0, up * scale), (across / 2 * scale, up * scale), across / 2,
            (0.0, up / 2 * scale), up / 2,
        )  # fmt: skip
        return AxisPoints(calibration, across / 2, up / 2)

    @property
    def uncertainty(self) -> RigUncertainty:
        """How well the bench will be known, wherever laser and plane stand."""
        return RigUncertainty(
            self.axes, *covariance_of(self.sigma, self.angle_distance_correlation)
        )

    def rig(self, place: Place) -> Rig:
        """The bench with laser and plane at a place."""
        return Rig(
            Laser(place.projection_angle_deg, place.distance_mm),
            self.pattern,
            Electrode(self.electrode_mm),
            ImagingPlane.vertical(place.plane_mm, place.s_mm, place.h_mm, *self.plate_mm),
        )


class LaserPlace:
    """What a place of the laser makes of the expected pools, wherever the plane stands.

    Rays are followed to the extreme pools themselves rather than where the pattern's rays happen
    to fall: a pool a little to the side has one right at its edge.

    Parameters
    ----------
    angle_deg, distance_mm
        The laser's place.
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
        """Points on a pool in the pattern's reach, shape (n, 3), where rays go from there, and Z.

        Z is that at which the incident or the reflected ray crosses y = 0.
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
        # Half a ray more than there is, for what lies between.
        across, along = (
            np.tan(np.radians(pattern.inter_beam_angle_deg)) * count / 2
            for count in (pattern.columns, pattern.rows)
        )
        inside = np.abs(incident[:, 0]) <= across * forward
        return np.asarray(inside & (np.abs(incident @ up) <= along * forward))

    def place(self, plane_mm: float) -> Place:
        """Put the plate where the dots are farthest from its edges, as far as s and h go."""
        x, z = _dots(self.points, self.away, plane_mm).T
        across, up = self.limits.plate_mm
        s = float(np.clip((across - x.min() - x.max()) / 2, *self.limits.s_mm))
        h = float(np.clip((z.min() + z.max() - up) / 2, *self.limits.h_mm))
        return Place(self.laser.projection_angle_deg, self.laser.distance_mm, plane_mm, s, h)

    def margins(self, place: Place) -> dict[Constraint, float]:
        """By how much each of `CONSTRAINTS` is kept; negative: broken."""
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
    """How far a set-up is from being possible, 0 if it is: the broken margins' sum."""
    return -sum(min(margin, 0.0) for margin in margins.values())
