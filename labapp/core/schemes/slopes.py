"""Slope field and slope-oriented points: steps 1 and 2 of IRS and ERS, and their loop (§6.3.1).

A reflection point lies on its ray, so that it is given by its distance from the laser. A step from
one point to the next takes place in the plane through the laser and both points: the row plane
within a row, the column plane within a column. There the line of slope S through P_a meets the
ray of P_b at a distance that is a *multiple* of that of P_a::

    s_b = s_a · (d_a,m − S·d_a,h) / (d_b,m − S·d_b,h)

with d the ray's direction along the plane's horizontal axis h and its upward axis m. A chain of
steps is therefore a sum of logarithms, and the distances of all points follow from those of their
base points by one product with a matrix that indicates which steps lead to which point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.optics import (
    bisecting_gradient,
    direction_to_dots,
    intersect_imaging_plane,
    ray_directions,
    reflect,
    surface_normal,
)
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.match import Match
from labapp.core.schemes import LEAST_DOTS
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.interpolation import SurfaceThroughPoints, whole_surface
from labapp.core.surface.measures import reflection_scale
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.surface import Surface, intersect
from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

LEAST_ROWS = 3
"""Minimum number of rows for a surface."""

SETTLED_MM = 1e-5
"""The loops end when no reflection point moves farther than this."""

PATIENCE = 10
"""The loops also end when the ARE has not decreased for this many loops.

Where the slope changes its sign, Eq. 6-1 rises slightly too far from either side, so that the edge
points of the edge-points algorithm climb from loop to loop and never converge.
"""

Move = Callable[[FloatArray, FloatArray], FloatArray]
"""Step 2: function of the normals, shape (n, 3), and the previous distances, shape (n,), mm, that
returns the distances of the slope-oriented points, shape (n,), mm."""


@dataclass(frozen=True)
class ReflectedRays(ReadOnlyArrays):
    """The n lit rays, and their reflected dots.

    The absent centre reference is the last one if a substitute for its dot exists (§6.3.1).

    Parameters
    ----------
    laser_mm
        Where all rays start, UCS, shape (3,), mm.
    ray
        Ray (i, j), counted from 1, shape (n, 2).
    direction
        Unit direction, shape (n, 3).
    plane_mm
        Reflected dot, IPCS (X′, Z′), shape (n, 2), mm.
    measured
        Number of rays, the first ones, whose dots are those of the match.
    scale
        From the imaging plane to the work piece (`reflection_scale`), shape (2,).
    """

    laser_mm: FloatArray
    ray: IntArray
    direction: FloatArray
    plane_mm: FloatArray
    imaging_plane: ImagingPlane
    measured: int
    scale: FloatArray

    def points(self, distance_mm: FloatArray) -> FloatArray:
        """Points at a distance along each ray, shape (n, 3), mm."""
        return np.asarray(self.laser_mm + distance_mm[:, None] * self.direction)

    def distance_at(self, z_mm: float) -> FloatArray:
        """Distance along each ray to the level z = z_mm, shape (n,), mm."""
        return np.asarray((z_mm - self.laser_mm[2]) / self.direction[:, 2])

    def normals(self, distance_mm: FloatArray) -> FloatArray:
        """Normals (3-D slopes) at those points by the law of reflection, shape (n, 3)."""
        reflected = direction_to_dots(self.points(distance_mm), self.plane_mm, self.imaging_plane)
        return surface_normal(bisecting_gradient(self.direction, reflected))

    def reflected(self, point_mm: FloatArray, gradient: FloatArray) -> FloatArray:
        """Computed dots for points and gradients, IPCS, shape (n, 2), mm (step 4)."""
        return intersect_imaging_plane(
            point_mm, reflect(self.direction, surface_normal(gradient)), self.imaging_plane
        )

    def residual(self, surface: Surface, boundary: Boundary) -> FloatArray:
        """Computed minus captured dots of the measured rays, shape (measured, 2), mm.

        Each ray is intersected with the surface; NaN if it misses it within the boundary.
        """
        points = intersect(surface, self.laser_mm, self.direction)
        points[~boundary.contains(points[:, 0], points[:, 1])] = np.nan
        gradient = surface.gradient(points[:, 0], points[:, 1])
        return (self.reflected(points, gradient) - self.plane_mm)[: self.measured]


def reflected_rays(match: Match, rig: Rig) -> ReflectedRays:
    """Collect the matched rays, including the absent centre reference.

    The centre reference has no dot; if both its neighbours in the row have one, the mean of these
    is used for it, "considering the continuity of the rows" (§6.3.1).

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` if there are fewer than `LEAST_DOTS` or `LEAST_ROWS`.
    """
    rows = len(np.unique(match.ray[:, 0]))
    if len(match.ray) < LEAST_DOTS or rows < LEAST_ROWS:
        raise CannotMeasure(
            "too-few-dots",
            f"{len(match.ray)} matched dots in {rows} rows; "
            f"at least {LEAST_DOTS} in {LEAST_ROWS} are needed",
        )
    ray, plane = match.ray, match.plane_mm
    i, j = rig.pattern.center_ray
    beside = (ray[:, 0] == i) & (np.abs(ray[:, 1] - j) == 1)
    centre = (ray == (i, j)).all(axis=1)
    if (i, j) in rig.pattern.absent_rays and beside.sum() == 2 and not centre.any():
        ray = np.vstack([ray, [(i, j)]])
        plane = np.vstack([plane, plane[beside].mean(axis=0)])
    directions = ray_directions(rig.laser, rig.pattern)
    return ReflectedRays(
        laser_mm=rig.laser.position_mm,
        ray=ray,
        direction=directions[ray[:, 0] - 1, ray[:, 1] - 1],
        plane_mm=plane,
        imaging_plane=rig.imaging_plane,
        measured=len(match.ray),
        scale=reflection_scale(match, rig),
    )


@dataclass(frozen=True)
class Paths(ReadOnlyArrays):
    """Steps from base points to all other points: a forest over the reflected rays.

    Parameters
    ----------
    base
        Base point of each point, shape (n,).
    start, end
        Start and end point of each step, shape (s,).
    horizontal, upward
        Axes of each step's plane through the laser and both points, shape (s, 3).
    start_components, end_components
        The two rays along these axes, shape (s, 2).
    apart
        Sine of the angle between the two rays, shape (s,).
    matrix
        1 where a step is on the way to a point, else 0, shape (n, s).
    """

    base: IntArray
    start: IntArray
    end: IntArray
    horizontal: FloatArray
    upward: FloatArray
    start_components: FloatArray
    end_components: FloatArray
    apart: FloatArray
    matrix: FloatArray

    @classmethod
    def along(cls, parent: IntArray, direction: FloatArray) -> Paths:
        """Build from each point's predecessor, shape (n,), −1 for base points."""
        end = np.flatnonzero(parent >= 0)
        start = parent[end]
        normal = np.cross(direction[start], direction[end])
        apart = np.linalg.norm(normal, axis=-1)
        horizontal = np.stack([normal[:, 1], -normal[:, 0], np.zeros(len(normal))], axis=-1)
        horizontal /= np.linalg.norm(horizontal, axis=-1, keepdims=True)
        upward = np.cross(normal, horizontal)
        upward *= np.sign(upward[:, 2:]) / np.linalg.norm(upward, axis=-1, keepdims=True)
        base, matrix = _steps_to(parent, end)
        return cls(
            base=base,
            start=start,
            end=end,
            horizontal=horizontal,
            upward=upward,
            start_components=_components(direction[start], horizontal, upward),
            end_components=_components(direction[end], horizontal, upward),
            apart=apart,
            matrix=matrix,
        )

    def follow(self, normal: FloatArray, base_distance_mm: FloatArray) -> FloatArray:
        """Distances of all slope-oriented points from the laser (step 2).

        Parameters
        ----------
        normal
            Normals of the slope field, shape (n, 3).
        base_distance_mm
            Distances of the points, shape (n,), of which only those of `base` are used, mm.

        Returns
        -------
        FloatArray
            Shape (n,), mm; NaN where a slope is steeper than its ray.
        """
        slope_a = -_dot(normal[self.start], self.horizontal) / _dot(normal[self.start], self.upward)
        slope_b = -_dot(normal[self.end], self.horizontal) / _dot(normal[self.end], self.upward)
        mean = (slope_a + slope_b) / 2
        # Points are known to SETTLED_MM, slopes to their change over that distance. A smaller slope
        # is zero within its error and has no sign: the mean then keeps its own sign.
        way = base_distance_mm[self.base[self.end]] * self.apart
        has_sign = np.abs(slope_a) > SETTLED_MM / way * np.abs(slope_b - slope_a)
        slope = np.where(has_sign, np.sign(slope_a) * np.abs(mean), mean)  # Eq. 6-1, 7-1
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.log(
                (self.start_components[:, 1] - slope * self.start_components[:, 0])
                / (self.end_components[:, 1] - slope * self.end_components[:, 0])
            )
        return np.asarray(base_distance_mm[self.base] * np.exp(self.matrix @ step))


def _steps_to(parent: IntArray, end: IntArray) -> tuple[IntArray, FloatArray]:
    """Base point of each point, and mask of the steps that lead to it: shapes (n,) and (n, s)."""
    number = np.full(len(parent), -1)
    number[end] = np.arange(len(end))
    base = np.arange(len(parent))
    matrix = np.zeros((len(parent), len(end)))
    for point in range(len(parent)):
        at = point
        while parent[at] >= 0:
            matrix[point, number[at]] = 1.0
            at = parent[at]
        base[point] = at
    return base, matrix


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...k,...k->...", a, b))


def _components(vector: FloatArray, horizontal: FloatArray, upward: FloatArray) -> FloatArray:
    return np.stack([_dot(vector, horizontal), _dot(vector, upward)], axis=-1)


def rows_or_columns(ray: IntArray, axis: int) -> list[IntArray]:
    """Indices of the rays in every row (axis 0) or column (axis 1), each in ascending order.

    Rows and columns may have gaps, which are skipped.
    """
    return [
        members[np.argsort(ray[members, 1 - axis])]
        for members in (np.flatnonzero(ray[:, axis] == k) for k in np.unique(ray[:, axis]))
    ]


def parents_along(chains: list[IntArray]) -> IntArray:
    """Predecessor of each point when every chain is followed from its first point, shape (n,)."""
    parent = np.full(sum(map(len, chains)), -1)
    for chain in chains:
        parent[chain[1:]] = chain[:-1]
    return parent


def parents_from(ray: IntArray, base: int) -> IntArray:
    """Predecessor of each point when all are reached from one base point (Fig. 6-6, 7-3).

    First the base point's row; then, from the middle point of that row, row by row along its
    column; then every row from there. Where a row does not have that column, the column nearest
    to it that the row shares with the row before is taken; where they share none, the step goes
    between their nearest points, in the plane of these two rays.

    Returns
    -------
    IntArray
        Shape (n,), −1 for the base point.
    """
    rows = rows_or_columns(ray, axis=0)
    first = next(k for k, row in enumerate(rows) if base in row)
    column = ray[rows[first], 1]
    middle = int(column[np.argmin(np.abs(column - (column[0] + column[-1]) / 2))])
    parent = np.full(len(ray), -1)
    _spread(parent, rows[first], base)
    for order in (range(first + 1, len(rows)), range(first - 1, -1, -1)):
        before = rows[first]
        for k in order:
            start, end = _crossing(ray, before, rows[k], middle)
            _spread(parent, rows[k], end)
            parent[end] = start
            before = rows[k]
    return parent


def _spread(parent: IntArray, row: IntArray, start: int) -> None:
    """Set the predecessors of a row that is followed both ways from one of its points."""
    at = int(np.flatnonzero(row == start)[0])
    parent[row[at + 1 :]] = row[at:-1]
    parent[row[:at]] = row[1 : at + 1]


def _crossing(ray: IntArray, before: IntArray, row: IntArray, middle: int) -> tuple[int, int]:
    """Start and end point of the step from one row to the next."""
    apart = np.abs(ray[before, 1][:, None] - ray[row, 1])
    off_middle = np.abs(ray[row, 1] - middle)
    # The nearest columns first (the same one if there is any), then the nearest to the middle.
    a, b = np.unravel_index(np.argmin(apart * 1000 + off_middle), apart.shape)
    return int(before[a]), int(row[b])


@dataclass(frozen=True)
class Estimate:
    """Result of one loop: points, shape (n, 3), the surface through them, and its ARE.

    ``are_mm``, Eq. 6-3, excludes the centre reference, which is not an actual dot.
    """

    points_mm: FloatArray
    surface: SurfaceThroughPoints
    are_mm: float


def best_of_loops(
    rays: ReflectedRays,
    move: Move,
    surface_through: Callable[[FloatArray], SurfaceThroughPoints],
    loops: int,
) -> Estimate | None:
    """Repeat steps 1 to 4 from the flat work piece, and return the estimate of least ARE.

    The surface passes through points on the rays, which therefore are the intersections of step 1
    of the next loop.

    Parameters
    ----------
    rays
        The n lit rays.
    move
        Step 2.
    surface_through
        Step 3: function of points, shape (n, 3), that returns the surface through them.
    loops
        Maximum number of loops, see `SETTLED_MM` and `PATIENCE`.

    Returns
    -------
    Estimate | None
        None if the points diverge before there is an estimate.
    """
    distance = rays.distance_at(0.0)
    best: Estimate | None = None
    since_best = 0
    for _ in range(loops):
        before, distance = distance, move(rays.normals(distance), distance)
        points = rays.points(distance)
        if not np.isfinite(points).all():
            break
        surface = surface_through(points)
        residual = (rays.reflected(points, surface.point_gradient) - rays.plane_mm)[: rays.measured]
        are = float(np.mean(np.hypot(*(residual * rays.scale).T)))
        if np.isfinite(are) and (best is None or are < best.are_mm):
            best, since_best = Estimate(points, surface, are), 0
        else:
            since_best += 1
        if np.abs(distance - before).max() < SETTLED_MM or since_best >= PATIENCE:
            break
    return best


def reconstruction_within(
    scheme: str, match: Match, rays: ReflectedRays, best: Estimate, boundary: Boundary
) -> Reconstruction:
    """Reconstruct the surface through the points of an estimate and the boundary (step 5).

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no reflection point lies within the boundary.
    """
    surface = whole_surface(best.points_mm, boundary)
    return Reconstruction(
        scheme=scheme,
        surface=surface,
        boundary=boundary,
        ray=match.ray,
        points_mm=best.points_mm[: rays.measured],
        residual_mm=rays.residual(surface, boundary),
        sigma_mm=np.full(rays.measured, np.nan),
        own_are_mm=best.are_mm,
    )
