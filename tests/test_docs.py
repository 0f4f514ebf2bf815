"""The worked examples of the documents do what they say."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from labapp.session.export import verify_export
from labapp.session.session import Session

ROOT = Path(__file__).resolve().parent.parent


def test_the_examples_of_the_python_api_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
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
