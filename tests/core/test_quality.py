from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.config.setup import read_setup
from labapp.core.images.exposure import ADVICE
from labapp.core.images.find_dots import find_dots
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.quality import GRADES, UNMEASURED, Quality, judge_quality
from labapp.core.values import CannotMeasure
from labapp.media import GreyImage, open_source

SAMPLES = Path(__file__).parents[2] / "sample_sessions"

RAYS = 19 * 19 - 1


def frame(sample: str, recording: str, number: int) -> GreyImage:
    with open_source(SAMPLES / sample / recording) as source:
        return source.frame(number).image


def judged(image: GreyImage, sample: str | None = "gtaw") -> Quality:
    """Judge a frame with a sample's setup, or without one."""
    return judge_quality(image, observed(image, sample), 8, RAYS)


def observed(image: GreyImage, sample: str | None) -> Measurement:
    setup = None if sample is None else read_setup(SAMPLES / sample / "setup.toml")
    if setup is not None:
        return measure(image, setup.bench, Settings())[0]
    found = Measurement(UNMEASURED, "there is no set-up yet", "fit")
    try:
        return replace(found, dots=find_dots(image, Settings().dots))
    except CannotMeasure as why:
        return replace(found, status=why.status, reason=why.reason)


def words_of(quality: Quality, what: str) -> str:
    """Return the words of the remark about a topic."""
    (remark,) = (remark for remark in quality.remarks if remark.about == what)
    return remark.words


def height_sigma_mm(quality: Quality) -> float:
    """Return the uncertainty of the height that the remark states."""
    stated = re.search(r"± (\S+) mm", words_of(quality, "height ±"))
    assert stated
    return float(stated[1])


def grade_of(quality: Quality, what: str) -> str:
    """Return the grade of the remark about a topic."""
    (remark,) = (remark for remark in quality.remarks if remark.about == what)
    return remark.grade


@pytest.fixture(scope="module")
def good() -> GreyImage:
    return frame("gtaw", "recording.avi", 0)


@pytest.fixture(scope="module")
def measured(good: GreyImage) -> Measurement:
    return observed(good, "gtaw")


@pytest.mark.slow
def test_good_frame_has_the_predicted_height_uncertainty(
    good: GreyImage, measured: Measurement
) -> None:
    quality = judge_quality(good, measured, 8, RAYS)
    assert quality.grade == "good"
    assert quality.words == ADVICE["good"]
    assert {remark.grade for remark in quality.remarks} == {"good"}
    assert words_of(quality, "rows").endswith(" dots are seen.")  # none is hidden
    assert words_of(quality, "reference") == "The reference is seen."
    with (SAMPLES / "gtaw" / "truth.csv").open() as file:
        height_mm = float(next(csv.DictReader(file))["height_mm"])
    sizes = measured.measures
    assert sizes is not None
    assert 0.0005 < height_sigma_mm(quality) < 0.02
    assert abs(sizes.height_mm - height_mm) < 4 * sizes.height_sigma_mm
    assert height_sigma_mm(quality) == pytest.approx(sizes.height_sigma_mm, abs=0.0005)


def test_uncertainty_of_the_depth_counts_for_a_concave_pool() -> None:
    quality = judged(frame("concave", "recording", 0), "concave")
    assert 0.0005 < height_sigma_mm(quality) < 0.05


def test_without_setup_all_but_the_measurement_is_judged(good: GreyImage) -> None:
    quality = judged(good, None)
    assert quality.grade == "good"
    assert [remark.about for remark in quality.remarks] == ["exposure", "blur", "rows"]


def test_grade_worsens_with_blur(good: GreyImage) -> None:
    grades = [
        GRADES.index(judged(cv2.GaussianBlur(good, (0, 0), blur), None).grade)
        for blur in (0.5, 2.3, 4.0)
    ]
    assert grades == [0, 1, 2]


def test_texture_with_too_many_dots_is_bad() -> None:
    speckle = cv2.GaussianBlur(np.random.default_rng(4).normal(size=(640, 480)), (0, 0), 3.0)
    quality = judged(np.clip(100 + 50 * speckle / speckle.std(), 0, 255).astype(np.uint8))
    assert quality.grade == "bad"
    assert "where the lens makes 361 dots at most (too-many-dots)" in quality.words
    assert "height ±" not in [remark.about for remark in quality.remarks]


@pytest.mark.parametrize(
    ("image", "verdict", "grade"),
    [
        (np.full((480, 640), 7, np.uint8), "blank", "bad"),
        (np.random.default_rng(1).normal(3, 1, (480, 640)).clip(0).astype(np.uint8), None, "bad"),
    ],
)
def test_frame_without_dots_is_bad(image: GreyImage, verdict: str, grade: str) -> None:
    quality = judged(image)
    assert quality.grade == grade
    assert [remark.about for remark in quality.remarks] == ["exposure"]
    assert verdict is None or quality.words == ADVICE["blank"]


def test_clipped_dots_are_doubtful_and_reported_first(good: GreyImage) -> None:
    quality = judged(np.clip(good.astype(float) * 4, 0, 255).astype(np.uint8), None)
    assert quality.grade == "doubtful"
    assert quality.remarks[0].about == "exposure"
    assert quality.words.startswith(ADVICE["saturated"])


def test_row_hidden_by_the_torch_is_reported() -> None:
    quality = judged(frame("thumb_tack", "recording.tif", 0), "thumb_tack")
    assert grade_of(quality, "rows") == "doubtful"
    assert "The torch hides dots in a row" in quality.words


@pytest.mark.slow
def test_frame_that_cannot_be_measured_is_bad_with_a_reason() -> None:
    image = frame("blocked_rows", "recording.mkv", 5).copy()
    image[:, 330:] = np.median(image)  # the torch hides its right end
    quality = judged(image, "blocked_rows")
    assert quality.grade == "bad"
    assert quality.words.endswith("(no-match).")


@pytest.mark.slow
def test_dot_at_the_reference_is_reported(good: GreyImage, measured: Measurement) -> None:
    quality = judged(without_middle(good, measured))
    assert "The reference is seen." not in [remark.words for remark in quality.remarks]
    assert quality.grade == "bad"
    assert grade_of(quality, "measurement") == "bad"
    assert quality.words.endswith(("(no-reference).", "(ambiguous-rows)."))


def without_middle(image: GreyImage, measured: Measurement) -> GreyImage:
    """Return the frame with a dot at the reference."""
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


def test_few_dots_are_reported(good: GreyImage) -> None:
    cut = np.full_like(good, int(np.median(good)))
    cut[:, 220:270] = good[:, 220:270]
    quality = judged(cut, None)
    assert grade_of(quality, "rows") == "doubtful"
    count = re.search(r"Only (\d+) of 360 dots are seen", quality.words)
    assert count
    assert int(count[1]) < 36
