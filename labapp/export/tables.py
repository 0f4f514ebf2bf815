"""Tables of a measurement: columns, units, values, and CSV text.

Values have full precision; only CSV is rounded. An unknown value is NaN, and an empty cell in CSV.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.core.rows.correction import Correction
from labapp.core.surface import measures
from labapp.core.surface.measures import Measures, sigma_name
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray
from labapp.export.frame_result import FrameResult
from labapp.text import HEIGHT_SIGMA_OF, SIGMA_OF, as_cell, csv_text, unescaped_csv_text

PX_DIGITS, MM_DIGITS = 4, 6

UNITS = ("mm", "mm2", "mm3", "px", "deg", "s")
NO_UNIT = "1"

Columns = dict[str, npt.NDArray[Any]]
"""Column name → values, shape (rows,): int64 if always known, float64, or text (object)."""


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str
    """Name, which ends in the unit."""
    description: str
    """Short description."""
    digits: int | None = MM_DIGITS
    """Decimals in CSV; 0 for integers, None for text."""
    is_part: bool = False
    """Whether it is a part of a standard uncertainty, which is optional in CSV files."""

    @property
    def unit(self) -> str:
        """``mm``, ``px`` …; ``1`` for plain numbers and text."""
        end = self.name.rpartition("_")[2]
        return end if end in UNITS else NO_UNIT


PARTS = ("noise", "level", "setup")
"""Independent parts of a size's standard uncertainty."""

FRAME = Column("frame", "number of the frame in its recording, from 0", 0)

TABLES: dict[str, tuple[Column, ...]] = {
    "dots": (
        FRAME,
        Column("u_px", "place in the frame, to the right", PX_DIGITS),
        Column("v_px", "place in the frame, down", PX_DIGITS),
        Column("plane_x_mm", "place on the imaging plane, X′"),
        Column("plane_z_mm", "place on the imaging plane, Z′"),
        Column("reflected_row", "reflected row, from the bottom up, from 1", 0),
        Column("reflected_column", "reflected column, from left to right, from 1", 0),
        Column("ray_row", "row i of the ray that made the dot, from 1", 0),
        Column("ray_column", "column j of the ray that made the dot, from 1", 0),
        Column("blocked", "1 if the torch hides dots of its row, otherwise 0", 0),
        Column("source", "auto as it was found, manual if placed or changed by hand", None),
    ),
    "points": (
        FRAME,
        Column("ray_row", "row i of the ray, from 1", 0),
        Column("ray_column", "column j of the ray, from 1", 0),
        Column("x_mm", "X of the reflection point"),
        Column("y_mm", "Y of the reflection point, along the weld"),
        Column("z_mm", "height of the reflection point above the work piece"),
        Column("residual_mm", "distance of computed and captured dot on the imaging plane"),
        Column("sigma_mm", f"standard uncertainty of the height, {HEIGHT_SIGMA_OF}"),
        Column("residual_x_mm", "captured minus computed dot on the imaging plane, along X′"),
        Column("residual_z_mm", "captured minus computed dot on the imaging plane, along Z′"),
        Column("error_x_mm", "that residual scaled to the work piece: reflection error, along X"),
        Column("error_y_mm", "that residual scaled to the work piece: reflection error, along Y"),
    ),
    "boundary": (
        FRAME,
        Column("theta_deg", "polar angle about the centre, from +X, counter-clockwise", PX_DIGITS),
        Column("x_mm", "X of the boundary point"),
        Column("y_mm", "Y of the boundary point"),
        Column("z_mm", "height of the boundary point above the work piece"),
    ),
    "measures": (
        FRAME,
        Column("time_s", "time since the recording's first frame"),
        Column("status", "ok, or one word for why there is no surface", None),
        Column("scheme", "reconstruction scheme", None),
        Column(
            "correspondence",
            "orientation: order of columns/rows, S as the rays, I inverse",
            None,
        ),
        Column("dots", "dots found", 0),
        Column("rows", "reflected rows found", 0),
        Column("are_mm", "average reflection error"),
        Column("mre_mm", "maximum reflection error"),
        Column("width_mm", "extent of the boundary along X"),
        Column("length_mm", "extent of the boundary along Y"),
        Column("height_mm", "largest z"),
        Column("depth_mm", "smallest z"),
        Column("area_mm2", "area within the boundary, seen from above"),
        Column("volume_mm3", "integral of z over the area, negative for a concave pool"),
        Column("center_x_mm", "X of the pool's centre"),
        Column("center_y_mm", "Y of the pool's centre"),
        Column("peak_x_mm", "X where the surface is farthest from the work piece"),
        Column("peak_y_mm", "Y where the surface is farthest from the work piece"),
        *(
            Column(f"{size}_sigma_{unit}", f"standard uncertainty of the {size}, {SIGMA_OF}")
            for size, unit in (name.split("_") for name in measures.SIZES)
        ),
        Column("are_inner_mm", "average reflection error of inside points"),
        Column("mre_inner_mm", "maximum reflection error of inside points"),
        Column("own_are_mm", "irs, ers: average reflection error of the scheme's own points"),
        Column("convexity_mm", "mean height of the longitudinal section through the middle"),
        Column("asymmetry", "volume right of that section less that left of it, over both"),
        Column("wetting_slope_deg", "mean angle of the surface at the boundary"),
        Column("convexity_sigma_mm", f"standard uncertainty of the convexity, {SIGMA_OF}"),
        Column("asymmetry_sigma", f"standard uncertainty of the asymmetry, {SIGMA_OF}"),
        Column("wetting_slope_sigma_deg", f"standard uncertainty of that angle, {SIGMA_OF}"),
        Column("sigma_of", "what is in the standard uncertainties, where there are any", None),
        Column("reason", "why there is no surface, in a sentence", None),
        Column("setup_status", "entered, calibrated, checked against a mirror, or doubtful", None),
        *(
            Column(sigma_name(size, part), f"part of {sigma_name(size)}: {part}", is_part=True)
            for part in PARTS
            for size in measures.WITH_SIGMA
        ),
    ),
}
"""The tables and their columns, in the order of writing."""

NODES = tuple(Column(f"{axis}_mm", f"{axis.upper()} of the node") for axis in "xyz")
"""Columns of a surface as CSV."""

_NAMES = {name: [column.name for column in columns] for name, columns in TABLES.items()}
_MEASURED = {field.name for field in fields(Measures)}
MEASURE_COLUMNS = [c.name for c in TABLES["measures"] if c.name in _MEASURED and not c.is_part]


@cache
def columns_of(name: str, sigma_parts: bool = False) -> tuple[Column, ...]:
    """Return the columns of a table's CSV file, with or without parts of uncertainties."""
    return tuple(column for column in TABLES[name] if sigma_parts or not column.is_part)


def frame_tables(result: FrameResult, calibration: ImageCalibration) -> dict[str, Columns]:
    """Return all tables of a frame, with the columns of `TABLES`.

    `measures` always has a row; the other tables may be empty.
    """
    cells = [np.array([cell], object if isinstance(cell, str) else None) for cell in _cells(result)]
    measures = dict(zip(_NAMES["measures"], cells, strict=True))
    return _point_tables(result, calibration) | {"measures": measures}


def _point_tables(result: FrameResult, calibration: ImageCalibration) -> dict[str, Columns]:
    """Return the tables of a frame that have a row for each dot or point."""
    measurement = result.measurement
    reconstruction = measurement.reconstruction
    columns = {
        "dots": _dots(measurement, calibration),
        "points": [] if reconstruction is None else _points(reconstruction, measurement.measures),
        "boundary": [] if reconstruction is None else _boundary(reconstruction),
    }
    tables = {}
    for name, values in columns.items():
        rows = len(values[0]) if values else 0
        filled = values or [np.empty(0)] * (len(TABLES[name]) - 1)
        tables[name] = dict(zip(_NAMES[name], [np.full(rows, result.frame), *filled], strict=True))
    return tables


def _cells(result: FrameResult) -> list[Any]:
    """Return the cells of a frame's row of `measures`: numbers and text."""
    measurement = result.measurement
    lattice, match = measurement.lattice, measurement.match
    return [
        result.frame,
        math.nan if result.time_s is None else result.time_s,
        measurement.status,
        measurement.scheme,
        "" if match is None else match.orientation,
        0 if measurement.dots is None else len(measurement.dots),
        math.nan if lattice is None else float(len(set(lattice.row.tolist()) - {0})),
        *(getattr(measurement.measures, name, math.nan) for name in MEASURE_COLUMNS),
        sigma_of(measurement),
        measurement.reason,
        measurement.setup_status,
        *_sigma_parts(measurement.measures),
    ]


def sigma_of(measurement: Measurement) -> str:
    """Return the contributions to a frame's standard uncertainties; empty if it has none."""
    total, setup = (_sigmas(measurement.measures, part) for part in ("", "setup"))
    if not any(map(math.isfinite, total)):
        return ""
    return SIGMA_OF if any(map(math.isfinite, setup)) else HEIGHT_SIGMA_OF


def _sigma_parts(measured: Measures | None) -> list[float]:
    """Return the parts of each size's standard uncertainty: noise, level, set-up."""
    total, level, setup = (_sigmas(measured, part) for part in ("", "level", "setup"))
    square, of_level, of_setup = np.array([total, level, setup]) ** 2
    noise = np.sqrt(np.maximum(square - of_level - np.nan_to_num(of_setup), 0.0))
    return [*noise.tolist(), *level, *setup]


def _sigmas(measured: Measures | None, part: str) -> list[float]:
    """Return the σ of each of `measures.WITH_SIGMA`, or a part of it; NaN if unknown."""
    return [getattr(measured, name, math.nan) for name in measures.sigma_names(part)]


def _dots(measurement: Measurement, calibration: ImageCalibration) -> list[npt.NDArray[Any]]:
    """Return the columns of all dots; NaN for an unknown row, column or ray."""
    dots, lattice, match = measurement.dots, measurement.lattice, measurement.match
    if dots is None:
        return []
    ray = np.full((len(dots), 2), np.nan)
    if match is not None:
        ray[match.dot] = match.ray
    site = np.full((len(dots), 2), np.nan)
    blocked = np.full(len(dots), np.nan)
    if lattice is not None:
        number = np.array([lattice.row, lattice.column]).T
        site = np.where(number > 0, number, np.nan)
        hidden = np.isin(lattice.row, list(lattice.blocked_rows)) if lattice.blocked_rows else 0
        blocked = np.where(lattice.row > 0, hidden, np.nan)
    source = np.full(len(dots), "auto", object)
    if isinstance(measurement.correction, Correction):
        source[measurement.correction.manual] = "manual"
    plane = calibration.to_plane(dots.image_px)
    return [*dots.image_px.T, *plane.T, *site.T, *ray.T, blocked, source]


def _points(reconstruction: Reconstruction, measures: Measures | None) -> list[npt.NDArray[Any]]:
    """Return the columns of the reflection points; residuals are captured minus computed."""
    residual = -reconstruction.residual_mm
    scale = (math.nan, math.nan) if measures is None else (measures.scale_x, measures.scale_z)
    return [
        *reconstruction.ray.T,
        *reconstruction.points_mm.T,
        np.linalg.norm(residual, axis=-1),
        reconstruction.sigma_mm,
        *residual.T,
        *(residual * scale).T,
    ]


def _boundary(reconstruction: Reconstruction) -> list[npt.NDArray[Any]]:
    return [reconstruction.boundary.theta_deg, *reconstruction.boundary.points_mm.T]


def table_rows(
    result: FrameResult, calibration: ImageCalibration, sigma_parts: bool = False
) -> dict[str, str]:
    """Return a frame's rows of every table as CSV text (`frame_tables`)."""
    tables = _point_tables(result, calibration)
    rows = {name: csv_rows(name, table, sigma_parts) for name, table in tables.items()}
    row = [
        as_cell(cell) if column.digits is None else number(cell, column.digits)
        for cell, column in zip(_cells(result), TABLES["measures"], strict=True)
        if sigma_parts or not column.is_part
    ]
    return rows | {"measures": unescaped_csv_text([row])}


def csv_header(name: str, sigma_parts: bool = False) -> str:
    """Return the header line of a table's CSV file."""
    return csv_text([[column.name for column in columns_of(name, sigma_parts)]])


def csv_rows(name: str, table: Columns, sigma_parts: bool = False) -> str:
    """Return a table's rows as CSV text, without header, rounded to the decimals of `TABLES`."""
    return _rows(columns_of(name, sigma_parts), table)


def _rows(columns: Sequence[Column], table: Columns) -> str:
    text = _numeric_rows(columns, table)
    if text is not None:
        return text
    cells = [
        table[column.name].tolist()
        if column.digits is None
        else [number(value, column.digits) for value in table[column.name].tolist()]
        for column in columns
    ]
    return csv_text(zip(*cells, strict=True))


def _numeric_rows(columns: Sequence[Column], table: Columns) -> str | None:
    """Return the same with compiled loops, for numbers and a constant word in the last column.

    None for other tables, and if a number is too close to a tie for correct rounding.
    """
    from labapp.export.fixed_point import format_fixed  # loads numba

    end = "\n"
    if columns[-1].digits is None:
        words = set(table[columns[-1].name].tolist())
        if len(words) != 1:
            return None
        columns, end = columns[:-1], f",{words.pop()}\n"
    if any(column.digits is None for column in columns):
        return None
    digits = np.array([column.digits for column in columns])
    values = np.array([table[column.name] for column in columns], float)
    text, length = format_fixed(values.T, digits)
    if length < 0:
        return None
    return text[:length].tobytes().decode("ascii").replace("\n", end)


def nodes_csv(nodes: FloatArray) -> bytes:
    """Return the nodes of a surface, shape (n, 3), mm, as CSV `x_mm,y_mm,z_mm`."""
    table = {column.name: values for column, values in zip(NODES, nodes.T, strict=True)}
    return (csv_text([list(table)]) + _rows(NODES, table)).encode()


def number(value: float | None, digits: int = MM_DIGITS) -> str:
    """Format a number as a CSV cell; empty if unknown."""
    return f"{value:z.{digits}f}" if value is not None and math.isfinite(value) else ""
