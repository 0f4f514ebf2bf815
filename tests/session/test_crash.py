"""A session survives whatever stops the program: `crash.py` run for a short while."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "crash.py"


@pytest.mark.parametrize(
    ("how", "times", "changes"),
    [
        pytest.param("kill", 12, 60, id="killed"),
        pytest.param("disk", 5, 0, id="disk full"),
        pytest.param("kill", 200, 1000, id="killed, long", marks=pytest.mark.soak),
        pytest.param("disk", 50, 0, id="disk full, long", marks=pytest.mark.soak),
    ],
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
