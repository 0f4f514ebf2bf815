"""The check of the setup by the residuals of recordings, with right and wrong setups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.bench_check.adjustment import System
from labapp.core.bench_check.forecast import expected_sighting
from labapp.core.bench_check.mirrors import Cap, Plate
from labapp.core.geometry.perturbation import directions, moved_calibration, moved_rig
from labapp.core.geometry.rig import ImagingPlane
from labapp.core.geometry.uncertainty import (
    INDEX,
    QUANTITIES,
    AxisPoints,
    RigUncertainty,
    covariance_of,
)
from labapp.core.match import Match
from labapp.core.pipeline import Measurement
from labapp.core.recording.residual_check import MOST, ResidualRecord
from labapp.core.schemes import fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.simulation.forward import trace
from labapp.simulation.pools import egg
from tests.oscillation import Oscillation
from tests.scenes import BENCH_RIG, BENCH_VIEW

KNOWN = RigUncertainty(AxisPoints(BENCH_VIEW, 69.85, 31.75), *covariance_of({}))
RIG = replace(BENCH_RIG, uncertainty=KNOWN)
EXACT = replace(BENCH_RIG, uncertainty=None)


CENTER_MM = np.array([50.8, 50.8])


def bent(plane_mm, by_percent, center_mm):
    """Return dots seen through a lens with distortion around a centre."""
    offset = plane_mm - center_mm
    relative = np.sum(offset**2, axis=-1, keepdims=True) / np.sum(CENTER_MM**2)
    return plane_mm + by_percent / 100.0 * relative * offset


def frames(truth, count=8, seed=0, noise_mm=0.02, growth=0.0, lens=lambda plane_mm: plane_mm):
    """Yield frames of an oscillating pool on a true bench, fitted with the assumed one."""
    rng = np.random.default_rng(seed)
    for n in range(count):
        scale = 1.0 + growth * n / count
        swing = Oscillation(0.012, 22.0, n / 60.0)
        pool = egg(6.6 * scale, 3.0 * scale, 4.2 * scale, 0.29 * scale, (0.0, -0.6), (swing,))
        reflections = trace(pool, truth)
        ray = np.argwhere(reflections.visible) + 1
        dots = lens(reflections.plane_mm[reflections.visible]) + rng.normal(
            0, noise_mm, (len(ray), 2)
        )
        ray_states = np.where(
            reflections.visible, 1, np.where(reflections.lit | reflections.absent, 0, -1)
        )
        covariance = np.broadcast_to(noise_mm**2 * np.eye(2), (len(ray), 2, 2))
        index = np.arange(len(ray))
        match = Match("S/S", index, ray, np.zeros_like(ray), dots, covariance, ray_states)
        reconstruction = fit.reconstruct(match, EXACT, FitSettings())
        yield Measurement("ok", "", "fit", match=match, reconstruction=reconstruction)


def verdict_of(measured, rig=RIG):
    record = ResidualRecord(rig)
    for one in measured:
        record.add(one)
    return record.verdict()


@pytest.mark.parametrize("seed", range(3))
def test_right_setup_is_not_doubted(seed):
    assert not verdict_of(frames(BENCH_RIG, seed=seed)).is_doubtful


def test_rolled_plane_is_doubted_and_named():
    plane = BENCH_RIG.imaging_plane
    rolled = ImagingPlane.of_angles(plane.origin_mm, (0, 0, 3.5), plane.width_mm, plane.height_mm)
    verdict = verdict_of(frames(replace(BENCH_RIG, imaging_plane=rolled)))
    assert verdict.is_doubtful
    roll = next(one for one in verdict.suspects if "roll" in one.name)
    assert roll.off == pytest.approx(3.5, abs=0.8)


def test_error_within_its_uncertainty_is_not_doubted():
    plane = BENCH_RIG.imaging_plane
    rolled = ImagingPlane.of_angles(plane.origin_mm, (0, 0, 0.4), plane.width_mm, plane.height_mm)
    assert not verdict_of(frames(replace(BENCH_RIG, imaging_plane=rolled))).is_doubtful


@pytest.fixture(scope="module")
def checked():
    """Return the bench with its uncertainty after a check with a plate and a thumb tack."""
    sightings = [expected_sighting(mirror, RIG) for mirror in (Plate(0.0), Cap(9.75, 0.91))]
    system = System.of(RIG, sightings, None)
    covariance = system.adjustment(np.zeros(system.size), 1.0).covariance
    return replace(RIG, uncertainty=replace(KNOWN, covariance=covariance))


WRONG = {
    "laser.projection_angle_deg": 0.7,
    "laser.distance_mm": 1.0,
    "laser.azimuth_deg": 0.05,
    "laser.aim_x_mm": 0.05,
    "laser.aim_y_mm": 0.5,
    "pattern.inter_beam_angle_deg": 0.01,
    "pattern.rotation_deg": 0.1,
    "imaging_plane.distance_mm": 0.5,
    "imaging_plane.s_mm": 0.05,
    "imaging_plane.h_mm": 0.5,
    "imaging_plane.yaw_deg": 0.4,
    "imaging_plane.roll_deg": 0.5,
    "imaging_plane.glass_mm": 1.3,
    "image_calibration.z_axis_px[v]": 7.0,
    "image_calibration.z_axis_mm": 1.5,
    "camera_lens.distortion_percent": 1.3,
    "picture.u": 0.25,
    "picture.v": 2.5,
    "picture.scale": 0.1,
}
"""Errors of quantities that are found on a checked bench, in their units: at least twice those in
the table of `docs/method.md`."""


@pytest.mark.slow
@pytest.mark.parametrize("key", WRONG)
def test_each_wrong_quantity_is_named_on_a_checked_bench(key, checked):
    direction = next(direction for direction in directions(RIG) if direction.key == key)
    offset = WRONG[key] * direction.vector
    camera = moved_calibration(KNOWN.axes, RIG.imaging_plane, offset)

    def seen(plane_mm):
        return BENCH_VIEW.to_plane(camera.to_image(plane_mm))

    verdict = verdict_of(frames(moved_rig(BENCH_RIG, offset), lens=seen), checked)
    assert verdict.is_doubtful
    named = next(suspect for suspect in verdict.suspects if suspect.name == direction.name)
    assert not named.is_drift
    assert abs(named.off - WRONG[key]) < 4 * named.sigma


@pytest.mark.parametrize("pitch_deg", [10.0, -8.0])
def test_pitch_far_off_is_named_alone(checked, pitch_deg):
    """An error within its assumed ± leaves small residuals; a gross one is found."""
    plane = BENCH_RIG.imaging_plane
    size = plane.width_mm, plane.height_mm
    pitched = ImagingPlane.of_angles(plane.origin_mm, (pitch_deg, 0.0, 0.0), *size)
    verdict = verdict_of(frames(replace(BENCH_RIG, imaging_plane=pitched)), checked)
    assert verdict.is_doubtful
    assert [one.name for one in verdict.suspects if not one.is_drift] == ["imaging plane, pitch"]


def test_reason_names_all_indistinguishable_quantities(checked):
    higher = moved_rig(BENCH_RIG, 0.5 * np.eye(len(QUANTITIES))[INDEX["imaging_plane.h_mm"]])
    verdict = verdict_of(frames(higher), checked)
    assert len(verdict.suspects) > 4
    assert all(one.name in verdict.reason for one in verdict.suspects)


def test_off_centre_lens_distortion_is_not_doubted():
    """A checked bench knows the amount of distortion, but not its centre."""
    calibration = BENCH_VIEW.with_distortion(1.0, CENTER_MM)
    sigma = {one.sigma_key: 0.02 * one.assumed for one in QUANTITIES}
    known = RigUncertainty(AxisPoints(calibration, 69.85, 31.75), *covariance_of(sigma))

    def left(plane_mm):
        """Return dots with the distortion that remains after the check adjusted the calibration."""
        remainder = bent(plane_mm, 1.0, CENTER_MM) - bent(plane_mm, 1.0, CENTER_MM - [22.0, 5.0])
        ones = np.column_stack([plane_mm, np.ones(len(plane_mm))])
        return plane_mm + remainder - ones @ np.linalg.lstsq(ones, remainder, rcond=None)[0]

    verdict = verdict_of(frames(BENCH_RIG, lens=left), replace(BENCH_RIG, uncertainty=known))
    assert not verdict.is_doubtful


def test_too_few_frames_give_no_verdict():
    verdict = verdict_of(frames(BENCH_RIG, count=3))
    assert not verdict.is_doubtful
    assert "too few" in verdict.reason


@pytest.mark.parametrize(("lost", "doubtful"), [(19, True), (10, False)])
def test_many_unmatched_frames_are_doubted(lost, doubtful):
    unmatched = Measurement("no-match", "", "fit")
    good = next(iter(frames(BENCH_RIG, count=1)))
    assert verdict_of([unmatched] * lost + [good] * (20 - lost)).is_doubtful == doubtful


@pytest.mark.parametrize("status", ["no-reference", "ambiguous-rows", "no-rows"])
def test_frames_without_a_reference_are_not_doubted(status):
    """They also occur with the right setup, for instance if the pool is beside the absent ray."""
    good = next(iter(frames(BENCH_RIG, count=1)))
    assert not verdict_of([Measurement(status, "", "fit")] * 30).is_doubtful
    assert not verdict_of([Measurement(status, "", "fit")] * 29 + [good]).is_doubtful
    unmatched = [Measurement("no-match", "", "fit")] * 12
    assert verdict_of([Measurement(status, "", "fit")] * 30 + unmatched).is_doubtful


def test_dark_frames_are_not_doubted():
    assert not verdict_of([Measurement("no-dots", "", "fit")] * 30).is_doubtful


def test_long_recordings_are_thinned_evenly():
    record, one = ResidualRecord(RIG), next(iter(frames(BENCH_RIG, count=1)))
    for _ in range(500):
        record.add(one)
    assert MOST / 2 <= len(record._samples) <= MOST


def test_slipped_laser_is_doubted_as_a_drift():
    slipped = replace(BENCH_RIG, laser=replace(BENCH_RIG.laser, azimuth_deg=0.15))
    verdict = verdict_of([*frames(BENCH_RIG), *frames(slipped, seed=1)])
    assert verdict.is_doubtful
    assert verdict.suspects[0].is_drift
    azimuth = next(one for one in verdict.suspects if "azimuth" in one.name)
    assert azimuth.off == pytest.approx(0.15, abs=0.04)


def test_setup_status_becomes_doubtful_once_known():
    slipped = replace(BENCH_RIG, laser=replace(BENCH_RIG.laser, azimuth_deg=0.15))
    record = ResidualRecord(RIG)
    entered = [replace(one, setup_status="entered") for one in frames(BENCH_RIG)]
    later = [replace(one, setup_status="entered") for one in frames(slipped, count=16, seed=1)]
    assert {record.add_and_judge(one).setup_status for one in entered} == {"entered"}
    assert record.doubt == ""
    assert [record.add_and_judge(one).setup_status for one in later][-1] == "doubtful"
    assert record.doubt


def test_growing_pool_is_no_drift():
    assert not verdict_of(frames(BENCH_RIG, count=12, growth=0.07)).is_doubtful
