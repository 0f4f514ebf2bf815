from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings, measure, start_correction
from labapp.core.rows.correction import block_row, set_reference
from labapp.media import open_source
from labapp.simulation.recording import TARGET
from labapp.simulation.torch import ConeTorch
from tests.samples.__main__ import main
from tests.samples.lines import line_samples
from tests.samples.runs import (
    BENT_MM,
    blocked_rows,
    concave,
    gtaw,
    samples,
    thumb_tack,
)

FOLDER = Path(__file__).parents[2] / "sample_sessions"

every_sample = pytest.mark.parametrize("sample", samples(), ids=lambda sample: sample.name)


def rows(name, file="truth.csv"):
    with (FOLDER / name / file).open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def column(name, key):
    return np.array([float(row[key]) for row in rows(name)])


def recorded(sample, index):
    with open_source(FOLDER / sample.name / sample.file) as source:
        return source.frame(index).image


def measured(sample, index, correction=None):
    setup = read_setup(FOLDER / sample.name / "setup.toml")
    image = recorded(sample, index)
    return measure(image, setup.bench, Settings(), correction=correction)[0]


def same_picture(computed, committed):
    """Whether pictures are equal, except for rounding on another processor or library."""
    difference = np.abs(computed.astype(int) - committed.astype(int))
    return difference.max() <= 1 and (difference > 0).mean() < 1e-3


# --- the committed files are those the program makes ------------------------------------------


@every_sample
@pytest.mark.slow
def test_recording_is_reproduced_by_the_program(sample):
    with open_source(FOLDER / sample.name / sample.file) as source:
        assert len(source) == len(sample.pools)
        assert source.frame_rate_hz == sample.frame_rate_hz
        assert source.shape == (sample.view.height_px, sample.view.width_px)
        for index in (1, len(source) - 1):
            committed, computed = source.frame(index).image, sample.frame(index).image
            assert committed.dtype == computed.dtype
            assert same_picture(computed, committed)
            assert not same_picture(computed, source.frame(0).image)


@every_sample
@pytest.mark.slow
def test_pictures_and_texts_are_reproduced_by_the_program(sample):
    folder = FOLDER / sample.name
    committed = cv2.imread(str(folder / "calibration.png"), cv2.IMREAD_UNCHANGED)
    assert same_picture(sample.calibration_picture(), committed)
    assert (folder / "setup.toml").read_text(encoding="utf-8") == sample.setup()
    assert (folder / "README.md").read_text(encoding="utf-8") == sample.readme()


@every_sample
def test_truth_is_that_of_the_pools(sample):
    truth = rows(sample.name)
    assert [row["frame"] for row in truth] == [str(n) for n in range(len(sample.pools))]
    for n, (row, pool) in enumerate(zip(truth, sample.pools, strict=True)):
        size = pool.size
        for key in ("width_mm", "length_mm", "height_mm", "depth_mm"):
            assert float(row[key]) == pytest.approx(getattr(size, key), abs=2e-5)
        peak = np.array([float(row["peak_x_mm"]), float(row["peak_y_mm"])])
        assert abs(pool.height(*peak)) == pytest.approx(
            max(size.height_mm, -size.depth_mm), abs=2e-5
        )
        rate = sample.frame_rate_hz
        assert row["time_s"] == ("" if rate is None else f"{n / rate:.5f}")


@every_sample
@pytest.mark.slow
def test_dots_truth_is_that_of_the_rays(sample):
    index = len(sample.pools) - 1
    frame = sample.frame(index)
    truth = [row for row in rows(sample.name, "dots_truth.csv") if row["frame"] == str(index)]
    rays = np.array([[int(row["ray_row"]), int(row["ray_column"])] for row in truth]) - 1
    np.testing.assert_array_equal(rays, np.argwhere(frame.reflections.lit))
    shown = np.array([row["visible"] == "1" for row in truth])
    np.testing.assert_array_equal(shown, frame.shown[tuple(rays.T)])
    assert shown.sum() == int(rows(sample.name)[index]["dots"])
    dots = np.array([[float(row["u_px"]), float(row["v_px"])] for row in truth])
    np.testing.assert_allclose(dots, frame.dot_px[tuple(rays.T)], atol=2e-3)
    points = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in truth])
    np.testing.assert_allclose(points[:, 2], frame.pool.height(*points[:, :2].T), atol=5e-5)


@every_sample
def test_dots_truth_agrees_with_the_picture(sample):
    truth = [row for row in rows(sample.name, "dots_truth.csv") if row["frame"] == "2"]
    image = cv2.GaussianBlur(recorded(sample, 2).astype(float), (0, 0), 1.5) / sample.exposures
    shown = np.array([row["visible"] == "1" for row in truth])
    dots = np.array([[float(row["u_px"]), float(row["v_px"])] for row in truth])
    light = image[tuple(np.rint(dots[shown][:, ::-1]).astype(int).T)]
    assert shown.sum() > 60
    # Relative to the whole frame, as the concave pool's dots are close together.
    assert np.mean(light > np.median(image) + 8) == 1.0
    assert ("10", "10") not in {(row["ray_row"], row["ray_column"]) for row in truth}


@every_sample
@pytest.mark.slow
def test_written_recording_is_lossless_and_complete(sample, tmp_path):
    short = replace(sample, pools=sample.pools[:2], exposures=min(sample.exposures, 2))
    short.write(tmp_path)
    # The session beside them is made from these files by another program; opening it leaves a
    # hidden lock file there.
    committed = {path.name for path in (FOLDER / sample.name).iterdir() if path.name[0] != "."}
    written = {path.name for path in tmp_path.iterdir()}
    assert written == committed - {f"{sample.name}.labsession"}
    with open_source(tmp_path / sample.file) as source:
        assert len(source) == 2
        for frame in source:
            np.testing.assert_array_equal(frame.image, short.frame(frame.index).image)


def test_command_writes_a_folder_for_each(tmp_path):
    target = tmp_path / "targets" / "target.svg"
    main([str(tmp_path / "all"), "--only", "concave", "--target", str(target)])
    assert [path.name for path in (tmp_path / "all").iterdir()] == ["concave"]
    assert target.read_text(encoding="utf-8").startswith("<svg")
    committed = {path.name for path in FOLDER.iterdir() if path.is_dir()}
    assert committed == {sample.name for sample in (*samples(), *line_samples())}


@every_sample
def test_setup_file_describes_the_rendered_bench(sample):
    setup = read_setup(FOLDER / sample.name / "setup.toml")
    assert setup.rig.laser == sample.rig.laser
    assert setup.rig.pattern == sample.rig.pattern
    assert setup.rig.electrode == sample.rig.electrode
    np.testing.assert_allclose(
        setup.rig.imaging_plane.origin_mm, sample.rig.imaging_plane.origin_mm
    )
    place = np.array([[0.0, 0.0], [40.0, 12.0]])
    np.testing.assert_allclose(
        setup.calibration.to_image(place), sample.view.to_image(place), atol=1e-9
    )
    assert sample.view.x_axis_mm == TARGET.x_middle_mm


# --- the GTAW run -----------------------------------------------------------------------------


def test_pool_fluctuates_as_in_7_3():
    for key, mean, sigma in (
        ("width_mm", 6.66, 0.15),
        ("length_mm", 7.45, 0.46),
        ("height_mm", 0.294, 0.019),
    ):
        values = column("gtaw", key)
        assert values.mean() == pytest.approx(mean, abs=1e-3)
        assert values.std() == pytest.approx(sigma, abs=1e-3)
        # Smooth: consecutive frames differ little.
        assert np.abs(np.diff(values)).mean() < 0.6 * sigma


def test_head_is_nearer_to_the_torch_than_the_tail():
    for pool in gtaw().pools:
        y = pool.boundary_mm()[:, 1]
        assert 0 < y.max() < -y.min()


def test_torch_hides_nothing_and_the_plane_catches_all():
    for index in range(0, 30, 7):
        reflections = gtaw().frame(index).reflections
        np.testing.assert_array_equal(reflections.visible, reflections.lit)


# --- the thumb tack ---------------------------------------------------------------------------


def test_thumb_tack_is_that_of_8_2_and_does_not_move():
    diameter, height = 9.75, 0.91
    for row in rows("thumb_tack"):
        assert float(row["width_mm"]) == float(row["length_mm"]) == diameter
        assert float(row["height_mm"]) == pytest.approx(height, abs=1e-5)
        assert float(row["area_mm2"]) == pytest.approx(np.pi * diameter**2 / 4, rel=1e-3)
        cap = np.pi * height / 6 * (3 * (diameter / 2) ** 2 + height**2)
        assert float(row["volume_mm3"]) == pytest.approx(cap, rel=1e-3)
    setup = read_setup(FOLDER / "thumb_tack" / "setup.toml")
    assert (setup.rig.laser.projection_angle_deg, setup.rig.laser.distance_mm) == (30.56, 46.4)
    assert setup.rig.imaging_plane.origin_mm[1] == -40.69


def test_thumb_tack_is_measured():
    result = measured(thumb_tack(), 0)
    assert result.status == "ok"
    assert result.measures.height_mm == pytest.approx(0.91, rel=0.03)
    assert result.measures.width_mm == pytest.approx(9.75, rel=0.015)


# --- rows blocked by the torch ----------------------------------------------------------------


def test_torch_hides_the_rays_it_intersects():
    torch = ConeTorch((1.0, 2.0, 3.0), tip_radius_mm=0.3, radius_mm=1.0, half_angle_deg=45.0)
    below = np.array([[1.0, 2.0, 0.0], [1.29, 2.0, 0.0], [1.9, 2.0, 0.0], [2.1, 2.0, 0.0]])
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    incident, reflected = torch.hides(below, up, up)
    assert reflected.tolist() == [True, True, True, False]
    assert not incident.any()
    assert torch.hides(below, -up, up)[0].tolist() == [True, True, True, False]
    # Horizontal rays, past the flat end and below it.
    beside = np.array([[-4.0, 2.0, 3.1], [-4.0, 2.0, 2.9], [-4.0, 2.45, 3.1], [-4.0, 2.45, 3.3]])
    along = np.tile([1.0, 0.0, 0.0], (4, 1))
    assert torch.hides(beside, along, along)[1].tolist() == [True, False, False, True]


def test_lowered_torch_hides_the_references_neighbourhood():
    sample = blocked_rows()
    for index in range(len(sample.pools)):
        reflections = sample.frame(index).reflections
        hidden = reflections.lit & reflections.blocked
        beside = hidden[[8, 9, 9, 10], [9, 8, 10, 9]]
        if index < 2:
            assert not hidden.any()
        else:
            assert beside.any()
            # The middle of rows; complete rows only at the ends of head and rear.
            assert 10 <= hidden.sum() <= 20
            assert (reflections.visible.sum(axis=1)[5:12] >= 6).all()


def advised(index):
    """Return status, reference, its position and blocked rows of a frame from the README."""
    text = (FOLDER / "blocked_rows" / "README.md").read_text(encoding="utf-8")
    cells = re.search(rf"^\| {index} \|(.*)\|$", text, re.MULTILINE)[1].split("|")
    status, reference, place, blocked = cells
    numbers = [[int(n) for n in re.findall(r"\d+", cell)] for cell in (reference, place, blocked)]
    return status.strip(" `"), tuple(numbers[0]), numbers[1], numbers[2]


def test_frame_with_raised_torch_is_measured():
    result = measured(blocked_rows(), 1)
    assert result.status == advised(1)[0] == "ok"
    assert result.lattice.reference == advised(1)[1]
    height = blocked_rows().pools[1].size.height_mm
    assert result.measures.height_mm == pytest.approx(height, rel=0.03)


@pytest.mark.parametrize("index", [2, 4, 5])
@pytest.mark.slow
def test_blocked_frame_is_measured_alone_and_with_given_rows(index):
    sample, frame = blocked_rows(), blocked_rows().frame(index)
    found = measured(sample, index)
    status, reference, _, blocked = advised(index)
    assert found.status == status == "ok"
    assert found.lattice.reference == reference
    correction = set_reference(start_correction(found), reference)
    for row in blocked:
        correction = block_row(correction, row)
    for result in (found, measured(sample, index, correction)):
        assert result.status == "ok"
        assert result.measures.height_mm == pytest.approx(frame.pool.size.height_mm, rel=0.02)
        true = frame.reflections.plane_mm[tuple(result.match.ray.T - 1)]
        np.testing.assert_allclose(result.match.plane_mm, true, atol=0.3)


@pytest.mark.parametrize("mark", [True, False])
@pytest.mark.slow
def test_frame_with_more_hidden_dots_is_measured_after_correction(mark):
    index, bench = 5, read_setup(FOLDER / "blocked_rows" / "setup.toml").bench
    sample = replace(blocked_rows(), torches=(ConeTorch((*BENT_MM, 0.8)),) * 6)
    frame = sample.frame(index)
    result = measure(frame.image, bench, Settings())[0]
    _, reference, place, blocked = advised(index)
    assert result.status == "no-match"
    np.testing.assert_allclose(place, frame.dot_px[9, 9], atol=1.0)
    correction = set_reference(start_correction(result), reference)
    for row in blocked if mark else ():
        correction = block_row(correction, row)
    corrected = measure(frame.image, bench, Settings(), correction=correction)[0]
    assert corrected.status == "ok"
    tolerance = 0.03 if mark else 0.05
    assert corrected.measures.height_mm == pytest.approx(frame.pool.size.height_mm, rel=tolerance)
    true = frame.reflections.plane_mm[tuple(corrected.match.ray.T - 1)]
    np.testing.assert_allclose(corrected.match.plane_mm, true, atol=0.3)


# --- the concave pool -------------------------------------------------------------------------


def test_concave_pool_is_measured_with_its_orientation():
    sample = concave()
    result = measured(sample, 3)
    assert result.status == "ok"
    assert result.match.orientation == "I/I"
    size = sample.pools[3].size
    assert result.measures.depth_mm == pytest.approx(size.depth_mm, rel=0.03)
    place = np.array([result.measures.peak_x_mm, result.measures.peak_y_mm])
    np.testing.assert_allclose(place, size.bottom_mm, atol=0.05)
