from __future__ import annotations

import csv
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.simulation import sample

FOLDER = Path(__file__).parents[2] / "sample_sessions" / "gtaw"


def read_video(path):
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    assert video.isOpened()
    video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    rate, frames = video.get(cv2.CAP_PROP_FPS), []
    while True:
        there, frame = video.read()
        if not there:
            break
        frames.append(np.squeeze(frame))
    video.release()
    return rate, frames


@pytest.fixture(scope="module")
def recording():
    return read_video(FOLDER / "recording.avi")


def rows(name):
    with (FOLDER / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(name, key):
    return np.array([float(row[key]) for row in rows(name)])


def same_picture(made, kept):
    """Equal, but for a rounding that another processor or library may do otherwise."""
    apart = np.abs(made.astype(int) - kept.astype(int))
    return apart.max() <= 1 and (apart > 0).mean() < 1e-3


def test_recording_is_what_the_program_makes(recording):
    rate, frames = recording
    assert rate == 60.0
    assert len(frames) == sample.FRAMES
    for index in (0, 17):
        assert same_picture(sample.sample_frame(index).frame.image, frames[index])
    assert not same_picture(sample.sample_frame(1).frame.image, frames[2])


def test_calibration_picture_is_what_the_program_makes():
    kept = cv2.imread(str(FOLDER / "calibration.png"), cv2.IMREAD_UNCHANGED)
    assert same_picture(sample.calibration_picture(), kept)


def test_video_loses_nothing(tmp_path):
    noise = np.random.default_rng(1).integers(0, 256, (5, 64, 48), dtype=np.uint8)
    sample._write_video(tmp_path / "noise.avi", list(noise))
    np.testing.assert_array_equal(read_video(tmp_path / "noise.avi")[1], noise)


def test_pool_fluctuates_as_7_3_reports():
    for key, mean, sigma in (
        ("width_mm", 6.66, 0.15),
        ("length_mm", 7.45, 0.46),
        ("height_mm", 0.294, 0.019),
    ):
        course = column("truth.csv", key)
        assert course.mean() == pytest.approx(mean, abs=1e-3)
        assert course.std() == pytest.approx(sigma, abs=1e-3)
        # Smooth: a frame is far more like the next than like any other.
        assert np.abs(np.diff(course)).mean() < 0.6 * sigma


def test_head_is_nearer_to_the_torch_than_the_tail():
    for pool in sample.sample_pools():
        y = pool.boundary_mm()[:, 1]
        assert 0 < y.max() < -y.min()


def test_torch_hides_nothing_and_the_plane_catches_all():
    for index in range(0, sample.FRAMES, 7):
        reflections = sample.sample_frame(index).reflections
        np.testing.assert_array_equal(reflections.visible, reflections.lit)


def test_dots_truth_agrees_with_the_picture(recording):
    truth = [row for row in rows("dots_truth.csv") if row["frame"] == "12"]
    image = cv2.GaussianBlur(recording[1][12].astype(float), (0, 0), 1.5)
    shown = np.array([row["visible"] == "1" for row in truth])
    dots = np.array([[float(row["u_px"]), float(row["v_px"])] for row in truth])
    u, v = np.rint(dots[shown]).astype(int).T
    beside = np.median([image[v + 9, u], image[v - 9, u]], axis=0)
    assert len(u) > 85
    assert (image[v, u] - beside > 8).all()
    assert ("10", "10") not in {(row["ray_row"], row["ray_column"]) for row in truth}


def test_setup_file_says_what_was_rendered():
    with (FOLDER / "setup.toml").open("rb") as file:
        setup = tomllib.load(file)
    assert (FOLDER / "setup.toml").read_text(encoding="utf-8") == sample.SETUP
    assert set(setup) == {"laser", "pattern", "electrode", "imaging_plane", "image_calibration"}
    plane = setup["imaging_plane"]
    np.testing.assert_allclose(
        sample.RIG.imaging_plane.origin_mm, [-plane["s_mm"], -plane["distance_mm"], plane["h_mm"]]
    )
    assert setup["image_calibration"]["x_axis_mm"] == sample.TARGET.x_middle_mm


def test_command_writes_the_whole_folder_again(tmp_path, monkeypatch):
    monkeypatch.setattr(sample, "FRAMES", 2)
    monkeypatch.setattr(sample, "sample_pools", sample.sample_pools.__wrapped__)
    target = tmp_path / "targets" / "target.svg"
    sample.main([str(tmp_path / "run"), "--target", str(target)])
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        path.name for path in FOLDER.iterdir()
    }
    assert target.read_text(encoding="utf-8").startswith("<svg")
    assert len(read_video(tmp_path / "run" / "recording.avi")[1]) == 2


def test_folder_is_small_enough_for_git():
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 5e6
