"""Pools from files: height maps (CSV, NumPy) and meshes (STL, PLY), in mm."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
import numpy.typing as npt
from matplotlib.path import Path as Polygon
from scipy.interpolate import CloughTocher2DInterpolator

from labapp.core.values import FloatArray, IntArray
from labapp.errors import InputError
from labapp.files import read_limited
from labapp.simulation.outlined_pool import OutlinedPool, pool_from_heights

A_SURFACE = "a height map (.csv, .npy, .npz) or a mesh (.stl, .ply)"

MESH_NODES = 250
"""Maximum number of nodes along the longer side of the grid at which a mesh is sampled."""

LARGEST_FILE = 1 << 29
"""Largest table or mesh, bytes."""

MOST_NODES = 1 << 24
"""Largest number of heights: a small file can claim any number, or name as many places."""

FARTHEST_MM = 1e6
"""Largest coordinate of a mesh, also of the faces that are not the pool."""

SMALLEST_MM, LARGEST_MM = 0.5, 200.0
"""Limits of the longer side of a pool; other values indicate a wrong unit."""

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

DAMAGED = (ValueError, LookupError, EOFError, BadZipFile, OverflowError, MemoryError)
"""Errors raised for damaged files."""

Grid = tuple[FloatArray, FloatArray, FloatArray]


class _Unreadable(Exception):
    """The error in a file and what was expected."""

    def __init__(self, what: object, expected: str) -> None:
        super().__init__(str(what), expected)
        self.what, self.expected = what, expected


def read_pool(
    path: str | os.PathLike[str],
    spacing_mm: float | None = None,
    center_mm: tuple[float, float] = (0.0, 0.0),
    outline_mm: FloatArray | None = None,
) -> OutlinedPool:
    """Read a pool from a file.

    ============================== =======================================================
    ``.npy``, ``.csv`` of numbers  heights; columns run along +X, rows along +Y from the
                                   first, both ``spacing_mm`` apart, (0, 0) in the middle
    ``.csv`` with x_mm,y_mm,z_mm   nodes of an even grid, as `labapp reconstruct` writes
    ``.npz``                       x_mm (n), y_mm (m), z_mm (m, n)
    ``.stl``, ``.ply``             triangles; those that face up are the pool
    ============================== =======================================================

    An empty cell or nan is outside the pool.

    Parameters
    ----------
    spacing_mm
        Spacing of a grid without node positions; not used for others.
    center_mm
        Added to every (x, y) of the file, including its outline.
    outline_mm
        Corners of the boundary, shape (k, 2), mm. None: that of the heights or of the mesh.

    Raises
    ------
    InputError
        If the file cannot be read or is not such a surface.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path, float | None], tuple[Grid, FloatArray | None]]] = {
        ".npy": _npy, ".npz": _npz, ".csv": _csv, ".stl": _mesh, ".ply": _mesh,
    }  # fmt: skip
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, "file", path.suffix or "no suffix", A_SURFACE)
    try:
        (x, y, z), own_outline = reader(path, spacing_mm)
        longest = max(np.ptp(x), np.ptp(y))
        if not SMALLEST_MM <= longest <= LARGEST_MM:
            expected = f"{SMALLEST_MM:g} to {LARGEST_MM:g} mm along its longer side"
            raise _Unreadable(f"{longest:g} mm long", expected)
        if (np.abs(z) > LARGEST_MM).any():
            raise _Unreadable("heights of metres", f"at most {LARGEST_MM:g} mm")
        outline = own_outline if outline_mm is None else np.asarray(outline_mm, float)
        shift = np.asarray(center_mm, float)
        outline = None if outline is None else outline + shift
        return pool_from_heights(x + shift[0], y + shift[1], z, outline)
    except _Unreadable as error:
        raise InputError(path, "surface", error.what, error.expected) from error
    except OSError as error:
        raise InputError(path, "file", error.strerror or error, A_SURFACE) from error
    except DAMAGED as error:
        raise InputError(path, "surface", error, A_SURFACE) from error


# --- height maps --------------------------------------------------------------------------------


def _npy(path: Path, spacing_mm: float | None) -> tuple[Grid, None]:
    # Mapped, so that a claimed size beyond that of the file is an error, and takes no memory.
    heights = np.load(path, mmap_mode="r", allow_pickle=False)
    if heights.size > MOST_NODES:
        raise _Unreadable(f"{heights.size} heights", f"at most {MOST_NODES}")
    return _even(np.array(heights), spacing_mm), None


def _even(heights: npt.NDArray[Any], spacing_mm: float | None) -> Grid:
    """Heights without positions: (0, 0) is in the middle."""
    if heights.ndim != 2 or heights.dtype.kind not in "fiu" or min(heights.shape) < 4:
        shape = f"{heights.dtype} of shape {heights.shape}"
        raise _Unreadable(shape, "numbers in at least 4 rows and 4 columns")
    if spacing_mm is None:
        raise _Unreadable("heights without positions", "spacing_mm to be given")
    y, x = (spacing_mm * (np.arange(count) - (count - 1) / 2) for count in heights.shape)
    return x, y, np.asarray(heights, float)


def _npz(path: Path, spacing_mm: float | None) -> tuple[Grid, None]:
    del spacing_mm
    # Opened here: numpy leaves a file open that begins like an archive but is not one.
    with path.open("rb") as file:
        with ZipFile(file) as archive:
            unpacked = sum(part.file_size for part in archive.infolist())
        if unpacked > LARGEST_FILE:
            raise _Unreadable(f"{unpacked} bytes unpacked", f"at most {LARGEST_FILE}")
        file.seek(0)
        with np.load(file, allow_pickle=False) as kept:
            lacking = {"x_mm", "y_mm", "z_mm"} - set(kept.files)
            if lacking:
                raise _Unreadable(f"no {', '.join(sorted(lacking))}", "x_mm, y_mm and z_mm")
            x, y, z = (np.asarray(kept[name], float) for name in ("x_mm", "y_mm", "z_mm"))
    if z.ndim != 2 or z.shape != (*y.shape, *x.shape):
        shapes = f"x_mm {x.shape}, y_mm {y.shape}, z_mm {z.shape}"
        raise _Unreadable(shapes, "shapes (n), (m) and (m, n)")
    return (_rising(x, "x_mm"), _rising(y, "y_mm"), z), None


def _csv(path: Path, spacing_mm: float | None) -> tuple[Grid, None]:
    text = read_limited(path, LARGEST_FILE, A_SURFACE).decode("utf-8-sig")
    header, _, rest = text.partition("\n")
    if header.strip().replace(" ", "") != "x_mm,y_mm,z_mm":
        return _even(_numbers(text), spacing_mm), None
    nodes = _numbers(rest)
    if nodes.ndim != 2 or nodes.shape[1] != 3 or len(nodes) < 16:
        raise _Unreadable(f"{len(nodes)} nodes", "at least 4 × 4 nodes x_mm,y_mm,z_mm")
    # Files have a few decimals: closer positions belong to the same line of the grid.
    (x, column), (y, row) = (
        np.unique(np.round(nodes[:, n], 6), return_inverse=True) for n in range(2)
    )
    if len(x) * len(y) > MOST_NODES:
        found = f"{len(x)} values of x_mm and {len(y)} of y_mm"
        raise _Unreadable(found, "those of the columns and rows of a grid")
    z = np.full((len(y), len(x)), np.nan)
    z[row, column] = nodes[:, 2]
    return (_rising(x, "x_mm"), _rising(y, "y_mm"), z), None


def _numbers(text: str) -> FloatArray:
    """Read lines of numbers separated by commas; an empty cell is NaN."""
    rows = [
        [float(cell) if cell.strip() else np.nan for cell in line.split(",")]
        for line in text.splitlines()
        if line.strip()
    ]
    if len({len(row) for row in rows}) > 1:
        raise _Unreadable("rows of different lengths", "a table")
    return np.array(rows, float)


def _rising(line: FloatArray, name: str) -> FloatArray:
    step = np.diff(line)
    if len(line) < 4 or not (step > 0).all() or np.ptp(step) > 0.01 * step.mean():
        raise _Unreadable(f"{name} of {len(line)} positions", "4 or more, evenly increasing")
    return line


# --- meshes -------------------------------------------------------------------------------------


def _mesh(path: Path, spacing_mm: float | None) -> tuple[Grid, FloatArray]:
    """Sample a mesh on an even grid, and find its boundary."""
    del spacing_mm
    data = read_limited(path, LARGEST_FILE, A_SURFACE)
    corners = _stl(data) if path.suffix.lower() == ".stl" else _ply(data)
    if not (np.abs(corners) <= FARTHEST_MM).all():
        found = f"a corner at {np.abs(corners).max():g}"
        raise _Unreadable(found, f"numbers up to {FARTHEST_MM:g} (mm)")
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = normal[:, 2] > 0.05 * np.linalg.norm(normal, axis=1)
    if up.sum() < 16:
        raise _Unreadable(f"{up.sum()} triangles that face up", "at least 16, the pool's surface")
    corners = corners[up]
    # STL has no shared corners: corners that are equal in 32 bits are merged.
    places, index = np.unique(np.round(corners.reshape(-1, 3), 5), axis=0, return_inverse=True)
    outline = places[_boundary(index.reshape(-1, 3)), :2]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    spacing = max(float(np.median(edges)) / 2, float((high - low).max()) / MESH_NODES)
    x, y = (
        np.linspace(low[n], high[n], max(int(np.ceil((high[n] - low[n]) / spacing)) + 1, 4))
        for n in range(2)
    )
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    z = CloughTocher2DInterpolator(places[:, :2], places[:, 2])(nodes)
    closed = Polygon(np.concatenate([outline, outline[:1]]), closed=True)
    z[~closed.contains_points(nodes.reshape(-1, 2)).reshape(z.shape)] = np.nan
    return (x, y, z), outline


def _boundary(triangles: IntArray) -> IntArray:
    """Corners along the longest loop of edges that belong to only one triangle."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    following = dict(edges[first[count == 1]].tolist())
    loops: list[list[int]] = []
    while following:
        start, at = following.popitem()
        loop = [start]
        while at != start and at in following:
            loop.append(at)
            at = following.pop(at)
        loops.append(loop)
    longest = max(loops, key=len, default=[])
    if len(longest) < 3:
        raise _Unreadable("a closed mesh", "a surface that ends at its boundary")
    return np.array(longest)


def _stl(data: bytes) -> FloatArray:
    """Corners of triangles, shape (k, 3, 3)."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * STL_TRIANGLE.itemsize and count:
        return np.frombuffer(data, STL_TRIANGLE, count, 84)["corner"].astype(float)
    lines = [line.split() for line in data.decode("ascii", "replace").splitlines()]
    corners = [line[1:] for line in lines if len(line) == 4 and line[0] == "vertex"]
    if not corners or len(corners) % 3:
        raise _Unreadable("no triangles", "STL, binary or ASCII")
    return np.array(corners, float).reshape(-1, 3, 3)


def _ply(data: bytes) -> FloatArray:
    """Corners of triangles, shape (k, 3, 3)."""
    head, found, body = data.partition(b"end_header\n")
    if not found:
        head, found, body = data.partition(b"end_header\r\n")
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or words[:1] != [["ply"]] or len(words) < 2 or words[1][:1] != ["format"]:
        raise _Unreadable("no header", "PLY")
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(words[1][1])
    elements = [(line[1], int(line[2])) for line in words if line[:1] == ["element"]]
    if order is None or [name for name, _ in elements][:2] != ["vertex", "face"]:
        raise _Unreadable(" ".join(words[1]), "PLY with vertices, then triangles")
    split = next(n for n, line in enumerate(words) if line[:2] == ["element", "face"])
    plain = [line for line in words[:split] if line[:1] == ["property"]]
    lists = [line for line in words[split:] if line[:1] == ["property"]]
    if len(lists) != 1 or lists[0][1] != "list" or any(line[1] == "list" for line in plain):
        raise _Unreadable("other properties", "faces with only a list of corners")
    names = [line[2] for line in plain]
    (_, vertices), (_, faces) = elements[:2]
    if min(vertices, faces) < 1:
        raise _Unreadable(f"{vertices} vertices, {faces} faces", "at least 1 of each")
    if order == "":
        table = body.split(b"\n")
        values = np.array([line.split() for line in table[:vertices]], float)
        places = values[:, [names.index(axis) for axis in "xyz"]]
        triangles = np.array([line.split() for line in table[vertices : vertices + faces]], int)
    else:
        kind = np.dtype([(line[2], order + PLY_TYPES[line[1]]) for line in plain])
        read = np.frombuffer(body, kind, vertices)
        places = np.stack([read[axis].astype(float) for axis in "xyz"], axis=-1)
        face = np.dtype(
            [("count", order + PLY_TYPES[lists[0][2]]), ("at", order + PLY_TYPES[lists[0][3]], 3)]
        )
        found_faces = np.frombuffer(body, face, faces, vertices * kind.itemsize)
        triangles = np.column_stack([found_faces["count"], found_faces["at"]])
    if triangles.ndim != 2 or triangles.shape[1] != 4 or (triangles[:, 0] != 3).any():
        raise _Unreadable("faces that are not triangles", "PLY of triangles")
    if triangles.min() < 0:  # would count from the end
        raise _Unreadable(f"corner {triangles.min()}", "numbers of vertices, from 0")
    return np.asarray(places[triangles[:, 1:]])
