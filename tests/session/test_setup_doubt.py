"""A recording that contradicts its set-up, from the picture to all that results go into."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from labapp.export.folder import ExportChoice
from labapp.session.report import layout, report_pdf
from labapp.session.session import Session
from tests.setups import GTAW, OFF, closely_known

FRAMES = "0:8"


def statuses(path: Path) -> set[str]:
    with path.open(newline="", encoding="utf-8") as file:
        return {row["setup_status"] for row in csv.DictReader(file)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "status", "options"),
    [
        ({}, "calibrated", ()),
        (OFF, "doubtful", ()),
        (OFF, "doubtful", ("--warm", "--surfaces", "none")),
    ],
)
@pytest.mark.usefixtures("state")
def test_a_run_says_whether_its_frames_contradict_the_set_up(
    labapp: Any, tmp_path: Path, values: Any, status: str, options: tuple[str, ...]
):
    setup, out = tmp_path / "setup.toml", tmp_path / "out"
    setup.write_text(closely_known(values), "utf-8")
    source = GTAW / "recording.avi", "--setup", setup, "--out", out, "--frames", FRAMES
    code, said, _ = labapp("reconstruct", *source, *options)
    assert code == 0
    assert ("doubtful" in said) == (status == "doubtful")
    run = json.loads((out / "run.json").read_text("utf-8"))
    assert run["setup_status"] == status
    assert run["setup_check"]["is_doubtful"] == (status == "doubtful")
    assert bool(run["setup_check"]["suspects"]) == (status == "doubtful")
    assert statuses(out / "measures.csv") == {status}


@pytest.mark.slow
def test_a_session_keeps_the_doubt_with_the_set_up_it_is_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "one.labsession"
    with Session.create(path) as session:
        session.set_setup(closely_known(OFF))
        session.import_recording(GTAW / "recording.avi", FRAMES)
        list(session.measure_each())
        assert session.setup_status == "doubtful"
    with Session.open(path) as session:
        assert session.problems() == []
        assert session.setup_status == "doubtful"
        verdict = session.setup_verdict
        assert verdict is not None
        assert verdict.reason in session.setup_words
        assert verdict.suspects
        result = session.result(0)
        assert result is not None
        assert (result.measurement.setup_status, result.doubt) == ("doubtful", verdict.reason)
        choice = ExportChoice(surfaces=frozenset(), hdf5=True)
        session.export(tmp_path / "out", choice)
        assert statuses(tmp_path / "out" / "measures.csv") == {"doubtful"}
        manifest = json.loads((tmp_path / "out" / "manifest.json").read_text("utf-8"))
        assert manifest["provenance"]["setup_check"]["reason"] == verdict.reason
        told: list[str] = []
        monkeypatch.setattr(layout.Story, "text", lambda _, words, *__: told.append(words))
        report_pdf(session)
        assert any(verdict.reason in words for words in told)

        session.set_setup(closely_known({}))  # another set-up is not doubted, nor measured yet
        assert (session.setup_status, session.setup_verdict) == ("calibrated", None)
        result = session.result(0)
        assert result is not None
        assert result.measurement.setup_status == "doubtful"
        session.undo()
        assert session.setup_verdict == verdict
        session.redo()
        list(session.measure_each())
        assert session.setup_status == "calibrated"
        found = session.setup_verdict
        assert found is not None
        assert not found.is_doubtful
