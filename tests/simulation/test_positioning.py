"""L1, L2 and the plane distances of §4.2.1.1, compared with traced rays and the tables."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.optics import reflect, surface_normal
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.simulation.forward import trace
from labapp.simulation.pools import ellipsoidal_cap
from labapp.simulation.positioning import Fate, clearance, side_view

DATA = Path(__file__).parents[1] / "data"


def rig_with(angle=30.0, distance=30.0, electrode=5.0, plane=50.0, h=3.0, size=101.6):
    return Rig(
        Laser(angle, distance),
        DotPattern(),
        Electrode(electrode),
        ImagingPlane.vertical(plane, 50.8, h, size, size),
    )


def test_flat_pool_agrees_with_eq_4_14_to_4_16():
    rig = rig_with(angle=35.0, electrode=2.0, h=3.0)
    _, horizontal, height = rig.laser.position_mm
    limits = clearance(rig)
    assert limits.l1_mm == pytest.approx(2 * horizontal / (height - 2))
    assert limits.l2_mm == pytest.approx(2 * horizontal / (height + 2))
    assert limits.least_plane_mm == pytest.approx(limits.l2_mm * (3 - 2) / 2)
    assert limits.most_plane_mm == pytest.approx(limits.l2_mm * (104.6 - 2) / 2)
    assert clearance(rig_with(electrode=20.0)).l1_mm == np.inf
    assert clearance(rig_with(electrode=5.0)).least_plane_mm == 0.0


@given(
    angle=st.floats(15, 60),
    electrode=st.floats(1, 8),
    slope=st.floats(-12, 12),
)
def test_ray_reflected_at_l2_grazes_the_tip(angle, electrode, slope):
    rig = rig_with(angle=angle, electrode=electrode)
    l2 = clearance(rig, slope).l2_mm
    if not 0 < l2 < 0.99 * rig.laser.position_mm[1]:
        return  # the torch blocks no ray, or every ray
    point = np.array([0.0, l2, 0.0])
    normal = surface_normal(np.array([0.0, -np.tan(np.radians(slope))]))
    out = reflect(point - rig.laser.position_mm, normal)
    assert point[2] - point[1] / out[1] * out[2] == pytest.approx(electrode, rel=1e-6)


def test_convex_head_has_a_shorter_l2_and_a_concave_one_a_longer():
    rig = rig_with()
    convex, flat, concave = (clearance(rig, slope).l2_mm for slope in (10, 0, -10))
    assert convex < flat < concave


@pytest.mark.parametrize(
    ("name", "sign"), [("table_4_1_blocking_convex", 1), ("table_4_2_blocking_concave", -1)]
)
@pytest.mark.slow
def test_l2_is_too_short_where_tables_4_1_and_4_2_have_blocking(name, sign):
    with (DATA / f"{name}.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            angle = float(line.pop("projection_angle_deg"))
            for column, expected in line.items():
                radius, depth = (float(part[1:]) for part in column.split("_"))
                view = side_view(rig_with(angle=angle), 2 * radius, 2 * radius, sign * depth)
                blocked = view.tally[Fate.BLOCKED] > 0
                assert (angle, column, blocked) == (angle, column, expected == "rb")
                # No ray need meet the very edge: a short L2 does not imply blocking.
                if blocked:
                    assert view.clearance.l2_mm < radius


def test_ray_at_l2_meets_the_plane_edges_at_the_two_distances():
    rig = rig_with(electrode=2.0, size=40.0)
    limits = clearance(rig)
    point = np.array([0.0, limits.l2_mm, 0.0])
    out = reflect(point - rig.laser.position_mm, np.array([0.0, 0.0, 1.0]))
    for distance, edge in ((limits.least_plane_mm, 3.0), (limits.most_plane_mm, 43.0)):
        reach = (-distance - point[1]) / out[1]
        assert point[2] + reach * out[2] == pytest.approx(edge)


def test_side_view_is_the_central_column_of_the_trace():
    rig = rig_with(angle=31.14, distance=31.48)
    view = side_view(rig, 5.0, 6.0, 0.5)
    reflections = trace(ellipsoidal_cap(5.0, 6.0, 0.5), rig)
    assert len(view.rays) == 18  # the centre ray is absent
    for ray in view.rays:
        i = ray.row - 1
        assert (ray.fate is Fate.CAUGHT) == reflections.visible[i, 9]
        if ray.fate is not Fate.UNUSED:
            np.testing.assert_allclose(ray.path_mm[1], reflections.point_mm[i, 9, 1:])
            end = rig.imaging_plane.to_universal(reflections.plane_mm[i, 9])
            np.testing.assert_allclose(ray.path_mm[2], end[1:])
        else:
            assert ray.path_mm[1, 1] == pytest.approx(0.0)
    assert sum(view.tally.values()) == 360
    assert view.tally[Fate.CAUGHT] == reflections.visible.sum()
    np.testing.assert_allclose(view.plane_mm, [[-50.0, 3.0], [-50.0, 104.6]])


def test_impossible_pool_is_rejected():
    with pytest.raises(ValueError, match="overhang"):
        side_view(rig_with(), 2.0, 6.0, 3.0)
