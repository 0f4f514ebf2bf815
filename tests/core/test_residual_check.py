"""What the residuals of recordings say of the set-up: right ones, and such that are off."""

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
from labapp.simulation.pools import Oscillation, egg
from tests.scenes import BENCH_RIG, BENCH_VIEW

KNOWN = RigUncertainty(AxisPoints(BENCH_VIEW, 69.85, 31.75), *covariance_of({}))
RIG = replace(BENCH_RIG, uncertainty=KNOWN)
EXACT = replace(BENCH_RIG, uncertainty=None)


CENTER_MM = np.array([50.8, 50.8])


def bent(plane_mm, by_percent, center_mm):
    """Dots seen through a lens whose distortion has a centre."""
    out = plane_mm - center_mm
    square = np.sum(out**2, axis=-1, keepdims=True) / np.sum(CENTER_MM**2)
    return plane_mm + by_percent / 100.0 * square * out


def frames(truth, count=8, seed=0, noise_mm=0.02, growth=0.0, lens=lambda plane_mm: plane_mm):
    """Frames of a pool that swings, seen on a bench, and fitted on what it is taken for."""
    rng = np.random.default_rng(seed)
    for n in range(count):
        by = 1.0 + growth * n / count
        swing = Oscillation(0.012, 22.0, n / 60.0)
        pool = egg(6.6 * by, 3.0 * by, 4.2 * by, 0.29 * by, (0.0, -0.6), (swing,))
        seen = trace(pool, truth)
        ray = np.argwhere(seen.visible) + 1
        dots = lens(seen.plane_mm[seen.visible]) + rng.normal(0, noise_mm, (len(ray), 2))
        witness = np.where(seen.visible, 1, np.where(seen.lit | seen.absent, 0, -1))
        covariance = np.broadcast_to(noise_mm**2 * np.eye(2), (len(ray), 2, 2))
        index = np.arange(len(ray))
        match = Match("S/S", index, ray, np.zeros_like(ray), dots, covariance, witness)
        made = fit.reconstruct(match, EXACT, FitSettings())
        yield Measurement("ok", "", "fit", match=match, reconstruction=made)


def verdict_of(measured, rig=RIG):
    record = ResidualRecord(rig)
    for one in measured:
        record.add(one)
    return record.verdict()


@pytest.mark.parametrize("seed", range(3))
def test_right_set_up_is_not_doubted(seed):
    assert not verdict_of(frames(BENCH_RIG, seed=seed)).is_doubtful


def test_rolled_plane_is_doubted_and_named():
    plane = BENCH_RIG.imaging_plane
    rolled = ImagingPlane.of_angles(plane.origin_mm, (0, 0, 3.5), plane.width_mm, plane.height_mm)
    found = verdict_of(frames(replace(BENCH_RIG, imaging_plane=rolled)))
    assert found.is_doubtful
    roll = next(one for one in found.suspects if "roll" in one.name)
    assert roll.off == pytest.approx(3.5, abs=0.8)


def test_error_that_is_not_off_by_more_than_known_is_not_doubted():
    plane = BENCH_RIG.imaging_plane
    rolled = ImagingPlane.of_angles(plane.origin_mm, (0, 0, 0.4), plane.width_mm, plane.height_mm)
    assert not verdict_of(frames(replace(BENCH_RIG, imaging_plane=rolled))).is_doubtful


@pytest.fixture(scope="module")
def checked():
    """The bench as it is known after a check with a plate and a thumb tack."""
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
"""How far quantities are off that are found on a checked bench, twice what the table of
`docs/method.md` has or a little more, in their units."""


@pytest.mark.slow
@pytest.mark.parametrize("key", WRONG)
def test_every_quantity_that_is_off_is_named_on_a_checked_bench(key, checked):
    one = next(one for one in directions(RIG) if one.key == key)
    offset = WRONG[key] * one.vector
    camera = moved_calibration(KNOWN.axes, RIG.imaging_plane, offset)

    def seen(plane_mm):
        return BENCH_VIEW.to_plane(camera.to_image(plane_mm))

    found = verdict_of(frames(moved_rig(BENCH_RIG, offset), lens=seen), checked)
    assert found.is_doubtful
    own = next(suspect for suspect in found.suspects if suspect.name == one.name)
    assert not own.is_drift
    assert abs(own.off - WRONG[key]) < 4 * own.sigma


@pytest.mark.parametrize("pitch_deg", [10.0, -8.0])
def test_pitch_far_off_is_named_alone(checked, pitch_deg):
    """It leaves little for its assumed ±, and enough for a gross error."""
    plane = BENCH_RIG.imaging_plane
    size = plane.width_mm, plane.height_mm
    pitched = ImagingPlane.of_angles(plane.origin_mm, (pitch_deg, 0.0, 0.0), *size)
    found = verdict_of(frames(replace(BENCH_RIG, imaging_plane=pitched)), checked)
    assert found.is_doubtful
    assert [one.name for one in found.suspects if not one.is_drift] == ["imaging plane, pitch"]


def test_reason_names_all_quantities_that_residuals_cannot_tell_apart(checked):
    higher = moved_rig(BENCH_RIG, 0.5 * np.eye(len(QUANTITIES))[INDEX["imaging_plane.h_mm"]])
    found = verdict_of(frames(higher), checked)
    assert len(found.suspects) > 4
    assert all(one.name in found.reason for one in found.suspects)


def test_lens_that_looks_beside_the_plane_s_middle_is_no_doubt():
    """A checked bench knows how much its picture is distorted, and not about which centre."""
    calibration = BENCH_VIEW.with_distortion(1.0, CENTER_MM)
    sigma = {one.sigma_key: 0.02 * one.assumed for one in QUANTITIES}
    known = RigUncertainty(AxisPoints(calibration, 69.85, 31.75), *covariance_of(sigma))

    def left(plane_mm):
        """What is left of the distortion, the check has moved the image calibration's points."""
        off = bent(plane_mm, 1.0, CENTER_MM) - bent(plane_mm, 1.0, CENTER_MM - [22.0, 5.0])
        ones = np.column_stack([plane_mm, np.ones(len(plane_mm))])
        return plane_mm + off - ones @ np.linalg.lstsq(ones, off, rcond=None)[0]

    found = verdict_of(frames(BENCH_RIG, lens=left), replace(BENCH_RIG, uncertainty=known))
    assert not found.is_doubtful


def test_few_frames_say_nothing():
    found = verdict_of(frames(BENCH_RIG, count=3))
    assert not found.is_doubtful
    assert "too few" in found.reason


@pytest.mark.parametrize(("lost", "doubtful"), [(19, True), (10, False)])
def test_frames_that_match_nothing_are_a_doubt(lost, doubtful):
    none = Measurement("no-match", "", "fit")
    some = next(iter(frames(BENCH_RIG, count=1)))
    assert verdict_of([none] * lost + [some] * (20 - lost)).is_doubtful == doubtful


@pytest.mark.parametrize("status", ["no-reference", "ambiguous-rows", "no-rows"])
def test_frames_that_lack_the_absent_dot_are_no_doubt(status):
    """The right set-up gives these, too: the pool lies beside the absent ray, say."""
    some = next(iter(frames(BENCH_RIG, count=1)))
    assert not verdict_of([Measurement(status, "", "fit")] * 30).is_doubtful
    assert not verdict_of([Measurement(status, "", "fit")] * 29 + [some]).is_doubtful
    none = [Measurement("no-match", "", "fit")] * 12
    assert verdict_of([Measurement(status, "", "fit")] * 30 + none).is_doubtful


def test_dark_frames_are_no_doubt_of_the_set_up():
    assert not verdict_of([Measurement("no-dots", "", "fit")] * 30).is_doubtful


def test_long_recordings_are_thinned_evenly():
    record, one = ResidualRecord(RIG), next(iter(frames(BENCH_RIG, count=1)))
    for _ in range(500):
        record.add(one)
    assert MOST / 2 <= len(record._samples) <= MOST


def test_laser_that_slips_is_doubted_as_a_drift():
    slipped = replace(BENCH_RIG, laser=replace(BENCH_RIG.laser, azimuth_deg=0.15))
    found = verdict_of([*frames(BENCH_RIG), *frames(slipped, seed=1)])
    assert found.is_doubtful
    assert found.suspects[0].is_drift
    azimuth = next(one for one in found.suspects if "azimuth" in one.name)
    assert azimuth.off == pytest.approx(0.15, abs=0.04)


def test_what_is_sent_has_the_doubt_once_it_is_known():
    slipped = replace(BENCH_RIG, laser=replace(BENCH_RIG.laser, azimuth_deg=0.15))
    record = ResidualRecord(RIG)
    entered = [replace(one, setup_status="entered") for one in frames(BENCH_RIG)]
    later = [replace(one, setup_status="entered") for one in frames(slipped, count=16, seed=1)]
    assert {record.judged(one).setup_status for one in entered} == {"entered"}
    assert record.doubt == ""
    assert [record.judged(one).setup_status for one in later][-1] == "doubtful"
    assert record.doubt


def test_pool_that_grows_is_no_drift():
    assert not verdict_of(frames(BENCH_RIG, count=12, growth=0.07)).is_doubtful
