"""Summary of a run: number of frames by status, and mean sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from labapp.core.recording.residual_check import DOUBTFUL, SetupVerdict
from labapp.core.sequence.mean import series_of, sigma_of_mean
from labapp.core.surface.measures import Measures
from labapp.core.values import FloatArray
from labapp.export.frame_result import FrameResult
from labapp.text import pluralize, setup_words

MEANS = {
    "width": "width_mm",
    "length": "length_mm",
    "height": "height_mm",
    "depth": "depth_mm",
    "ARE": "are_mm",
    "own ARE": "own_are_mm",
}


@dataclass
class Summary:
    """Accumulates measures and statuses of a run, frame by frame."""

    frames: list[tuple[int, float | None, Measures | None]] = field(default_factory=list)
    """(frame, time in s, measures or None) of every frame, in order."""
    statuses: Counter[str] = field(default_factory=Counter)
    """Number of frames by status."""
    example: FrameResult | None = None
    """The first frame with a surface."""
    verdict: SetupVerdict | None = None
    """Check of the set-up by the run, at its end."""

    def add(self, result: FrameResult) -> None:
        """Add a frame."""
        measurement = result.measurement
        self.frames.append((result.frame, result.time_s, measurement.measures))
        self.statuses[measurement.status] += 1
        if self.example is None and measurement.measures is not None:
            self.example = result

    def series(self, name: str) -> FloatArray:
        """Return a measure over the frames, shape (n,); NaN without a surface."""
        return np.array([getattr(measures, name, np.nan) for _, _, measures in self.frames])

    def text(self) -> str:
        """Return the number of frames and mean sizes as text, one line each."""
        count = len(self.frames)
        total = f"{pluralize(count, 'frame')}, {self.statuses['ok']} with a surface"
        without = [f"{n} {status}" for status, n in self.statuses.items() if status != "ok"]
        lines = [f"{total} ({', '.join(without)})" if without else total]
        known = series_of([each for _, _, each in self.frames if each is not None])
        for label, name in MEANS.items():
            values = self.series(name)
            values = values[np.isfinite(values)]
            if not len(values):
                continue
            sigma = sigma_of_mean(name, known)
            words = [f"± {sigma:.4f}"] if np.isfinite(sigma) else []
            words += ["mm"]
            if len(values) > 1:
                words += [f"(mean; standard deviation {np.std(values):.4f} mm)"]
            lines.append(f"{label:7}{np.mean(values):z8.4f} {' '.join(words)}")
        if self.verdict is not None and self.verdict.is_doubtful:
            lines.append(setup_words(DOUBTFUL, doubt=self.verdict.reason))
        elif self.example is not None:
            lines.append(setup_words(self.example.measurement.setup_status))
        return "\n".join(line for line in lines if line)


def format_ranges(frames: Iterable[int], to: str = "–", most: int = 12) -> str:
    """Format frame numbers as at most ``most`` ranges: ``0–4, 7, 9–11``."""
    runs: list[list[int]] = []
    for frame in sorted(frames):
        if runs and frame == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], frame]
        else:
            runs.append([frame])
    more = f" and {len(runs) - most} more" if len(runs) > most else ""
    return ", ".join(to.join(map(str, run)) for run in runs[:most]) + more
