"""The projected line pattern: k lines, each a fan of rays in one plane (§3.1.2, §3.2.1, Fig. 3-9).

Unlike a dot, a point of a reflected line does not identify its ray: only the plane of rays is
known, not the position along the fan.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig, turned
from labapp.core.values import FloatArray


@dataclass(frozen=True)
class LinePattern:
    """Parallel lines across the beam axis.

    Line i, from 1, grows towards the head of the pool (+Y), as rows of dots do; the position in
    the fan grows with X. Line i at angle φ has the direction
    ``a + tan(φ)·e + tan((c − i)·γ)·n`` with c = (count + 1)/2 and the interline angle γ.

    Parameters
    ----------
    interline_angle_deg
        Angle γ between neighbouring lines at the centre, degrees.
    fan_angle_deg
        Angle from one end of a line to the other, degrees.
    rotation_deg
        Rotation of the pattern about the beam axis, degrees, as in `DotPattern`.
    """

    count: int = 5
    interline_angle_deg: float = 0.23
    fan_angle_deg: float = 5.0
    rotation_deg: float = 0.0

    @property
    def half_fan(self) -> float:
        """Half of the fan angle, rad."""
        return float(np.radians(self.fan_angle_deg) / 2)

    def tangents(self, line: FloatArray, fan: FloatArray) -> FloatArray:
        """Tangents of the angles of rays to the beam axis, sideways and upwards, shape (…, 2).

        Parameters
        ----------
        line
            Number of the line, from 1; numbers beyond 1 … count are diffraction fringes.
        fan
            Angle φ in the fan, rad; the shapes of both must broadcast.
        """
        up = np.tan(((self.count + 1) / 2 - line) * np.radians(self.interline_angle_deg))
        tangents = np.stack(np.broadcast_arrays(np.tan(fan), up), axis=-1)
        return turned(tangents, self.rotation_deg)


KIND = "lines"
"""Kind of a line pattern in setup files."""

RAYS_A_LINE = 41
"""Number of rays that represent a line if single rays are traced."""


@dataclass(frozen=True)
class LineRays(DotPattern):
    """A line pattern as rays, one row for each line, for drawings and for counts of rays."""

    lines: LinePattern = field(default_factory=LinePattern)

    @classmethod
    def of(cls, lines: LinePattern) -> LineRays:
        """Rays at equal angles along each line."""
        step = lines.fan_angle_deg / (RAYS_A_LINE - 1)
        none = frozenset[tuple[int, int]]()
        return cls(lines.count, RAYS_A_LINE, step, none, KIND, lines.rotation_deg, lines=lines)

    @property
    def tangents(self) -> FloatArray:
        """Tangents of the angles of the rays to the beam axis, shape (rows, columns, 2)."""
        fan = np.linspace(-self.lines.half_fan, self.lines.half_fan, self.columns)
        return self.lines.tangents(np.arange(1.0, self.rows + 1)[:, None], fan)

    @cached_property
    def _outside(self) -> frozenset[tuple[int, int]]:
        return frozenset()


@dataclass(frozen=True)
class LineRig:
    """A rig with a line pattern."""

    laser: Laser
    pattern: LinePattern
    electrode: Electrode
    imaging_plane: ImagingPlane


def line_rig(rig: Rig) -> LineRig | None:
    """The rig as one with a line pattern; None if it has a dot pattern."""
    if not isinstance(rig.pattern, LineRays):
        return None
    return LineRig(rig.laser, rig.pattern.lines, rig.electrode, rig.imaging_plane)


def line_directions(
    laser: Laser, pattern: LinePattern, line: FloatArray, fan: FloatArray
) -> FloatArray:
    """Unit directions of the rays of lines, shape (…, 3); see `LinePattern.tangents`."""
    return laser.directions(pattern.tangents(line, fan))
