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
def test_caps_reflect_as_a_sphere_does(pool):
    """Ray by ray against the quadratic formula for a ray and a sphere, and mirroring at it."""
    rig = rig_with()
    seen = trace(pool, rig)
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
            under = b * b - c
            # From outside the near side of the ball, from inside (a hollow) the far side.
            length = -b - np.sign(peak) * np.sqrt(under) if under >= 0 else np.nan
            point = laser + length * ray
            if not (np.hypot(point[0], point[1]) <= half and point[2] * peak >= 0):
                assert not seen.hit[i, j]
                continue
            hits += 1
            assert seen.hit[i, j]
            np.testing.assert_allclose(seen.point_mm[i, j], point, atol=1e-9)
            outward = (point - middle) / radius
            back = ray - 2 * (ray @ outward) * outward
            np.testing.assert_allclose(seen.reflected[i, j], back, atol=1e-9)
            if back[1] < 0:
                reach = (-50.0 - point[1]) / back[1]
                on_plane = (point[0] + reach * back[0] + 45.0, point[2] + reach * back[2] - 3.0)
                np.testing.assert_allclose(seen.plane_mm[i, j], on_plane, rtol=1e-7, atol=1e-7)
    assert hits > 40


def test_flat_mirror_is_s_s():
    seen = trace(mirror(), rig_with())
    assert seen.hit.all()
    assert (np.diff(seen.point_mm[..., 1], axis=0) > 0).all(), "i grows towards the head"
    assert (np.diff(seen.plane_mm[..., 1], axis=0) > 0).all(), "and upward on the plane"
    assert (np.diff(seen.plane_mm[..., 0], axis=1) > 0).all(), "j grows to the right"
    assert correspondence_letters(seen) == "S/S"
    # The axis of the beam meets the origin and leaves as steeply as it came.
    np.testing.assert_allclose(seen.point_mm[9, 9], 0, atol=1e-9)
    assert seen.plane_mm[9, 9, 1] == pytest.approx(50 * np.tan(np.radians(31.14)) - 3)


def test_absent_rays_are_never_visible_and_cannot_testify():
    rig = rig_with(pattern=DotPattern(absent=frozenset({(10, 10), (12, 7)})))
    seen = trace(spherical_cap(6, 0.3), rig)
    assert np.argwhere(seen.absent).tolist() == [[9, 9], [11, 6]]
    assert seen.hit[seen.absent].all()
    assert not seen.visible[seen.absent].any()
    match = exact_match(seen, rig)
    assert (match.witness[seen.absent] == 0).all()


def test_torch_blocks_a_flat_mirror_where_the_text_says():
    """L1 and L2 of Eq. 4-14 and 4-15."""
    seen = trace(mirror(), rig_with(angle=35, distance=30, electrode=2.0))
    height, away = 30 * np.sin(np.radians(35)), 30 * np.cos(np.radians(35))
    l1, l2 = 2 * away / (height - 2), 2 * away / (height + 2)
    y = seen.point_mm[..., 1]
    np.testing.assert_array_equal(seen.incident_blocked, y < -l1)
    np.testing.assert_array_equal(seen.reflected_blocked, y > l2)
    assert seen.incident_blocked.any()
    assert seen.reflected_blocked.any()
    assert not (seen.visible & seen.blocked).any()


@pytest.mark.parametrize(
    ("name", "sign"), [("table_4_1_blocking_convex", 1), ("table_4_2_blocking_concave", -1)]
)
def test_tables_4_1_and_4_2(name, sign):
    cells = list(table(f"{name}.csv"))
    assert len(cells) == 36
    for angle, column, expected in cells:
        radius, depth = (float(part[1:]) for part in column.split("_"))
        rig = rig_with(angle=float(angle), distance=30.0, electrode=5.0)
        seen = trace(spherical_cap(2 * radius, sign * depth), rig)
        assert not seen.incident_blocked.any()
        found = "rb" if (seen.lit & seen.reflected_blocked).any() else "nb"
        assert (angle, column, found) == (angle, column, expected)


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


def test_a_tilted_plane_catches_the_same_rays():
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


def test_a_ray_that_runs_away_from_the_plane_makes_no_dot():
    behind = ImagingPlane.vertical(-50.0, 45.0, 3.0)
    seen = trace(mirror(), rig_with(plane=behind))
    assert seen.hit.all()
    assert np.isnan(seen.plane_mm).all()
    assert not seen.visible.any()


def test_dots_beyond_the_edges_are_not_visible():
    small = ImagingPlane.vertical(50.0, 45.0, 3.0, width_mm=50.0, height_mm=40.0)
    whole, cut = (trace(spherical_cap(6, 0.3), rig_with(plane=p)) for p in (None, small))
    x, z = whole.plane_mm[..., 0], whole.plane_mm[..., 1]
    np.testing.assert_array_equal(cut.visible, whole.visible & (x <= 50) & (z <= 40))
    assert whole.visible.sum() > cut.visible.sum() > 0


def test_rays_obey_the_law_of_reflection_on_a_disturbed_pool():
    pool = egg(7, 3, 4.4, 0.3, terms=(Dent(0.15, 0.6), LowRear(0.08)))
    seen = trace(pool, rig_with())
    point, hit = seen.point_mm[seen.hit], seen.hit
    x, y, z = point.T
    np.testing.assert_allclose(z, pool.height(x, y), atol=1e-9)
    slope = pool.gradient(x, y)
    bisector = seen.reflected[hit] - seen.incident[hit]
    np.testing.assert_allclose(-bisector[:, :2] / bisector[:, 2:], slope, atol=1e-9)
    laser = 31.48 * np.array([0, np.cos(np.radians(31.14)), np.sin(np.radians(31.14))])
    to_point = point - laser
    np.testing.assert_allclose(
        to_point / np.linalg.norm(to_point, axis=-1, keepdims=True), seen.incident[hit], atol=1e-9
    )


def walked_again(pool, seen, steps=20000):
    """Rays whose reflection comes under the pool, each followed by itself in tiny steps."""
    again = np.zeros(seen.hit.shape, bool)
    for ray in np.argwhere(seen.hit):
        t = np.linspace(0, 12, steps)[1:, None]
        way = seen.point_mm[tuple(ray)] + t * seen.reflected[tuple(ray)]
        again[tuple(ray)] = (pool.height(way[:, 0], way[:, 1]) > way[:, 2] + 1e-6).any()
    return again


def test_second_reflections_in_a_deep_hollow_are_told_and_make_no_dot():
    wide = DotPattern(inter_beam_angle_deg=1.0)
    for depth, some in ((-0.3, False), (-2.6, True)):
        pool = spherical_cap(6.0, depth)
        seen = trace(pool, rig_with(angle=50.0, pattern=wide))
        np.testing.assert_array_equal(seen.hits_again, walked_again(pool, seen))
        assert seen.hits_again.any() == some
        assert not (seen.visible & seen.hits_again).any()


def test_rays_leave_a_convex_pool_and_a_mirror_for_good():
    for pool in (mirror(), spherical_cap(8.0, 0.9), egg(7, 3, 4.4, 0.3)):
        assert not trace(pool, rig_with()).hits_again.any()


def test_the_first_of_several_meetings_counts():
    """A steep hill in front hides what lies behind it."""
    hill = Pool(Foot(8, 4, 4, (0, 0)), 2.5)
    seen = trace(hill, rig_with(angle=20.0))
    steps = np.linspace(0.5, 0.999, 400)[:, None, None, None]
    laser = 31.48 * np.array([0, np.cos(np.radians(20)), np.sin(np.radians(20))])
    on_the_way = laser + steps * (seen.point_mm - laser)
    ground = np.nan_to_num(hill.height(on_the_way[..., 0], on_the_way[..., 1]), nan=0.0)
    clear = on_the_way[..., 2] > ground
    assert clear[:, seen.hit].all()
    assert seen.point_mm[seen.hit][:, 1].min() > -2


@pytest.mark.parametrize("orientation", ["S/S", "S/I", "I/I"])
def test_exact_match_numbers_dots_as_the_conventions_do(orientation):
    rig = rig_with()
    match = exact_match(trace(spherical_cap(6, 0.3), rig), rig, orientation)
    i, j = match.ray.T
    k, t = match.reflected.T
    assert match.orientation == orientation
    assert (k.min(), t.min()) == (1, 1)
    row_sign = 1 if orientation[2] == "S" else -1
    column_sign = 1 if orientation[0] == "S" else -1
    assert len(set((i - row_sign * k).tolist())) == 1
    assert len(set((j - column_sign * t).tolist())) == 1


def test_exact_match_sees_the_orientation_of_the_28_caps():
    rig = rig_with()
    for pool in caps_8_3_1():
        match = exact_match(trace(pool, rig), rig)
        assert match.orientation == ("S/S" if pool.peak_mm > 0 else "I/I")


def test_witnesses_tell_who_came_back():
    rig = rig_with(electrode=5.0)
    seen = trace(spherical_cap(8, 0.8), rig)
    match = exact_match(seen, rig)
    assert {-1, 0, 1} == set(match.witness.flat)
    came, missed, silent = (match.witness == value for value in (1, -1, 0))
    np.testing.assert_array_equal(np.argwhere(came) + 1, match.ray)
    assert not seen.hit[missed].any()
    assert (seen.absent | (seen.hit & (seen.blocked | ~seen.on_plane)))[silent].all()


def test_exact_match_noise_has_the_covariance_it_claims():
    rig = rig_with()
    seen = trace(spherical_cap(8, 0.4), rig)
    clean = exact_match(seen, rig)
    rng = np.random.default_rng(3)
    errors = np.concatenate(
        [exact_match(seen, rig, None, 0.05, rng).plane_mm - clean.plane_mm for _ in range(20)]
    )
    match = exact_match(seen, rig, None, 0.05, rng)
    np.testing.assert_allclose(
        match.plane_covariance_mm2,
        0.0025 * np.ones((1, 1, 1)) * np.eye(2) + np.zeros((len(match.ray), 1, 1)),
    )
    np.testing.assert_allclose(np.cov(errors.T), 0.0025 * np.eye(2), atol=1.5e-4)
    with pytest.raises(ValueError, match="generator"):
        exact_match(seen, rig, sigma_mm=0.05)


def test_an_even_pattern_has_rays_on_both_sides_of_its_axis():
    rig = rig_with(pattern=DotPattern(rows=6, columns=4, absent=frozenset()))
    seen = trace(mirror(), rig)
    assert seen.visible.shape == (6, 4)
    np.testing.assert_allclose(seen.point_mm[:, 0, 0], -seen.point_mm[:, 3, 0], atol=1e-9)


def test_no_pool_no_dots():
    rig = rig_with()
    seen = trace(replace(spherical_cap(2, 0.1), footprint=Foot(2, 1, 1, (50, 50))), rig)
    assert not seen.hit.any()
    match = exact_match(seen, rig)
    assert match.ray.shape == (0, 2)
    assert match.plane_mm.shape == (0, 2)


def test_truth_never_comes_from_the_code_that_measures():
    """Of the core, what makes truth may use only the values that name a rig and a match.

    What analyses (chapters 4 and 8) may measure; nothing that makes truth knows it.
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
                found = [node.module]
            elif isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            else:
                continue
            waiting += [one for one in found if one not in used]
    core = {name for name in used if name.startswith("labapp.core")}
    assert {"labapp.simulation.recording", "labapp.simulation.render"} <= used
    assert "labapp.core.geometry.rig" in core
    assert core <= allowed


def test_rays_of_a_bench_that_is_nowhere_ideal_are_those_of_the_core():
    laser = Laser(31.14, 31.48, azimuth_deg=3.0, aim_x_mm=0.5, aim_y_mm=-0.7)
    plane = ImagingPlane.of_angles(np.array([-45.0, -50.0, 3.0]), (3.0, -4.0, 5.0))
    rig = Rig(laser, DotPattern(rotation_deg=2.0), Electrode(5.0), plane)
    seen = trace(spherical_cap(3.0, 0.3), rig)
    np.testing.assert_allclose(seen.incident, ray_directions(laser, rig.pattern), atol=1e-12)
    met = seen.hit
    away = seen.point_mm[met] - laser.position_mm
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    np.testing.assert_allclose(away, seen.incident[met], atol=1e-9)
    np.testing.assert_allclose(
        intersect_imaging_plane(seen.point_mm[met], seen.reflected[met], plane),
        seen.plane_mm[met],
        atol=1e-9,
    )
