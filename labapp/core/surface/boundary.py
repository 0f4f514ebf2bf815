"""Boundary of the pool: piecewise polar model and circle (§6.3.2, §8.2.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

BoundaryModel = Literal["piecewise", "circle"]
"""Three cubic pieces and two transitions (§6.3.2.2), or a circle (§8.2.1)."""

POINTS = 360
"""Number of points of a modelled boundary: one per degree."""

LARGEST_STRETCH = 1.5
"""Maximum ratio of the model's largest radius to that of its edge points; beyond it the model
diverges."""


@dataclass(frozen=True, repr=False)
class Boundary(ReadOnlyArrays):
    """A closed boundary around a centre, one point per polar angle.

    Parameters
    ----------
    center_mm
        Origin of the polar coordinates, shape (2,), mm.
    theta_deg
        Polar angle of each point, ascending from −180 (inclusive) to 180 (exclusive), degrees,
        counter-clockwise from +X, shape (m,).
    points_mm
        The points in the UCS, shape (m, 3), mm; not repeated at the end.
    """

    center_mm: FloatArray
    theta_deg: FloatArray
    points_mm: FloatArray

    @classmethod
    def polar(cls, center_mm: FloatArray, radius_mm: FloatArray) -> Boundary:
        """Build a boundary on z = 0 from radii at equally spaced angles from −180°.

        Parameters
        ----------
        center_mm
            X and Y of the centre, shape (2,), mm.
        radius_mm
            Distances of the points from the centre, shape (m,), mm.
        """
        count = len(radius_mm)
        theta = -180.0 + 360.0 * np.arange(count) / count
        angle = np.radians(theta)
        xy = center_mm + radius_mm[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return cls(np.asarray(center_mm, float), theta, np.column_stack([xy, np.zeros(count)]))

    def at_height(self, z_mm: FloatArray) -> Boundary:
        """Return the boundary with the same X and Y at other heights.

        Parameters
        ----------
        z_mm
            Heights of the points, shape (m,), mm.
        """
        return replace(self, points_mm=np.column_stack([self.points_mm[:, :2], z_mm]))

    def contains(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Whether points lie within the polygon of the boundary's points.

        Parameters
        ----------
        x_mm, y_mm
            Positions, arrays of the same shape, mm.

        Returns
        -------
        ndarray of bool
            Of that shape.
        """
        x = np.asarray(x_mm, float) - self.center_mm[0]
        y = np.asarray(y_mm, float) - self.center_mm[1]
        outline = self.points_mm[:, :2] - self.center_mm
        # Find the side of the polygon at each point's angle, then whether the point is inside it.
        theta = np.degrees(np.arctan2(y, x))
        before = np.searchsorted(self.theta_deg, theta, side="right") - 1
        a = outline[before]
        side = outline[(before + 1) % len(outline)] - a
        return np.asarray(side[..., 0] * (y - a[..., 1]) - side[..., 1] * (x - a[..., 0]) >= 0)


@dataclass(frozen=True)
class EdgePoints(ReadOnlyArrays):
    """Estimated boundary points on the work piece, one pair per row of rays; r rows.

    Parameters
    ----------
    left_mm, right_mm
        (X, Y) of the two points of each row, shape (r, 2), mm.
    steps
        Number of rays from each row's first to its last, minus 1, shape (r,).
    """

    left_mm: FloatArray
    right_mm: FloatArray
    steps: IntArray

    @property
    def center_mm(self) -> FloatArray:
        """Middle of the longest row, the origin O′ of the polar coordinates, shape (2,), mm.

        Often several rows have the same number of steps, and the widest of them in mm is only the
        one farthest from the laser: the mean of their middles is used.
        """
        longest = self.steps == self.steps.max()
        return np.asarray((self.left_mm[longest] + self.right_mm[longest]).mean(axis=0) / 2)

    @property
    def all_mm(self) -> FloatArray:
        """Points of both sides, shape (2r, 2), mm."""
        return np.vstack([self.left_mm, self.right_mm])


def boundary_on_work_piece(match: Match, rig: Rig, model: BoundaryModel) -> Boundary:
    """Estimate the pool's boundary on z = 0 from the rows' ends (§6.3.2, §8.2.1).

    Raises
    ------
    CannotMeasure
        ``no-boundary`` if there are fewer than two rows, or the model diverges from its points.
    """
    edges = edge_points(match, rig)
    return circle(edges) if model == "circle" else piecewise(edges, rig.head_sign)


def edge_points(match: Match, rig: Rig) -> EdgePoints:
    """Estimate where the boundary crosses each row of rays, on z = 0 (Eq. 6-9 … 6-12).

    It lies between the landing points of the row's last ray that came back and of its outer
    neighbour that did not; the midpoint has the least mean square error. At the edge of the pattern
    the neighbour is the ray that would be next. Rows that end at a ray in an unknown state
    (hidden by the torch, in doubt) give no information about the boundary and are omitted, as the
    text omits fragmental rows (§7.3), unless fewer than three rows would be left.

    Raises
    ------
    CannotMeasure
        ``no-boundary`` if there are fewer than two rows.
    """
    rows = np.unique(match.ray[:, 0])
    if len(rows) < 2:
        raise CannotMeasure("no-boundary", "a boundary needs at least two rows of dots")
    first = np.array([match.ray[match.ray[:, 0] == i, 1].min() for i in rows])
    last = np.array([match.ray[match.ray[:, 0] == i, 1].max() for i in rows])
    # Beyond the pattern rays are dark.
    ray_states = np.pad(match.ray_states, 1, constant_values=-1)
    sure = (ray_states[rows, first - 1] != 0) & (ray_states[rows, last + 1] != 0)
    if sure.sum() >= 3:
        rows, first, last = rows[sure], first[sure], last[sure]
    landing = _landings(rig)
    return EdgePoints(
        left_mm=(landing[rows, first] + landing[rows, first - 1]) / 2,
        right_mm=(landing[rows, last] + landing[rows, last + 1]) / 2,
        steps=last - first,
    )


def _landings(rig: Rig) -> FloatArray:
    """(X, Y) of ray (i, j) on z = 0 at ``[i, j]``, with an additional ring around the pattern."""
    pattern = rig.pattern
    wider = replace(pattern, rows=pattern.rows + 2, columns=pattern.columns + 2, absent=None)
    return intersect_level(rig.laser.position_mm, ray_directions(rig.laser, wider))[..., :2]


def circle(edges: EdgePoints) -> Boundary:
    """Circle about the middle of the longest row, with the least-squares radius (§8.2.1)."""
    radius = np.linalg.norm(edges.all_mm - edges.center_mm, axis=-1).mean()
    return Boundary.polar(edges.center_mm, np.full(POINTS, radius))


def piecewise(edges: EdgePoints, head_sign: int = 1) -> Boundary:
    """Three cubic pieces r(θ) — left, right and head — and two transitions (Eq. 6-13 … 6-19).

    θ runs clockwise from +X here, as in Fig. 6-8 (b): the head is at −90°, the rear at 90°. A
    piece with fewer than five points gets a polynomial of lower order: 2 for four points, 1 for
    three, the mean for fewer. If the left and right pieces do not cross at the rear, the model
    changes linearly from one to the other between the rearmost points instead of at β₃.

    Parameters
    ----------
    edges
        The rows' ends.
    head_sign
        +1 if the head lies towards +Y. −1 if it lies towards −Y: θ then runs counter-clockwise, so
        that the head is at −90° again.

    Raises
    ------
    CannotMeasure
        ``no-boundary`` if a piece has no points or diverges from them.
    """
    center = edges.center_mm
    dx, dy = (edges.all_mm - center).T
    theta, radius = np.degrees(np.arctan2(-head_sign * dy, dx)), np.hypot(dx, dy)
    # A pair at the Y of the centre lies at 0° and 180° up to rounding.
    theta = np.where(np.abs(np.abs(theta) - 180) < 1e-9, 180.0, theta)
    left, right = np.abs(theta) >= 90, np.abs(theta) < 90
    head = (theta <= 1e-9) | (theta == 180)
    if not (left.any() and right.any()):
        raise CannotMeasure("no-boundary", "all ends of rows lie on one side of the pool")
    # Eq. 6-15: θ_L and θ_R increase from the rear to the head, θ_H from left to right.
    left_piece = _Piece(_theta_left(theta[left]), radius[left])
    right_piece = _Piece(90 - theta[right], radius[right])
    head_piece = _Piece(_theta_head(theta[head]), radius[head])

    at = np.arange(POINTS) * 360.0 / POINTS - 180
    r_left, r_right = left_piece(_theta_left(at)), right_piece(90 - at)
    r_head = head_piece(_theta_head(at))
    front_left, front_right = theta[left & (theta < 0)], theta[right]
    beta_1 = front_left.max(initial=-180.0)
    beta_2 = min(front_right.min(), 0.0)
    t_left = np.clip((beta_1 - at) / max(beta_1 + 180, 1e-9), 0, 1)  # Eq. 6-19
    t_right = np.clip(1 - at / min(beta_2, -1e-9), 0, 1)
    rear = _share_of_left(
        at, r_left - r_right, theta[right].max(), _theta_left(theta[left]).min() + 90
    )
    model = np.where(  # Eq. 6-18
        at < beta_1,
        t_left * r_left + (1 - t_left) * r_head,
        np.where(
            at <= beta_2,
            r_head,
            np.where(
                at < 0,
                t_right * r_right + (1 - t_right) * r_head,
                rear * r_left + (1 - rear) * r_right,
            ),
        ),
    )
    if not (model > 0).all() or model.max() > LARGEST_STRETCH * radius.max():
        raise CannotMeasure("no-boundary", "the boundary model diverges from the rows' ends")
    # θ of `Boundary` runs counter-clockwise from +X; with the head at +Y it is −θ of the text.
    return Boundary.polar(center, np.roll(model[::-1], 1) if head_sign > 0 else model)


def _share_of_left(
    theta: FloatArray, difference: FloatArray, right_end: float, left_end: float
) -> FloatArray:
    """Weight of the left piece in the rear half, 0 … 1: a step at β₃, where the pieces cross."""
    gap = np.flatnonzero((theta >= right_end) & (theta <= left_end))
    crossings = gap[:-1][difference[gap[:-1]] * difference[gap[1:]] <= 0]
    if len(crossings):
        beta_3 = theta[crossings[np.argmin(np.abs(theta[crossings] - 90))]]
        return np.where(theta > beta_3, 1.0, 0.0)
    return np.asarray(np.clip((theta - right_end) / max(left_end - right_end, 1e-9), 0, 1))


def _theta_left(theta: FloatArray) -> FloatArray:
    """θ_L = θ − 90°, or θ + 270° past ±180° (Eq. 6-15)."""
    return np.where(theta >= 0, theta - 90, theta + 270)


def _theta_head(theta: FloatArray) -> FloatArray:
    """θ_H = θ + 180° in the head half (Eq. 6-15); 180° itself is −180° there."""
    return np.where(theta >= 180, 0.0, theta + 180)


class _Piece:
    """Least-squares polynomial r(θ), of third order if there are enough points (Eq. 6-16)."""

    def __init__(self, theta_deg: FloatArray, radius_mm: FloatArray) -> None:
        order = int(np.clip(len(radius_mm) - 2, 0, 3))
        # In units of 180° the powers are at most about 1: the least squares are well conditioned.
        powers = np.vander(theta_deg / 180, order + 1)
        self._weights = np.linalg.lstsq(powers, radius_mm, rcond=None)[0]

    def __call__(self, theta_deg: FloatArray) -> FloatArray:
        return np.asarray(np.polyval(self._weights, theta_deg / 180))
