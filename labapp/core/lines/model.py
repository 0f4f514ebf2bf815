"""Reflection of a line pattern by a spline surface, and its derivatives w.r.t. the surface.

For a point of a reflected line the plane of rays is known, but not the position along the fan:
`LineModel.residuals` compares the point with the nearest point of the predicted curve, which gives
one equation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.line_pattern import LineRig, line_directions
from labapp.core.geometry.optics import intersect_imaging_plane, reflect, surface_normal
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

NEWTON_STEPS = 4
STEP_MM, FAN_STEP = 1e-5, 1e-5
"""Steps of the numerical derivatives, mm and rad."""

END_HEIGHT_MM = 0.004
"""Standard uncertainty of the height of the boundary, z = 0, mm."""


@dataclass(frozen=True)
class LineData(ReadOnlyArrays):
    """Measured lines of a frame: n points of k lines, and their m ends.

    Parameters
    ----------
    line
        Index of each point's line, from the lowest in the picture up, shape (n,).
    plane_mm, normal
        Positions on the imaging plane (IPCS), and unit vectors across the line, shape (n, 2).
    sigma_mm
        Standard uncertainty across the line, shape (n,), mm.
    end_line
        Index of each end's line, shape (m,).
    end_mm
        Positions of the ends, shape (m, 2), mm.
    end_sigma_mm
        Standard uncertainty along the line, shape (m,), mm.
    """

    line: IntArray
    plane_mm: FloatArray
    normal: FloatArray
    sigma_mm: FloatArray
    end_line: IntArray
    end_mm: FloatArray
    end_sigma_mm: FloatArray


@dataclass(frozen=True)
class Curves(ReadOnlyArrays):
    """Predicted curves: f rays of each of k lines.

    Parameters
    ----------
    fan
        Angles in the fan, shape (f,), rad.
    plane_mm
        Landing points of the reflected rays on the imaging plane, shape (k, f, 2), mm; NaN if there
        is none.
    """

    fan: FloatArray
    plane_mm: FloatArray


@dataclass(frozen=True)
class Linearized(ReadOnlyArrays):
    """Linearised equations of the fit at a surface: standardised residuals and their Jacobian.

    Parameters
    ----------
    residual
        Observed minus predicted, over the standard uncertainty, shape (n + m,).
    jacobian
        Derivatives of the prediction w.r.t. the coefficients, over the same, (n + m, p), mm⁻¹.
    point_mm
        Intersection of the surface with the ray nearest to each point and end, (n + m, 3), mm.
    aside
        Derivatives of the x of these intersections w.r.t. the coefficients, (n + m, p): the ray
        nearest to a point is another one on another surface. At an end of the fan they are as if
        the fan went on, since the line may as well end on the boundary beside it.
    """

    residual: FloatArray
    jacobian: FloatArray
    point_mm: FloatArray
    aside: FloatArray


@dataclass(frozen=True)
class LineModel:
    """Model that predicts the lines ``numbers``, in the order of `LineData`.

    Parameters
    ----------
    basis
        The p splines of the surface.
    numbers
        Number of each of k lines, from 1, shape (k,).
    rays
        Number of rays traced for each line.
    """

    rig: LineRig
    basis: SplineBasis
    numbers: FloatArray
    rays: int = 121

    def curves(self, coefficients: FloatArray) -> Curves:
        """Predict the reflected curves of all lines."""
        half = self.rig.pattern.half_fan
        fan = np.linspace(-half, half, self.rays)
        number = np.repeat(self.numbers, self.rays)
        point, direction, slope = self._meet(coefficients, number, np.tile(fan, len(self.numbers)))
        plane = self._land(point, direction, slope)
        return Curves(fan, plane.reshape(len(self.numbers), self.rays, 2))

    def residuals(self, coefficients: FloatArray, data: LineData) -> Linearized:
        """Return the equations of points (across the line) and ends (z = 0, or end of the fan)."""
        curves = self.curves(coefficients)
        line = np.concatenate([data.line, data.end_line])
        place = np.concatenate([data.plane_mm, data.end_mm])
        number = self.numbers[line]
        fan = nearest_on_curves(curves, line, place)
        plane = self._land(*self._meet(coefficients, number, fan))
        # One step along the polyline from its nearest point to that of the curve.
        step = curves.fan[1] - curves.fan[0]
        piece = np.clip((fan - curves.fan[0]) / step, 0, len(curves.fan) - 2).astype(int)
        rate = np.nan_to_num(np.diff(curves.plane_mm, axis=1)[line, piece] / step)
        ahead = np.vecdot(rate, place - plane) / np.maximum(np.vecdot(rate, rate), 1e-6)
        fan = np.clip(fan + np.clip(ahead, -step, step), curves.fan[0], curves.fan[-1])
        point, direction, slope = self._meet(coefficients, number, fan)
        plane = self._land(point, direction, slope)
        rate, move = self._rates(coefficients, number, fan)
        by_height, by_slope = self._derivatives(coefficients, point, direction, slope)
        cells = self.basis.cells(point[:, 0], point[:, 1])
        value, slope_x, slope_y = cells.value_and_slopes()
        # ∂(X′, Z′)/∂c of the splines that are not zero there, shape (n + m, 2, 16).
        change = by_height[:, :, None] * value[:, None]
        change += by_slope[:, :, :1] * slope_x[:, None] + by_slope[:, :, 1:] * slope_y[:, None]
        count = len(data.line)
        off = place - plane
        # Compare across the predicted curve only: the position along it is undetermined.
        across = np.stack([-rate[:count, 1], rate[:count, 0]], axis=-1)
        across *= np.sign(np.vecdot(across, data.normal))[:, None]
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        residual, local = np.empty(len(line)), np.empty(value.shape)
        residual[:count] = np.vecdot(across, off[:count]) / data.sigma_mm
        local[:count] = (across[:, :, None] * change[:count]).sum(axis=1) / data.sigma_mm[:, None]
        # A higher surface meets the ray earlier, which changes the rise of the intersection.
        descent = np.minimum(direction[:, 2] - np.vecdot(slope, direction[:, :2]), -0.05)
        rises = (direction[:, 2] / descent)[:, None] * value
        inside = np.abs(fan) < curves.fan[-1] - 1e-6
        turn = -1.0 / np.maximum(np.vecdot(rate, rate), 1e-6)
        aside = (move[:, 0] * turn)[:, None] * (rate[:, :, None] * change).sum(axis=1)
        aside += (direction[:, 0] / descent)[:, None] * value
        ends = slice(count, None)
        residual[ends], local[ends] = _end_equations(
            data=data,
            at_fan=~inside[ends],
            height=point[ends, 2],
            off=off[ends],
            rate=rate[ends],
            rise=move[ends, 2],
            rises=rises[ends],
            change=change[ends],
        )
        jacobian, moved = np.zeros((2, len(line), self.basis.count))
        np.put_along_axis(jacobian, cells.splines, local, axis=1)
        np.put_along_axis(moved, cells.splines, aside, axis=1)
        return Linearized(np.nan_to_num(residual, nan=1e3), jacobian, point, moved)

    def _rates(
        self, coefficients: FloatArray, number: FloatArray, fan: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of position on plane, (n, 2), and surface, (n, 3), by fan angle, mm/rad."""
        before, after = (
            self._meet(coefficients, number, fan + sign * FAN_STEP) for sign in (-1.0, 1.0)
        )
        rate = (self._land(*after) - self._land(*before)) / (2 * FAN_STEP)
        return np.nan_to_num(rate), (after[0] - before[0]) / (2 * FAN_STEP)

    def _meet(
        self, coefficients: FloatArray, number: FloatArray, fan: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Intersections of rays with the surface, (n, 3), directions, and slopes there, (n, 2)."""
        laser = self.rig.laser
        direction = line_directions(laser, self.rig.pattern, number, fan)
        source = laser.position_mm
        distance = -source[2] / direction[:, 2]
        for _ in range(NEWTON_STEPS):
            point = source + distance[:, None] * direction
            height, slope = self.surface_at(coefficients, point)
            descent = direction[:, 2] - np.vecdot(slope, direction[:, :2])
            descent = np.minimum(descent, -0.05)
            distance = distance - np.clip((point[:, 2] - height) / descent, -1.0, 1.0)
        point = source + distance[:, None] * direction
        return point, direction, self.surface_at(coefficients, point)[1]

    def surface_at(
        self, coefficients: FloatArray, point_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Height, shape (n,), and slopes, shape (n, 2); the outermost cells are extrapolated."""
        cells = self.basis.cells(point_mm[:, 0], point_mm[:, 1])
        every = np.vecdot(cells.value_and_slopes(), coefficients[cells.splines])
        return every[0], every[1:].T

    def _land(self, point: FloatArray, direction: FloatArray, slope: FloatArray) -> FloatArray:
        away = reflect(direction, surface_normal(slope))
        return intersect_imaging_plane(point, away, self.rig.imaging_plane)

    def _derivatives(
        self, coefficients: FloatArray, point: FloatArray, direction: FloatArray, slope: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """∂(X′, Z′) w.r.t. the surface's height, shape (n, 2), and its slopes, (n, 2, 2)."""
        here = self._land(point, direction, slope)
        by_slope = np.stack(
            [
                (self._land(point, direction, slope + STEP_MM * axis) - here) / STEP_MM
                for axis in np.eye(2)
            ],
            axis=-1,
        )
        # A higher surface meets the ray earlier, where the slopes differ.
        descent = direction[:, 2] - np.vecdot(slope, direction[:, :2])
        earlier = point + (STEP_MM / np.minimum(descent, -0.05))[:, None] * direction
        slope_there = self.surface_at(coefficients, earlier)[1]
        by_height = (self._land(earlier, direction, slope_there) - here) / STEP_MM
        return by_height, by_slope


def _end_equations(
    data: LineData,
    at_fan: BoolArray,
    height: FloatArray,
    off: FloatArray,
    rate: FloatArray,
    rise: FloatArray,
    rises: FloatArray,
    change: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Equations of the ends: z = 0 on the boundary, unless the fan itself ends there."""
    length = np.maximum(np.linalg.norm(rate, axis=-1), 1.0)
    along = rate / length[:, None]
    by_place = rise / length  # dz per displacement of the end along the line
    sigma = np.hypot(by_place * data.end_sigma_mm, END_HEIGHT_MM)
    moved = (along[:, :, None] * change).sum(axis=1)
    residual, local = -height / sigma, (rises - by_place[:, None] * moved) / sigma[:, None]
    out = np.vecdot(along, off) / data.end_sigma_mm
    residual = np.where(at_fan, out, residual)
    local = np.where(at_fan[:, None], moved / data.end_sigma_mm[:, None], local)
    return residual, local


def nearest_on_curves(curves: Curves, line: IntArray, place_mm: FloatArray) -> FloatArray:
    """Angle in the fan, rad, of the curve's point nearest to each position, shape (n,)."""
    curve = np.nan_to_num(curves.plane_mm, nan=1e6)
    start, step = curve[:, :-1], np.diff(curve, axis=1)
    length2 = np.maximum(np.vecdot(step, step), 1e-12)
    fan = np.empty(len(line))
    for k in range(len(curve)):
        on = line == k
        off = place_mm[on][:, None] - start[k]
        share = np.clip(np.vecdot(off, step[k]) / length2[k], 0.0, 1.0)
        away = off - share[..., None] * step[k]
        best = np.argmin(np.vecdot(away, away), axis=1)
        part = share[np.arange(len(best)), best]
        fan[on] = curves.fan[best] + part * (curves.fan[1] - curves.fan[0])
    return fan
