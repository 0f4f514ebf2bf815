"""The worked examples of the documents do what they say."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from labapp.session.export import verify_export
from labapp.session.session import Session
from tests.conftest import Run

ROOT = Path(__file__).resolve().parent.parent


def test_the_examples_of_the_python_api_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("thumb_tack", "blocked_rows"):
        shutil.copytree(ROOT / "sample_sessions" / name, tmp_path / "sample_sessions" / name)
    monkeypatch.chdir(tmp_path)
    examples = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs/python.md").read_text("utf-8"), re.S
    )
    names: dict[str, object] = {}
    for example in examples:
        exec(example, names)
    told = capsys.readouterr().out
    height = re.search(r"height ([\d.]+) ± ([\d.]+) mm", told)
    assert height is not None
    assert float(height[1]) == pytest.approx(0.91, rel=0.03)
    assert verify_export("tack_results") == []
    assert re.search(r"^no-match ", told, re.MULTILINE)
    assert re.search(r"^ok 0\.\d+$", told, re.MULTILINE)
    assert "('the dots or rows were corrected',)" in told
    for session in ("tack", "blocked"):
        with Session.open(f"{session}.labsession", read_only=True) as opened:
            assert opened.problems() == []


def test_the_worked_example_of_the_command_line_says_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, labapp: Run
) -> None:
    sample = ROOT / "sample_sessions/blocked_rows"
    for name in ("blocked_rows.labsession", "recording.mkv", "setup.toml"):
        shutil.copy(sample / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/command-line.md").read_text("utf-8").replace("\\\n", " ")
    example = text.partition("### A worked example")[2].partition("### correct")[0]
    commands = re.findall(r"^    labapp session (.*)$", example, re.MULTILINE)
    assert [line.split()[0] for line in commands] == "new import measure correct export".split()
    # The sample is what the first three make, with a set-up found and frame 2 corrected.
    (tmp_path / "blocked_rows.labsession").rename("run.labsession")
    assert labapp("session", "undo", "run.labsession")[0] == 0
    assert labapp("session", "setup", "run.labsession", "setup.toml")[0] == 0
    assert labapp("session", "measure", "run.labsession", "--frames", "2")[0] == 1
    code, told, _ = labapp("session", *commands[3].split())
    assert code == 0
    expected = re.findall(r"^    (.*)$", example.partition("--carry-on")[2], re.MULTILINE)[:6]
    assert expected.pop(4) == "  …"
    assert not set(expected) - set(told.splitlines())
    code, told, _ = labapp(
        "session", *commands[4].removesuffix(" --report").split(), "--frames", "2:"
    )
    assert code == 0
    assert verify_export("results") == []
