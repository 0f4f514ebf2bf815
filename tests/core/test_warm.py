"""Frames followed from the previous one agree with independent ones and have no wrong ray."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from labapp.core import pipeline
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from labapp.core.images.band_pass import quick_dots
from labapp.core.images.dots import BandPassSettings, Dots, Image
from labapp.core.images.peaks import DetectorTuning
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.recording.chain import WarmChain
from labapp.core.sequence.prior import DROP_EVERY
from labapp.core.values import FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import LowRear, Wave, egg
from labapp.simulation.recording import RecordedFrame, Recording
from labapp.simulation.render import Look
from tests.same import assert_same

RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50.0, 45.0, 3.0))
VIEW = CameraView((44.0, 590.0), (242.02, 590.0), 34.925, (44.0, 499.99), 15.875)
CALIBRATION = ImageCalibration.from_three_points(
    VIEW.origin_px, VIEW.x_axis_px, VIEW.x_axis_mm, VIEW.z_axis_px, VIEW.z_axis_mm
)
BENCH = Bench(RIG, CALIBRATION)
RATE_HZ, WAVE_HZ = 200.0, 31.0
FRAMES, WARMED = 18, 16
TRUE_PX = 2.5


@cache
def frames() -> tuple[RecordedFrame, ...]:
    """Return frames of an oscillating pool: dots at its rim move by up to 2 columns per frame."""
    pool = egg(6.66, 3.0, 4.4, 0.29, (0.0, -0.6), terms=(Wave((0, 1), 0.03, WAVE_HZ),))
    pools = tuple(pool.after(n / RATE_HZ) for n in range(FRAMES))
    look = Look(hot_pixels=2, missing=0.01)
    recording = Recording(
        file="recording.avi", rig=RIG, view=VIEW, look=look, pools=pools, seed=61,
        frame_rate_hz=RATE_HZ,
    )  # fmt: skip
    return tuple(recording.frame(n) for n in range(FRAMES))


@dataclass(frozen=True)
class Run:
    """A chain after `WARMED` frames, and its results."""

    chain: WarmChain
    measurements: tuple[Measurement, ...]
    track_lost: tuple[str | None, ...]


@cache
def warmed() -> Run:
    chain = WarmChain(BENCH, Settings())
    measurements, track_lost = [], []
    for frame in frames()[:WARMED]:
        measurements.append(chain.measure(frame.image))
        track_lost.append(chain.track_lost)
    return Run(chain, tuple(measurements), tuple(track_lost))


def chain() -> WarmChain:
    return copy.copy(warmed().chain)


def wrong_rays(result: Measurement, frame: RecordedFrame, shift_px: float = 0.0) -> int:
    """Return the number of dots which are not at the true dot of their ray."""
    if result.match is None or result.dots is None:
        return 0
    true = frame.dot_px + np.array([shift_px, 0.0])
    i, j = result.match.ray.T - 1
    error = np.linalg.norm(result.dots.image_px[result.match.dot] - true[i, j], axis=-1)
    return int(np.sum(~(error < TRUE_PX)))


def with_dots(image: FloatArray, positions: FloatArray, peak: float = 50.0) -> FloatArray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    light = image.astype(float)
    for position in positions:
        light += peak * np.exp(-((u - position[0]) ** 2 + (v - position[1]) ** 2) / (2 * 1.8**2))
    return np.clip(light, 0, 255).astype(np.uint8)


def without_dots(image: FloatArray, positions: FloatArray) -> FloatArray:
    dark = image.copy()
    rng = np.random.default_rng(7)
    for u, v in np.rint(positions).astype(int):
        patch = dark[v - 6 : v + 7, u - 6 : u + 7]
        patch[:] = np.clip(rng.normal(np.quantile(patch, 0.2), 1.5, patch.shape), 0, 255)
    return dark


def test_all_frames_after_the_first_are_followed() -> None:
    run = warmed()
    assert run.track_lost[0] is not None
    assert [reason for reason in run.track_lost[1:] if reason] == []
    for result, frame in zip(run.measurements, frames(), strict=False):
        assert result.status == "ok"
        assert wrong_rays(result, frame) == 0
        assert result.match is not None
        assert len(result.match.ray) >= 0.97 * frame.shown.sum()


def test_sizes_are_within_their_uncertainty() -> None:
    for name in ("width", "length", "height"):
        normalized_errors = []
        for result, frame in zip(warmed().measurements, frames(), strict=False):
            assert result.measures is not None
            error = getattr(result.measures, f"{name}_mm") - getattr(frame.pool.size, f"{name}_mm")
            normalized_errors.append(error / getattr(result.measures, f"{name}_sigma_mm"))
        assert np.abs(normalized_errors).max() < 4.0
        assert 0.2 < np.sqrt(np.mean(np.square(normalized_errors))) < 2.0


def test_uncertain_depth_of_the_rear_counts_in_followed_frames() -> None:
    pools = (egg(6.0, 2.8, 3.6, 0.28, terms=(LowRear(0.07),)),) * 2
    recording = Recording(
        file="recording.avi", rig=RIG, view=VIEW, look=Look(), pools=pools, seed=62
    )
    first, prior = measure(recording.frame(0).image, BENCH, Settings())
    followed, _ = measure(recording.frame(1).image, BENCH, Settings(), prior)
    assert first.measures is not None
    assert followed.measures is not None
    sigma = first.measures.length_sigma_level_mm
    assert sigma > 1.5 * first.measures.width_sigma_level_mm
    assert followed.measures.length_sigma_level_mm == pytest.approx(sigma, rel=0.3)


@pytest.mark.parametrize("ray", [(9, 16), (9, 2)])
def test_missing_dot_at_the_rim_is_not_taken_for_a_low_rear(ray: tuple[int, int]) -> None:
    pool = egg(6.0, 3.0, 3.0, 0.3)
    recording = Recording(
        file="recording.avi", rig=RIG, view=VIEW, look=Look(), pools=(pool, pool), seed=62
    )
    _, prior = measure(recording.frame(0).image, BENCH, Settings())
    assert prior is not None
    frame = recording.frame(1)
    image = without_dots(frame.image, frame.dot_px[ray][None])
    found, after = measure(image, BENCH, Settings(), replace(prior, count=DROP_EVERY - 1))
    assert found.measures is not None
    assert after is not None
    assert after.level.rear.drop_mm == 0.0
    error = found.measures.height_mm - pool.size.height_mm
    assert abs(error) < 2 * found.measures.height_sigma_mm


@pytest.mark.parametrize("number", [2, 9])
def test_followed_frame_agrees_with_an_independent_measurement(number: int) -> None:
    warm = warmed().measurements[number]
    cold = measure(frames()[number].image, BENCH, Settings())[0]
    assert cold.match is not None
    assert warm.match is not None
    assert cold.measures is not None
    assert warm.measures is not None
    assert warm.match.orientation == cold.match.orientation
    warm_index = {tuple(ray): k for k, ray in enumerate(warm.match.ray.tolist())}
    both = [
        (warm_index[r], k)
        for k, r in enumerate(map(tuple, cold.match.ray.tolist()))
        if r in warm_index
    ]
    assert len(both) >= 0.97 * len(cold.match.ray)
    assert warm.reconstruction is not None
    assert cold.reconstruction is not None
    in_warm, in_cold = np.array(both).T
    difference = (
        warm.reconstruction.points_mm[in_warm, 2] - cold.reconstruction.points_mm[in_cold, 2]
    )
    # The knots may differ, which matters by a few µm at the rim.
    normalized = difference / cold.reconstruction.sigma_mm[in_cold]
    assert np.sqrt(np.mean(normalized**2)) < 1.0
    assert np.abs(normalized).max() < 2.0
    np.testing.assert_allclose(
        warm.reconstruction.sigma_mm[in_warm], cold.reconstruction.sigma_mm[in_cold], rtol=0.4
    )
    for name in ("width_mm", "length_mm", "height_mm", "area_mm2", "volume_mm3"):
        sigma = name.replace("_mm", "_sigma_mm")
        warm_sizes, cold_sizes = warm.measures, cold.measures
        assert abs(getattr(warm_sizes, name) - getattr(cold_sizes, name)) < getattr(
            cold_sizes, sigma
        )
        assert getattr(warm_sizes, sigma) == pytest.approx(getattr(cold_sizes, sigma), rel=0.4)
    # Centroids over more of each dot are less affected by speckle.
    assert 0.6 < warm.measures.are_mm / cold.measures.are_mm < 1.1
    assert warm.lattice is not None
    assert cold.lattice is not None
    assert warm.lattice.reference is not None
    row = warm.lattice.row[warm.match.dot[in_warm]] - cold.lattice.row[cold.match.dot[in_cold]]
    assert (row == row[0]).all()


def test_following_is_reproducible() -> None:
    one, other = chain(), chain()
    for frame in frames()[WARMED:]:
        first, second = one.measure(frame.image), other.measure(frame.image)
        assert_same(first.measures, second.measures)


def test_missing_and_false_dots_get_no_ray() -> None:
    frame, follower = frames()[WARMED], chain()
    missing = frame.dot_px[[9, 9, 11], [5, 13, 8]]
    image = without_dots(frame.image, missing)
    image = with_dots(image, missing[:1] + np.array([6.0, 14.0]))
    result = follower.measure(image)
    assert follower.track_lost is None
    assert wrong_rays(result, frame) == 0
    assert result.match is not None
    rays = {tuple(ray) for ray in result.match.ray.tolist()}
    assert not rays & {(10, 6), (10, 14), (12, 9)}
    assert len(rays) >= frame.shown.sum() - 6


def places_apart(frame: RecordedFrame, count: int) -> FloatArray:
    """Random places in the picture that are away from its dots, shape (count, 2), px."""
    places = np.random.default_rng(5).uniform((20.0, 20.0), (460.0, 620.0), (200, 2))
    from_dots = places[:, None] - frame.dot_px[frame.shown]
    return places[np.linalg.norm(from_dots, axis=-1).min(axis=1) > 15.0][:count]


def test_frame_with_isolated_false_dots_is_followed() -> None:
    """Once such a frame lost the track and took twenty times as long, with the same result."""
    frame, follower = frames()[WARMED], chain()
    result = follower.measure(with_dots(frame.image, places_apart(frame, 10)))
    assert follower.track_lost is None
    assert wrong_rays(result, frame) == 0
    assert result.match is not None
    assert len(result.match.ray) >= 0.97 * frame.shown.sum()


def test_row_of_dots_without_rays_breaks_the_track() -> None:
    frame, follower = frames()[WARMED], chain()
    last = np.flatnonzero(frame.shown.any(axis=1))[-1]
    columns = frame.shown[last]
    beyond = 2 * frame.dot_px[last, columns] - frame.dot_px[last - 1, columns]
    assert len(beyond) >= 4
    follower.measure(with_dots(frame.image, np.vstack([beyond, places_apart(frame, 5)])))
    assert follower.track_lost is not None


@pytest.mark.parametrize("beside", [(5.0, 0.0), (0.0, 5.0)])
def test_dot_merged_with_a_false_one_gets_no_ray(
    beside: tuple[float, float],
) -> None:
    frame, follower = frames()[WARMED], chain()
    image = with_dots(frame.image, frame.dot_px[8, 8][None] + beside)
    followed, cold = follower.measure(image), measure(image, BENCH, Settings())[0]
    assert follower.track_lost is None
    for result in (followed, cold):
        assert wrong_rays(result, frame) == 0
        assert result.match is not None
        rays = {tuple(ray) for ray in result.match.ray.tolist()}
        assert (9, 9) not in rays
        assert {(8, 9), (10, 9), (9, 8)} <= rays


@pytest.mark.slow
def test_dot_at_the_absent_ray_breaks_the_track() -> None:
    frame, follower = frames()[WARMED], chain()
    hole = frame.dot_px[9, 8:11:2].mean(axis=0)
    result = follower.measure(with_dots(frame.image, hole[None]))
    assert follower.track_lost is not None
    assert "absent" in follower.track_lost
    assert wrong_rays(result, frame) == 0


@pytest.mark.slow
def test_shift_by_a_column_gives_no_wrong_rays() -> None:
    frame, follower = frames()[WARMED], chain()
    step = round(float(np.nanmedian(np.diff(frame.dot_px[9, 5:14, 0]))))
    result = follower.measure(np.roll(frame.image, step, axis=1))
    assert follower.track_lost is not None
    assert wrong_rays(result, frame, shift_px=step) == 0


@pytest.mark.parametrize("way", [-1, 1])
@pytest.mark.slow
def test_pool_that_moves_by_a_row_gives_no_wrong_rays(way: int) -> None:
    """The dot that would reveal it, at the former absent ray, is missing."""
    prior = chain()._prior
    assert prior is not None
    step = way * BENCH.rays.spacing_mm[1]
    for k, share in enumerate(np.linspace(0.6, 1.4, 17).tolist()):
        pool = egg(6.66, 3.0, 4.4, 0.29, (0.0, -0.6 + share * step))
        recording = Recording(
            file="recording.avi", rig=RIG, view=VIEW, look=Look(), pools=(pool,), seed=8000 + k,
            frame_rate_hz=RATE_HZ,
        )  # fmt: skip
        frame = recording.frame(0)
        image = without_dots(frame.image, frame.dot_px[[9 + way], [9]])
        result, _ = measure(image, BENCH, Settings(), prior)
        assert wrong_rays(result, frame) == 0


def test_another_pool_with_as_many_rays_starts_a_new_track() -> None:
    """The splines differ, so that cached results of the first pool cannot be used."""
    follower = WarmChain(BENCH, Settings())
    for number, pool in enumerate(
        [
            (5.57, 3.04, 3.73, 0.27, (-0.66, -0.39)),
            *[(6.17, 2.56, 3.21, 0.27, (1.06, -0.12))] * 2,
        ]
    ):
        recording = Recording(
            file="recording.avi", rig=RIG, view=VIEW, look=Look(), pools=(egg(*pool),),
            seed=10 + number, frame_rate_hz=RATE_HZ,
        )  # fmt: skip
        frame = recording.frame(0)
        result = follower.measure(frame.image)
        assert result.status == "ok"
        assert wrong_rays(result, frame) == 0
        if number == 1:
            assert follower.track_lost is not None
    assert follower.track_lost is None


@cache
def frame_of_another_pool() -> RecordedFrame:
    other = egg(5.6, 2.6, 3.4, 0.2, (0.3, -0.2))
    recording = Recording(
        file="recording.avi", rig=RIG, view=VIEW, look=Look(), pools=(other,), seed=62,
        frame_rate_hz=RATE_HZ,
    )  # fmt: skip
    return recording.frame(0)


def test_pool_that_jumps_is_measured_again() -> None:
    frame, follower = frame_of_another_pool(), chain()
    result = follower.measure(frame.image)
    assert wrong_rays(result, frame) == 0
    if result.measures is not None:
        error = result.measures.height_mm - frame.pool.size.height_mm
        assert abs(error) < 4 * result.measures.height_sigma_mm


def test_dots_found_ahead_give_the_same_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a frame measured without a prior they are found again, with its tuning."""
    jumped, (before, after) = frame_of_another_pool(), frames()[WARMED:]
    images = [before.image, jumped.image, after.image]
    follower, ahead = chain(), chain()
    expected = [follower.measure(image).measures for image in images]
    found_again = []

    def detect(image: Image, tuning: DetectorTuning, settings: BandPassSettings) -> Dots:
        found_again.append(image)
        return quick_dots(image, tuning, settings)

    monkeypatch.setattr(pipeline, "quick_dots", detect)
    ahead.look_ahead(images)
    for image, measures in zip(images, expected, strict=True):
        assert_same(ahead.measure(image).measures, measures)
    assert [image is after.image for image in found_again] == [True]


def test_following_resumes_after_a_lost_frame() -> None:
    follower = chain()
    dark = np.full_like(frames()[0].image, 20)
    assert follower.track(dark) is None
    assert follower.track_lost is not None
    result = follower.track(frames()[WARMED].image)
    assert result is not None
    assert follower.track_lost is None
    assert wrong_rays(result, frames()[WARMED]) == 0


def test_track_continues_after_a_frame_without_dots() -> None:
    follower = chain()
    dark = np.full_like(frames()[0].image, 18)
    assert follower.measure(dark).status == "no-dots"
    assert follower.track_lost is not None
    frame = frames()[WARMED + 1]
    result = follower.measure(frame.image)
    assert follower.track_lost is None
    assert wrong_rays(result, frame) == 0


@pytest.mark.slow
def test_another_scheme_is_never_followed() -> None:
    follower = WarmChain(BENCH, Settings(scheme="ers"))
    for frame in frames()[:2]:
        result = follower.measure(frame.image)
        assert follower.track_lost is not None
        assert result.scheme == "ers"


@pytest.mark.slow
def test_setup_part_of_sigma_is_updated_as_a_pool_grows():
    axes = AxisPoints(CALIBRATION, VIEW.x_axis_mm, VIEW.z_axis_mm)
    covariance, assumed = covariance_of({})
    rig = replace(RIG, uncertainty=RigUncertainty(axes, covariance, assumed))
    pools = tuple(egg(6.4, 2.9, 3.9, height, (0.0, -0.4)) for height in np.linspace(0.18, 0.34, 20))
    recording = Recording(
        file="recording.avi", rig=rig, view=VIEW, look=Look(), pools=pools, seed=5,
        frame_rate_hz=RATE_HZ,
    )  # fmt: skip
    chain, bench = WarmChain(Bench(rig, CALIBRATION), Settings()), Bench(rig, CALIBRATION)
    last = None
    for n in range(len(pools)):
        last = chain.measure(recording.frame(n).image)
    assert last is not None
    assert chain.track_lost is None
    cold = measure(recording.frame(len(pools) - 1).image, bench, Settings())[0]
    assert last.measures is not None
    assert cold.measures is not None
    for name in ("height_sigma_setup_mm", "volume_sigma_setup_mm3"):
        assert getattr(last.measures, name) == pytest.approx(getattr(cold.measures, name), rel=0.25)
