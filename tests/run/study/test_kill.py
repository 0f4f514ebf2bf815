"""Workers and program killed at any moment: no result is lost or duplicated."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.run.study.kill import kill_at_random


@pytest.mark.soak
def test_killed_study_loses_no_results(simulated: Path, tmp_path: Path) -> None:
    setup, recording = simulated / "setup.toml", simulated / "recording.avi"
    text = f"setup = '{setup}'\n"
    for k in range(24):
        # Different settings create different tasks for the same frames.
        correspondence = ("auto", "S/S")[k // 12]
        text += (
            f"[[recording]]\nfile = '{recording}'\nname = 'r{k}'\nframes = '{k % 6}:{k % 6 + 3}'\n"
        )
        text += f"correspondence = '{correspondence}'\nwarm = {str(k % 12 < 6).lower()}\n"
    path = tmp_path / "study.toml"
    path.write_text(text, "utf-8")
    assert kill_at_random(path, 20, 1).total() >= 10
