from __future__ import annotations

import io
import pickle
import tracemalloc
import zipfile

import meshio
import numpy as np
import pytest
import trimesh

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.errors import InputError
from labapp.simulation.forward import trace
from labapp.simulation.outlined_pool import OutlinedPool, pool_from_heights
from labapp.simulation.pools import Dent, egg
from labapp.simulation.surface_files import read_pool

RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50.0, 45.0, 3.0))
EGG = egg(6.6, 3.0, 4.4, 0.3, (0.1, -0.6), (Dent(0.05, 0.8),))
"""The exact surface in the files."""


def square(half):
    return np.array([[-half, -half], [half, -half], [half, half], [-half, half]], float)


def saddle(x, y):
    return 0.05 * np.sin(x) * np.cos(1.5 * y)


def grid_of(pool, spacing=0.1):
    x, y = np.arange(-4, 4.05, spacing), np.arange(-6, 4.05, spacing)
    return x, y, pool.height(*np.meshgrid(x, y))


def inner(pool, count=200, reach=0.95):
    """Return points inside the pool."""
    rng = np.random.default_rng(5)
    rim = pool.boundary_mm()[rng.integers(0, len(pool.boundary_mm()), count), :2]
    middle = rim.mean(axis=0)
    return (middle + reach * np.sqrt(rng.random(count))[:, None] * (rim - middle)).T


def assert_is_the_egg(pool, height_mm=2e-3, slope=0.02, size_mm=0.06):
    x, y = inner(EGG)
    np.testing.assert_allclose(pool.height(x, y), EGG.height(x, y), atol=height_mm)
    np.testing.assert_allclose(pool.gradient(x, y), EGG.gradient(x, y), atol=slope)
    for name in ("width_mm", "length_mm"):
        assert getattr(pool.size, name) == pytest.approx(getattr(EGG.size, name), abs=size_mm)
    assert pool.size.height_mm == pytest.approx(EGG.size.height_mm, abs=2e-3)


# --- any function ---------------------------------------------------------------------------------


def test_gradient_of_any_function_is_its_derivative():
    pool = OutlinedPool(saddle, square(3))
    x, y = np.random.default_rng(1).uniform(-2.9, 2.9, (2, 100))
    exact = np.stack(
        [0.05 * np.cos(x) * np.cos(1.5 * y), -0.075 * np.sin(x) * np.sin(1.5 * y)], axis=-1
    )
    np.testing.assert_allclose(pool.gradient(x, y), exact, atol=1e-10)


def test_pool_ends_at_its_outline():
    pool = OutlinedPool(saddle, square(3))
    x, y = np.random.default_rng(2).uniform(-4, 4, (2, 400))
    inside = np.maximum(abs(x), abs(y)) < 3
    np.testing.assert_array_equal(pool.inside(x, y), inside)
    np.testing.assert_array_equal(np.isfinite(pool.height(x, y)), inside)
    np.testing.assert_array_equal(np.isfinite(pool.gradient(x, y)).all(axis=-1), inside)
    np.testing.assert_allclose(pool.height(x, y)[inside], saddle(x, y)[inside])
    assert (pool.size.width_mm, pool.size.length_mm) == (6.0, 6.0)
    assert pool.size.height_mm == pytest.approx(0.05, abs=1e-9)
    assert pool.after(1.0) is pool


@pytest.mark.slow
def test_pool_as_a_function_gives_the_same_reflections():
    dent = Dent(0.05, 0.8)
    assert dent in EGG.terms
    rim = EGG.boundary_mm(7200)[:, :2]
    # The function has no boundary: beyond the outline it returns 0.
    pool = OutlinedPool(lambda x, y: np.nan_to_num(EGG.height(x, y)), rim, EGG.gradient)
    reflections, exact = trace(pool, RIG), trace(EGG, RIG)
    assert (reflections.hit != exact.hit).sum() <= 1
    both = reflections.visible & exact.visible
    assert both.sum() > 80
    np.testing.assert_allclose(reflections.plane_mm[both], exact.plane_mm[both], atol=1e-6)


@pytest.mark.parametrize("outline", [square(3)[:2], np.array([[0, 0], [1, 1], [2, 2]])])
def test_outline_without_area_is_rejected(outline):
    with pytest.raises(ValueError, match="area"):
        OutlinedPool(saddle, outline)


# --- height maps ----------------------------------------------------------------------------------


def test_height_map_reproduces_its_surface():
    pool = pool_from_heights(*grid_of(EGG), EGG.boundary_mm(360)[:, :2])
    assert_is_the_egg(pool, 1e-4, 2e-3, 1e-3)
    rim = pool.boundary_mm()
    np.testing.assert_allclose(rim[:, 2], 0, atol=1e-3)  # continued beyond the last heights


def test_gradient_of_a_height_map_is_the_derivative_of_its_height():
    pool = pool_from_heights(*grid_of(EGG, 0.2))
    x, y = inner(EGG, reach=0.9)
    step = 1e-5
    numeric = np.stack(
        [
            pool.height(x + step, y) - pool.height(x - step, y),
            pool.height(x, y + step) - pool.height(x, y - step),
        ],
        axis=-1,
    ) / (2 * step)
    np.testing.assert_allclose(pool.gradient(x, y), numeric, atol=1e-8)


def test_height_map_gives_the_dots_of_its_surface():
    reflections, exact = trace(pool_from_heights(*grid_of(EGG)), RIG), trace(EGG, RIG)
    both = reflections.visible & exact.visible
    assert (reflections.visible ^ exact.visible).sum() <= 4
    distance = np.linalg.norm(reflections.plane_mm - exact.plane_mm, axis=-1)[both]
    assert np.median(distance) < 0.01


def test_height_map_can_be_pickled():
    pool = pool_from_heights(*grid_of(EGG))
    pool.size  # noqa: B018 - the cached value is pickled too
    again = pickle.loads(pickle.dumps(pool))
    x, y = inner(EGG)
    np.testing.assert_array_equal(again.height(x, y), pool.height(x, y))


def write(path):
    x, y, z = grid_of(EGG)
    if path.name == "table.csv":
        rows = (",".join("" if np.isnan(v) else f"{v:.6f}" for v in row) for row in z)
        path.write_text("\n".join(rows) + "\n")
    elif path.name == "nodes.csv":
        u, v = np.meshgrid(x, y)
        known = np.isfinite(z)
        np.savetxt(path, np.stack([u[known], v[known], z[known]], -1), "%.6f", ",",
                   header="x_mm,y_mm,z_mm", comments="")  # fmt: skip
    elif path.suffix == ".npy":
        np.save(path, z)
    else:
        np.savez(path, x_mm=x, y_mm=y, z_mm=z)


@pytest.mark.parametrize("name", ["table.csv", "nodes.csv", "map.npy", "map.npz"])
def test_height_maps_are_read_from_every_file_format(tmp_path, name):
    write(tmp_path / name)
    is_bare = name in ("table.csv", "map.npy")
    # The grid's middle is at (0, -1).
    pool = read_pool(
        tmp_path / name, 0.1 if is_bare else None, (0.0, -1.0) if is_bare else (0.0, 0.0)
    )
    assert_is_the_egg(pool)


# --- meshes -------------------------------------------------------------------------------------


def triangles(rings=40, sectors=90):
    """Return the egg as rings of triangles."""
    rim = EGG.boundary_mm(sectors)[:, :2]
    middle = np.array(EGG.footprint.center_mm)
    points = [middle[None]]
    points += [middle + (n / rings) * (1 - 1e-9) * (rim - middle) for n in range(1, rings + 1)]
    xy = np.concatenate(points)
    vertices = np.column_stack([xy, EGG.height(*xy.T)])
    next_ = np.roll(np.arange(sectors), -1)
    faces = [np.column_stack([np.zeros(sectors, int), 1 + np.arange(sectors), 1 + next_])]
    for ring in range(rings - 1):
        a, b = 1 + ring * sectors, 1 + (ring + 1) * sectors
        sector = np.arange(sectors)
        faces += [np.column_stack([a + sector, b + sector, b + next_])]
        faces += [np.column_stack([a + sector, b + next_, a + next_])]
    return vertices, np.concatenate(faces)


def write_mesh(path, kind):
    vertices, faces = triangles()
    if kind in ("trimesh", "ascii"):
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        options = {"file_type": "stl_ascii"} if kind == "ascii" else {}
        mesh.export(path, **options)
    else:
        meshio.write_points_cells(path, vertices, [("triangle", faces)], binary=kind == "binary")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.stl", "trimesh"),
        ("a.stl", "ascii"),
        ("a.ply", "trimesh"),
        ("a.ply", "binary"),
        ("a.ply", "text"),
    ],
)
@pytest.mark.slow
def test_meshes_of_other_programs_are_read(tmp_path, name, kind):
    write_mesh(tmp_path / name, kind)
    assert_is_the_egg(read_pool(tmp_path / name), size_mm=0.02)


def test_top_of_a_closed_body_is_the_pool(tmp_path):
    vertices, faces = triangles()
    sectors = 90
    rim = len(vertices) - sectors + np.arange(sectors)
    below = vertices[rim] - [0, 0, 1.0]
    floor = len(vertices) + np.arange(sectors)
    walls = [np.column_stack([rim, floor, np.roll(floor, -1)]),
             np.column_stack([rim, np.roll(floor, -1), np.roll(rim, -1)]),
             np.column_stack([np.full(sectors - 2, floor[0]), floor[2:], floor[1:-1]])]  # fmt: skip
    body = trimesh.Trimesh(np.concatenate([vertices, below]), np.concatenate([faces, *walls]))
    assert body.is_watertight
    body.export(tmp_path / "body.stl")
    assert_is_the_egg(read_pool(tmp_path / "body.stl"), size_mm=0.02)


def test_mesh_with_a_corner_at_infinity_or_nearly_there_is_rejected(tmp_path):
    vertices, faces = triangles()
    far = np.array([[0.0, 0, -1e38], [0, 1, -1], [1, 0, -1]])  # of a wall, not of the pool
    faces = np.concatenate([faces, [[len(vertices), len(vertices) + 2, len(vertices) + 1]]])
    body = trimesh.Trimesh(np.concatenate([vertices, far]), faces, process=False)
    body.export(tmp_path / "body.stl")
    with pytest.raises(InputError, match=r"a corner at 1e\+38"):
        read_pool(tmp_path / "body.stl")


# --- invalid files ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", b"", ".obj"),
        ("a.csv", b"1,2\n3\n", "different length"),
        ("a.csv", b"1,2\n3,x\n", "could not convert"),
        ("a.csv", b"x_mm,y_mm,z_mm\n1,2,3\n", "4 × 4"),
        ("a.csv", b"\n".join([b"0.1,0.2,0.3,0.4"] * 5), "spacing_mm"),
        ("a.npy", b"no numbers", "height map"),
        ("a.npz", b"PK\x03\x04", "height map"),
        ("a.stl", b"solid\nendsolid\n", "no triangles"),
        ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "vertices"),
        ("a.ply", b"ply\n", "no header"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
            b"element face 1\nproperty list uchar int at\nend_header\n0 0\n1 0\n1 1\n3 0 1 2\n",
            "mesh",
        ),
    ],
)
def test_invalid_surface_files_are_rejected(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as error:
        read_pool(path)
    assert error.value.source == str(path)


def claim(shape):
    """The bytes of a .npy file that claims a shape, and has ten numbers."""
    file = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + bytes(80)


def archive(**parts):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in parts.items():
            made.writestr(f"{name}.npy", content)
    return file.getvalue()


def ply(corner, vertices=4):
    head = f"element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    faces = np.array([(3, (0, 1, 2)), (3, (0, 2, corner))], [("n", "<u1"), ("at", "<i4", 3)])
    places = np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]], "<f4")
    head += "element face 2\nproperty list uchar int at\nend_header\n"
    start = b"ply\nformat binary_little_endian 1.0\n"
    return start + head.encode() + places.tobytes() + faces.tobytes()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npy", claim((10**6, 10**6))),
        ("a.npz", claim((10, 10))),
        ("a.npz", archive(x_mm=bytes(1 << 28), y_mm=bytes(1 << 28), z_mm=b"x")),
        ("a.csv", b"x_mm,y_mm,z_mm\n" + b"".join(b"%d,%d,0\n" % (k, k) for k in range(9000))),
        ("a.npy", b"".join([claim((4, 4)), np.full(6, 1e300).tobytes()])),
        ("a.ply", ply(-1)),
        ("a.ply", ply(3, vertices=-1)),
        ("a.ply", ply(3, vertices=10**30)),
        ("a.stl", bytes(80) + (20).to_bytes(4, "little") + np.full(250, np.inf, "<f4").tobytes()),
    ],
)
def test_sizes_and_numbers_of_surface_files_are_not_trusted(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            read_pool(tmp_path / name, 0.5)
        assert tracemalloc.get_traced_memory()[1] < 600_000_000
    finally:
        tracemalloc.stop()


def test_archive_whose_arrays_are_shorter_than_claimed_is_rejected(tmp_path):
    # The memory is reserved, but never used.
    content = archive(x_mm=claim((10**12,)), y_mm=claim((10,)), z_mm=claim((10, 10)))
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError):
        read_pool(tmp_path / "a.npz")


def test_missing_file_and_wrong_unit_are_rejected(tmp_path):
    with pytest.raises(InputError, match=r"No such file"):
        read_pool(tmp_path / "a.csv", 0.1)
    x, y, z = grid_of(EGG)
    np.savez(tmp_path / "metres.npz", x_mm=x / 1000, y_mm=y / 1000, z_mm=z / 1000)
    with pytest.raises(InputError, match="mm along its longer side"):
        read_pool(tmp_path / "metres.npz")
