"""Registry of export formats; each entry names the function or class that writes the files.

Commands and the Export page read the registry; writers are imported on use. Installed packages add
formats through the entry points of the group ``labapp.exports``, scripts by `add_export_format`.
"""

from __future__ import annotations

import importlib
import logging
import os
import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from labapp.errors import InputError

if TYPE_CHECKING:
    from labapp.core.surface.reconstruction import Reconstruction
    from labapp.export.tables import Columns


MANIFEST, TREND_FILE, FILM_FILE = "manifest.json", "trends.png", "film.mp4"
REPORT_FILE = "report.pdf"
"""Files of an export that no added format may write, as the tables' CSV files."""

_NUMBERED = re.compile(r"(surface|solid|frame)_\d{6}", re.IGNORECASE)


@dataclass(frozen=True)
class SurfaceFormat:
    """A format with one file per frame that has a surface.

    Parameters
    ----------
    end
        End of its file names, after ``surface_NNNNNN``: letters, digits, hyphens and dots, the
        extension last; not ``.png``, as surface pictures have it.
    title, tip
        Name and description on the Export page.
    of
        Data: ``mesh`` for triangles (`meshes.Mesh`), which can also be a watertight solid;
        ``nodes`` for the points of a grid within the boundary, shape (n, 3), mm.
    writer
        Function that returns the file's content, bytes, for the mesh or nodes; also as
        ``module:function`` in this package.
    bytes_each
        Approximate size of a triangle or node in the file, bytes, for the size of an export.
    """

    end: str
    title: str
    tip: str
    of: Literal["mesh", "nodes"]
    writer: str | Callable[[Any], bytes]
    bytes_each: float = 50.0

    def content(self, shape: object) -> bytes:
        """Return the content of a file.

        Parameters
        ----------
        shape
            The mesh or the nodes, see ``of``.

        Raises
        ------
        InputError
            If the writer does not return bytes.
        """
        content = _load(self.writer)(shape)
        if not isinstance(content, bytes):
            kind = type(content).__name__
            raise InputError(f"export format {self.title}", "writer returned", kind, "bytes")
        return content


class RunWriter(Protocol):
    """Context manager that writes a run into one file, frame by frame."""

    def write(
        self, frame: int, tables: Mapping[str, Columns], reconstruction: Reconstruction | None
    ) -> None:
        """Add a frame.

        Parameters
        ----------
        frame
            Number of the frame.
        tables
            Its rows of every table, by the table's name.
        reconstruction
            Its surface; None if it has none.
        """
        ...


@dataclass(frozen=True)
class RunFormat:
    """A format with one file for all frames.

    Parameters
    ----------
    file
        Name of the file in the export's folder, which no other file of an export may have.
    title, tip
        Name and description on the Export page.
    writer
        Class of a `RunWriter`, whose arguments are the file's path, its provenance, and the
        distance between the surfaces' nodes in mm; also as ``module:Class`` in this package.
    frame_bytes, node_bytes
        Approximate size in the file of the tables of a frame, and of a node of its surface, bytes.
    """

    file: str
    title: str
    tip: str
    writer: str | Callable[[Path, Mapping[str, object], float], AbstractContextManager[RunWriter]]
    frame_bytes: float = 80_000.0
    node_bytes: float = 6.5

    def open(
        self, path: str | os.PathLike[str], about: Mapping[str, object], spacing_mm: float
    ) -> AbstractContextManager[RunWriter]:
        """Return a writer of the file.

        Parameters
        ----------
        path
            Path of the file.
        about
            Provenance: program, version, source and settings.
        spacing_mm
            Distance between the surfaces' nodes, mm.
        """
        opened: AbstractContextManager[RunWriter] = _load(self.writer)(
            Path(path), about, spacing_mm
        )
        return opened


SURFACE_FORMATS: dict[str, SurfaceFormat] = {
    "csv": SurfaceFormat(".csv", "CSV", "x, y, z of a grid within the boundary, mm",
        "nodes", "tables:nodes_csv", 28),
    "stl": SurfaceFormat(".stl", "STL", "Triangles, binary, mm", "mesh", "meshes:stl", 50),
    "stl-ascii": SurfaceFormat("_ascii.stl", "STL as text",
        "Triangles as text, for old programs, mm", "mesh", "meshes:stl_ascii", 247),
    "ply": SurfaceFormat(".ply", "PLY", "Triangles for mesh programs, mm",
        "mesh", "meshes:ply", 29),
    "vtp": SurfaceFormat(".vtp", "VTP", "Triangles for ParaView, mm", "mesh", "meshes:vtp", 64),
}  # fmt: skip
"""Formats by their names in ``--surfaces``."""

RUN_FORMATS: dict[str, RunFormat] = {
    "hdf5": RunFormat(
        "results.h5",
        "HDF5",
        "All tables and surfaces with units and their source in one file",
        "hdf5:Hdf5Writer",
    ),
}
"""Formats by their names in ``--together``."""


def mesh_formats() -> list[str]:
    """Return the names of the surface formats with triangles."""
    return [name for name, each in SURFACE_FORMATS.items() if each.of == "mesh"]


def add_export_format(name: str, added: SurfaceFormat | RunFormat) -> None:
    """Add an export format to those of this program.

    Parameters
    ----------
    name
        Name for `ExportChoice`, ``--surfaces`` and ``--together``: lower-case letters, digits and
        hyphens.
    added
        The format.

    Raises
    ------
    InputError
        If the name, the data or the file name is invalid, or another format has the name or writes
        the same file.
    """
    source = f"export format {name}"
    if not isinstance(added, SurfaceFormat | RunFormat):
        raise InputError(source, "type", type(added).__name__, "SurfaceFormat or RunFormat")
    if not re.fullmatch("[a-z][a-z0-9-]*", name) or name == "none":
        raise InputError(source, "name", name, "lower-case letters, digits and hyphens, not none")
    if name in SURFACE_FORMATS or name in RUN_FORMATS:
        raise InputError(source, "name", name, "a name that no other format has")
    if isinstance(added, SurfaceFormat):
        _check_surface_format(source, added)
        SURFACE_FORMATS[name] = added
    else:
        _check_run_format(source, added)
        RUN_FORMATS[name] = added


def _check_surface_format(source: str, added: SurfaceFormat) -> None:
    if added.of not in ("mesh", "nodes"):
        raise InputError(source, "of", added.of, "nodes or mesh")
    if not re.fullmatch(r"(?!\d)[\w.-]*\.\w+", str(added.end)):
        raise InputError(source, "end", added.end, "an end such as .xyz or _fine.xyz")
    if added.end.lower() == ".png":
        raise InputError(source, "end", added.end, "another end: surface pictures have this one")
    if added.end.lower() in {each.end.lower() for each in SURFACE_FORMATS.values()}:
        raise InputError(source, "end", added.end, "an end that no other format has")


def _check_run_format(source: str, added: RunFormat) -> None:
    from labapp.export.tables import TABLES

    if not re.fullmatch(r"\w([\w .,+()-]*[\w)])?", str(added.file)):
        raise InputError(source, "file", added.file, "a plain file name such as points.json")
    own = (MANIFEST, TREND_FILE, FILM_FILE, REPORT_FILE, *(f"{table}.csv" for table in TABLES))
    # Without regard to case, as file systems of Windows and macOS.
    if added.file.lower() in own or _NUMBERED.match(added.file):
        raise InputError(source, "file", added.file, "a name that labapp's own files do not have")
    if added.file.lower() in {each.file.lower() for each in RUN_FORMATS.values()}:
        raise InputError(source, "file", added.file, "a file that no other format has")


def _add_installed() -> None:
    for point in entry_points(group="labapp.exports"):
        try:
            add_export_format(point.name, point.load())
        except Exception as error:  # of another package: labapp works without its format
            logging.getLogger("labapp.notices").warning(
                "export format %s (%s) is not available: %s", point.name, point.value, error
            )


def _load(writer: str | Callable[..., Any]) -> Callable[..., Any]:
    if callable(writer):
        return writer
    module, _, name = writer.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(f"{__package__}.{module}"), name)
    return found


_add_installed()
