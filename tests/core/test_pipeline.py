"""The whole measurement on the sample run, by every scheme, and on frames that show nothing."""

from __future__ import annotations

import csv
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from labapp.config.setup import read_setup
from labapp.core.geometry.bench import Bench
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
def test_the_sample_run_is_measured_true(measurements: dict[int, Measurement]) -> None:
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
            off = getattr(size, f"{name}_mm") - true[f"{name}_mm"]
            assert abs(off) < 3.5 * getattr(size, f"{name}_sigma_mm")


def test_no_dot_of_the_sample_run_has_a_wrong_ray(measurements: dict[int, Measurement]) -> None:
    rows = [row for row in table("dots_truth.csv") if row["visible"]]
    labelled = shown = 0
    for index, result in measurements.items():
        mine = [row for row in rows if int(row["frame"]) == index]
        place = np.array([[row["u_px"], row["v_px"]] for row in mine])
        ray = np.array([[row["ray_row"], row["ray_column"]] for row in mine], int)
        assert result.match is not None
        assert result.dots is not None
        found = result.dots.image_px[result.match.dot]
        distance = np.linalg.norm(found[:, None] - place, axis=-1)
        nearest = np.argmin(distance, axis=1)
        assert distance.min(axis=1).max() < 2.0
        np.testing.assert_array_equal(result.match.ray, ray[nearest])
        labelled, shown = labelled + len(found), shown + len(mine)
    assert labelled >= 0.97 * shown


def test_reflection_points_lie_where_they_were(measurements: dict[int, Measurement]) -> None:
    truth = {
        (int(row["frame"]), int(row["ray_row"]), int(row["ray_column"])): row["z_mm"]
        for row in table("dots_truth.csv")
    }
    surprise = []
    for index, result in measurements.items():
        made = result.reconstruction
        assert made is not None
        true = np.array([truth[index, i, j] for i, j in made.ray.tolist()])
        surprise.append((made.points_mm[:, 2] - true) / made.sigma_mm)
    within = np.abs(np.concatenate(surprise)) < 1.96
    assert within.mean() > 0.85


def test_every_step_is_handed_on(measurements: dict[int, Measurement]) -> None:
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
def test_every_scheme_answers(measurements: dict[int, Measurement], settings: Settings) -> None:
    match = measurements[FRAMES[1]].match
    true = table("truth.csv")[FRAMES[1]]
    assert match is not None
    made = reconstruct(match, SETUP.rig, settings)
    assert made.scheme == settings.scheme
    width, length = np.ptp(made.boundary.points_mm[:, :2], axis=0)
    assert width == pytest.approx(true["width_mm"], rel=0.15)
    assert length == pytest.approx(true["length_mm"], rel=0.15)
    assert np.nanmax(made.points_mm[:, 2]) == pytest.approx(true["height_mm"], rel=0.5)


def test_the_algorithms_of_irs_are_different_ones(
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


def test_the_scheme_is_the_one_that_is_asked_for(
    images: dict[int, npt.NDArray[np.generic]], measurements: dict[int, Measurement]
) -> None:
    result = measure(images[FRAMES[1]], SETUP.bench, Settings(scheme="ers"))[0]
    assert result.status == "ok"
    assert result.scheme == "ers"
    assert result.reconstruction is not None
    assert result.reconstruction.scheme == "ers"
    assert result.measures is not None
    ours, other = measurements[FRAMES[1]], result
    assert ours.measures is not None
    assert ours.measures.are_mm < other.measures.are_mm
    # Up to the reconstruction nothing depends on the scheme, and nothing at all on chance.
    assert ours.match is not None
    assert other.match is not None
    for name in ("dot", "ray", "plane_mm", "witness"):
        np.testing.assert_array_equal(getattr(ours.match, name), getattr(other.match, name))
    assert ours.match.trials == other.match.trials
    again = reconstruct(other.match, SETUP.rig, Settings())
    assert_alike(measure_surface(again, other.match, SETUP.rig), ours.measures)


def test_a_correction_that_changes_nothing_changes_no_figure(
    images: dict[int, npt.NDArray[np.generic]], measurements: dict[int, Measurement]
) -> None:
    found = measurements[FRAMES[2]]
    assert found.lattice is not None
    correction = start_correction(found)
    assert correction.lattice.reference == found.lattice.reference
    dark = np.zeros_like(images[FRAMES[2]])  # of the image only the shape counts
    again = measure(dark, SETUP.bench, Settings(), correction=correction)[0]
    assert_alike(again.measures, found.measures)
    assert again.correction is correction
    assert start_correction(again) is correction
    assert again.lattice is not None
    np.testing.assert_array_equal(again.lattice.row, found.lattice.row)
    assert again.match is not None
    assert found.match is not None
    np.testing.assert_array_equal(again.match.witness, found.match.witness)


def test_a_false_dot_is_deleted_and_a_missing_one_added_by_hand(
    images: dict[int, npt.NDArray[np.generic]], measurements: dict[int, Measurement]
) -> None:
    index = FRAMES[0]
    found = measurements[index]
    assert found.match is not None
    assert found.dots is not None
    start = start_correction(found)
    # A dot in the middle, of all rays, is missed by the detector and a false one seen instead.
    one = int(found.match.dot[len(found.match.dot) // 2])
    ray = found.match.ray[len(found.match.dot) // 2].tolist()
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
    assert len(result.match.dot) == len(found.match.dot)
    assert result.match.ray[result.match.dot == last].tolist() == [ray]
    assert result.measures is not None
    assert found.measures is not None
    assert result.measures.height_mm == pytest.approx(found.measures.height_mm, rel=0.002)


def test_a_frame_that_was_refused_is_measured_with_its_reference_set() -> None:
    # The torch hides what is round the reference.
    pool = spherical_cap(5.5, 0.27)
    seen = see(pool, np.random.default_rng(2), sigma_px=0.1)
    hidden = (np.abs(seen.ray - [11, 10]) <= 1).all(axis=-1)
    dots = Dots(*(getattr(seen.dots, field.name)[~hidden] for field in fields(Dots)))
    ray = seen.ray[~hidden]
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


def test_a_hole_that_no_ray_confirmed_is_no_reference() -> None:
    dots = as_dots(np.mgrid[:4, :4].reshape(2, -1).T * 20.0)
    lattice = Lattice(np.arange(16) // 4 + 1, np.arange(16) % 4 + 1, (9, 9), ((9, 9),))
    refused = Measurement("no-match", "…", "fit", dots, lattice)
    assert start_correction(refused).lattice.reference is None
    assert len(start_correction(Measurement("no-dots", "…", "fit")).dots) == 0


def test_a_correction_without_dots_has_a_status() -> None:
    nothing = Correction.of(None, None)
    result = measure(np.zeros((640, 480)), SETUP.bench, Settings(), correction=nothing)[0]
    assert result.status == "too-few-dots"
    assert result.lattice is not None


def test_a_frame_is_left_as_it_was(images: dict[int, npt.NDArray[np.generic]]) -> None:
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
def test_a_frame_that_shows_nothing_has_a_status_and_a_reason(
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
def test_the_text_s_detectors_say_that_a_blank_frame_has_no_dots(method: str) -> None:
    settings = Settings(dots=DotSettings(method=method))
    result = measure(np.zeros((640, 480), np.uint8), SETUP.bench, settings)[0]
    assert result.status == "no-dots"


@pytest.mark.parametrize(
    "count",
    [1, 2, 3],
)
def test_a_frame_of_one_or_a_few_dots_is_answered(count: int) -> None:
    v, u = np.mgrid[:640, :480]
    frame = np.random.default_rng(0).normal(20.0, 1.0, u.shape)
    for k in range(count):
        frame += 80.0 * np.exp(-((u - 200 - 40 * k) ** 2 + (v - 300) ** 2) / 8.0)
    result = measure(frame, SETUP.bench, Settings())[0]
    assert result.status == "too-few-dots"
    assert result.reason


@pytest.mark.slow
def test_a_step_that_cannot_be_done_keeps_those_before_it(
    images: dict[int, npt.NDArray[np.generic]],
) -> None:
    half = images[FRAMES[0]].copy()
    half[: half.shape[0] * 7 // 10] = np.median(half)  # only the lowest dots are left
    result = measure(half, SETUP.bench, Settings())[0]
    assert result.status != "ok"
    assert result.reason
    assert result.dots is not None
    assert len(result.dots) > 3
    assert result.measures is None


def test_a_scheme_that_finds_no_surface_says_so(measurements: dict[int, Measurement]) -> None:
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
