"""The rig: laser, dot pattern, electrode and imaging plane.

All positions are in the universal coordinate system (UCS): origin on the work piece under the
electrode tip, Y along the weld, towards the laser, Z up, X to the right as the camera sees it; mm.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from labapp.core.geometry.patterns import MEASURED, PATTERNS, MeasuredRay, measured_steps
from labapp.core.geometry.uncertainty import RigUncertainty
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays


@dataclass(frozen=True)
class Laser:
    """The laser diode, ideally in the YOZ plane on the side of +Y (§3.1.2).

    Parameters
    ----------
    projection_angle_deg
        Elevation of the beam axis above the work piece, degrees (Appendix I's α₅).
    distance_mm
        Distance from the diode to the intersection of beam axis and work piece, mm.
    azimuth_deg
        Rotation of the laser out of the YOZ plane, anticlockwise from above, degrees.
    aim_x_mm, aim_y_mm
        Intersection of beam axis and work piece, mm; ideally the origin.
    """

    projection_angle_deg: float
    distance_mm: float
    azimuth_deg: float = 0.0
    aim_x_mm: float = 0.0
    aim_y_mm: float = 0.0

    @cached_property
    def axes(self) -> FloatArray:
        """Unit vectors along the beam axis, to its side (with X) and upwards, shape (3, 3)."""
        angle, azimuth = np.radians([self.projection_angle_deg, self.azimuth_deg])
        sin, cos = np.sin(angle), np.cos(angle)
        aside, away = np.sin(azimuth), np.cos(azimuth)
        return np.array(
            [
                [aside * cos, -away * cos, -sin],
                [away, aside, 0.0],
                [aside * sin, -away * sin, cos],
            ]
        )

    @cached_property
    def position_mm(self) -> FloatArray:
        """Position of the diode, shape (3,), mm, read-only."""
        aim = np.array([self.aim_x_mm, self.aim_y_mm, 0.0])
        position = np.asarray(aim - self.distance_mm * self.axes[0])
        position.flags.writeable = False
        return position

    def directions(self, tangents: FloatArray) -> FloatArray:
        """Unit directions, shape (…, 3), of rays by their tangents to the beam axis, (…, 2)."""
        axis, across, along = self.axes
        direction = axis + tangents[..., :1] * across + tangents[..., 1:] * along
        return np.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True))


def turned(tangents: FloatArray, angle_deg: float) -> FloatArray:
    """Rotate a pattern of tangents, shape (…, 2), about the beam axis."""
    turn = np.radians(angle_deg)
    sin, cos = np.sin(turn), np.cos(turn)
    return np.asarray(tangents @ np.array([[cos, sin], [-sin, cos]]))


def _rays(rows: int, columns: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(1, rows + 1) for j in range(1, columns + 1)]


@dataclass(frozen=True)
class DotPattern:
    """The projected dot matrix: rays in rows and columns (Fig. 4-14).

    Parameters
    ----------
    rows, columns
        Numbers of rows and columns of rays.
    inter_beam_angle_deg
        Angle between neighbouring rays at the centre, degrees.
    absent
        Rays ``(i, j)``, counted from 1, that the lens does not make. None: the centre.
    kind
        Arrangement of the rays: one of `PATTERNS`, or `MEASURED`.
    rotation_deg
        Rotation of the pattern about the beam axis, degrees: if positive, the elevation of the
        rays of a row increases with j.
    measured
        All rays of a pattern of kind `MEASURED`; empty for other kinds.
    """

    rows: int = 19
    columns: int = 19
    inter_beam_angle_deg: float = 0.77
    absent: frozenset[tuple[int, int]] | None = None
    kind: str = "square"
    rotation_deg: float = 0.0
    measured: tuple[MeasuredRay, ...] = ()

    def __post_init__(self) -> None:
        if self.absent is None:
            absent = frozenset[tuple[int, int]]() if self.measured else {self.center_ray}
            object.__setattr__(self, "absent", frozenset(absent))

    @property
    def center_ray(self) -> tuple[int, int]:
        """The ray ``(i, j)`` at the centre, counted from 1; usually absent."""
        return (self.rows + 1) // 2, (self.columns + 1) // 2

    @cached_property
    def marker(self) -> tuple[int, int] | None:
        """The absent ray whose hole identifies the rows: the nearest to the centre, or None."""
        center = np.array(self.center_ray)
        return min(
            sorted(self.absent_rays - self._outside),
            key=lambda ray: float(np.linalg.norm(np.array(ray) - center)),
            default=None,
        )

    @property
    def tangents(self) -> FloatArray:
        """Tangents of the rays' angles to the beam axis (`Tangents`), shape (rows, columns, 2)."""
        step = np.radians(self.inter_beam_angle_deg)
        if self.kind == MEASURED:
            steps = measured_steps(self.measured, self.rows, self.columns)
            tangents = np.asarray(steps * np.tan(step))
        else:
            tangents = PATTERNS[self.kind].tangents(self.rows, self.columns, step)
        return turned(tangents, self.rotation_deg) if self.rotation_deg else tangents

    @cached_property
    def absent_rays(self) -> frozenset[tuple[int, int]]:
        """Rays ``(i, j)`` that do not exist: absent, outside the outline, or not measured."""
        assert self.absent is not None
        return self.absent | self._outside | self._within - self._listed

    @cached_property
    def is_absent(self) -> BoolArray:
        """Mask of the `absent_rays`, shape (rows, columns), read-only."""
        mask = np.zeros((self.rows, self.columns), bool)
        for i, j in self.absent_rays:
            mask[i - 1, j - 1] = True
        mask.flags.writeable = False
        return mask

    @cached_property
    def _listed(self) -> frozenset[tuple[int, int]]:
        """Measured rays; for other kinds all rays within the outline."""
        if self.kind != MEASURED:
            return self._within
        i, j = self.center_ray
        return frozenset((i + row, j + column) for row, column, *_ in self.measured)

    @cached_property
    def _within(self) -> frozenset[tuple[int, int]]:
        """Rays within the outline."""
        return frozenset(_rays(self.rows, self.columns)) - self._outside

    @cached_property
    def _outside(self) -> frozenset[tuple[int, int]]:
        """Rays outside the outline; if measured, outside the range of the rays of their row."""
        if self.kind != MEASURED:
            return PATTERNS[self.kind].beyond(self.rows, self.columns)
        ends = {i: [j for row, j in self._listed if row == i] for i in range(1, self.rows + 1)}
        return frozenset(
            (i, j)
            for i, j in _rays(self.rows, self.columns)
            if not ends[i] or not min(ends[i]) <= j <= max(ends[i])
        )


@dataclass(frozen=True)
class Electrode:
    """The torch's electrode: its tip is ``height_mm`` above the origin."""

    height_mm: float = 5.0


POSE = ("distance_mm", "s_mm", "h_mm", "pitch_deg", "yaw_deg", "roll_deg")
"""Names of the quantities that determine the pose of the imaging plane (`ImagingPlane.pose`)."""

_LEVEL = 1e-9
"""Largest horizontal component of the unit normal of a horizontal plane."""


@dataclass(frozen=True)
class ImagingPlane(ReadOnlyArrays):
    """The imaging plane with any pose: O′ and the directions of O′X′ and O′Z′ in the UCS.

    It is the scattering surface, a sheet of paper, on which dots and calibration target are
    visible. A plane-parallel glass plate may cover its pool side (§3.1): rays pass through the
    glass to the paper, and the camera sees the other side of the paper.

    Parameters
    ----------
    origin_mm
        O′, shape (3,), mm.
    x_axis, z_axis
        Unit vectors along O′X′ and O′Z′, shape (3,).
    width_mm, height_mm
        Size along X′ and Z′, mm.
    glass_mm, glass_index
        Thickness of the glass, mm; 0 for none; and its refractive index.
    """

    origin_mm: FloatArray
    x_axis: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    z_axis: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    width_mm: float = 101.6
    height_mm: float = 101.6
    glass_mm: float = 0.0
    glass_index: float = 1.5

    @classmethod
    def vertical(
        cls,
        distance_mm: float,
        s_mm: float,
        h_mm: float,
        width_mm: float = 101.6,
        height_mm: float = 101.6,
    ) -> ImagingPlane:
        """Build the plane y = −distance_mm with O′ at X = −s, Z = h (Fig. 4-5, Eq. 4-5)."""
        return cls(np.array([-s_mm, -distance_mm, h_mm]), width_mm=width_mm, height_mm=height_mm)

    @classmethod
    def of_angles(
        cls,
        origin_mm: FloatArray,
        angles_deg: tuple[float, float, float],
        width_mm: float = 101.6,
        height_mm: float = 101.6,
    ) -> ImagingPlane:
        """Build the plane at O′, shape (3,), mm, from its pitch, yaw and roll, degrees.

        The vertical plane is rotated about its own normal by roll (O′X′ rises), then about X by
        pitch (its top leans to the camera), then about Z by yaw (O′X′ turns towards +Y).
        """
        sin, cos = np.sin(np.radians(angles_deg)), np.cos(np.radians(angles_deg))
        rolled = np.array([[cos[2], -sin[2]], [0.0, 0.0], [sin[2], cos[2]]])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos[0], -sin[0]], [0.0, sin[0], cos[0]]])
        about_z = np.array([[cos[1], -sin[1], 0.0], [sin[1], cos[1], 0.0], [0.0, 0.0, 1.0]])
        x_axis, z_axis = (about_z @ about_x @ rolled).T
        return cls(np.asarray(origin_mm, float), x_axis, z_axis, width_mm, height_mm)

    @property
    def angles_deg(self) -> tuple[float, float, float]:
        """Pitch, yaw and roll (`of_angles`), degrees."""
        x, y, z = self.normal.tolist()
        pitch, yaw = np.arctan2(-z, np.hypot(x, y)), np.arctan2(x, -y)
        roll = np.arctan2(self.x_axis[2], self.z_axis[2])
        if np.hypot(x, y) < _LEVEL:  # yaw and roll rotate a horizontal plane about the same axis
            yaw, roll = np.arctan2(self.x_axis[1], self.x_axis[0]), 0.0
        return float(np.degrees(pitch)), float(np.degrees(yaw)), float(np.degrees(roll))

    @property
    def pose(self) -> FloatArray:
        """Quantities `POSE`: place of O′ (`vertical`), mm, and `angles_deg`, shape (6,)."""
        x, y, z = self.origin_mm
        return np.array([-y, -x, z, *self.angles_deg])

    def with_pose(self, pose: npt.ArrayLike) -> ImagingPlane:
        """Return a plane of the same size and glass with another `pose`, shape (6,)."""
        distance, s, h, pitch, yaw, roll = np.asarray(pose, float).tolist()
        posed = ImagingPlane.of_angles(np.array([-s, -distance, h]), (pitch, yaw, roll))
        return replace(self, origin_mm=posed.origin_mm, x_axis=posed.x_axis, z_axis=posed.z_axis)

    @cached_property
    def normal(self) -> FloatArray:
        """Unit normal, shape (3,); for the vertical plane it points to the camera, −Y."""
        (a, b, c), (d, e, f) = self.x_axis.tolist(), self.z_axis.tolist()
        return np.array([b * f - c * e, c * d - a * f, a * e - b * d])  # faster than np.cross

    @cached_property
    def pose_mm(self) -> FloatArray:
        """O′, the directions of O′X′ and O′Z′, the normal, and the glass, for compiled functions.

        Shape (5, 3); the last row is the thickness of the glass, its refractive index, and 0.
        """
        glass = np.array([self.glass_mm, self.glass_index, 0.0])
        return np.array([self.origin_mm, self.x_axis, self.z_axis, self.normal, glass])

    def to_universal(self, plane_mm: FloatArray) -> FloatArray:
        """Transform IPCS (X′, Z′), shape (…, 2), to UCS points, shape (…, 3), mm (Eq. 4-5)."""
        plane_mm = np.asarray(plane_mm, float)
        return self.origin_mm + plane_mm[..., :1] * self.x_axis + plane_mm[..., 1:] * self.z_axis

    def from_universal(self, point_mm: FloatArray) -> FloatArray:
        """Transform UCS points on the plane, shape (…, 3), to IPCS (X′, Z′), shape (…, 2), mm."""
        offset = np.asarray(point_mm, float) - self.origin_mm
        return np.stack([offset @ self.x_axis, offset @ self.z_axis], axis=-1)


Travel = Literal["+y", "-y"]
"""Direction of travel of the torch, in which the head of the pool lies."""


@dataclass(frozen=True)
class Rig:
    """All components of the bench whose position must be known.

    Parameters
    ----------
    uncertainty
        Their uncertainty; None: exactly known.
    travel
        Direction of travel of the torch, in which the pool's head lies.
    """

    laser: Laser
    pattern: DotPattern
    electrode: Electrode
    imaging_plane: ImagingPlane
    uncertainty: RigUncertainty | None = None
    travel: Travel = "+y"

    @property
    def head_sign(self) -> int:
        """+1 if the pool's head points to +Y, −1 if it points to −Y."""
        return 1 if self.travel == "+y" else -1
