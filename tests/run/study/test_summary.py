"""Means over recordings with their ±, outliers, and the summary page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labapp import Study
from labapp.config.scenario import read_scenario
from labapp.core.surface.measures import SIZES, sigma_name
from labapp.export.tables import Columns
from labapp.run.study.page import summary_page
from labapp.run.study.plan import StudyRecording
from labapp.run.study.status import RecordingStatus
from labapp.run.study.summary import (
    RecordingSummary,
    StudySummary,
    group_recordings,
    outlying_frames,
    outlying_recordings,
    recording_means,
)
from labapp.simulated.benchmark import scenario_text
from labapp.simulated.simulate import simulate
from labapp.text import with_sigma

NOISE, LEVEL, SETUP = 0.03, 0.02, 0.1


def table(seed: int, frames: int = 50, offset: float = 0.0) -> Columns:
    """Frames whose sizes scatter by their noise about 6 mm."""
    rng = np.random.default_rng(seed)
    table: Columns = {
        "frame": np.arange(frames),
        "status": np.array(["ok"] * frames),
        "center_x_mm": np.zeros(frames),
        "center_y_mm": np.zeros(frames),
    }
    for size in SIZES:
        table[size] = 6 + offset + NOISE * rng.standard_normal(frames)
        for part, value in (("noise", NOISE), ("level", LEVEL), ("setup", SETUP)):
            table[sigma_name(size, part)] = np.full(frames, value)
        table[sigma_name(size)] = np.full(frames, np.hypot(np.hypot(NOISE, LEVEL), SETUP))
    return table


def status(name: str, **conditions: float | str) -> RecordingStatus:
    recording = StudyRecording(name, Path(name), Path("s.toml"), conditions=conditions)
    return RecordingStatus(recording, "done", "", 50, 50)


def summary(name: str, frames: Columns, **conditions: float | str) -> RecordingSummary:
    return RecordingSummary(
        status(name, **conditions), {"ok": 50}, "entered", "", recording_means(frames)
    )


def test_only_noise_averages_out_over_recordings() -> None:
    several = [summary(f"r{k}", table(k), current=80.0) for k in range(5)]
    (group,) = group_recordings(["current"], several)
    mean = group.means["width_mm"]
    assert mean.noise == pytest.approx(NOISE / np.sqrt(250))
    assert mean.setup == pytest.approx(SETUP)
    assert LEVEL * 0.5 < mean.level <= LEVEL
    assert mean.sigma == pytest.approx(np.sqrt(mean.noise**2 + mean.level**2 + SETUP**2))
    assert abs(mean.mean - 6) < 4 * mean.noise
    assert mean.count == 5


def test_recordings_are_grouped_by_equal_conditions() -> None:
    several = [
        summary("a", table(1), current=80.0, gas="Ar"),
        summary("b", table(2), current=100.0),
        summary("c", table(3), current=80.0, gas="Ar"),
        RecordingSummary(status("d", current=80.0, gas="Ar"), {}, "", "", {}),
    ]
    groups = group_recordings(["current", "gas"], several)
    assert [group.recordings for group in groups] == [("a", "c"), ("b",)]
    assert groups[1].conditions == {"current": 100.0}


def test_outlying_frame_is_named() -> None:
    frames = table(5)
    assert not outlying_frames(status("a"), frames)
    frames["width_mm"][7] += 12 * NOISE
    frames["status"][9] = "no-dots"
    frames["height_mm"][9] = np.nan
    (outlier,) = outlying_frames(status("a"), frames)
    assert (outlier.frame, outlier.measure, outlier.recording) == (7, "width_mm", "a")
    frames[sigma_name("width_mm", "noise")][7] = 12 * NOISE  # within its ±
    assert not outlying_frames(status("a"), frames)


def test_outlying_recording_is_named() -> None:
    several = [summary(f"r{k}", table(k)) for k in range(6)]
    assert not outlying_recordings(group_recordings([], several), several)
    several[3] = summary("r3", table(3, offset=0.2))
    outliers = outlying_recordings(group_recordings([], several), several)
    assert {outlier.recording for outlier in outliers} == {"r3"}
    assert {outlier.frame for outlier in outliers} == {None}


def test_text_of_the_page_is_escaped() -> None:
    evil = "<script>alert(1)</script>"
    one = summary("a", table(1), gas=evil)
    two = summary("b", table(2), gas="Ar")
    groups = group_recordings(["gas"], [one, two])
    page = summary_page(StudySummary(evil, ("gas",), (one, two), groups, ()), "today")
    assert "<script" not in page
    assert "&lt;script&gt;" in page


def test_size_that_is_0_everywhere_has_no_plot() -> None:
    tables = [table(k) for k in range(2)]
    pages = []
    for depth_mm in (0.1, 0.0):
        for frames in tables:
            frames["depth_mm"] = np.full(len(frames["frame"]), depth_mm)
        summaries = [summary(f"r{k}", frames, current=80.0 + k) for k, frames in enumerate(tables)]
        study = StudySummary(
            "t", ("current",), tuple(summaries), group_recordings(["current"], summaries), ()
        )
        pages.append(summary_page(study, "today"))
    assert ["0 everywhere" in page for page in pages] == [False, True]


@pytest.mark.parametrize(
    ("value", "sigma", "expected"),
    [
        (6.1234, 0.123, "6.12 ± 0.12"),
        (0.28123, 0.0083, "0.2812 ± 0.0083"),
        (6.1234, np.nan, "6.123"),
        (-0.012345, 0.0, "−0.012"),
        (-0.0001, np.nan, "0.000"),
    ],
)
def test_values_are_rounded_to_their_uncertainty(value: float, sigma: float, expected: str) -> None:
    assert with_sigma(value, sigma) == expected


@pytest.mark.slow
def test_known_dependence_is_recovered(tmp_path: Path) -> None:
    widths = {80: 5.6, 100: 6.2, 120: 6.8}
    for current, width in widths.items():
        text = scenario_text(2).replace("width_mm = 6.66", f"width_mm = {width}")
        text = text.replace("wander_percent = 2.0", "wander_percent = 0.0")
        (tmp_path / "scenario.toml").write_text(text, "utf-8")
        simulate(read_scenario(tmp_path / "scenario.toml"), tmp_path / f"I{current}", workers=1)
    path = tmp_path / "study.toml"
    path.write_text(
        'setup = "I80/setup.toml"\n[[recording]]\nfile = "I{current_a}/recording.avi"\n', "utf-8"
    )
    study = Study(path)
    study.run(0)
    means = [group.means["width_mm"] for group in study.results().groups]
    for mean, width in zip(means, widths.values(), strict=True):
        assert abs(mean.mean - width) < 2.5 * mean.sigma
    slope = np.polyfit(list(widths), [mean.mean for mean in means], 1)[0]
    assert slope == pytest.approx(0.03, rel=0.15)
