from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.surface import Surface
from labapp.export import meshes
from labapp.export.formats import SURFACE_FORMATS, mesh_formats
from labapp.export.meshes import Mesh
from labapp.simulation.pools import Dent, Pool, egg, spherical_cap

RADIUS_MM, HEIGHT_MM = 3.5, 0.4
CENTER_MM = (5.0, -6.0)


def reconstruction(
    surface: Surface, center: tuple[float, float] = CENTER_MM, rim_mm: float = 0
) -> object:
    """Reconstruction of a round pool, with its boundary at the height ``rim_mm`` times X."""
    boundary = Boundary.polar(np.array(center), np.full(360, RADIUS_MM))
    return Reconstruction(
        scheme="fit",
        surface=surface,
        boundary=boundary.at_height(rim_mm * boundary.points_mm[:, 0]),
        ray=np.empty((0, 2), int),
        points_mm=np.empty((0, 3)),
        residual_mm=np.empty((0, 2)),
        sigma_mm=np.empty(0),
    )


def cap(peak_mm: float) -> Pool:
    return spherical_cap(2 * RADIUS_MM, peak_mm, CENTER_MM)


DENTED = egg(7.0, 3.5, 3.5, 0.2, CENTER_MM, terms=(Dent(0.6, 0.8),))


@dataclass
class PartlyKnown:
    """A pool whose height is unknown in some places."""

    pool: Pool
    unknown: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(self.unknown(x, y), np.nan, self.pool.height(x, y))

    def gradient(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.pool.gradient(x, y)


@dataclass
class Tilted:
    """A cap on an inclined plane."""

    pool: Pool
    slope: float

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.pool.height(x, y) + self.slope * x

    def gradient(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.pool.gradient(x, y) + np.array([self.slope, 0.0])


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_mm, mesh.triangles, process=False)


def cap_volume(height_mm: float) -> float:
    return np.pi * height_mm * (3 * RADIUS_MM**2 + height_mm**2) / 6


def test_solid_of_a_cap_has_the_correct_volume() -> None:
    solid = as_trimesh(meshes.solid_mesh(reconstruction(cap(HEIGHT_MM)), 0.1))
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(cap_volume(HEIGHT_MM), rel=0.002)
    # The normals of the top point up, those of the flat bottom straight down; there are no others.
    up = solid.face_normals[:, 2] > 0
    assert solid.vertices[:, 2].min() == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(solid.face_normals[~up], [[0, 0, -1]] * 360, atol=1e-9)
    assert len(solid.faces) - 360 == up.sum()


def test_boundary_need_not_be_horizontal() -> None:
    tilted = reconstruction(Tilted(cap(HEIGHT_MM), 0.05), rim_mm=0.05)
    solid = as_trimesh(meshes.solid_mesh(tilted, 0.1))
    assert solid.is_watertight
    assert solid.volume == pytest.approx(cap_volume(HEIGHT_MM), rel=0.002)


@pytest.mark.parametrize(
    ("pool", "lowest", "volume"),
    [(cap(-HEIGHT_MM), -HEIGHT_MM, -cap_volume(HEIGHT_MM)), (DENTED, DENTED.size.depth_mm, None)],
    ids=["concave", "dented"],
)
def test_concave_or_dented_pool_is_the_top_of_a_block(
    pool: Pool, lowest: float, volume: float | None
) -> None:
    assert lowest < -0.05
    solid = as_trimesh(meshes.solid_mesh(reconstruction(pool), 0.1))
    assert solid.is_watertight
    assert solid.is_winding_consistent
    bottom = lowest - meshes.BLOCK_MM
    assert solid.vertices[:, 2].min() == pytest.approx(bottom, abs=2e-3)
    up, down = (sign * solid.face_normals[:, 2] > 1e-6 for sign in (1, -1))
    assert (up.sum(), down.sum()) == (len(solid.faces) - 3 * 360, 360)
    # Walls stand upright and face outwards.
    walls = ~(up | down)
    outwards = solid.triangles_center[walls, :2] - CENTER_MM
    assert (np.sum(outwards * solid.face_normals[walls, :2], axis=1) > 0).all()
    if volume is not None:
        block = -bottom * np.pi * RADIUS_MM**2
        assert solid.volume == pytest.approx(block + volume, rel=0.002)


def test_open_surface_ends_at_the_boundary_with_normals_up() -> None:
    surface = as_trimesh(meshes.open_mesh(reconstruction(cap(-HEIGHT_MM)), 0.1))
    assert not surface.is_watertight
    assert surface.is_winding_consistent
    assert (surface.face_normals[:, 2] > 0.5).all()
    assert np.hypot(*(surface.vertices[:, :2] - CENTER_MM).T).max() == pytest.approx(RADIUS_MM)


HOLE_MM, EDGE_MM = 0.6, 3.0
FULL_MM2 = np.pi * RADIUS_MM**2
SLICE_MM2 = RADIUS_MM**2 * np.arccos(EDGE_MM / RADIUS_MM) - EDGE_MM * np.sqrt(
    RADIUS_MM**2 - EDGE_MM**2
)


@pytest.mark.parametrize(
    ("unknown", "area_mm2"),
    [
        (lambda x, y: np.hypot(x, y) < HOLE_MM, FULL_MM2 - np.pi * HOLE_MM**2),
        (lambda x, _: x > EDGE_MM, FULL_MM2 - SLICE_MM2),
    ],
    ids=["middle", "edge"],
)
def test_unknown_parts_are_open_in_the_surface_and_closed_in_the_solid(
    unknown: Callable[[np.ndarray, np.ndarray], np.ndarray], area_mm2: float
) -> None:
    pool = spherical_cap(2 * RADIUS_MM, HEIGHT_MM)
    partly = reconstruction(PartlyKnown(pool, unknown), center=(0.0, 0.0))
    surface, solid = (
        as_trimesh(meshes.open_mesh(partly, 0.05)),
        as_trimesh(meshes.solid_mesh(partly, 0.05)),
    )
    assert np.isfinite(surface.vertices).all()
    assert len(np.unique(surface.faces)) == len(surface.vertices)
    projected_mm2 = np.sum(surface.area_faces * surface.face_normals[:, 2])
    assert projected_mm2 == pytest.approx(area_mm2, rel=0.01)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(cap_volume(HEIGHT_MM), rel=0.01)


MESHES = {
    "surface": meshes.open_mesh(reconstruction(cap(HEIGHT_MM)), 0.2),
    "solid": meshes.solid_mesh(reconstruction(cap(-HEIGHT_MM)), 0.2),
}
both_meshes = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


@both_meshes
@pytest.mark.parametrize("write", [meshes.stl, meshes.stl_ascii])
def test_stl_can_be_read_by_other_programs(
    mesh: Mesh, write: Callable[[Mesh], bytes], tmp_path: Path
) -> None:
    content = write(mesh)
    corners = mesh.vertices_mm[mesh.triangles].astype(np.float32)
    read = trimesh.load_mesh(io.BytesIO(content), file_type="stl", process=False)
    np.testing.assert_array_equal(read.triangles.astype(np.float32), corners)
    (tmp_path / "a.stl").write_bytes(content)
    with np.errstate(over="ignore"):  # of meshio, which reads text as the number of triangles
        other = meshio.read(tmp_path / "a.stl")
    np.testing.assert_array_equal(other.points[other.cells[0].data].astype(np.float32), corners)


@pytest.mark.parametrize("write", [meshes.stl, meshes.stl_ascii])
@pytest.mark.parametrize("height_mm", [HEIGHT_MM, -HEIGHT_MM])
def test_solid_stays_watertight_in_32_bit(write: Callable[[Mesh], bytes], height_mm: float) -> None:
    solid = meshes.solid_mesh(reconstruction(cap(height_mm)), meshes.SMALLEST_SPACING_MM)
    read = trimesh.load_mesh(io.BytesIO(write(solid)), file_type="stl")
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume == pytest.approx(as_trimesh(solid).volume, rel=1e-5)


def test_normals_of_stl_agree_with_its_triangles() -> None:
    mesh = MESHES["solid"]
    numbers = re.findall(rb"facet normal (\S+) (\S+) (\S+)", meshes.stl_ascii(mesh))
    np.testing.assert_allclose(np.array(numbers, float), as_trimesh(mesh).face_normals, atol=1e-6)
    content = np.frombuffer(meshes.stl(mesh)[84:], meshes.STL_TRIANGLE)
    np.testing.assert_array_equal(content["normal"], np.array(numbers, np.float32))


def test_stl_has_only_triangles_with_an_area() -> None:
    places = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1], [6, 0, 0]])
    mesh = Mesh(places, np.array([[0, 1, 2], [0, 1, 4], [2, 2, 3], [0, 3, 1]]))
    content = np.frombuffer(meshes.stl(mesh)[84:], meshes.STL_TRIANGLE)
    np.testing.assert_array_equal(content["normal"], [[0, 0, 1], [0, 1, 0]])
    np.testing.assert_array_equal(content["corner"], places[[[0, 1, 2], [0, 3, 1]]])


@both_meshes
def test_ply_can_be_read_by_other_programs(mesh: Mesh, tmp_path: Path) -> None:
    content = meshes.ply(mesh)
    read = trimesh.load_mesh(io.BytesIO(content), file_type="ply", process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices_mm)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    (tmp_path / "a.ply").write_bytes(content)
    other = meshio.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(other.points, mesh.vertices_mm)
    np.testing.assert_array_equal(other.cells[0].data, mesh.triangles)
    np.testing.assert_array_equal(other.point_data["height_mm"], mesh.vertices_mm[:, 2])


@both_meshes
def test_vtp_can_be_read_by_vtk(mesh: Mesh) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOXML")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    reader = vtk.vtkXMLPolyDataReader()
    reader.ReadFromInputStringOn()
    reader.SetInputString(meshes.vtp(mesh).decode())
    reader.Update()
    assert reader.GetErrorCode() == 0
    read = reader.GetOutput()
    points = support.vtk_to_numpy(read.GetPoints().GetData())
    np.testing.assert_array_equal(points, mesh.vertices_mm)
    corners = support.vtk_to_numpy(read.GetPolys().GetConnectivityArray())
    np.testing.assert_array_equal(corners.reshape(-1, 3), mesh.triangles)
    height = support.vtk_to_numpy(read.GetPointData().GetScalars("height_mm"))
    np.testing.assert_array_equal(height, mesh.vertices_mm[:, 2])
    assert read.GetFieldData().GetAbstractArray("units").GetValue(0) == "mm"


@pytest.mark.parametrize("name", mesh_formats())
def test_equal_meshes_give_equal_files(name: str) -> None:
    write = SURFACE_FORMATS[name].content
    mesh = meshes.open_mesh(reconstruction(cap(HEIGHT_MM)), 0.2)
    assert write(mesh) == write(MESHES["surface"])
