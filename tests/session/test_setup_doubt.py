"""A recording that contradicts its set-up: the doubt is stated in all outputs."""

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
def test_run_reports_whether_frames_contradict_the_setup(
    labapp: Any, tmp_path: Path, values: Any, status: str, options: tuple[str, ...]
):
    setup, out = tmp_path / "setup.toml", tmp_path / "out"
    setup.write_text(closely_known(values), "utf-8")
    source = GTAW / "recording.avi", "--setup", setup, "--out", out, "--frames", FRAMES
    code, stdout, _ = labapp("reconstruct", *source, *options)
    assert code == 0
    assert ("doubtful" in stdout) == (status == "doubtful")
    run = json.loads((out / "run.json").read_text("utf-8"))
    assert run["setup_status"] == status
    assert run["setup_check"]["is_doubtful"] == (status == "doubtful")
    assert bool(run["setup_check"]["suspects"]) == (status == "doubtful")
    assert statuses(out / "measures.csv") == {status}


@pytest.mark.slow
def test_session_stores_the_doubt_with_its_setup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
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
        texts: list[str] = []
        monkeypatch.setattr(layout.Story, "text", lambda _, words, *__: texts.append(words))
        report_pdf(session)
        assert any(verdict.reason in words for words in texts)

        session.set_setup(closely_known({}))  # another set-up is not in doubt, and not measured yet
        assert (session.setup_status, session.setup_verdict) == ("calibrated", None)
        result = session.result(0)
        assert result is not None
        assert result.measurement.setup_status == "doubtful"
        session.undo()
        assert session.setup_verdict == verdict
        session.redo()
        list(session.measure_each())
        assert session.setup_status == "calibrated"
        new_verdict = session.setup_verdict
        assert new_verdict is not None
        assert not new_verdict.is_doubtful
