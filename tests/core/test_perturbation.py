"""Perturbed benches: the effect of each quantity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.geometry.perturbation import (
    moved_bench,
    moved_dots,
    moved_rig,
    quantity_values,
)
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import (
    FIRST,
    INDEX,
    QUANTITIES,
    AxisPoints,
    RigUncertainty,
    covariance_of,
)

RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50, 45, 3))
AXES = AxisPoints(
    ImageCalibration.from_three_points((44, 590), (440, 590), 69.85, (44, 410), 31.75), 69.85, 31.75
)
LENS = Lens((700.0, 700.0), (240.0, 320.0), (-0.2, 0.03, 0.001, -0.001, 0.0))
DOTS = np.random.default_rng(5).uniform(5.0, 95.0, (30, 2))


def offset(**by: float) -> np.ndarray:
    vector = np.zeros(len(QUANTITIES))
    for name, value in by.items():
        (key,) = [key for key in INDEX if key.replace(".", "_") == name]
        vector[INDEX[key]] = value
    return vector


def test_every_quantity_moves_the_named_value():
    rig = moved_rig(
        RIG,
        offset(
            laser_distance_mm=0.5,
            laser_azimuth_deg=1.0,
            laser_aim_y_mm=-0.3,
            pattern_rotation_deg=2.0,
            pattern_inter_beam_angle_deg=0.01,
            imaging_plane_distance_mm=0.7,
            imaging_plane_s_mm=0.2,
            imaging_plane_h_mm=0.1,
            imaging_plane_roll_deg=0.6,
            imaging_plane_pitch_deg=-0.4,
            imaging_plane_glass_mm=0.3,
            imaging_plane_glass_index=0.02,
        ),
    )
    assert rig.imaging_plane.glass_mm == pytest.approx(0.3)
    assert rig.imaging_plane.glass_index == pytest.approx(1.52)
    assert rig.laser == Laser(31.14, 31.98, 1.0, 0.0, -0.3)
    assert rig.pattern.rotation_deg == 2.0
    assert rig.pattern.inter_beam_angle_deg == pytest.approx(0.78)
    np.testing.assert_allclose(rig.imaging_plane.origin_mm, [-45.2, -50.7, 3.1])
    assert rig.imaging_plane.angles_deg == pytest.approx((-0.4, 0.0, 0.6))
    assert moved_rig(RIG, offset()).imaging_plane is RIG.imaging_plane


@pytest.mark.parametrize("percent", [0.0, 0.8])
@pytest.mark.parametrize("lens", [None, LENS])
def test_dots_follow_the_image_calibration(lens: Lens | None, percent: float):
    """A dot is fixed in the picture; the moved bench's calibration maps it elsewhere."""
    before = replace(AXES.calibration, lens=lens).with_distortion(percent, np.array([50.8, 50.8]))
    axes = replace(AXES, calibration=before)
    rig = replace(RIG, uncertainty=RigUncertainty(axes, *covariance_of({})))
    offsets = {key: 30.0 for key in INDEX if key.endswith("px[u]")}
    offsets |= {"image_calibration.origin_px[v]": -2.0, "camera_lens.distortion_percent": 0.5}
    vector = np.zeros(len(QUANTITIES))
    vector[[INDEX[key] for key in offsets]] = list(offsets.values())
    moved = moved_dots(DOTS, rig, axes, vector)
    again = moved_bench(rig, vector)[1].to_plane(before.to_image(DOTS))
    np.testing.assert_allclose(moved, again, atol=1e-6)
    assert np.abs(moved - DOTS).max() > 0.3


def test_dots_scale_with_the_axis_points():
    offsets = offset(image_calibration_x_axis_mm=0.6985, image_calibration_z_axis_mm=-0.3175)
    np.testing.assert_allclose(moved_dots(DOTS, RIG, AXES, offsets), DOTS * [1.01, 0.99], rtol=1e-9)
    rig = replace(RIG, uncertainty=RigUncertainty(AXES, *covariance_of({})))
    changed = quantity_values(moved_bench(rig, offsets)[0]) - quantity_values(rig)
    np.testing.assert_allclose(changed, offsets, atol=1e-9)


def test_glass_index_is_uncertain_only_with_glass():
    sigmas = {"imaging_plane.glass_mm_sigma": 0.3}
    indices = [INDEX["imaging_plane.glass_mm"], INDEX["imaging_plane.glass_index"]]
    for has_glass, sigma in ((False, (0.3, 0.0)), (True, (0.3, 0.02))):
        covariance, assumed = covariance_of(sigmas, has_glass=has_glass)
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)[indices]), sigma)
        assert ("imaging_plane.glass_index" in assumed) == has_glass


def test_covariance_of_first_quantities_has_the_others_exact():
    before = RigUncertainty(AXES, covariance_of({})[0][:FIRST, :FIRST])
    assert before.covariance.shape == (len(QUANTITIES), len(QUANTITIES))
    assert not before.sigma[FIRST:].any()
    assert before.sigma[:FIRST].all()


def test_distortion_moves_the_corner_but_not_the_centre():
    offsets = offset(camera_lens_distortion_percent=1.0)
    corner, center = np.array([101.6, 101.6]), np.array([50.8, 50.8])
    moved = moved_dots(np.array([corner, center]), RIG, AXES, offsets)
    np.testing.assert_allclose(moved, [corner + 0.01 * center, center])


def test_angle_and_distance_of_the_laser_may_be_correlated():
    sigmas = {"laser.projection_angle_deg_sigma": 0.2, "laser.distance_mm_sigma": 0.4}
    covariance, assumed = covariance_of(sigmas, 0.5)
    assert covariance[0, 1] == covariance[1, 0] == pytest.approx(0.04)
    assert np.count_nonzero(covariance - np.diag(np.diag(covariance))) == 2
    assert len(assumed) == len(QUANTITIES) - 4  # these two, and no glass
