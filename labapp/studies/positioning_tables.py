"""Tables 4-1 and 4-2, L1, L2 and D1, and the coverage of the plane (§4.2.1, Fig. 4-11).

Assumptions where the text gives no usable values: the electrode's tip is at 5 mm (the text's 0.5 mm
does not reproduce Table 4-1), and the 4″ plane stands on the work piece, its centre opposite the
torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays
from labapp.simulation.forward import trace
from labapp.simulation.pools import spherical_cap
from labapp.simulation.positioning import clearance
from labapp.studies.tables import Cell, Table

ANGLES_DEG = (20, 25, 30, 35, 40, 45)
SIZES_MM = ((2, 0.2), (2, 0.4), (3, 0.3), (3, 0.6), (4, 0.4), (4, 0.8))
"""Radius and depth of the caps of Tables 4-1 and 4-2."""

DISTANCE_MM, TIP_MM = 30.0, 5.0
"""Distance from laser to origin (§4.2.1.3), and the electrode tip's height for these tables."""

PLANES_MM = (30, 50, 70, 90)
"""Distances of the imaging plane of Fig. 4-11."""


def blocking_tables() -> tuple[Table, Table]:
    """Tables 4-1 and 4-2: `rb` if the torch blocks a reflected ray, `ib` for an incident one."""
    made = []
    for number, kind, sign in ((1, "convex", 1), (2, "concave", -1)):
        rows = []
        for angle in ANGLES_DEG:
            row: dict[str, Cell] = {"projection_angle_deg": angle}
            for radius, depth in SIZES_MM:
                row[f"r{radius}_d{depth:g}"] = _blocking(angle, radius, sign * depth)
            rows.append(row)
        name = f"table_4_{number}_blocking_{kind}"
        made.append(Table.of(name, f"Table 4-{number}, blocking on {kind} surfaces", rows))
    return made[0], made[1]


def _blocking(angle_deg: float, radius_mm: float, depth_mm: float) -> str:
    seen = trace(spherical_cap(2 * radius_mm, depth_mm), positioning_rig(angle_deg))
    if (seen.lit & seen.incident_blocked).any():
        return "ib"
    return "rb" if (seen.lit & seen.reflected_blocked).any() else "nb"


def positioning_rig(angle_deg: float, plane_mm: float = 50.0) -> Rig:
    """The bench of §4.2.1.3: laser 30 mm away, 4″ plane with O′ at half its width."""
    return Rig(
        Laser(angle_deg, DISTANCE_MM),
        DotPattern(),
        Electrode(TIP_MM),
        ImagingPlane.vertical(plane_mm, 50.8, 0.0),
    )


def clearance_table() -> Table:
    """L1, L2 and D1 (Eq. 4-14 … 4-18) for flat, convex and concave surfaces."""
    # The slope at the edge of a cap is half the angle of its arc.
    slopes = {f"r/{part}": float(np.degrees(2 * np.arctan(1 / part))) for part in (10, 5)}
    surfaces = {
        "flat": 0.0,
        **{f"convex, d = {depth}": slope for depth, slope in slopes.items()},
        **{f"concave, d = {depth}": -slope for depth, slope in slopes.items()},
    }
    rows = []
    for angle in ANGLES_DEG:
        for surface, slope in surfaces.items():
            found = clearance(positioning_rig(angle), slope)
            row: dict[str, Cell] = {
                "projection_angle_deg": angle,
                "surface": surface,
                "head_slope_deg": slope,
                "l1_mm": found.l1_mm,
                "l2_mm": found.l2_mm,
                "d1_least_mm": found.least_plane_mm + 0.0,
                "d1_most_mm": found.most_plane_mm + 0.0,
            }
            rows.append(row)
    return Table.of(
        "l1_l2_d1",
        "L1, L2 and D1 (Eq. 4-14 … 4-18): laser 30 mm away, electrode 5 mm, plane 0 to 101.6 mm up",
        rows,
    )


@dataclass(frozen=True)
class Coverage(ReadOnlyArrays):
    """Dots of one placement of the imaging plane (Fig. 4-11)."""

    distance_mm: float
    """Distance of the plane from the torch."""
    plane_mm: FloatArray
    """The dots, ignoring the plane's edges, IPCS, shape (n, 2), mm."""
    on_plane: BoolArray
    """Whether each dot is within the plane's edges, shape (n,)."""


def coverage() -> tuple[Coverage, ...]:
    """Fig. 4-11: the cap 3/0.3 at 30°, the plane at 30, 50, 70 and 90 mm."""
    made = []
    for distance in PLANES_MM:
        seen = trace(spherical_cap(6.0, 0.3), positioning_rig(30.0, distance))
        lit = seen.lit & ~seen.blocked
        made.append(Coverage(distance, seen.plane_mm[lit], seen.on_plane[lit]))
    return tuple(made)


def coverage_table(placements: tuple[Coverage, ...]) -> Table:
    """Number of dots on the 4″ plane and off it."""
    rows: list[dict[str, Cell]] = [
        {
            "plane_distance_mm": one.distance_mm,
            "reflected_dots": len(one.on_plane),
            "on_plane": int(one.on_plane.sum()),
            "off_plane": int((~one.on_plane).sum()),
        }
        for one in placements
    ]
    caption = "Fig. 4-11, dots on the 4″ plane: convex cap 3/0.3, laser at 30°, 30 mm"
    return Table.of("figure_4_11_coverage", caption, rows)
