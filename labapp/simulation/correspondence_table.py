"""Which way the reflected rows and columns run: the letters of Tables 4-4 and 4-5 (§4.2.2)."""

from __future__ import annotations

import numpy as np

from labapp.core.values import FloatArray
from labapp.simulation.forward import Reflections


def correspondence_letters(reflections: Reflections) -> str:
    """Column and row correspondence as the tables write it: ``S/S``, ``I/I*`` … ``D/D``.

    Counts every lit ray whose reflection meets the plane, its edges and the torch ignored. A row
    runs one way when X′ changes with one sign from every dot to the next that is there. Fewer
    than half of the rows running one way: disordered. Otherwise the first letter is that of the
    highest such row in the image, with a star where at least a quarter of the rows run the other
    way (the sand timer of Fig. 4-18); the second is the sign that Z′ mostly changes with from one
    dot of a column to the next.

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
    """Steps from each dot of a line to the next that is there."""
    return np.diff(line[np.isfinite(line)])


def _way(steps: FloatArray) -> float:
    """Sign that all steps share, 0 where they differ, NaN where there are none."""
    signs = np.sign(steps)
    if signs.size == 0:
        return float("nan")
    return float(signs[0]) if (signs == signs[0]).all() else 0.0
