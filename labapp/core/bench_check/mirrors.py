"""Mirrors of known shape, and the points where reflected rays meet the imaging plane.

A mirror has a *pose*, the vector of its uncertain parameters, with standard uncertainties. The
names of the parameters have the unit as suffix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.optics import (
    intersect_imaging_plane,
    intersect_level,
    ray_directions,
    reflect,
)
from labapp.core.geometry.rig import Rig
from labapp.core.values import BoolArray, FloatArray, IntArray

FREE_MM = 10.0
"""Standard uncertainty of an unknown length, mm."""


@dataclass(frozen=True)
class Plate:
    """A flat polished plate, larger than the dot matrix on it.

    Parameters
    ----------
    height_mm
        Height of its surface over the work piece at the origin.
    height_sigma_mm
        Standard uncertainty of the height. The default is for a plate in place of the work piece,
        or a gauge block on it.
    tilt_sigma_deg
        Standard uncertainty of the tilt along X and along Y. The default is for a plate on the work
        piece or a levelled table.
    """

    height_mm: float = 0.0
    height_sigma_mm: float = 0.02
    tilt_sigma_deg: float = 0.1

    @property
    def name(self) -> str:
        """The mirror in a few words."""
        return f"plate at {self.height_mm:g} mm"

    @property
    def parameters(self) -> tuple[str, ...]:
        """Height at the origin, and tilt along X and along Y."""
        return ("height_mm", "tilt_x_deg", "tilt_y_deg")

    @property
    def pose(self) -> FloatArray:
        """Expected pose, shape (d,)."""
        return np.array([self.height_mm, 0.0, 0.0])

    @property
    def sigma(self) -> FloatArray:
        """Standard uncertainty of each parameter, shape (d,)."""
        return np.array([self.height_sigma_mm, self.tilt_sigma_deg, self.tilt_sigma_deg])

    def meet(
        self, source_mm: FloatArray, direction: FloatArray, pose: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Intersect rays with the mirror at a pose.

        Parameters
        ----------
        source_mm, direction
            The laser, shape (3,), mm; the rays' unit directions, shape (…, 3).
        pose
            Shape (d,).

        Returns
        -------
        point_mm, normal, hit
            Point and upward normal, shapes (…, 3), also slightly beyond the mirror's edge, so that
            they are smooth functions of the pose; whether the ray meets the mirror, shape (…).
        """
        normal = np.append(-np.tan(np.radians(pose[1:3])), 1.0)
        falls = direction @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (pose[0] - source_mm @ normal) / falls
        point = source_mm + way[..., None] * direction
        return point, np.broadcast_to(normal, point.shape), np.asarray(way > 0)


@dataclass(frozen=True)
class _Sphere:
    """Part of a sphere, by its diameter and the height of its top over the work piece."""

    diameter_mm: float
    height_mm: float
    diameter_sigma_mm: float = 0.02
    height_sigma_mm: float = 0.005
    place_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Place and height of its top, and diameter."""
        return ("x_mm", "y_mm", "height_mm", "diameter_mm")

    @property
    def pose(self) -> FloatArray:
        """Expected pose, shape (d,)."""
        return np.array([*self.place_mm, self.height_mm, self.diameter_mm])

    @property
    def sigma(self) -> FloatArray:
        """Standard uncertainty of each parameter, shape (d,)."""
        return np.array([FREE_MM, FREE_MM, self.height_sigma_mm, self.diameter_sigma_mm])


@dataclass(frozen=True)
class Cap(_Sphere):
    """A cap of a sphere on the work piece: a thumb tack, or a lens's face.

    Parameters
    ----------
    diameter_mm, height_mm
        Diameter of its rim, which lies on the work piece, and height of its top.
    diameter_sigma_mm, height_sigma_mm
        Standard uncertainties of these; the defaults are those of a caliper and a dial gauge.
    place_mm
        Expected X and Y of its top.
    """

    @property
    def name(self) -> str:
        """The mirror in a few words."""
        return f"cap ⌀ {self.diameter_mm:g} mm, {self.height_mm:g} mm high"

    def meet(
        self, source_mm: FloatArray, direction: FloatArray, pose: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Intersect rays with the cap, see `Plate.meet`."""
        x, y, top, diameter = pose
        radius = sphere_radius(diameter, top)
        center = np.array([x, y, top - radius])
        point, normal, met = _meet_sphere(source_mm, direction, center, radius)
        out = np.hypot(point[..., 0] - x, point[..., 1] - y)
        return point, normal, np.asarray(met & (out < diameter / 2) & (normal[..., 2] > 0))


@dataclass(frozen=True)
class Ball(_Sphere):
    """A bearing ball, on the work piece or sunk into it.

    Parameters
    ----------
    diameter_mm, height_mm
        Its diameter, and height of its top: the diameter if it lies on the work piece.
    diameter_sigma_mm, height_sigma_mm
        Standard uncertainties of these.
    place_mm
        Expected X and Y of its top, see `placed`.
    """

    diameter_sigma_mm: float = 0.002
    height_sigma_mm: float = 0.01

    @property
    def name(self) -> str:
        """The mirror in a few words."""
        return f"ball ⌀ {self.diameter_mm:g} mm, top at {self.height_mm:g} mm"

    def meet(
        self, source_mm: FloatArray, direction: FloatArray, pose: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Intersect rays with the ball above the work piece, see `Plate.meet`."""
        x, y, top, diameter = pose
        center = np.array([x, y, top - diameter / 2])
        point, normal, met = _meet_sphere(source_mm, direction, center, diameter / 2)
        return point, normal, np.asarray(met & (point[..., 2] > 0) & (normal[..., 2] > 0))


Mirror = Plate | Cap | Ball
"""A mirror in a bench check; its pose has d parameters."""


def placed(mirror: Mirror, rig: Rig) -> Mirror:
    """Return the mirror at its expected position: a ball's top lies on the beam axis."""
    if not isinstance(mirror, Ball):
        return mirror
    laser = rig.laser
    x, y, _ = intersect_level(laser.position_mm, laser.axes[0], mirror.height_mm).tolist()
    return replace(mirror, place_mm=(x, y))


def sphere_radius(diameter_mm: float, height_mm: float) -> float:
    """Radius of the sphere of a cap with a given rim diameter and height, mm."""
    return (diameter_mm**2 / 4 + height_mm**2) / (2 * height_mm)


def landing_points(
    mirror: Mirror, pose: FloatArray, rig: Rig, of: tuple[IntArray, ...] = ()
) -> tuple[FloatArray, BoolArray]:
    """Points where rays reflected by a mirror meet the imaging plane.

    Parameters
    ----------
    mirror, pose, rig
        The mirror, its pose, shape (d,), and the bench.
    of
        Rows and columns of the rays, counted from 0, shapes (n,). Empty: all rays.

    Returns
    -------
    plane_mm, hit
        IPCS (X′, Z′), shape (rows, columns, 2) or (n, 2), mm, the plane's edges ignored, NaN if a
        ray does not meet it; whether the ray meets the mirror and the plane. Absent rays are
        traced like others.
    """
    point, direction, hit = reflected_rays(mirror, pose, rig, of)
    plane = intersect_imaging_plane(point, direction, rig.imaging_plane)
    return plane, np.asarray(hit & np.isfinite(plane[..., 0]))


def reflected_rays(
    mirror: Mirror, pose: FloatArray, rig: Rig, of: tuple[IntArray, ...] = ()
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Reflected rays, as `landing_points`: points, UCS, mm, and directions, shapes (…, 3); hits."""
    rays = ray_directions(rig.laser, rig.pattern)[of]
    point, normal, hit = mirror.meet(rig.laser.position_mm, rays, pose)
    return point, reflect(rays, normal), hit


def _meet_sphere(
    source_mm: FloatArray, direction: FloatArray, center_mm: FloatArray, radius_mm: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """First intersection with a sphere (else a point near it), and the normal from its centre."""
    offset = center_mm - source_mm
    along = direction @ offset
    square = radius_mm**2 - (offset @ offset - along**2)
    way = along - np.sqrt(np.maximum(square, 0.0))
    point = source_mm + way[..., None] * direction
    normal = point - center_mm
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return point, normal, np.asarray((square > 0) & (way > 0))
