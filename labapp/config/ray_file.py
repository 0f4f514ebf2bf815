"""The table of measured rays named in a setup file: ``[pattern] kind = "directions"``.

The rays are inserted into the text of the setup file (``rays`` in place of ``file``), so that a
session, which stores the text, contains the whole set-up.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import tomlkit

from labapp.config.csv_tables import bounded_lines, open_table, parse_number
from labapp.config.toml_keys import is_number, shown
from labapp.core.geometry.patterns import FEWEST_RAYS, MEASURED
from labapp.core.geometry.rig import Laser
from labapp.core.geometry.uncertainty import ENDINGS
from labapp.core.values import FloatArray, IntArray
from labapp.errors import InputError

A_RAY_TABLE = "a table of rays (CSV, UTF-8): ray_row, ray_column and x, y, z or aside, up, along"

LABELS = ("ray_row", "ray_column")
UNIVERSAL, BEAM = ("x", "y", "z"), ("aside", "up", "along")
"""Columns of a ray's unit direction: in the UCS; or to the side, up and along the beam axis."""

MOST_ROWS = 99
"""Largest row or column of a ray: no pattern has more."""

LARGEST_FILE = 4_000_000
NORM_OFF = 0.01
"""Maximum deviation of the length of a unit vector from 1."""


def text_with_rays(text: str, path: Path, values: Mapping[str, Any]) -> str:
    """Text of a setup file in which the named table is replaced by its rays.

    Raises
    ------
    InputError
        If the named file is not in the same folder or is not a table of rays.
    """
    pattern = values.get("pattern")
    if not isinstance(pattern, dict) or pattern.get("kind") != MEASURED or "file" not in pattern:
        return text
    name = pattern["file"]
    if not isinstance(name, str) or not name or PurePath(name.replace("\\", "/")).name != name:
        expected = "the name of a CSV file in the folder of the setup file"
        raise InputError(path, "pattern.file", shown(name), expected)
    ray, tangents = read_rays(path.parent / name, values)
    found: dict[str, float] = {"rows": int(ray[:, 0].max()), "columns": int(ray[:, 1].max())}
    step = pattern.get("inter_beam_angle_deg")
    if step is None:
        step = found["inter_beam_angle_deg"] = _inter_beam_angle(path, ray, tangents)
    # An invalid value is reported with the other problems of the file.
    made = np.round(tangents / np.tan(np.radians(step if is_number(step) and step > 0 else 1.0)), 9)
    document = tomlkit.parse(text)
    table: Any = document["pattern"]
    del table["file"]
    for key, value in found.items():
        if key not in pattern:
            table[key] = value
    rays = tomlkit.array()
    rays.extend([i, j, *place] for (i, j), place in zip(ray.tolist(), made.tolist(), strict=True))
    table["rays"] = rays.multiline(True)
    return tomlkit.dumps(document)


def read_rays(path: Path, setup: Mapping[str, Any]) -> tuple[IntArray, FloatArray]:
    """Read a table of measured rays.

    Parameters
    ----------
    setup
        Tables of the setup file: directions in the UCS require the beam axis and the rotation.

    Returns
    -------
    tuple
        Rays (row, column), counted from 1, shape (n, 2), in ascending order, and their tangents to
        the beam axis, to the side and upwards, shape (n, 2).

    Raises
    ------
    InputError
        If the file cannot be read, or anything in it is missing or impossible.
    """
    with open_table(path, A_RAY_TABLE, LARGEST_FILE) as file:
        reader = csv.reader(bounded_lines(path, file, A_RAY_TABLE), strict=True)
        names = [cell.strip().lower() for cell in next(reader, [])]
        form = next((form for form in (UNIVERSAL, BEAM) if set(form) <= set(names)), None)
        if form is None or not set(LABELS) <= set(names):
            raise InputError(path, "line 1, names", ", ".join(names) or "none", A_RAY_TABLE)
        at = [names.index(name) for name in (*LABELS, *form)]
        found: dict[tuple[int, int], list[float]] = {}
        for cells in reader:
            if not any(map(str.strip, cells)):
                continue
            i, j, *direction = _numbers(path, reader.line_num, cells, at)
            if (i, j) in found:
                raise InputError(path, f"line {reader.line_num}", f"ray {i}, {j}", "each ray once")
            found[i, j] = direction
    if len(found) < FEWEST_RAYS:
        raise InputError(path, "rays", len(found), f"at least {FEWEST_RAYS}")
    rays = sorted(found)
    directions = np.array([found[ray] for ray in rays])
    if form == UNIVERSAL:
        directions = directions @ _beam_axes(path, setup).T
    away = int(np.argmin(directions[:, 2]))
    if directions[away, 2] <= 0:
        expected = "rays less than 90° from the beam axis"
        raise InputError(path, "ray {}, {}".format(*rays[away]), "away from the pool", expected)
    return np.array(rays), directions[:, :2] / directions[:, 2:]


def ray_table(ray: IntArray, tangents: FloatArray) -> str:
    """Write rays (i, j), shape (n, 2), and their tangents to the beam axis, shape (n, 2)."""
    direction = np.column_stack([tangents, np.ones(len(tangents))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lines = [",".join((*LABELS, *BEAM))]
    for (i, j), way in zip(ray.tolist(), direction.tolist(), strict=True):
        lines.append(f"{i},{j}," + ",".join(f"{part:.9f}" for part in way))
    return "\n".join(lines) + "\n"


def _numbers(path: Path, line: int, cells: list[str], at: list[int]) -> tuple[Any, ...]:
    """Row, column and the three components of the direction in a line."""
    values = [parse_number(cells[k].strip(), ",") if k < len(cells) else None for k in at]
    i, j = values[:2]
    labels = [v for v in (i, j) if v is not None and v == int(v) and 1 <= v <= MOST_ROWS]
    direction = [v for v in values[2:] if v is not None]
    if len(labels) < 2:
        expected = f"a row and a column from 1 to {MOST_ROWS}"
        raise InputError(path, f"line {line}, ray", ",".join(cells[:2]), expected)
    if len(direction) < 3 or abs(np.linalg.norm(direction) - 1) > NORM_OFF:
        raise InputError(path, f"line {line}, direction", ",".join(cells), "a unit vector")
    return int(labels[0]), int(labels[1]), *direction


def _beam_axes(path: Path, setup: Mapping[str, Any]) -> FloatArray:
    """Directions to the side, up and along the beam axis in the UCS, shape (3, 3)."""
    try:
        keys = {k: float(v) for k, v in setup["laser"].items() if not k.endswith(ENDINGS)}
        axis, aside, up = Laser(**keys).axes
        turn = np.radians(float(setup["pattern"].get("rotation_deg", 0.0)))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        expected = "a valid [laser] and rotation, to convert directions in the UCS to the beam axis"
        raise InputError(path, "laser", "missing or wrong", expected) from error
    sin, cos = np.sin(turn), np.cos(turn)
    return np.array([cos * aside + sin * up, cos * up - sin * aside, axis])


def _inter_beam_angle(path: Path, ray: IntArray, tangents: FloatArray) -> float:
    """The median angle between neighbours of a row, degrees."""
    beside = (np.diff(ray[:, 0]) == 0) & (np.diff(ray[:, 1]) == 1)
    if not beside.any():
        expected = "an angle in degrees, as no two rays of the table are neighbours"
        raise InputError(path, "pattern.inter_beam_angle_deg", "missing", expected)
    steps = np.linalg.norm(np.diff(tangents, axis=0), axis=1)[beside]
    return round(float(np.degrees(np.arctan(np.median(steps)))), 6)
