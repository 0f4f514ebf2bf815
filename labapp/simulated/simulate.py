"""Simulation of a recording: a folder with recording, set-up, calibration picture and ground truth.

The recording can also be made into a session.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from labapp.config.scenario import Scenario, read_scenario
from labapp.config.scenario_keys import RECORDINGS
from labapp.errors import InputError, os_errors_as_input
from labapp.session.creation import new_session
from labapp.session.record import Record
from labapp.simulation.parallel import Progress

SCENARIO = "scenario.toml"
"""Name of the scenario in the folder; it identifies the folder of an earlier simulation."""

FILES = {SCENARIO, "setup.toml", "calibration.png", "truth.csv", "dots_truth.csv"}

OWN_FOLDER = "a new folder, an empty one or that of a former simulation"


def simulate(
    scenario: Scenario,
    out: str | os.PathLike[str],
    workers: int | None = None,
    progress: Progress | None = None,
) -> None:
    """Render a scenario's recording into a folder, which is then complete or absent.

    An earlier simulation in the folder is replaced.

    Parameters
    ----------
    workers
        Number of processes that render. None: one per core. The result is the same.
    progress
        Called for each frame and while waiting for one; if it raises, no file is left.

    Raises
    ------
    InputError
        If the folder contains anything else or cannot be written.
    """
    out = Path(out).absolute()
    _check_replaceable(out)
    recording = scenario.recording
    if workers is None:
        workers = min(os.cpu_count() or 1, len(recording.pools))
    with os_errors_as_input(out, "folder", "a folder that can be written"):
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as beside:
            part = Path(beside) / out.name
            recording.write_run(part, scenario.setup, workers, progress)
            (part / SCENARIO).write_text(scenario.text, encoding="utf-8")
            _check_replaceable(out)
            if out.exists():
                shutil.rmtree(out)
            part.rename(out)


def _check_replaceable(out: Path) -> None:
    """Refuse to replace a folder that contains anything but an earlier simulation."""
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(out, "folder", "is a file", OWN_FOLDER)
    # The lock of a session that no longer exists can be removed.
    names = {path.name for path in out.iterdir() if path.suffix != ".lock"}
    foreign = sorted(names - FILES - set(RECORDINGS.values()))
    if names and (foreign or SCENARIO not in names):
        found = f"holds {foreign[0]}" if foreign else f"holds no {SCENARIO}"
        raise InputError(out, "folder", found, OWN_FOLDER)
    setup = out / "setup.toml"
    if (
        setup.exists()
        and setup.read_text("utf-8", "replace") != read_scenario(out / SCENARIO, frames=1).setup
    ):
        raise InputError(out, setup.name, f"is not that of {SCENARIO}: it may be yours", OWN_FOLDER)


def begin_session(
    scenario: Scenario,
    folder: Path,
    path: Path,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Create a session of a simulation with its set-up and recording, without measurements.

    Parameters
    ----------
    progress
        Called with the imported share of the recording; if it raises, no session is left.

    Raises
    ------
    InputError
        If the folder lacks the recording, or the session exists or cannot be written. No session is
        left then.
    """
    made, size = scenario.recording, scenario.recording.pools[0].size
    height_mm = size.height_mm if size.height_mm >= -size.depth_mm else size.depth_mm
    record = Record(
        title=scenario.title or folder.name,
        expected_width_mm=round(size.width_mm, 2),
        expected_length_mm=round(size.length_mm, 2),
        expected_height_mm=round(height_mm, 3),
        notes=f"Simulated, seed {made.seed}; the ground truth is in {folder.name}.",
    )
    rate_hz = None if made.file.endswith(".avi") else made.frame_rate_hz
    with new_session(path, record) as session:
        session.set_setup(scenario.setup)
        session.import_recording(folder / made.file, frame_rate_hz=rate_hz, progress=progress)
    session.close()
