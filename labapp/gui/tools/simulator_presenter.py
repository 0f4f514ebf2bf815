"""Data of the simulator's window: scenarios and their preview. Without Qt."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from labapp.config.scenario import Scenario, read_scenario, shipped_scenarios
from labapp.core.values import FloatArray
from labapp.gui.digits import ResultRow
from labapp.simulation.recording import RecordedFrame


@dataclass(frozen=True)
class ScenarioPreview:
    """A scenario with its first frame."""

    scenario: Scenario
    """The scenario as read, but with one frame."""
    frames: int
    """Number of frames given in the scenario."""
    frame: RecordedFrame
    """The first frame with its true values."""

    @property
    def dots_px(self) -> FloatArray:
        """(u, v) of the dots in the picture, shape (n, 2), px."""
        return self.frame.dot_px[self.frame.shown]


def preview(path: Path, seed: int | None) -> ScenarioPreview:
    """Render the first frame of a scenario.

    Raises
    ------
    InputError
        As `read_scenario`.
    """
    scenario = read_scenario(path, 1, seed)
    frames = tomllib.loads(scenario.text.lstrip("\ufeff"))["recording"]["frames"]
    return ScenarioPreview(scenario, frames, scenario.recording.frame(0))


def choices(own: Path | None) -> list[tuple[str, str]]:
    """(path, text) of the available scenarios; the operator's own, if any, comes first."""
    paths = [own] if own is not None and own not in shipped_scenarios() else []
    return [(str(path), path.stem.replace("_", " ")) for path in (*paths, *shipped_scenarios())]


def rows(shown: ScenarioPreview, frames: int) -> tuple[ResultRow, ...]:
    """Rows about a scenario's first frame, and about a recording of ``frames`` frames."""
    recording, frame = shown.scenario.recording, shown.frame
    size, seen = frame.pool.size, frame.reflections
    free = seen.lit & ~seen.blocked
    rate = recording.frame_rate_hz or 0.0
    wide, high = recording.view.width_px, recording.view.height_px
    counts = (
        ("Dots in the picture", frame.shown, "dots"),
        ("Rays that meet the pool", seen.lit, "rays"),
        ("Hidden by the torch", seen.lit & seen.blocked, "rays"),
        ("Meet the pool twice", free & seen.hits_again, "rays"),
    )
    return (
        ResultRow("Pool's width", size.width_mm, unit="mm"),
        ResultRow("Pool's length", size.length_mm, unit="mm"),
        ResultRow("Highest point", size.height_mm, unit="mm"),
        ResultRow("Lowest point", size.depth_mm, unit="mm"),
        *(ResultRow(name, float(of.sum()), unit=unit, decimals=0) for name, of, unit in counts),
        ResultRow("Frame rate", rate, unit="frames/s", decimals=1),
        ResultRow("Recording lasts", frames / rate if rate else None, unit="s", decimals=2),
        ResultRow("Frame", f"{wide} × {high}", unit="px"),
        ResultRow("Recording", recording.file),
    )
