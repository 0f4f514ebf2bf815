"""Registry of export formats: an entry here, and a function or a class that writes the files.

Commands and the Export page read the registry; a writer is loaded when it is used.
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
    """A format with a file for each frame that has a surface."""

    end: str
    """How the names of its files end, after ``surface_NNNNNN``."""
    title: str
    tip: str
    """What the Export page calls it, and what it is."""
    of: Literal["mesh", "nodes"]
    """What is written: ``mesh`` for triangles (`meshes.Mesh`), which can be a watertight body too;
    ``nodes`` for the points of a grid within the boundary, shape (n, 3), mm.
    """
    writer: str
    """``module:function`` in this package: makes the file's bytes from the mesh or the nodes."""

    def content(self, shape: object) -> bytes:
        """Content of the file for a mesh, or for nodes."""
        content: bytes = _load(self.writer)(shape)
        return content


class RunWriter(Protocol):
    """Writes a run into one file, frame by frame; complete when its ``with`` ends without error."""

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
    """What the Export page calls it, and what it is."""
    writer: str
    """``module:Class`` in this package: a `RunWriter`, made from the file's path, what is to be
    said of its source, and the distance of the surfaces' nodes in mm.
    """

    def open(
        self, path: str | os.PathLike[str], about: Mapping[str, object], spacing_mm: float
    ) -> AbstractContextManager[RunWriter]:
        """Writer of the file; see ``writer``."""
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
"""By the words of ``--surfaces``."""

RUN_FORMATS: dict[str, RunFormat] = {
    "hdf5": RunFormat(
        "results.h5",
        "HDF5",
        "All tables and surfaces with units and their source in one file",
        "hdf5:Hdf5Writer",
    ),
}
"""By the words of ``--together``."""


def mesh_formats() -> list[str]:
    """Names of the surface formats that hold triangles."""
    return [name for name, each in SURFACE_FORMATS.items() if each.of == "mesh"]


def _load(writer: str) -> Any:
    module, _, name = writer.partition(":")
    return getattr(importlib.import_module(f"{__package__}.{module}"), name)
