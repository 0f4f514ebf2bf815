"""Reading of surfaces and sizes from a results folder (CSV)."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from labapp.config.csv_tables import bounded_lines, open_table, parse_number
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.interpolation import CloughTocherSurface
from labapp.core.surface.measures import SHAPES, SIZES
from labapp.core.values import CannotMeasure, FloatArray
from labapp.errors import InputError
from labapp.export.dynamics import MeasuredSurface, no_time_base

LARGEST = 1 << 31
"""Largest table, bytes; boundary.csv of 100,000 frames has 1.5 GB, and is read row by row."""

LARGEST_NUMBER = 1e9

MOST_NODES = 200_000
"""Most nodes of a surface."""

MOST_STEPS = 3
"""Largest distance of the outermost nodes from the boundary, in steps of the grid."""

KEPT_NODES = 800
"""Approximate number of nodes used of a surface, as pools are smooth."""

WANTED = "as `labapp reconstruct` writes it"


def measured_in(folder: Path) -> Iterator[MeasuredSurface]:
    """Yield the frames with a surface in a folder that `labapp reconstruct` or an export wrote.

    Raises
    ------
    InputError
        If a table is missing or damaged, or frames have no time.
    """
    outlines = itertools.groupby(_rows(folder / "boundary.csv"), lambda row: row.get("frame"))
    outline = next(outlines, None)
    path = folder / "measures.csv"
    before_s = -np.inf
    for row in _rows(path):
        if row.get("status") != "ok":
            continue
        if not row.get("time_s"):
            raise no_time_base()
        frame, time_s = _number(path, row, "frame"), _number(path, row, "time_s")
        if not frame.is_integer() or frame < 0:
            raise InputError(path, "frame", row["frame"], "the number of a frame")
        if not before_s < time_s < np.inf:
            raise InputError(path, f"time_s of frame {frame:g}", row["time_s"], "an ascending time")
        before_s = time_s
        while outline is not None and outline[0] != row["frame"]:
            outline = next(outlines, None)
        if outline is None:
            raise InputError(
                folder / "boundary.csv", "frame", "missing", f"{row['frame']} in order"
            )
        sizes = {
            name: _number(path, row, name)
            for name in (*row, *SIZES)
            if name.endswith(("_mm", "mm2", "mm3")) or name in SHAPES
        }
        boundary = _boundary(folder / "boundary.csv", list(outline[1]))
        surface = _surface(folder / f"surface_{int(frame):06d}.csv", boundary)
        yield MeasuredSurface(int(frame), time_s, surface, boundary, sizes)


def _rows(path: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of a table, by column."""
    with open_table(path, WANTED, LARGEST) as file:
        reader = csv.DictReader(bounded_lines(path, file, WANTED), strict=True)
        names = reader.fieldnames or ()
        if len(set(names)) < len(names):
            raise InputError(path, "line 1", "a name twice", WANTED)
        for row in reader:
            if None in row or None in row.values():
                raise InputError(path, "row", "too many or too few cells", WANTED)
            yield row


def _number(path: Path, row: dict[str, str], name: str) -> float:
    cell = row.get(name)
    value = np.nan if cell == "" else parse_number(cell or "", ",")
    if value is None or abs(value) > LARGEST_NUMBER:
        right = f"a number up to {LARGEST_NUMBER:g}"
        raise InputError(path, name, "missing" if cell is None else cell, right)
    return value


def _points(path: Path, rows: list[dict[str, str]]) -> FloatArray:
    points = np.array([[_number(path, row, f"{n}_mm") for n in "xyz"] for row in rows])
    if len(rows) < 8 or not np.isfinite(points).all():
        raise InputError(path, "points", f"{len(rows)}, or not numbers", WANTED)
    return points


def _boundary(path: Path, rows: list[dict[str, str]]) -> Boundary:
    points = _points(path, rows)
    theta = np.array([_number(path, row, "theta_deg") for row in rows])
    if not (np.diff(theta) > 0).all():
        raise InputError(path, "theta_deg", "not ascending", WANTED)
    # The centre of the polar angles, by least squares: (y − y_c)·cos θ = (x − x_c)·sin θ.
    sin, cos = np.sin(np.radians(theta)), np.cos(np.radians(theta))
    right = points[:, 0] * sin - points[:, 1] * cos
    center = np.linalg.lstsq(np.column_stack([sin, -cos]), right, rcond=None)[0]
    return Boundary(np.asarray(center, float), theta, points)


def _surface(path: Path, boundary: Boundary) -> CloughTocherSurface:
    rows = list(itertools.islice(_rows(path), MOST_NODES + 1))
    if len(rows) > MOST_NODES:
        raise InputError(path, "rows", f"more than {MOST_NODES}", WANTED)
    nodes = _points(path, rows)
    _check_extent(path, nodes[:, :2], boundary.points_mm[:, :2])
    kept = nodes[:: max(1, -(-len(rows) // KEPT_NODES))]
    try:
        return CloughTocherSurface(np.vstack([kept, boundary.points_mm]))
    except CannotMeasure as answer:
        raise InputError(path, "points", answer.reason, WANTED) from answer


def _check_extent(path: Path, nodes: FloatArray, outline: FloatArray) -> None:
    """Raise unless the nodes, shape (n, 2), reach all sides of the boundary: others are missing."""
    steps = [max(len(np.unique(places)) - 1, 1) for places in nodes.T]
    furthest = MOST_STEPS * np.ptp(nodes, axis=0) / steps
    for end in (np.min, np.max):
        if (np.abs(end(nodes, axis=0) - end(outline, axis=0)) > furthest).any():
            raise InputError(path, "points", "do not reach the boundary", WANTED)
