"""Triangle meshes of the pool surface, and mesh files.

Lengths are in mm. Triangles are counter-clockwise seen from outside; normals of the pool surface
point up. The same reconstruction gives the same bytes.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from labapp.core.surface.measures import NODES_MM
from labapp.core.surface.mesh import grid_nodes, surface_mesh
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays
from labapp.errors import InputError

SPACING_MM = NODES_MM
"""Distance between the rings of a mesh, and between the nodes of a surface as CSV, mm."""

SMALLEST_SPACING_MM = 0.05
"""Smallest spacing, mm: 32-bit numbers of STL cannot distinguish vertices of smaller rings."""

MOST_NODES = 10_000_000
"""Most nodes of a written surface; one in an untrusted session may have any size."""

MOST_DRAWN = 300_000
"""Most nodes of a mesh for drawing."""

BLOCK_MM = 1.0
"""Distance of a block's bottom below the lowest point of the pool, mm."""

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
PLY_VERTEX = np.dtype([("place", "<f8", 3), ("height", "<f8")])
PLY_FACE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])


@dataclass(frozen=True, repr=False)
class Mesh(ReadOnlyArrays):
    """Triangles; n vertices, k triangles.

    Parameters
    ----------
    vertices_mm
        UCS, shape (n, 3), mm.
    triangles
        Indices of their corners, shape (k, 3).
    """

    vertices_mm: FloatArray
    triangles: IntArray


def refuse_too_large(reconstruction: Reconstruction, spacing_mm: float) -> None:
    """Raise if a surface has more nodes than `MOST_NODES`, as a grid or as a mesh.

    Raises
    ------
    InputError
        If it has too many, or its size is unknown.
    """
    count = len(reconstruction.boundary.points_mm)
    width, length = np.ptp(reconstruction.boundary.points_mm[:, :2], axis=0)
    mesh = _radius_mm(reconstruction) / spacing_mm * count
    if not max(mesh, width / spacing_mm * length / spacing_mm) <= MOST_NODES:
        size = f"{width:.6g} × {length:.6g} mm, {count} boundary points"
        expected = f"a surface of at most {MOST_NODES} nodes, {spacing_mm:g} mm apart"
        raise InputError("export", "surface", size, expected)


def drawn_spacing(reconstruction: Reconstruction, spacing_mm: float) -> float:
    """Return the distance between a mesh's rings for drawing at most `MOST_DRAWN` nodes, mm."""
    rings = max(MOST_DRAWN // len(reconstruction.boundary.points_mm), 1)
    return max(spacing_mm, _radius_mm(reconstruction) / rings)


def _radius_mm(reconstruction: Reconstruction) -> float:
    boundary = reconstruction.boundary
    return float(np.hypot(*(boundary.points_mm[:, :2] - boundary.center_mm).T).max())


def known_nodes(reconstruction: Reconstruction, spacing_mm: float) -> FloatArray:
    """Return the grid nodes within the boundary where the surface is known, shape (n, 3), mm."""
    each = np.column_stack(grid_nodes(reconstruction, spacing_mm))
    return np.asarray(each[np.isfinite(each).all(axis=1)])


def open_mesh(reconstruction: Reconstruction, spacing_mm: float) -> Mesh:
    """Return the pool surface as an open mesh, which ends at the boundary.

    Triangles where the surface is unknown are omitted.

    Parameters
    ----------
    spacing_mm
        Largest distance between rings of vertices, mm.
    """
    vertices, triangles = surface_mesh(reconstruction, spacing_mm)
    used, triangles = known_part(triangles, vertices[:, 2])
    return Mesh(vertices[used], triangles)


def known_part(triangles: IntArray, value: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the triangles of a mesh whose corners all have a known value, shape (n,).

    Returns
    -------
    used, triangles
        Indices of their vertices, shape (m,), and the triangles by indices into these.
    """
    known, is_used = np.isfinite(value), np.zeros(len(value), bool)
    if known.all():
        return np.arange(len(value)), triangles
    triangles = triangles[known[triangles].all(axis=1)]
    is_used[triangles] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[triangles]


def solid_mesh(reconstruction: Reconstruction, spacing_mm: float) -> Mesh:
    """Return a watertight solid with the pool surface as its top.

    A pool that is above its boundary everywhere is closed by the polygon of its boundary, so that
    the solid has the pool's volume. Any other (concave, dented) is the top of a block with vertical
    walls along the boundary and a flat bottom, `BLOCK_MM` below the lowest point. Where the surface
    is unknown, it is interpolated linearly.

    Parameters
    ----------
    spacing_mm
        Largest distance between rings of vertices, mm.
    """
    vertices, top = surface_mesh(reconstruction, spacing_mm)
    count = len(reconstruction.boundary.points_mm)
    base = _base_height(vertices[0, :2], vertices[-count:])
    vertices = _filled(vertices, count)
    rings = len(vertices) // count
    # The boundary polygon is a fan about the centre: its height below each vertex, ring by ring.
    fraction = np.arange(1, rings)[:, None] / rings
    below = base + fraction * (vertices[-count:, 2] - base)
    convex = vertices[0, 2] > base and (vertices[1:-count, 2] > below.ravel()).all()

    centre, rim = len(vertices), np.arange(len(vertices) - count, len(vertices))
    if convex:
        floor, walls = rim, []
        bottom = np.append(vertices[0, :2], base)[None]
    else:
        level = vertices[:, 2].min() - BLOCK_MM
        floor, walls = centre + 1 + np.arange(count), _walls(rim, centre + 1)
        outline = np.column_stack([vertices[rim, :2], np.full(count, level)])
        bottom = np.vstack([np.append(vertices[0, :2], level), outline])
    fan = np.column_stack([np.full(count, centre), np.roll(floor, -1), floor])
    return Mesh(np.vstack([vertices, bottom]), np.vstack([top, *walls, fan]))


def _base_height(center_mm: FloatArray, rim_mm: FloatArray) -> float:
    """Return the height at the centre of the boundary's least-squares plane, mm."""
    terms = np.column_stack([np.ones(len(rim_mm)), rim_mm[:, :2] - center_mm])
    return float(np.linalg.lstsq(terms, rim_mm[:, 2], rcond=None)[0][0])


def _filled(vertices: FloatArray, count: int) -> FloatArray:
    """Return the vertices, with unknown heights interpolated along each spoke."""
    if np.isfinite(vertices).all():
        return vertices
    filled = vertices.copy()
    spokes = filled[1:, 2].reshape(-1, count)  # a view: a ring in each row, the boundary last
    if not np.isfinite(filled[0, 2]):
        innermost = np.isfinite(spokes).argmax(axis=0)
        filled[0, 2] = spokes[innermost, np.arange(count)].mean()
    for spoke in spokes.T:
        height = np.append(filled[0, 2], spoke)
        known = np.flatnonzero(np.isfinite(height))
        spoke[:] = np.interp(np.arange(1, len(height)), known, height[known])
    return filled


def _walls(rim: IntArray, below: int) -> list[IntArray]:
    """Return the triangles between the rim's vertices and as many below, the first at ``below``."""
    after, foot = np.roll(rim, -1), below + np.arange(len(rim))
    foot_after = np.roll(foot, -1)
    return [np.column_stack([rim, foot, foot_after]), np.column_stack([rim, foot_after, after])]


def stl(mesh: Mesh) -> bytes:
    """Return binary STL, without degenerate triangles."""
    numbers = _facets(mesh)
    facets = np.zeros(len(numbers), STL_TRIANGLE)
    facets["normal"], facets["corner"] = numbers[:, :3], numbers[:, 3:].reshape(-1, 3, 3)
    title = b"labapp pool surface, mm".ljust(80)
    return b"".join([title, len(facets).to_bytes(4, "little"), facets.data])


def stl_ascii(mesh: Mesh) -> bytes:
    """Return ASCII STL, with enough digits for 32-bit numbers."""
    facet = (
        "facet normal {:.8e} {:.8e} {:.8e}\nouter loop\n"
        + "vertex {:.8e} {:.8e} {:.8e}\n" * 3
        + "endloop\nendfacet\n"
    )
    facets = "".join(facet.format(*each) for each in _facets(mesh).tolist())
    return f"solid labapp_pool_surface_mm\n{facets}endsolid labapp_pool_surface_mm\n".encode()


def _facets(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return unit normal and three corners of the proper triangles, shape (k, 12)."""
    from labapp.core.surface.kernels.mesh_kernels import facets  # loads numba

    return facets(mesh.vertices_mm, mesh.triangles)


def ply(mesh: Mesh) -> bytes:
    """Return binary PLY, 64-bit, with the scalar ``height_mm`` at each vertex."""
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            "comment labapp pool surface, mm",
            f"element vertex {len(mesh.vertices_mm)}",
            *(f"property double {name}" for name in ("x", "y", "z", "height_mm")),
            f"element face {len(mesh.triangles)}",
            "property list uchar int vertex_indices",
            "end_header\n",
        ]
    )
    vertices = np.zeros(len(mesh.vertices_mm), PLY_VERTEX)
    vertices["place"], vertices["height"] = mesh.vertices_mm, mesh.vertices_mm[:, 2]
    faces = np.zeros(len(mesh.triangles), PLY_FACE)
    faces["count"], faces["corner"] = 3, mesh.triangles
    return b"".join([header.encode(), vertices.tobytes(), faces.tobytes()])


def vtp(mesh: Mesh) -> bytes:
    """Return VTK XML PolyData, 64-bit, with the point array ``height_mm``."""
    count = len(mesh.triangles)
    units = " ".join(str(code) for code in b"mm\0")  # VTK stores text as character codes
    points = _vtk_array("Points", mesh.vertices_mm, "<f8", components=3)
    height = _vtk_array("height_mm", mesh.vertices_mm[:, 2], "<f8")
    corners = _vtk_array("connectivity", mesh.triangles, "<i8")
    ends = _vtk_array("offsets", 3 * np.arange(1, count + 1), "<i8")
    return f"""<?xml version="1.0"?>
<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<PolyData>
<FieldData>
<Array type="String" Name="units" NumberOfTuples="1" format="ascii">{units}</Array>
</FieldData>
<Piece NumberOfPoints="{len(mesh.vertices_mm)}" NumberOfPolys="{count}">
<PointData Scalars="height_mm">{height}</PointData>
<Points>{points}</Points>
<Polys>{corners}{ends}</Polys>
</Piece>
</PolyData>
</VTKFile>
""".encode()


def _vtk_array(name: str, values: npt.NDArray[Any], kind: str, components: int = 1) -> str:
    content = np.ascontiguousarray(values, kind).tobytes()
    text = base64.b64encode(len(content).to_bytes(8, "little") + content).decode()
    vtk_type = {"<f8": "Float64", "<i8": "Int64"}[kind]
    return (
        f'<DataArray type="{vtk_type}" Name="{name}" NumberOfComponents="{components}" '
        f'format="binary">{text}</DataArray>'
    )
