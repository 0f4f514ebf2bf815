"""`labapp study …`: exit codes and output."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from labapp.run.study.study import Study
from tests.conftest import Run


def test_study_commands_from_the_file_to_the_page(study_file: Path, labapp: Run) -> None:
    code, out, err = labapp("study", "status", study_file)
    assert code == 1
    assert "3 waiting" not in out
    assert "4 waiting" in out
    code, out, err = labapp("study", "run", study_file, "--workers", "0")
    assert code == 1
    assert "2 done, 3 failed" in out
    for name in ("corrupt", "empty", "missing"):
        assert err.count(f"{name}: ") == 1
    folder = study_file.with_name("study_results")
    with (folder / "recordings.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["recording"]: row for row in csv.DictReader(file)}
    assert [row["state"] for row in rows.values()] == ["done"] * 2 + ["failed"] * 3
    assert float(rows["first"]["height_sigma_mm"]) > 0
    assert rows["empty"]["problem"]
    code, out, _ = labapp("study", "status", study_file)
    assert code == 1
    assert rows["empty"]["problem"] in out
    # Without the recordings that fail, everything is measured.
    text = study_file.read_text("utf-8").partition('[[recording]]\nfile = "empty')[0]
    study_file.write_text(text, "utf-8")
    assert labapp("study", "status", study_file)[0] == 0
    assert labapp("study", "results", study_file)[0] == 0
    page = (folder / "summary.html").read_text("utf-8")
    assert "<svg" in page
    assert not re.findall(r'(?:src|href)="(?!#)|<link|url\((?!#)', page)  # no external resources


def test_problem_is_printed_as_it_is(study_file: Path, labapp: Run) -> None:
    """Rich draws a symbol for a name between colons."""
    text = study_file.read_text("utf-8")
    study_file.write_text(text.replace('frames = ":5"', 'frames = "x:b:"'), "utf-8")
    code, _, err = labapp("study", "run", study_file, "--workers", "0")
    assert code == 1
    assert "x:b:" in err


def test_bad_input_exits_with_2(study_file: Path, tmp_path: Path, labapp: Run) -> None:
    (tmp_path / "wrong.toml").write_text("recording = 3", "utf-8")
    assert labapp("study", "run", tmp_path / "wrong.toml")[0] == 2
    assert labapp("study", "status", tmp_path / "none.toml")[0] == 2
    assert (
        labapp("study", "run", study_file, "--out", tmp_path)[0] == 2
    )  # a folder with other files
    assert labapp("study", "new", study_file, "a.avi", "--setup", "s.toml")[0] == 2  # exists
    assert labapp("study", "new", tmp_path / "a.txt", "a.avi", "--setup", "s.toml")[0] == 2
    assert labapp("study", "run", study_file, "--scheduler", "tcp://127.0.0.1:x")[0] == 2


def test_stopped_run_prints_its_status(
    study_file: Path, labapp: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Study, "run", interrupt)
    code, _, err = labapp("study", "run", study_file)
    assert code == 130
    assert "4 waiting" in err
