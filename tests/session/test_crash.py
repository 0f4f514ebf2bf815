"""A session survives whatever stops the program: `crash.py` run for a short while."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "crash.py"


@pytest.mark.parametrize(
    ("how", "times", "changes"), [("kill", 100, 500), ("disk", 25, 0)], ids=["killed", "disk full"]
)
def test_nothing_acknowledged_is_lost(tmp_path: Path, how: str, times: int, changes: int):
    answer = subprocess.run(
        [sys.executable, PROGRAM, how, tmp_path, str(times), str(changes), "20261121"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    told = json.loads(answer.stdout)
    assert told["rounds"] >= times
    assert told["changes"] >= max(changes, times)
