"""The complete measurement of the sample run, by every scheme, and of frames without dots."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from labapp.config.setup import read_setup
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.dots import Dots
from labapp.core.images.find_dots import DotSettings
from labapp.core.pipeline import (
    Measurement,
    Settings,
    measure,
    reconstruct,
    start_correction,
)
from labapp.core.rows.correction import Correction, add_dot, assign, delete_dots, set_reference
from labapp.core.rows.lattice import Lattice
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, FloatArray
from labapp.media import open_source
from labapp.simulation.pools import spherical_cap
from tests.same import assert_alike
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, as_dots, see

SAMPLE = Path(__file__).parents[2] / "sample_sessions" / "gtaw"
FRAMES = (0, 7, 14, 21, 28)
SETUP = read_setup(SAMPLE / "setup.toml")
Row = dict[str, float]


def table(name: str) -> list[Row]:
    with (SAMPLE / name).open(encoding="utf-8", newline="") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def images() -> dict[int, npt.NDArray[np.generic]]:
    with open_source(SAMPLE / "recording.avi") as source:
        assert len(source) == 30
        return {index: source.frame(index).image for index in FRAMES}


@pytest.fixture(scope="module")
def measurements(images: dict[int, npt.NDArray[np.generic]]) -> dict[int, Measurement]:
    return {index: measure(image, SETUP.bench, Settings())[0] for index, image in images.items()}


@pytest.mark.slow
def test_sizes_of_the_sample_run_are_accurate(measurements: dict[int, Measurement]) -> None:
    truth = {int(row["frame"]): row for row in table("truth.csv")}
    for index, result in measurements.items():
        assert (result.status, result.reason) == ("ok", "")
        size, true = result.measures, truth[index]
        assert size is not None
        assert size.height_mm == pytest.approx(true["height_mm"], rel=0.03)
        assert size.width_mm == pytest.approx(true["width_mm"], rel=0.02)
        assert size.length_mm == pytest.approx(true["length_mm"], rel=0.02)
        assert size.area_mm2 == pytest.approx(true["area_mm2"], rel=0.04)
        assert size.volume_mm3 == pytest.approx(true["volume_mm3"], rel=0.08)
        for name in ("height", "width", "length"):
            error = getattr(size, f"{name}_mm") - true[f"{name}_mm"]
            assert abs(error) < 3.5 * getattr(size, f"{name}_sigma_mm")


def test_no_dot_of_the_sample_run_has_a_wrong_ray(measurements: dict[int, Measurement]) -> None:
    rows = [row for row in table("dots_truth.csv") if row["visible"]]
    labelled = shown = 0
    for index, result in measurements.items():
        in_frame = [row for row in rows if int(row["frame"]) == index]
        true_px = np.array([[row["u_px"], row["v_px"]] for row in in_frame])
        ray = np.array([[row["ray_row"], row["ray_column"]] for row in in_frame], int)
        assert result.match is not None
        assert result.dots is not None
        labelled_px = result.dots.image_px[result.match.dot]
        distance = np.linalg.norm(labelled_px[:, None] - true_px, axis=-1)
        nearest = np.argmin(distance, axis=1)
        assert distance.min(axis=1).max() < 2.0
        np.testing.assert_array_equal(result.match.ray, ray[nearest])
        labelled, shown = labelled + len(labelled_px), shown + len(in_frame)
    assert labelled >= 0.97 * shown


def test_reflection_points_are_within_their_uncertainty(
    measurements: dict[int, Measurement],
) -> None:
    truth = {
        (int(row["frame"]), int(row["ray_row"]), int(row["ray_column"])): row["z_mm"]
        for row in table("dots_truth.csv")
    }
    normalized_errors = []
    for index, result in measurements.items():
        reconstruction = result.reconstruction
        assert reconstruction is not None
        true = np.array([truth[index, i, j] for i, j in reconstruction.ray.tolist()])
        normalized_errors.append((reconstruction.points_mm[:, 2] - true) / reconstruction.sigma_mm)
    within = np.abs(np.concatenate(normalized_errors)) < 1.96
    assert within.mean() > 0.85


def test_measurement_contains_the_result_of_every_step(
    measurements: dict[int, Measurement],
) -> None:
    result = measurements[FRAMES[0]]
    assert result.dots is not None
    assert result.lattice is not None
    assert result.match is not None
    assert result.reconstruction is not None
    indexed = np.flatnonzero(result.lattice.row > 0)
    np.testing.assert_array_equal(indexed, np.sort(result.match.dot))
    assert result.scheme == result.reconstruction.scheme == "fit"
    np.testing.assert_array_equal(result.reconstruction.ray, result.match.ray)


@pytest.mark.parametrize(
    "settings",
    [
        Settings(scheme="ers"),
        *[Settings(scheme="irs", algorithm=a) for a in ("opa", "epa-r", "epa-c", "epa-rc")],
    ],
    ids=["ers", "opa", "epa-r", "epa-c", "epa-rc"],
)
def test_every_scheme_reconstructs_the_pool(
    measurements: dict[int, Measurement], settings: Settings
) -> None:
    match = measurements[FRAMES[1]].match
    true = table("truth.csv")[FRAMES[1]]
    assert match is not None
    reconstruction = reconstruct(match, SETUP.rig, settings)
    assert reconstruction.scheme == settings.scheme
    width, length = np.ptp(reconstruction.boundary.points_mm[:, :2], axis=0)
    assert width == pytest.approx(true["width_mm"], rel=0.15)
    assert length == pytest.approx(true["length_mm"], rel=0.15)
    assert np.nanmax(reconstruction.points_mm[:, 2]) == pytest.approx(true["height_mm"], rel=0.5)


def test_irs_algorithms_give_different_heights(
    measurements: dict[int, Measurement],
) -> None:
    match = measurements[FRAMES[1]].match
    assert match is not None
    heights = [
        reconstruct(match, SETUP.rig, Settings(scheme="irs", algorithm=a)).points_mm[:, 2]
        for a in ("opa", "epa-r", "epa-c", "epa-rc")
    ]
    for k, one in enumerate(heights):
        assert all(np.abs(one - other).max() > 1e-6 for other in heights[k + 1 :])


def test_measure_uses_the_scheme_of_the_settings(
    images: dict[int, npt.NDArray[np.generic]], measurements: dict[int, Measurement]
) -> None:
    result = measure(images[FRAMES[1]], SETUP.bench, Settings(scheme="ers"))[0]
    assert result.status == "ok"
    assert result.scheme == "ers"
    assert result.reconstruction is not None
    assert result.reconstruction.scheme == "ers"
    assert result.measures is not None
    default, other = measurements[FRAMES[1]], result
    assert default.measures is not None
    assert default.measures.are_mm < other.measures.are_mm
    # Up to the reconstruction nothing depends on the scheme; all results are reproducible.
    assert default.match is not None
    assert other.match is not None
    for name in ("dot", "ray", "plane_mm", "ray_states"):
        np.testing.assert_array_equal(getattr(default.match, name), getattr(other.match, name))
    assert default.match.trials == other.match.trials
    again = reconstruct(other.match, SETUP.rig, Settings())
    assert_alike(measure_surface(again, other.match, SETUP.rig), default.measures)


def test_unchanged_correction_changes_no_figure(
    images: dict[int, npt.NDArray[np.generic]], measurements: dict[int, Measurement]
) -> None:
    original = measurements[FRAMES[2]]
    assert original.lattice is not None
    correction = start_correction(original)
    assert correction.lattice.reference == original.lattice.reference
    blank = np.zeros_like(images[FRAMES[2]])  # only the image's shape matters
    again = measure(blank, SETUP.bench, Settings(), correction=correction)[0]
    assert_alike(again.measures, original.measures)
    assert again.correction is correction
    assert start_correction(again) is correction
    assert again.lattice is not None
    np.testing.assert_array_equal(again.lattice.row, original.lattice.row)
    assert again.match is not None
    assert original.match is not None
    np.testing.assert_array_equal(again.match.ray_states, original.match.ray_states)


def test_false_dot_is_deleted_and_missing_one_added_manually(
    images: dict[int, npt.NDArray[np.generic]], measurements: dict[int, Measurement]
) -> None:
    index = FRAMES[0]
    original = measurements[index]
    assert original.match is not None
    assert original.dots is not None
    start = start_correction(original)
    # The detector misses a dot in the middle and finds a false one instead.
    one = int(original.match.dot[len(original.match.dot) // 2])
    ray = original.match.ray[len(original.match.dot) // 2].tolist()
    (true,) = (
        (row["u_px"], row["v_px"])
        for row in table("dots_truth.csv")
        if [row["frame"], row["ray_row"], row["ray_column"]] == [index, *ray]
    )
    worse = add_dot(delete_dots(start, [one]), images[index], true[0] + 30.0, true[1] + 17.0)
    site = int(start.lattice.row[one]), int(start.lattice.column[one])
    better = add_dot(
        delete_dots(worse, [len(worse.dots) - 1]), images[index], true[0] + 2.0, true[1] - 2.0
    )
    last = len(better.dots) - 1
    assert np.linalg.norm(better.dots.image_px[last] - true) < 0.3
    better = assign(better, [last], *site)
    assert np.flatnonzero(better.manual).tolist() == [last]
    result = measure(images[index], SETUP.bench, Settings(), correction=better)[0]
    assert result.status == "ok"
    assert result.match is not None
    assert len(result.match.dot) == len(original.match.dot)
    assert result.match.ray[result.match.dot == last].tolist() == [ray]
    assert result.measures is not None
    assert original.measures is not None
    assert result.measures.height_mm == pytest.approx(original.measures.height_mm, rel=0.002)


def test_setting_the_reference_makes_a_frame_measurable() -> None:
    # The torch hides the dots around the reference.
    pool = spherical_cap(5.5, 0.27)
    scene = see(pool, np.random.default_rng(2), sigma_px=0.1)
    hidden = (np.abs(scene.ray - [11, 10]) <= 1).all(axis=-1)
    dots = Dots(*(getattr(scene.dots, field.name)[~hidden] for field in fields(Dots)))
    ray = scene.ray[~hidden]
    lattice = grow_lattice(dots, GrowSettings())
    offset = (np.stack([lattice.row, lattice.column], axis=-1) - ray)[lattice.row > 0]
    assert (offset == offset[0]).all()
    k, t = (offset[0] + 10).tolist()
    result = measure(
        np.zeros(FRAME_SHAPE),
        Bench(BENCH_RIG, BENCH_VIEW),
        Settings(),
        correction=set_reference(Correction.of(dots, replace(lattice, reference=None)), (k, t)),
    )[0]
    assert (result.status, result.reason) == ("ok", "")
    assert result.match is not None
    np.testing.assert_array_equal(result.match.ray, ray[result.match.dot])
    assert result.measures is not None
    assert result.measures.height_mm == pytest.approx(0.27, rel=0.03)
    assert result.measures.width_mm == pytest.approx(5.5, rel=0.02)


def test_unconfirmed_hole_is_not_kept_as_reference() -> None:
    dots = as_dots(np.mgrid[:4, :4].reshape(2, -1).T * 20.0)
    lattice = Lattice(np.arange(16) // 4 + 1, np.arange(16) % 4 + 1, (9, 9), ((9, 9),))
    rejected = Measurement("no-match", "…", "fit", dots, lattice)
    assert start_correction(rejected).lattice.reference is None
    assert len(start_correction(Measurement("no-dots", "…", "fit")).dots) == 0


def test_correction_without_dots_has_a_status() -> None:
    empty = Correction.of(None, None)
    result = measure(np.zeros((640, 480)), SETUP.bench, Settings(), correction=empty)[0]
    assert result.status == "too-few-dots"
    assert result.lattice is not None


def test_measure_does_not_modify_the_frame(images: dict[int, npt.NDArray[np.generic]]) -> None:
    image = images[FRAMES[0]][:400].astype(np.float32)
    image.flags.writeable = False
    before = image.copy()
    measure(image, SETUP.bench, Settings())
    np.testing.assert_array_equal(image, before)


def noise(seed: int) -> FloatArray:
    return np.random.default_rng(seed).normal(40.0, 5.0, (240, 320))


@pytest.mark.parametrize("scheme", ["fit", "ers", "irs"])
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((640, 480), np.uint8),
        np.full((640, 480), 255, np.uint8),
        np.zeros((1, 1), np.uint8),
        np.zeros((1, 500), np.uint16),
        noise(1),
        np.clip(noise(2), 0, 255).astype(np.uint8),
    ],
    ids=["black", "white", "1x1", "one line", "noise", "8-bit noise"],
)
def test_frame_without_dots_has_a_status_and_a_reason(
    image: npt.NDArray[np.generic], scheme: str
) -> None:
    result = measure(image, SETUP.bench, Settings(scheme=scheme))[0]
    assert result.status != "ok"
    assert " " not in result.status
    assert result.reason
    assert result.scheme == scheme
    assert result.reconstruction is None
    assert result.measures is None


@pytest.mark.parametrize("method", ["block-threshold", "wavelet"])
def test_other_detectors_report_no_dots_in_a_blank_frame(method: str) -> None:
    settings = Settings(dots=DotSettings(method=method))
    result = measure(np.zeros((640, 480), np.uint8), SETUP.bench, settings)[0]
    assert result.status == "no-dots"


@pytest.mark.parametrize(
    "count",
    [1, 2, 3],
)
def test_frame_with_few_dots_has_status_too_few_dots(count: int) -> None:
    v, u = np.mgrid[:640, :480]
    frame = np.random.default_rng(0).normal(20.0, 1.0, u.shape)
    for k in range(count):
        frame += 80.0 * np.exp(-((u - 200 - 40 * k) ** 2 + (v - 300) ** 2) / 8.0)
    result = measure(frame, SETUP.bench, Settings())[0]
    assert result.status == "too-few-dots"
    assert result.reason


@pytest.mark.parametrize(
    "turn", [np.fliplr, np.flipud, np.transpose], ids=lambda turn: turn.__name__
)
def test_frame_of_a_mirrored_camera_can_be_corrected(
    images: dict[int, npt.NDArray[np.generic]],
    measurements: dict[int, Measurement],
    turn: Callable[[FloatArray], FloatArray],
) -> None:
    """Rows of a frame without a match are numbered as those of others: on the imaging plane."""
    image, usual = images[FRAMES[0]].astype(float), measurements[FRAMES[0]]
    assert usual.lattice is not None
    assert usual.dots is not None
    assert usual.lattice.reference is not None
    k, t = usual.lattice.reference
    beside = (usual.lattice.row == k) & (abs(usual.lattice.column - t) == 1)
    hole_px = usual.dots.image_px[beside].mean(axis=0)
    v, u = np.indices(image.shape).astype(float)
    false = 60.0 * np.exp(-((u - hole_px[0]) ** 2 + (v - hole_px[1]) ** 2) / 8.0)
    # The place in the usual picture of the first pixels of the other one.
    places = np.stack([turn(u), turn(v)], axis=-1)
    origin, on_u, on_v = places[0, 0], places[0, 1], places[1, 0]
    to_usual = np.eye(3)
    to_usual[:2] = np.stack([on_u - origin, on_v - origin, origin], axis=-1)
    bench = Bench(SETUP.rig, ImageCalibration(SETUP.calibration.matrix @ to_usual))
    refused = measure(turn(image + false), bench, Settings())[0]
    assert refused.status == "no-reference"
    start = start_correction(refused)
    at_px = np.linalg.solve(to_usual[:2, :2], hole_px - origin)
    nearest = int(np.argmin(np.linalg.norm(start.dots.image_px - at_px, axis=-1)))
    corrected = measure(turn(image), bench, Settings(), correction=delete_dots(start, [nearest]))[0]
    assert corrected.status == "ok"
    assert corrected.match is not None
    assert corrected.match.orientation == "S/S"
    assert corrected.measures is not None
    assert usual.measures is not None
    assert corrected.measures.height_mm == pytest.approx(usual.measures.height_mm, rel=0.002)


@pytest.mark.slow
def test_failed_step_keeps_the_results_of_earlier_steps(
    images: dict[int, npt.NDArray[np.generic]],
) -> None:
    half = images[FRAMES[0]].copy()
    half[: half.shape[0] * 7 // 10] = np.median(half)  # only the lowest dots remain
    result = measure(half, SETUP.bench, Settings())[0]
    assert result.status != "ok"
    assert result.reason
    assert result.dots is not None
    assert len(result.dots) > 3
    assert result.measures is None


def test_scheme_raises_too_few_dots(measurements: dict[int, Measurement]) -> None:
    match = measurements[FRAMES[0]].match
    assert match is not None
    few = replace(
        match,
        dot=match.dot[:4],
        ray=match.ray[:4],
        reflected=match.reflected[:4],
        plane_mm=match.plane_mm[:4],
        plane_covariance_mm2=match.plane_covariance_mm2[:4],
    )
    for scheme in ("fit", "ers", "irs"):
        with pytest.raises(CannotMeasure, match="too-few-dots"):
            reconstruct(few, SETUP.rig, Settings(scheme=scheme))
