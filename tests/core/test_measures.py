"""Reflection errors, and sizes of known pools."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.optics import (
    intersect_imaging_plane,
    ray_directions,
    reflect,
    surface_normal,
)
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.schemes import ers, irs
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.measures import measure_surface, reflection_errors, reflection_scale
from labapp.core.surface.mesh import grid_nodes, surface_mesh
from labapp.core.surface.reconstruction import Reconstruction
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import Pool, egg, spherical_cap

RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(1e9),
    ImagingPlane.vertical(50.0, 1e4, -1e4, 2e4, 2e4),
)


def truth(pool: Pool, residual=None):
    """Return the reconstruction by a perfect scheme, and its match."""
    match = exact_match(trace(pool, RIG))
    count = len(match.ray)
    points = trace(pool, RIG).point_mm[match.ray[:, 0] - 1, match.ray[:, 1] - 1]
    rim = pool.boundary_mm()
    centre = np.array(pool.footprint.center_mm)
    theta = np.degrees(np.arctan2(rim[:, 1] - centre[1], rim[:, 0] - centre[0]))
    theta[theta >= 180] -= 360
    order = np.argsort(theta)
    reconstruction = Reconstruction(
        scheme="ers",
        surface=pool,
        boundary=Boundary(centre, theta[order], rim[order]),
        ray=match.ray,
        points_mm=points,
        residual_mm=np.zeros((count, 2)) if residual is None else residual(count),
        sigma_mm=np.full(count, np.nan),
    )
    return reconstruction, match


@pytest.mark.slow
@given(
    st.floats(5.0, 8.0),
    st.sampled_from([-0.1, -0.05, 0.05, 0.1]),
    st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
)
def test_spherical_cap_has_analytical_sizes(diameter, share, center):
    height = diameter * share
    reconstruction, match = truth(spherical_cap(diameter, height, center))
    measures = measure_surface(reconstruction, match, RIG)
    assert measures.width_mm == pytest.approx(diameter, rel=1e-4)
    assert measures.length_mm == pytest.approx(diameter, rel=1e-4)
    assert measures.height_mm == pytest.approx(max(height, 0), abs=1e-5)
    assert measures.depth_mm == pytest.approx(min(height, 0), abs=1e-5)
    assert measures.area_mm2 == pytest.approx(np.pi * diameter**2 / 4, rel=1e-4)
    volume = np.pi * height / 6 * (3 * diameter**2 / 4 + height**2)
    assert measures.volume_mm3 == pytest.approx(volume, rel=1e-3)
    assert (measures.center_x_mm, measures.center_y_mm) == pytest.approx(center)
    assert (measures.peak_x_mm, measures.peak_y_mm) == pytest.approx(center, abs=1e-4)


def test_off_centre_egg_is_measured():
    pool = egg(6.6, 2.8, 4.6, 0.29, (0.2, -0.4))
    reconstruction, match = truth(pool)
    measures, size = measure_surface(reconstruction, match, RIG), pool.size
    assert measures.width_mm == pytest.approx(size.width_mm, rel=1e-4)
    assert measures.length_mm == pytest.approx(size.length_mm, rel=1e-4)
    assert measures.height_mm == pytest.approx(size.height_mm, rel=1e-4)
    assert (measures.peak_x_mm, measures.peak_y_mm) == pytest.approx(size.peak_mm, abs=0.01)
    x, _, z = grid_nodes(reconstruction, 0.02)
    assert measures.volume_mm3 == pytest.approx(z.sum() * 0.02**2, rel=1e-3)
    assert measures.area_mm2 == pytest.approx(len(x) * 0.02**2, rel=1e-3)


def test_size_uncertainties_are_those_of_the_reconstruction():
    reconstruction, match = truth(spherical_cap(6.0, 0.4))
    assert np.isnan(measure_surface(reconstruction, match, RIG).height_sigma_mm)
    sigma = np.array([0.06, 0.05, 0.04, 0.03, 0.2, 0.1])
    measures = measure_surface(replace(reconstruction, size_sigma=sigma), match, RIG)
    names = ("width_sigma_mm", "length_sigma_mm", "height_sigma_mm", "depth_sigma_mm")
    stated = [getattr(measures, name) for name in (*names, "area_sigma_mm2", "volume_sigma_mm3")]
    np.testing.assert_array_equal(stated, sigma)


def test_reflection_errors_agree_with_eq_6_3_to_6_8():
    reconstruction, match = truth(
        spherical_cap(6.0, 0.3),
        residual=lambda n: np.random.default_rng(1).normal(0.0, 1.0, (n, 2)),
    )
    landing = np.array(
        [
            RIG.laser.position_mm - RIG.laser.position_mm[2] / direction[2] * direction
            for direction in trace(spherical_cap(6.0, 0.3), RIG).incident[
                match.ray[:, 0] - 1, match.ray[:, 1] - 1
            ]
        ]
    )
    w = np.ptp(landing[:, 0]) / np.ptp(match.plane_mm[:, 0])
    l_ = np.ptp(landing[:, 1]) / np.ptp(match.plane_mm[:, 1])
    np.testing.assert_allclose(reflection_scale(match, RIG), [w, l_])
    errors = reflection_errors(reconstruction, match, RIG)
    each = [np.hypot(x * w, z * l_) for x, z in reconstruction.residual_mm]
    np.testing.assert_allclose([errors["scale_x"], errors["scale_z"]], [w, l_])
    assert errors["are_mm"] == pytest.approx(np.mean(each))
    assert errors["mre_mm"] == pytest.approx(np.max(each))


def test_inner_errors_exclude_edge_rows_and_row_ends():
    reconstruction, match = truth(spherical_cap(6.0, 0.3))
    inner = []
    for i, j in match.ray:
        row = match.ray[match.ray[:, 0] == i, 1]
        inner.append(
            match.ray[:, 0].min() < i < match.ray[:, 0].max() and row.min() < j < row.max()
        )
    # 1 mm along X' on the ends and edges, 0.1 mm inside.
    residual = np.where(np.array(inner)[:, None], [0.1, 0.0], [1.0, 0.0])
    errors = reflection_errors(replace(reconstruction, residual_mm=residual), match, RIG)
    scale = reflection_scale(match, RIG)[0]
    assert errors["are_inner_mm"] == pytest.approx(0.1 * scale)
    assert errors["mre_inner_mm"] == pytest.approx(0.1 * scale)
    assert errors["mre_mm"] == pytest.approx(scale)


def test_two_rows_have_no_inner_errors():
    reconstruction, match = truth(spherical_cap(6.0, 0.3))
    two = (match.ray[:, 0] == 10) | (match.ray[:, 0] == 11)
    match = replace(match, ray=match.ray[two], plane_mm=match.plane_mm[two])
    reconstruction = replace(
        reconstruction, ray=match.ray, residual_mm=reconstruction.residual_mm[two]
    )
    errors = reflection_errors(reconstruction, match, RIG)
    assert np.isnan(errors["are_inner_mm"])
    assert errors["are_mm"] == 0


def test_grid_nodes_are_inside_the_boundary():
    reconstruction, _ = truth(spherical_cap(6.0, 0.3, (0.1, 0.2)))
    x, y, z = grid_nodes(reconstruction, 0.25)
    np.testing.assert_allclose(x / 0.25, np.round(x / 0.25), atol=1e-9)
    assert (np.hypot(x - 0.1, y - 0.2) <= 3.0).all()
    assert len(x) == pytest.approx(np.pi * 9 / 0.25**2, rel=0.03)
    np.testing.assert_allclose(z, reconstruction.surface.height(x, y))


def test_mesh_ends_at_the_boundary_and_faces_up():
    reconstruction, match = truth(egg(6.6, 2.8, 4.6, 0.29))
    vertices, triangles = surface_mesh(reconstruction, 0.3)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (normal[:, 2] > 0).all()
    measures = measure_surface(reconstruction, match, RIG)
    assert normal[:, 2].sum() / 2 == pytest.approx(measures.area_mm2)
    # Every edge has two triangles, except boundary edges, whose vertices are boundary points.
    edges = np.sort(np.vstack([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count) == {1, 2}
    rim = np.unique(pairs[count == 1])
    np.testing.assert_allclose(vertices[rim], reconstruction.boundary.points_mm)
    assert vertices[:, 2].max() == pytest.approx(0.29, abs=0.01)


@pytest.mark.parametrize("algorithm", ["opa", "epa-r", "epa-c", "epa-rc"])
def test_no_node_is_beyond_height_and_depth(algorithm):
    # An interpolated surface has creases, also between the samples along the spokes.
    for pool in (egg(6.6, 3.0, 4.0, 0.3), egg(6.0, 3.0, 4.2, -0.2), spherical_cap(6.0, 0.3)):
        match = exact_match(trace(pool, RIG), sigma_mm=0.05, rng=np.random.default_rng(3))
        made = irs.reconstruct(match, RIG, irs.IrsSettings(algorithm=algorithm))
        measures = measure_surface(made, match, RIG)
        z = grid_nodes(made, 0.1)[2]
        assert measures.depth_mm - 1e-9 <= z.min()
        assert z.max() <= measures.height_mm + 1e-9


@pytest.mark.parametrize(
    ("scheme", "settings"), [(irs, irs.IrsSettings()), (ers, ers.ErsSettings())], ids=["irs", "ers"]
)
def test_residuals_of_irs_and_ers_are_those_of_their_surfaces(scheme, settings):
    match = exact_match(trace(egg(6.6, 3.0, 4.0, 0.2), RIG))
    reconstruction = scheme.reconstruct(match, RIG, settings)
    measures = measure_surface(reconstruction, match, RIG)
    # Independent of the program: search along each ray in vertical steps of 1 µm.
    laser = RIG.laser.position_mm
    distance = np.arange(-0.2, 1.2, 0.001)
    dots = []
    for i, j in match.ray:
        ray = ray_directions(RIG.laser, RIG.pattern)[i - 1, j - 1]
        points = laser + ((distance[::-1] - laser[2]) / ray[2])[:, None] * ray
        above = points[:, 2] - reconstruction.surface.height(points[:, 0], points[:, 1])
        crossings = np.flatnonzero((above[:-1] > 0) & (above[1:] <= 0))
        if len(crossings) == 0 or not reconstruction.boundary.contains(*points[crossings[0], :2]):
            dots.append([np.nan, np.nan])
            continue
        k = crossings[0]
        point = points[k] + above[k] / (above[k] - above[k + 1]) * (points[k + 1] - points[k])
        normal = surface_normal(reconstruction.surface.gradient(point[0], point[1]))
        dots.append(intersect_imaging_plane(point, reflect(ray, normal), RIG.imaging_plane))
    residual = np.array(dots) - match.plane_mm
    error = np.hypot(*(residual * reflection_scale(match, RIG)).T)
    known = np.isfinite(error)
    assert known.mean() > 0.9
    np.testing.assert_array_equal(known, np.isfinite(reconstruction.residual_mm).all(axis=1))
    np.testing.assert_allclose(
        np.median(reconstruction.residual_mm[known] / residual[known]), 1, rtol=1e-3
    )
    assert measures.are_mm == pytest.approx(error[known].mean(), rel=0.02)
    assert measures.mre_mm == pytest.approx(error[known].max(), rel=0.02)
    assert measures.own_are_mm < measures.are_mm
    assert (measures.scale_x, measures.scale_z) == tuple(reflection_scale(match, RIG))
