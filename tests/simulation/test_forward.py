from __future__ import annotations

import ast
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.core.geometry.optics import intersect_imaging_plane, ray_directions
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.simulation import forward
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import Dent, LowRear, Pool, caps_8_3_1, egg, spherical_cap
from labapp.simulation.pools import Footprint as Foot
from labapp.studies.correspondence_table import correspondence_letters

DATA = Path(__file__).parents[1] / "data"
OVERHEAD = 1000.0
"""Electrode height, mm, that blocks nothing."""


def rig_with(angle=31.14, distance=31.48, electrode=OVERHEAD, plane=None, pattern=None):
    return Rig(
        Laser(angle, distance),
        pattern or DotPattern(),
        Electrode(electrode),
        plane or ImagingPlane.vertical(50.0, 45.0, 3.0),
    )


def mirror(half=30.0):
    return Pool(Foot(2 * half, half, half), 0.0)


def table(name):
    with (DATA / name).open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            head, *cells = row.items()
            for column, expected in cells:
                yield head[1], column, expected


@pytest.mark.parametrize("pool", caps_8_3_1(), ids=lambda p: f"{p.footprint.width_mm}/{p.peak_mm}")
@pytest.mark.slow
def test_caps_reflect_like_a_sphere(pool):
    """Each ray and its reflection are compared with the formula for a ray and a sphere."""
    rig = rig_with()
    reflections = trace(pool, rig)
    half, peak = pool.footprint.width_mm / 2, pool.peak_mm
    radius = (half**2 + peak**2) / (2 * abs(peak))
    middle = np.array([0.0, 0.0, peak - np.sign(peak) * radius])
    alpha = np.radians(31.14)
    laser = 31.48 * np.array([0.0, np.cos(alpha), np.sin(alpha)])
    hits = 0
    for i in range(19):
        for j in range(19):
            axis = np.array([0.0, -np.cos(alpha), -np.sin(alpha)])
            normal = np.array([0.0, -np.sin(alpha), np.cos(alpha)])
            ray = axis + np.tan(np.radians(0.77 * (j - 9))) * np.array([1.0, 0.0, 0.0])
            ray = ray + np.tan(np.radians(0.77 * (9 - i))) * normal
            ray /= np.linalg.norm(ray)
            b, c = ray @ (laser - middle), (laser - middle) @ (laser - middle) - radius**2
            discriminant = b * b - c
            # A convex cap is hit on the near side of the sphere, a concave one on the far side.
            length = -b - np.sign(peak) * np.sqrt(discriminant) if discriminant >= 0 else np.nan
            point = laser + length * ray
            if not (np.hypot(point[0], point[1]) <= half and point[2] * peak >= 0):
                assert not reflections.hit[i, j]
                continue
            hits += 1
            assert reflections.hit[i, j]
            np.testing.assert_allclose(reflections.point_mm[i, j], point, atol=1e-9)
            outward = (point - middle) / radius
            reflected = ray - 2 * (ray @ outward) * outward
            np.testing.assert_allclose(reflections.reflected[i, j], reflected, atol=1e-9)
            if reflected[1] < 0:
                reach = (-50.0 - point[1]) / reflected[1]
                on_plane = (
                    point[0] + reach * reflected[0] + 45.0,
                    point[2] + reach * reflected[2] - 3.0,
                )
                np.testing.assert_allclose(
                    reflections.plane_mm[i, j], on_plane, rtol=1e-7, atol=1e-7
                )
    assert hits > 40


def test_flat_mirror_is_s_s():
    reflections = trace(mirror(), rig_with())
    assert reflections.hit.all()
    assert (np.diff(reflections.point_mm[..., 1], axis=0) > 0).all(), "i grows towards the head"
    assert (np.diff(reflections.plane_mm[..., 1], axis=0) > 0).all(), "and upward on the plane"
    assert (np.diff(reflections.plane_mm[..., 0], axis=1) > 0).all(), "j grows to the right"
    assert correspondence_letters(reflections) == "S/S"
    # The beam axis meets the origin and is reflected at the same elevation.
    np.testing.assert_allclose(reflections.point_mm[9, 9], 0, atol=1e-9)
    assert reflections.plane_mm[9, 9, 1] == pytest.approx(50 * np.tan(np.radians(31.14)) - 3)


def test_absent_rays_are_never_visible_and_in_an_unknown_state():
    rig = rig_with(pattern=DotPattern(absent=frozenset({(10, 10), (12, 7)})))
    reflections = trace(spherical_cap(6, 0.3), rig)
    assert np.argwhere(reflections.absent).tolist() == [[9, 9], [11, 6]]
    assert reflections.hit[reflections.absent].all()
    assert not reflections.visible[reflections.absent].any()
    match = exact_match(reflections)
    assert (match.ray_states[reflections.absent] == 0).all()


def test_torch_blocks_a_flat_mirror_as_in_eq_4_14_and_4_15():
    """L1 and L2 of Eq. 4-14 and 4-15."""
    reflections = trace(mirror(), rig_with(angle=35, distance=30, electrode=2.0))
    height, horizontal = 30 * np.sin(np.radians(35)), 30 * np.cos(np.radians(35))
    l1, l2 = 2 * horizontal / (height - 2), 2 * horizontal / (height + 2)
    y = reflections.point_mm[..., 1]
    np.testing.assert_array_equal(reflections.incident_blocked, y < -l1)
    np.testing.assert_array_equal(reflections.reflected_blocked, y > l2)
    assert reflections.incident_blocked.any()
    assert reflections.reflected_blocked.any()
    assert not (reflections.visible & reflections.blocked).any()


@pytest.mark.parametrize(
    ("name", "sign"), [("table_4_1_blocking_convex", 1), ("table_4_2_blocking_concave", -1)]
)
def test_tables_4_1_and_4_2(name, sign):
    cells = list(table(f"{name}.csv"))
    assert len(cells) == 36
    for angle, column, expected in cells:
        radius, depth = (float(part[1:]) for part in column.split("_"))
        rig = rig_with(angle=float(angle), distance=30.0, electrode=5.0)
        reflections = trace(spherical_cap(2 * radius, sign * depth), rig)
        assert not reflections.incident_blocked.any()
        blocking = "rb" if (reflections.lit & reflections.reflected_blocked).any() else "nb"
        assert (angle, column, blocking) == (angle, column, expected)


@pytest.mark.parametrize(
    ("name", "sign"),
    [("table_4_4_correspondence_concave", -1), ("table_4_5_correspondence_convex", 1)],
)
def test_tables_4_4_and_4_5(name, sign):
    cells = list(table(f"{name}.csv"))
    assert len(cells) == 20
    for depth, column, expected in cells:
        radius = float(column[1:])
        pool = spherical_cap(2 * radius, sign * radius / float(depth[2:]))
        assert (depth, column, correspondence_letters(trace(pool, rig_with()))) == (
            depth,
            column,
            expected,
        )


def test_letters_need_a_row():
    with pytest.raises(ValueError, match="no row"):
        correspondence_letters(trace(spherical_cap(0.2, 0.01, (0.0, 4.0)), rig_with()))


def test_tilted_plane_catches_the_same_rays():
    pool = egg(6.66, 3.2, 4.25, 0.29, terms=(Dent(0.05, 0.8),))
    tilt, turn = np.radians([25.0, -10.0])
    x_axis = np.array([np.cos(turn), np.sin(turn), 0.0])
    z_axis = np.cross(x_axis, [np.sin(turn), -np.cos(turn), 0.0]) * np.cos(tilt)
    z_axis = z_axis + np.sin(tilt) * np.array([np.sin(turn), -np.cos(turn), 0.0])
    plane = ImagingPlane(np.array([-50.0, -45.0, -5.0]), x_axis, z_axis)
    upright, tilted = trace(pool, rig_with()), trace(pool, rig_with(plane=plane))
    np.testing.assert_array_equal(upright.reflected, tilted.reflected)
    hit = tilted.hit & np.isfinite(tilted.plane_mm[..., 0])
    assert hit.sum() > 80
    x, z = np.moveaxis(tilted.plane_mm[hit], -1, 0)[..., None]
    dots = plane.origin_mm + x * x_axis + z * z_axis
    to_dot = dots - tilted.point_mm[hit]
    along = np.sum(to_dot * tilted.reflected[hit], axis=-1)
    assert (along > 0).all()
    np.testing.assert_allclose(to_dot, along[:, None] * tilted.reflected[hit], atol=1e-9)


def test_ray_reflected_away_from_the_plane_makes_no_dot():
    behind = ImagingPlane.vertical(-50.0, 45.0, 3.0)
    reflections = trace(mirror(), rig_with(plane=behind))
    assert reflections.hit.all()
    assert np.isnan(reflections.plane_mm).all()
    assert not reflections.visible.any()


def test_dots_beyond_the_edges_are_not_visible():
    small = ImagingPlane.vertical(50.0, 45.0, 3.0, width_mm=50.0, height_mm=40.0)
    full, cut = (trace(spherical_cap(6, 0.3), rig_with(plane=p)) for p in (None, small))
    x, z = full.plane_mm[..., 0], full.plane_mm[..., 1]
    np.testing.assert_array_equal(cut.visible, full.visible & (x <= 50) & (z <= 40))
    assert full.visible.sum() > cut.visible.sum() > 0


def test_rays_obey_the_law_of_reflection_on_a_disturbed_pool():
    pool = egg(7, 3, 4.4, 0.3, terms=(Dent(0.15, 0.6), LowRear(0.08)))
    reflections = trace(pool, rig_with())
    point, hit = reflections.point_mm[reflections.hit], reflections.hit
    x, y, z = point.T
    np.testing.assert_allclose(z, pool.height(x, y), atol=1e-9)
    slope = pool.gradient(x, y)
    bisector = reflections.reflected[hit] - reflections.incident[hit]
    np.testing.assert_allclose(-bisector[:, :2] / bisector[:, 2:], slope, atol=1e-9)
    laser = 31.48 * np.array([0, np.cos(np.radians(31.14)), np.sin(np.radians(31.14))])
    to_point = point - laser
    np.testing.assert_allclose(
        to_point / np.linalg.norm(to_point, axis=-1, keepdims=True),
        reflections.incident[hit],
        atol=1e-9,
    )


def second_reflections(pool, reflections, steps=20000):
    """Return the rays whose reflection goes below the surface, found in tiny steps."""
    found = np.zeros(reflections.hit.shape, bool)
    for ray in np.argwhere(reflections.hit):
        t = np.linspace(0, 12, steps)[1:, None]
        path = reflections.point_mm[tuple(ray)] + t * reflections.reflected[tuple(ray)]
        found[tuple(ray)] = (pool.height(path[:, 0], path[:, 1]) > path[:, 2] + 1e-6).any()
    return found


def test_second_reflections_are_detected_and_make_no_dot():
    wide = DotPattern(inter_beam_angle_deg=1.0)
    for depth, expected in ((-0.3, False), (-2.6, True)):
        pool = spherical_cap(6.0, depth)
        reflections = trace(pool, rig_with(angle=50.0, pattern=wide))
        np.testing.assert_array_equal(reflections.hits_again, second_reflections(pool, reflections))
        assert reflections.hits_again.any() == expected
        assert not (reflections.visible & reflections.hits_again).any()


def test_convex_pools_have_no_second_reflections():
    for pool in (mirror(), spherical_cap(8.0, 0.9), egg(7, 3, 4.4, 0.3)):
        assert not trace(pool, rig_with()).hits_again.any()


def test_first_of_several_intersections_counts():
    """A steep hill in front hides the surface behind it."""
    hill = Pool(Foot(8, 4, 4, (0, 0)), 2.5)
    reflections = trace(hill, rig_with(angle=20.0))
    steps = np.linspace(0.5, 0.999, 400)[:, None, None, None]
    laser = 31.48 * np.array([0, np.cos(np.radians(20)), np.sin(np.radians(20))])
    path = laser + steps * (reflections.point_mm - laser)
    ground = np.nan_to_num(hill.height(path[..., 0], path[..., 1]), nan=0.0)
    clear = path[..., 2] > ground
    assert clear[:, reflections.hit].all()
    assert reflections.point_mm[reflections.hit][:, 1].min() > -2


@pytest.mark.parametrize("orientation", ["S/S", "S/I", "I/I"])
def test_exact_match_numbers_dots_by_the_conventions(orientation):
    rig = rig_with()
    match = exact_match(trace(spherical_cap(6, 0.3), rig), orientation)
    i, j = match.ray.T
    k, t = match.reflected.T
    assert match.orientation == orientation
    assert (k.min(), t.min()) == (1, 1)
    row_sign = 1 if orientation[2] == "S" else -1
    column_sign = 1 if orientation[0] == "S" else -1
    assert len(set((i - row_sign * k).tolist())) == 1
    assert len(set((j - column_sign * t).tolist())) == 1


def test_exact_match_has_the_orientation_of_the_28_caps():
    rig = rig_with()
    for pool in caps_8_3_1():
        match = exact_match(trace(pool, rig))
        assert match.orientation == ("S/S" if pool.peak_mm > 0 else "I/I")


def test_states_of_lit_dark_and_unknown_rays():
    rig = rig_with(electrode=5.0)
    reflections = trace(spherical_cap(8, 0.8), rig)
    match = exact_match(reflections)
    assert {-1, 0, 1} == set(match.ray_states.flat)
    lit, dark, unknown = (match.ray_states == value for value in (1, -1, 0))
    np.testing.assert_array_equal(np.argwhere(lit) + 1, match.ray)
    assert not reflections.hit[dark].any()
    assert (reflections.absent | (reflections.hit & (reflections.blocked | ~reflections.on_plane)))[
        unknown
    ].all()


def test_exact_match_noise_has_the_covariance_it_claims():
    rig = rig_with()
    reflections = trace(spherical_cap(8, 0.4), rig)
    clean = exact_match(reflections)
    rng = np.random.default_rng(3)
    errors = np.concatenate(
        [exact_match(reflections, None, 0.05, rng).plane_mm - clean.plane_mm for _ in range(20)]
    )
    match = exact_match(reflections, None, 0.05, rng)
    np.testing.assert_allclose(
        match.plane_covariance_mm2,
        0.0025 * np.ones((1, 1, 1)) * np.eye(2) + np.zeros((len(match.ray), 1, 1)),
    )
    np.testing.assert_allclose(np.cov(errors.T), 0.0025 * np.eye(2), atol=1.5e-4)
    with pytest.raises(ValueError, match="generator"):
        exact_match(reflections, sigma_mm=0.05)


def test_even_pattern_has_rays_on_both_sides_of_its_axis():
    rig = rig_with(pattern=DotPattern(rows=6, columns=4, absent=frozenset()))
    reflections = trace(mirror(), rig)
    assert reflections.visible.shape == (6, 4)
    np.testing.assert_allclose(
        reflections.point_mm[:, 0, 0], -reflections.point_mm[:, 3, 0], atol=1e-9
    )


def test_rays_that_miss_the_pool_make_no_dots():
    rig = rig_with()
    reflections = trace(replace(spherical_cap(2, 0.1), footprint=Foot(2, 1, 1, (50, 50))), rig)
    assert not reflections.hit.any()
    match = exact_match(reflections)
    assert match.ray.shape == (0, 2)
    assert match.plane_mm.shape == (0, 2)


def test_simulation_does_not_use_the_measuring_code():
    """Of core, the simulation may use only the data types of a rig and a match.

    The studies (chapters 4 and 8) may measure; the simulation must not import them.
    """
    allowed = {f"labapp.core.{name}" for name in ("geometry.rig", "values", "match")}
    package = Path(forward.__file__).parents[2]
    waiting = ["tests.samples.runs", "labapp.simulation.surface_files"]
    used = set()
    while waiting:
        name = waiting.pop()
        used.add(name)
        if not name.startswith(("labapp.simulation", "tests.samples")):
            continue
        text = (package / f"{name.replace('.', '/')}.py").read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom):
                imported = [node.module]
            elif isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            else:
                continue
            waiting += [one for one in imported if one not in used]
    core = {name for name in used if name.startswith("labapp.core")}
    assert {"labapp.simulation.recording", "labapp.simulation.render"} <= used
    assert "labapp.core.geometry.rig" in core
    assert core <= allowed


def test_rays_of_a_misaligned_bench_agree_with_core():
    laser = Laser(31.14, 31.48, azimuth_deg=3.0, aim_x_mm=0.5, aim_y_mm=-0.7)
    plane = ImagingPlane.of_angles(np.array([-45.0, -50.0, 3.0]), (3.0, -4.0, 5.0))
    rig = Rig(laser, DotPattern(rotation_deg=2.0), Electrode(5.0), plane)
    reflections = trace(spherical_cap(3.0, 0.3), rig)
    np.testing.assert_allclose(reflections.incident, ray_directions(laser, rig.pattern), atol=1e-12)
    hit = reflections.hit
    direction = reflections.point_mm[hit] - laser.position_mm
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    np.testing.assert_allclose(direction, reflections.incident[hit], atol=1e-9)
    np.testing.assert_allclose(
        intersect_imaging_plane(reflections.point_mm[hit], reflections.reflected[hit], plane),
        reflections.plane_mm[hit],
        atol=1e-9,
    )
