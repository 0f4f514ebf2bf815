"""Rays, the law of reflection, and intersections of rays with planes (Eq. 4-1 … 4-4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from labapp.core.geometry.rig import DotPattern, ImagingPlane, Laser
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays


@lru_cache(maxsize=64)
def ray_directions(laser: Laser, pattern: DotPattern) -> FloatArray:
    """Unit directions of all projected rays (Eq. 4-1, Fig. 4-14).

    Returns
    -------
    FloatArray
        Shape (rows, columns, 3), read-only; ray (i, j), counted from 1, is at
        ``[i - 1, j - 1]``. i grows with Y on the work piece, j with X.
    """
    direction = laser.directions(pattern.tangents)
    direction.flags.writeable = False
    return direction


def surface_normal(gradient: FloatArray) -> FloatArray:
    """Upward normal (not normalised) of z = f(x, y) from (f_x, f_y), shape (…, 2) (Eq. 4-2)."""
    gradient = np.asarray(gradient, float)
    return np.concatenate([-gradient, np.ones((*gradient.shape[:-1], 1))], axis=-1)


def reflect(direction: FloatArray, normal: FloatArray) -> FloatArray:
    """Direction after reflection at a surface with the given normal, shapes (…, 3) (Eq. 4-4).

    The length of ``direction`` is preserved; ``normal`` need not be a unit vector.
    """
    k = np.vecdot(direction, normal) / np.vecdot(normal, normal)
    return np.asarray(direction - 2.0 * k[..., None] * normal)


def bisecting_gradient(incident: FloatArray, reflected: FloatArray) -> FloatArray:
    """Gradient (f_x, f_y), shape (…, 2), of the surface that reflects one direction to the other.

    The normal bisects the reversed incident ray and the reflected ray (Eq. 4-3). Both directions
    have shape (…, 3) and any length.
    """
    back, forth = (way / np.sqrt(np.vecdot(way, way))[..., None] for way in (incident, reflected))
    normal = forth - back
    return np.asarray(-normal[..., :2] / normal[..., 2:])


def intersect_imaging_plane(
    origin_mm: FloatArray, direction: FloatArray, plane: ImagingPlane
) -> FloatArray:
    """Intersect rays with the imaging plane: IPCS (X′, Z′), shape (…, 2), mm.

    A ray that points away from the plane or is parallel to it gives NaN. The plane is unbounded.
    Its glass refracts the ray towards the normal, which shifts the dot back along the plane.
    """
    normal = plane.normal
    along = np.asarray(direction @ normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((plane.origin_mm - origin_mm) @ normal) / along
    distance = np.where((distance > 0) & np.isfinite(distance), distance, np.nan)
    dot = plane.from_universal(origin_mm + distance[..., None] * direction)
    if not plane.glass_mm:
        return dot
    with np.errstate(divide="ignore", invalid="ignore"):
        aside = direction @ np.array([plane.x_axis, plane.z_axis]).T / np.abs(along)[..., None]
    share = _in_glass(plane.glass_index, np.vecdot(aside, aside))
    return np.asarray(dot - plane.glass_mm * (1.0 - share)[..., None] * aside)


def direction_to_dots(
    point_mm: FloatArray, plane_mm: FloatArray, plane: ImagingPlane
) -> FloatArray:
    """Directions of rays from points to their dots, shape (…, 3), not normalised.

    With glass, Snell's law is solved for the tangent of the angle of incidence by Newton's method.

    Parameters
    ----------
    point_mm, plane_mm
        Starting points, UCS, shape (…, 3), and dots, IPCS, shape (…, 2), mm.
    """
    way = plane.to_universal(plane_mm) - point_mm
    if not plane.glass_mm:
        return way
    along = (way @ plane.normal)[..., None] * plane.normal
    aside, gap = np.linalg.norm(way - along, axis=-1), np.linalg.norm(along, axis=-1)
    glass, index = plane.glass_mm, plane.glass_index
    air = np.maximum(gap - glass, 0.0)
    tangent = aside / (air + glass / index)
    for _ in range(_SNELL_STEPS):
        share = _in_glass(index, tangent**2)
        off = (air + glass * share) * tangent - aside
        tangent -= off / (air + glass * index**2 * share**3)
    farther = gap * tangent / np.maximum(aside, 1e-12)
    return np.asarray(along + farther[..., None] * (way - along))


_SNELL_STEPS = 4
"""Newton steps for the direction through glass: exact to rounding."""


def _in_glass(index: float, tangent2: FloatArray) -> FloatArray:
    """Ratio of the tangents of the rays' angles in glass and in air; takes that in air squared."""
    return np.asarray(1.0 / np.sqrt(index**2 + (index**2 - 1.0) * tangent2))


def intersect_level(
    origin_mm: FloatArray, direction: FloatArray, z_mm: FloatArray | float = 0.0
) -> FloatArray:
    """Intersect rays with planes z = z_mm, a scalar or shape (…, 1): points, shape (…, 3), mm."""
    return np.asarray(origin_mm + ((z_mm - origin_mm[..., 2:]) / direction[..., 2:]) * direction)


@dataclass(frozen=True)
class ProjectedRays(ReadOnlyArrays):
    """The rays of a pattern and their landing points on the work piece, z = 0.

    Parameters
    ----------
    directions
        Unit directions, shape (rows, columns, 3).
    landing_mm
        Intersections with the work piece, shape (rows, columns, 3), mm.
    absent
        Whether a ray is absent from the pattern, shape (rows, columns).
    """

    directions: FloatArray
    landing_mm: FloatArray
    absent: BoolArray

    @cached_property
    def spacing_mm(self) -> FloatArray:
        """Median distance of neighbouring landing points along X and along Y, shape (2,), mm."""
        across = np.median(np.diff(self.landing_mm[..., 0], axis=1))
        along = np.median(np.diff(self.landing_mm[..., 1], axis=0))
        spacing = np.abs([across, along])
        spacing.flags.writeable = False
        return spacing


@lru_cache(maxsize=64)
def project_rays(laser: Laser, pattern: DotPattern) -> ProjectedRays:
    """Compute the rays of a pattern from a laser, and their landing points."""
    directions = ray_directions(laser, pattern)
    landing = intersect_level(laser.position_mm, directions)
    return ProjectedRays(directions, landing, pattern.is_absent)
