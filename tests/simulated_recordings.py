"""Simulated recordings of an oscillating pool, for tests."""

from __future__ import annotations

from pathlib import Path

from labapp.config.scenario import read_scenario
from labapp.simulated.benchmark import scenario_text
from labapp.simulated.simulate import simulate


def simulated_recording(folder: Path, frames: int) -> Path:
    """Simulate a recording of the benchmark's pool; return the folder of its files."""
    (folder / "scenario.toml").write_text(scenario_text(frames), "utf-8")
    simulate(read_scenario(folder / "scenario.toml"), folder / "made", workers=1)
    return folder / "made"
