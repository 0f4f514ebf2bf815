"""labapp as on Windows and macOS: it works without the functions that those lack."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from labapp.export.folder import verify_export
from labapp.gui.shell.steps import STEPS
from tests.waiting import PATIENCE_S

ELSEWHERE = Path(__file__).parent / "elsewhere"
ROOT = ELSEWHERE.parents[1]


@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_complete_workflow_on_other_systems(system: str, tmp_path: Path) -> None:
    folders = ("HOME", "XDG_CONFIG_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME")
    process = subprocess.run(
        [sys.executable, ELSEWHERE / "way.py", tmp_path / "bench"],
        env={
            **os.environ,
            **dict.fromkeys(folders, str(tmp_path / "home")),
            "LABAPP_ELSEWHERE": system,
            "PYTHONPATH": f"{ELSEWHERE}{os.pathsep}{ROOT}",
            "PYTHONWARNDEFAULTENCODING": "1",
            "QT_QPA_PLATFORM": "offscreen",
        },
        capture_output=True,
        text=True,
        timeout=5 * PATIENCE_S,
        check=False,
    )
    assert process.returncode == 0, f"{process.stdout[-500:]}\n{process.stderr[-3000:]}"
    assert f"{system}: every module is imported" in process.stdout
    assert f"pages: {' '.join(sorted(step.key for step in STEPS))}" in process.stdout
    assert verify_export(tmp_path / "bench" / "results") == []
