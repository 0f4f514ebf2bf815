"""Assignment of sections to the frames of a study's recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.export.tables import Columns
from labapp.run.study.plan import COLUMNS, Condition, StudyPlan, StudyRecording
from labapp.run.study.sections import study_features

HEAD = "recording,position_mm,start_mm,travel_mm_s,back_width_mm,back_width_sigma_mm\n"


def plan(**conditions: Condition) -> StudyPlan:
    names = ("first", "second")
    recordings = tuple(
        StudyRecording(name, Path(f"{name}.avi"), Path("setup.toml"), conditions=conditions)
        for name in names
    )
    return StudyPlan("study", recordings, tuple(conditions))


def measured(count: int = 50, rate_hz: float = 10.0) -> Columns:
    """A recording whose width equals the frame number; every tenth frame has no surface."""
    table: Columns = {column.name: np.full(count, 1.0) for column in COLUMNS}
    table["frame"] = np.arange(count)
    table["time_s"] = np.arange(count) / rate_hz
    table["width_mm"] = np.arange(float(count))
    table["status"] = np.where(np.arange(count) % 10 == 9, "no-dots", "ok")
    return table


TABLES = {"first": measured(), "second": measured()}


def sections(folder: Path, text: str) -> Path:
    path = folder / "sections.csv"
    path.write_text(text, "utf-8")
    return path


def test_positions_are_converted_to_times_by_speed_and_start(tmp_path: Path) -> None:
    text = HEAD + "first,20,10,5,2.5,0.1\nfirst,12,10,5,1.5,0.1\nsecond,20,15,2,3.5,\n"
    features, unused = study_features(plan(), TABLES, sections(tmp_path, text))
    assert features.target == "back_width_mm"
    assert unused == 0
    first, second = features.welds
    cut = np.isfinite(first.target)
    assert first.time_s[cut] == pytest.approx([0.4, 2.0])
    assert first.target[cut] == pytest.approx([1.5, 2.5])
    assert first.target_sigma[cut] == pytest.approx([0.1, 0.1])
    cut = np.isfinite(second.target)
    assert second.time_s[cut] == pytest.approx([2.5])
    assert np.isnan(second.target_sigma[cut]).all()


def test_columns_of_speed_and_start_override_conditions(tmp_path: Path) -> None:
    text = "recording,position_mm,start_mm,back_width_mm\nfirst,20,,1\nfirst,20,10,2\n"
    path = sections(tmp_path, text)
    (first,) = study_features(plan(start_mm=5.0, travel_mm_s=5.0), TABLES, path)[0].welds
    cut = np.isfinite(first.target)
    assert first.time_s[cut] == pytest.approx([2.0, 3.0])
    assert first.target[cut] == pytest.approx([2, 1])


def test_sections_at_one_frame_are_averaged(tmp_path: Path) -> None:
    text = "recording,time_s,back_width_mm,back_width_sigma_mm\nfirst,1,2,0.3\nfirst,1.01,3,0.4\n"
    (first,) = study_features(plan(), TABLES, sections(tmp_path, text))[0].welds
    cut = np.isfinite(first.target)
    assert first.target[cut] == pytest.approx([2.5])
    assert first.target_sigma[cut] == pytest.approx([0.25])


def test_section_is_assigned_to_the_nearest_measured_frame(tmp_path: Path) -> None:
    text = "recording,time_s,back_width_mm\nfirst,0.91,1\nfirst,7,2\nfirst,-1,3\n"
    features, unused = study_features(plan(), TABLES, sections(tmp_path, text))
    (first,) = features.welds
    assert first.time_s[np.isfinite(first.target)] == pytest.approx([1.0])
    assert unused == 2


def test_without_sections_all_frames_have_features() -> None:
    features, _ = study_features(plan(), TABLES, None)
    assert features.target == ""
    assert [len(weld.time_s) for weld in features.welds] == [45, 45]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "recording,time_s\nfirst,1\n",
        "time_s,back_width_mm\n1,1\n",
        "recording,time_s,back_width_mm\nthird,1,1\n",
        "recording,back_width_mm\nfirst,1\n",
        "recording,position_mm,back_width_mm\nfirst,1,1\n",
        HEAD + "first,20,10,0,1,\n",
        HEAD + "first,20,10,-5,1,\n",
        "recording,time_s,back_width_mm\nfirst,1,-1\n",
        "recording,time_s,back_width_mm,back_width_sigma_mm\nfirst,1,1,-0.1\n",
        "recording,time_s,width_mm\nfirst,1,1\n",
        "recording,time_s,back_width_mm,depth_of_mm\nfirst,1,1,1\n",
        "recording,time_s,back_width_mm\nfirst,99,1\n",
        "recording,time_s,back_width_mm\nfirst,1,wide\n",
    ],
)
def test_wrong_sections_are_rejected(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        study_features(plan(), TABLES, sections(tmp_path, text))


def test_study_without_results_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        study_features(plan(), {}, None)
