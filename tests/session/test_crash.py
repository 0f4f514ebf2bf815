"""A session survives a killed program and a full disk: a short run of `crash.py`."""

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
def test_no_acknowledged_change_is_lost(tmp_path: Path, how: str, times: int, changes: int):
    process = subprocess.run(
        [sys.executable, PROGRAM, how, tmp_path, str(times), str(changes), "20261121"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    summary = json.loads(process.stdout)
    assert summary["rounds"] >= times
    assert summary["changes"] >= max(changes, times)
