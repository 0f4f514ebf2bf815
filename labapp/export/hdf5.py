"""A run in one HDF5 file, in full precision.

::

    /measures/<column>            one dataset per column of measures.csv, shape (frames,)
    /frames/000012/dots           table: the columns of dots.csv except frame
    /frames/000012/points         table: the columns of points.csv except frame
    /frames/000012/boundary       table: the columns of boundary.csv except frame
    /frames/000012/surface/x_mm   shape (columns,), y_mm  shape (rows,)
    /frames/000012/surface/z_mm   shape (rows, columns); NaN outside the boundary

A table is one compound dataset: ``file["frames/000012/dots"]["u_px"]`` in Python,
``h5read(file, '/frames/000012/dots').u_px`` in MATLAB. Data that a frame lacks are absent. Numbers
are float64, NaN if unknown, or int64 if always known; text is UTF-8, of fixed length in tables.
Every dataset has the attributes ``units`` and ``description``, tables one of each per column; those
of the root contain the provenance. The format is that of HDF5 1.8, for compatibility.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt

from labapp.core.surface.mesh import grid_nodes
from labapp.core.surface.reconstruction import Reconstruction
from labapp.export.tables import TABLES, Column, Columns
from labapp.files import as_bytes, write_all

TEXT_BYTES = 8
"""Length of text in a table, bytes."""

LIBRARY = ("v108", "v108")

AXES = (
    Column("x_mm", "X of the grid's columns"),
    Column("y_mm", "Y of the grid's rows, along the weld"),
    Column("z_mm", "height above the work piece, [row, column]; NaN outside the boundary"),
)


class Hdf5Writer:
    """Context manager that writes a run, frame by frame; the file is complete on exit.

    Parameters
    ----------
    path
        Path of the file; an existing file is replaced.
    attributes
        Attributes of the root: text unchanged, other values as JSON.
    spacing_mm
        Distance between the surface's nodes, mm.

    Raises
    ------
    OSError
        If it cannot be written; by the constructor and all methods.
    """

    def __init__(self, path: Path, attributes: Mapping[str, object], spacing_mm: float) -> None:
        self._spacing_mm = spacing_mm
        self._measures: list[Columns] = []
        self._disk = _Disk(path)
        try:
            self._file = h5py.File(self._disk, "w", libver=LIBRARY)
            for name, value in attributes.items():
                text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
                self._file.attrs[name] = _plain(text)
            self._frames = self._file.create_group("frames")
        except BaseException:
            self._disk.close()
            raise

    def write(
        self, frame: int, tables: Mapping[str, Columns], reconstruction: Reconstruction | None
    ) -> None:
        """Write the tables of a frame (`frame_tables`) and its surface."""
        self._measures.append(tables["measures"])
        group = self._frames.create_group(f"{frame:06d}")
        for name in ("dots", "points", "boundary"):
            if len(tables[name]["frame"]):
                _put_table(group, name, tables[name])
        if reconstruction is not None:
            _put_surface(group.create_group("surface"), reconstruction, self._spacing_mm)
        self._disk.check()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        try:
            if error is None:
                self._write_measures()
        finally:
            self._file.close()
            self._disk.close()
        if error is None:
            self._disk.check()

    def _write_measures(self) -> None:
        group = self._file.create_group("measures")
        for column in TABLES["measures"]:
            values = [table[column.name] for table in self._measures]
            cells = np.concatenate(values) if values else np.empty(0)
            if column.digits is None:
                plain = np.array([_plain(text) for text in cells], object)
                _put(group, column, plain, h5py.string_dtype())
            else:
                _put(group, column, cells)


def _put(group: Any, column: Column, values: npt.NDArray[Any], kind: Any = None) -> None:
    """Create a dataset with unit and description."""
    packing = {"compression": "gzip", "shuffle": True, "chunks": values.shape}
    dataset = group.create_dataset(
        column.name, data=values, dtype=kind, **(packing if values.size else {})
    )
    dataset.attrs["units"] = column.unit
    dataset.attrs["description"] = column.description


def _put_table(group: Any, name: str, table: Columns) -> None:
    columns = TABLES[name][1:]
    text = h5py.string_dtype("utf-8", TEXT_BYTES)
    kinds = [text if column.digits is None else table[column.name].dtype for column in columns]
    names = [column.name for column in columns]
    rows = np.empty(len(table["frame"]), list(zip(names, kinds, strict=True)))
    for column, kind in zip(columns, kinds, strict=True):
        values = table[column.name]
        rows[column.name] = [each.encode() for each in values] if kind is text else values
    dataset = group.create_dataset(
        name, data=rows, compression="gzip", shuffle=True, chunks=rows.shape
    )
    dataset.attrs["units"] = _texts([column.unit for column in columns])
    dataset.attrs["description"] = _texts([column.description for column in columns])


def _plain(text: str) -> str:
    """Return text without characters that HDF5 cannot store."""
    return as_bytes(text.replace("\0", r"\0")).decode()


def _texts(texts: list[str]) -> npt.NDArray[Any]:
    encoded = [text.encode() for text in texts]
    return np.array(encoded, h5py.string_dtype("utf-8", max(map(len, encoded))))


def _put_surface(group: Any, reconstruction: Reconstruction, spacing_mm: float) -> None:
    """Write the nodes of the surface within the boundary, as a grid."""
    x, y, z = grid_nodes(reconstruction, spacing_mm)
    columns, column = np.unique(x, return_inverse=True)
    rows, row = np.unique(y, return_inverse=True)
    grid = np.full((len(rows), len(columns)), np.nan)
    grid[row, column] = z
    for axis, values in zip(AXES, (columns, rows, grid), strict=True):
        _put(group, axis, values)


class _Disk(io.RawIOBase):
    """File object for HDF5 that defers write errors to `check`, as HDF5 cannot handle them.

    HDF5 ignores write errors while it closes a file, and then ends the process. Therefore the first
    error is stored for `check`, and later writes stay in memory, from where HDF5 can read them
    until it has closed the file.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self._at = 0
        self._failure: BaseException | None = None
        self._kept: list[tuple[int, bytes]] = []

    def check(self) -> None:
        """Raise the first write error, if any."""
        if self._failure is not None:
            raise self._failure

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            ends = [at + len(content) for at, content in self._kept]
            offset += max([os.fstat(self._file.fileno()).st_size, *ends])
        self._at = offset
        return offset

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        view[:] = bytes(len(view))
        self._file.seek(self._at)
        self._file.readinto(view)
        for at, content in self._kept:
            first, last = max(at, self._at), min(at + len(content), self._at + len(view))
            if first < last:
                view[first - self._at : last - self._at] = content[first - at : last - at]
        return len(view)

    def write(self, content: Any) -> int:
        whole = memoryview(content).cast("B")
        if self._failure is None:
            try:
                self._file.seek(self._at)
                write_all(self._file, whole)
            except BaseException as error:  # also Ctrl-C: HDF5 must not be interrupted
                self._failure = error
        if self._failure is not None:
            self._kept.append((self._at, bytes(whole)))
        self._at += len(whole)
        return len(whole)

    def truncate(self, size: int | None = None) -> int:
        size = self._at if size is None else size
        if self._failure is None:
            try:
                self._file.truncate(size)
            except BaseException as error:
                self._failure = error
        return size

    def flush(self) -> None:
        """Do nothing: writes are unbuffered."""

    def close(self) -> None:
        self._file.close()
        super().close()
