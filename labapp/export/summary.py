"""Summary of a run: number of frames by status, mean sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from labapp.core.surface.measures import Measures
from labapp.core.values import FloatArray
from labapp.export.frame_result import FrameResult

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
    """Accumulates measures and statuses of a run, frame by frame.

    Attributes
    ----------
    frames
        (frame, time in s, measures or None) of every frame, in order.
    statuses
        Number of frames by status.
    example
        The first frame with a surface.
    """

    frames: list[tuple[int, float | None, Measures | None]] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    example: FrameResult | None = None

    def add(self, result: FrameResult) -> None:
        """Add a frame."""
        measurement = result.measurement
        self.frames.append((result.frame, result.time_s, measurement.measures))
        self.statuses[measurement.status] += 1
        if self.example is None and measurement.measures is not None:
            self.example = result

    def series(self, name: str) -> FloatArray:
        """One of the measures over the frames, shape (n,); NaN without a surface."""
        return np.array([getattr(measures, name, np.nan) for _, _, measures in self.frames])

    def text(self) -> str:
        """Number of frames and mean sizes as text, a line each."""
        count = len(self.frames)
        total = f"{count} frame{'s' * (count != 1)}, {self.statuses['ok']} with a surface"
        without = [f"{n} {status}" for status, n in self.statuses.items() if status != "ok"]
        lines = [f"{total} ({', '.join(without)})" if without else total]
        for label, name in MEANS.items():
            values = self._finite(name)
            if len(values) > 1:
                spread = f"± {np.std(values):.4f} mm (mean, standard deviation)"
                lines.append(f"{label:7}{np.mean(values):z8.4f} {spread}")
            elif len(values):
                sigma = self._finite(name.replace("_mm", "_sigma_mm"))
                spread = f"± {sigma[0]:.4f} " if len(sigma) else ""
                lines.append(f"{label:7}{values[0]:z8.4f} {spread}mm")
        return "\n".join(lines)

    def _finite(self, name: str) -> FloatArray:
        values = self.series(name)
        return np.asarray(values[np.isfinite(values)])


def format_ranges(frames: Iterable[int], to: str = "–", most: int = 12) -> str:
    """Frame numbers as ranges, at most ``most`` of them: ``0–4, 7, 9–11``."""
    runs: list[list[int]] = []
    for frame in sorted(frames):
        if runs and frame == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], frame]
        else:
            runs.append([frame])
    more = f" and {len(runs) - most} more" if len(runs) > most else ""
    return ", ".join(to.join(map(str, run)) for run in runs[:most]) + more
