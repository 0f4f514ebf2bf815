"""A recording of an oscillating pool, and a study of parts of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.simulated_recordings import simulated_recording

FRAMES = 9

Write = Callable[..., Path]


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a simulated recording and its set-up."""
    return simulated_recording(tmp_path_factory.mktemp("simulated"), FRAMES)


@pytest.fixture
def study_file(simulated: Path, tmp_path: Path) -> Path:
    """A study of two parts of the recording, and of three invalid recordings."""
    return write_study(tmp_path, simulated)


def write_study(folder: Path, simulated: Path) -> Path:
    """Write `study_file` into a folder."""
    (folder / "empty.avi").touch()
    (folder / "corrupt.avi").write_bytes(b"RIFF no video at all" * 20)
    setup, recording = simulated / "setup.toml", simulated / "recording.avi"
    text = f"""
setup = '{setup}'
[[recording]]
file = '{recording}'
name = "first"
frames = ":5"
conditions = {{ current_a = 80, gas = "Ar" }}
[[recording]]
file = '{recording}'
name = "second"
frames = "5:"
conditions = {{ current_a = 100, gas = "Ar" }}
"""
    for name in ("empty", "corrupt", "missing"):
        text += f'[[recording]]\nfile = "{name}.avi"\nconditions = {{ current_a = 80 }}\n'
    path = folder / "study.toml"
    path.write_text(text, "utf-8")
    return path
