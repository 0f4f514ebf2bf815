"""Registry of export formats; each entry names the function or class that writes the files.

Commands and the Export page read the registry; writers are imported on use.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

if TYPE_CHECKING:
    from labapp.core.surface.reconstruction import Reconstruction
    from labapp.export.tables import Table


@dataclass(frozen=True)
class SurfaceFormat:
    """A format with one file per frame that has a surface."""

    end: str
    """End of its file names, after ``surface_NNNNNN``."""
    title: str
    tip: str
    """Name and description on the Export page."""
    of: Literal["mesh", "nodes"]
    """Data: ``mesh`` for triangles (`meshes.Mesh`), which can also be a watertight solid; ``nodes``
    for the points of a grid within the boundary, shape (n, 3), mm.
    """
    writer: str
    """``module:function`` in this package, which returns the file's content for the mesh or nodes.
    """

    def content(self, shape: object) -> bytes:
        """Return the content of the file for a mesh or for nodes."""
        content: bytes = _load(self.writer)(shape)
        return content


class RunWriter(Protocol):
    """Context manager that writes a run into one file, frame by frame."""

    def write(
        self, frame: int, tables: Mapping[str, Table], reconstruction: Reconstruction | None
    ) -> None:
        """Add a frame: its number, its rows of every table, and its surface."""
        ...


@dataclass(frozen=True)
class RunFormat:
    """A format with one file for all frames."""

    file: str
    title: str
    tip: str
    """Name and description on the Export page."""
    writer: str
    """``module:Class`` in this package: a `RunWriter`, whose arguments are the file's path, its
    provenance, and the distance between the surfaces' nodes in mm.
    """

    def open(
        self, path: str | os.PathLike[str], about: Mapping[str, object], spacing_mm: float
    ) -> AbstractContextManager[RunWriter]:
        """Return a writer of the file; see ``writer``."""
        opened: AbstractContextManager[RunWriter] = _load(self.writer)(
            Path(path), about, spacing_mm
        )
        return opened


SURFACE_FORMATS: dict[str, SurfaceFormat] = {
    "csv": SurfaceFormat(
        ".csv", "CSV", "x, y, z of a grid within the boundary, mm", "nodes", "tables:nodes_csv"
    ),
    "stl": SurfaceFormat(".stl", "STL", "Triangles, binary, mm", "mesh", "meshes:stl"),
    "stl-ascii": SurfaceFormat(
        "_ascii.stl",
        "STL as text",
        "Triangles as text, for old programs, mm",
        "mesh",
        "meshes:stl_ascii",
    ),
    "ply": SurfaceFormat(".ply", "PLY", "Triangles for mesh programs, mm", "mesh", "meshes:ply"),
    "vtp": SurfaceFormat(".vtp", "VTP", "Triangles for ParaView, mm", "mesh", "meshes:vtp"),
}
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


def _load(writer: str) -> Any:
    module, _, name = writer.partition(":")
    return getattr(importlib.import_module(f"{__package__}.{module}"), name)
