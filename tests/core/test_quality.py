from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.config.setup import read_setup
from labapp.core.images.exposure import ADVICE
from labapp.core.pipeline import Measurement, Settings
from labapp.core.quality import GRADES, Quality, judge_quality, look
from labapp.media import GreyImage, open_source

SAMPLES = Path(__file__).parents[2] / "sample_sessions"

RAYS = 19 * 19 - 1


def frame(sample: str, recording: str, number: int) -> GreyImage:
    with open_source(SAMPLES / sample / recording) as source:
        return source.frame(number).image


def judged(image: GreyImage, sample: str | None = "gtaw") -> Quality:
    """Judge a frame with a sample's set-up, or without any."""
    return judge_quality(image, seen(image, sample), 8, RAYS)


def seen(image: GreyImage, sample: str | None) -> Measurement:
    setup = None if sample is None else read_setup(SAMPLES / sample / "setup.toml")
    return look(image, Settings(), None if setup is None else setup.bench)


def about(quality: Quality, what: str) -> str:
    """The grade of one remark."""
    (remark,) = (remark for remark in quality.remarks if remark.about == what)
    return remark.grade


@pytest.fixture(scope="module")
def good() -> GreyImage:
    return frame("gtaw", "recording.avi", 0)


@pytest.fixture(scope="module")
def measured(good: GreyImage) -> Measurement:
    return seen(good, "gtaw")


@pytest.mark.slow
def test_a_good_frame_is_good_and_its_height_known_to_what_is_predicted(
    good: GreyImage, measured: Measurement
) -> None:
    found = judge_quality(good, measured, 8, RAYS)
    assert found.grade == "good"
    assert found.words == ADVICE["good"]
    assert {remark.grade for remark in found.remarks} == {"good"}
    assert (found.blocked_rows, found.reference) == (0, True)
    with (SAMPLES / "gtaw" / "truth.csv").open() as file:
        height_mm = float(next(csv.DictReader(file))["height_mm"])
    sizes = measured.measures
    assert sizes is not None
    assert 0.0005 < found.height_sigma_mm < 0.02
    assert abs(sizes.height_mm - height_mm) < 4 * found.height_sigma_mm


@pytest.mark.slow
def test_a_height_that_is_not_known_well_enough_is_said(
    good: GreyImage, measured: Measurement
) -> None:
    found = judge_quality(good, measured, 8, RAYS, most_sigma_mm=1e-4)
    assert found.grade == "doubtful"
    assert f"± {found.height_sigma_mm:.3f} mm, not to ± 0.0001 mm" in found.words
    assert judge_quality(good, measured, 8, RAYS, most_sigma_mm=1.0).grade == "good"


def test_of_a_hollow_the_depth_counts() -> None:
    found = judged(frame("concave", "recording", 0), "concave")
    assert 0.0005 < found.height_sigma_mm < 0.05


def test_without_a_set_up_all_but_the_measurement_is_judged(good: GreyImage) -> None:
    found = judged(good, None)
    assert found.grade == "good"
    assert np.isnan(found.height_sigma_mm)
    assert [remark.about for remark in found.remarks] == ["exposure", "blur", "rows"]


def test_the_more_a_frame_is_blurred_the_worse_it_is(good: GreyImage) -> None:
    grades = [
        GRADES.index(judged(cv2.GaussianBlur(good, (0, 0), blur), None).grade)
        for blur in (0.5, 2.3, 4.0)
    ]
    assert grades == [0, 1, 2]


def test_a_texture_is_not_sought_for_rows() -> None:
    speckle = cv2.GaussianBlur(np.random.default_rng(4).normal(size=(640, 480)), (0, 0), 3.0)
    found = judged(np.clip(100 + 50 * speckle / speckle.std(), 0, 255).astype(np.uint8))
    assert found.grade == "bad"
    assert "where the lens makes 361 dots at most (too-many-dots)" in found.words
    assert np.isnan(found.height_sigma_mm)


@pytest.mark.parametrize(
    ("image", "verdict", "grade"),
    [
        (np.full((480, 640), 7, np.uint8), "blank", "bad"),
        (np.random.default_rng(1).normal(3, 1, (480, 640)).clip(0).astype(np.uint8), None, "bad"),
    ],
)
def test_a_frame_without_dots_is_bad(image: GreyImage, verdict: str, grade: str) -> None:
    found = judged(image)
    assert found.grade == grade
    assert found.dots == 0
    assert [remark.about for remark in found.remarks] == ["exposure"]
    assert verdict is None or found.words == ADVICE["blank"]


def test_clipped_dots_are_doubtful_and_said_first(good: GreyImage) -> None:
    found = judged(np.clip(good.astype(float) * 4, 0, 255).astype(np.uint8), None)
    assert found.grade == "doubtful"
    assert found.remarks[0].about == "exposure"
    assert found.words.startswith(ADVICE["saturated"])


def test_a_row_that_the_torch_hides_is_said() -> None:
    found = judged(frame("thumb_tack", "recording.tif", 0), "thumb_tack")
    assert found.blocked_rows == 1
    assert about(found, "rows") == "doubtful"
    assert "The torch hides dots in a row" in found.words


@pytest.mark.slow
def test_a_frame_that_cannot_be_measured_is_bad_and_says_why() -> None:
    image = frame("blocked_rows", "recording.mkv", 5).copy()
    image[:, 330:] = np.median(image)  # the torch before its right end
    found = judged(image, "blocked_rows")
    assert found.grade == "bad"
    assert found.words.endswith("(no-match).")


@pytest.mark.slow
def test_a_dot_at_the_reference_is_said(good: GreyImage, measured: Measurement) -> None:
    found = judged(without_middle(good, measured))
    assert not found.reference
    assert found.grade == "bad"
    assert about(found, "measurement") == "bad"
    assert found.words.endswith(("(no-reference).", "(ambiguous-rows)."))


def without_middle(image: GreyImage, measured: Measurement) -> GreyImage:
    """A frame with a dot where the reference is."""
    assert measured.lattice is not None
    assert measured.dots is not None
    k, t = measured.lattice.reference or (0, 0)
    beside = np.flatnonzero((measured.lattice.row == k) & (abs(measured.lattice.column - t) == 1))
    assert len(beside) == 2
    u, v = np.rint(measured.dots.image_px[beside].mean(axis=0)).astype(int)
    a, b = np.rint(measured.dots.image_px[beside[0]]).astype(int)
    filled = image.copy()
    filled[v - 5 : v + 6, u - 5 : u + 6] = image[b - 5 : b + 6, a - 5 : a + 6]
    return filled


def test_few_dots_are_said(good: GreyImage) -> None:
    cut = np.full_like(good, int(np.median(good)))
    cut[:, 220:270] = good[:, 220:270]
    found = judged(cut, None)
    assert found.dots < 36
    assert about(found, "rows") == "doubtful"
