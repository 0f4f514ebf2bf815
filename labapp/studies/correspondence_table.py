"""Order of the reflected rows and columns: Tables 4-4 and 4-5 (§4.2.2)."""

from __future__ import annotations

import numpy as np

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.values import FloatArray
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import spherical_cap
from labapp.studies.tables import Cell, Table

RADII_MM, DEPTHS = (2, 3, 4, 5), (100, 50, 10, 5, 2)
"""Radius, and ratio of radius to depth, of the caps of Tables 4-4 and 4-5."""

EXAMPLES = (
    ("figure_4_17_concave", "Fig. 4-17: concave, r = 3 mm, d = r/10", 3, -1 / 10),
    ("figure_4_18_sand_timer", "Fig. 4-18: concave, r = 4 mm, d = r/10", 4, -1 / 10),
    ("figure_4_20_convex", "Fig. 4-20: convex, r = 3 mm, d = r/10", 3, 1 / 10),
)
"""Name, title, radius and depth in radii of the caps drawn in §4.2.2.3."""

OPEN_BENCH = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(1e9),
    ImagingPlane.vertical(50.0, 1e4, -1e4, 2e4, 2e4),
)
"""The bench of §4.2.2.2 and §8.3.1 without blocking, with a plane that catches all rays."""


def correspondence_tables() -> tuple[Table, Table]:
    """Tables 4-4 and 4-5: order of columns and rows; a star marks the sand timer of Fig. 4-18."""
    made = []
    for number, kind, sign in ((4, "concave", -1), (5, "convex", 1)):
        rows = []
        for part in DEPTHS:
            row: dict[str, Cell] = {"depth": f"r/{part}"}
            for radius in RADII_MM:
                row[f"r{radius}"] = correspondence_letters(cap_reflections(radius, sign / part))
            rows.append(row)
        caption = f"Table 4-{number}, column/row correspondence on {kind} surfaces"
        made.append(Table.of(f"table_4_{number}_correspondence_{kind}", caption, rows))
    return made[0], made[1]


def cap_reflections(radius_mm: float, depth: float) -> Reflections:
    """Reflections from a cap; the depth is in radii and negative for a concave cap."""
    return trace(spherical_cap(2 * radius_mm, radius_mm * depth), OPEN_BENCH)


def correspondence_letters(reflections: Reflections) -> str:
    """Column and row correspondence in the notation of the tables: ``S/S``, ``I/I*`` … ``D/D``.

    It uses every lit ray whose reflection meets the plane, ignoring the plane's edges and the
    torch. A row is ordered if X′ changes with the same sign from every existing dot to the next. If
    fewer than half of the rows are ordered, the result is disordered. Otherwise the first letter is
    that of the highest ordered row in the image, with a star if at least a quarter of the rows run
    in the other direction (the sand timer of Fig. 4-18). The second letter is the sign with which
    Z′ mostly changes from one dot of a column to the next.

    Raises
    ------
    ValueError
        If no row has two dots.
    """
    dots = np.where(reflections.lit[..., None], reflections.plane_mm, np.nan)
    ways = np.array([_way(_steps(row)) for row in dots[..., 0]])
    counted = ~np.isnan(ways)
    if not counted.any():
        raise ValueError("no row has two dots")
    with_way = counted & (ways != 0)
    if with_way.sum() < counted.sum() / 2:
        return "D/D"
    heights = np.array(
        [
            row[np.isfinite(row)].mean() if row_counts else -np.inf
            for row, row_counts in zip(dots[..., 1], with_way, strict=True)
        ]
    )
    top = ways[int(np.argmax(heights))]
    star = "*" if (ways == -top).sum() >= counted.sum() / 4 else ""
    rows = sum(np.sign(_steps(column)).sum() for column in dots[..., 1].T)
    return f"{'S' if top > 0 else 'I'}/{'S' if rows > 0 else 'I'}{star}"


def _steps(line: FloatArray) -> FloatArray:
    """Steps from each dot of a line to the next existing one."""
    return np.diff(line[np.isfinite(line)])


def _way(steps: FloatArray) -> float:
    """Common sign of all steps, 0 if they differ, NaN if there are none."""
    signs = np.sign(steps)
    if signs.size == 0:
        return float("nan")
    return float(signs[0]) if (signs == signs[0]).all() else 0.0
