"""L1, L2 and the plane distances of §4.2.1.1, against rays that are followed and the tables."""

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


def test_a_flat_pool_is_eq_4_14_to_4_16():
    rig = rig_with(angle=35.0, electrode=2.0, h=3.0)
    _, away, height = rig.laser.position_mm
    found = clearance(rig)
    assert found.l1_mm == pytest.approx(2 * away / (height - 2))
    assert found.l2_mm == pytest.approx(2 * away / (height + 2))
    assert found.least_plane_mm == pytest.approx(found.l2_mm * (3 - 2) / 2)
    assert found.most_plane_mm == pytest.approx(found.l2_mm * (104.6 - 2) / 2)
    assert clearance(rig_with(electrode=20.0)).l1_mm == np.inf
    assert clearance(rig_with(electrode=5.0)).least_plane_mm == 0.0


@given(
    angle=st.floats(15, 60),
    electrode=st.floats(1, 8),
    slope=st.floats(-12, 12),
)
def test_the_ray_reflected_at_l2_grazes_the_tip(angle, electrode, slope):
    rig = rig_with(angle=angle, electrode=electrode)
    l2 = clearance(rig, slope).l2_mm
    if not 0 < l2 < 0.99 * rig.laser.position_mm[1]:
        return  # the torch is never, or always, in the way
    point = np.array([0.0, l2, 0.0])
    normal = surface_normal(np.array([0.0, -np.tan(np.radians(slope))]))
    out = reflect(point - rig.laser.position_mm, normal)
    assert point[2] - point[1] / out[1] * out[2] == pytest.approx(electrode, rel=1e-6)


def test_a_convex_head_needs_more_room_and_a_concave_one_less():
    rig = rig_with()
    convex, flat, concave = (clearance(rig, slope).l2_mm for slope in (10, 0, -10))
    assert convex < flat < concave


@pytest.mark.parametrize(
    ("name", "sign"), [("table_4_1_blocking_convex", 1), ("table_4_2_blocking_concave", -1)]
)
@pytest.mark.slow
def test_where_tables_4_1_and_4_2_have_blocking_l2_is_too_short(name, sign):
    with (DATA / f"{name}.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            angle = float(line.pop("projection_angle_deg"))
            for column, expected in line.items():
                radius, depth = (float(part[1:]) for part in column.split("_"))
                view = side_view(rig_with(angle=angle), 2 * radius, 2 * radius, sign * depth)
                blocked = view.tally[Fate.BLOCKED] > 0
                assert (angle, column, blocked) == (angle, column, expected == "rb")
                # The pool's very edge need not carry a ray: too short an L2 blocks at most.
                if blocked:
                    assert view.clearance.l2_mm < radius


def test_the_steepest_ray_meets_the_plane_between_the_two_distances():
    rig = rig_with(electrode=2.0, size=40.0)
    found = clearance(rig)
    point = np.array([0.0, found.l2_mm, 0.0])
    out = reflect(point - rig.laser.position_mm, np.array([0.0, 0.0, 1.0]))
    for distance, edge in ((found.least_plane_mm, 3.0), (found.most_plane_mm, 43.0)):
        reach = (-distance - point[1]) / out[1]
        assert point[2] + reach * out[2] == pytest.approx(edge)


def test_the_side_view_is_the_central_column_of_the_whole():
    rig = rig_with(angle=31.14, distance=31.48)
    view = side_view(rig, 5.0, 6.0, 0.5)
    whole = trace(ellipsoidal_cap(5.0, 6.0, 0.5), rig)
    assert len(view.rays) == 18  # the centre ray is never made
    for ray in view.rays:
        i = ray.row - 1
        assert (ray.fate is Fate.CAUGHT) == whole.visible[i, 9]
        if ray.fate is not Fate.UNUSED:
            np.testing.assert_allclose(ray.path_mm[1], whole.point_mm[i, 9, 1:])
            end = rig.imaging_plane.to_universal(whole.plane_mm[i, 9])
            np.testing.assert_allclose(ray.path_mm[2], end[1:])
        else:
            assert ray.path_mm[1, 1] == pytest.approx(0.0)
    assert sum(view.tally.values()) == 360
    assert view.tally[Fate.CAUGHT] == whole.visible.sum()
    np.testing.assert_allclose(view.plane_mm, [[-50.0, 3.0], [-50.0, 104.6]])


def test_a_pool_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="overhang"):
        side_view(rig_with(), 2.0, 6.0, 3.0)
