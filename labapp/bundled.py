"""Data files distributed with labapp: samples, scenarios, the target, the guide."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path


def bundled(name: str) -> Path:
    """Return the path of a file or folder distributed with labapp, whether or not it exists.

    The folders ``resources``, ``sample_sessions`` and ``docs/guide`` are beside the package in a
    checkout; a wheel has them inside it (``pyproject.toml``).

    Parameters
    ----------
    name
        Path relative to the top of the repository, such as "resources/simulations".
    """
    package = Path(str(files("labapp")))
    inside = package / name
    return inside if inside.exists() else package.parent / name


@dataclass(frozen=True)
class SampleText:
    """Title and description of a sample session."""

    title: str
    shows: str
    """What it shows or what to try, in one line."""


SAMPLE_TEXTS = {
    "gtaw": SampleText("GTAW run of §7.3", "30 frames, measured: try every step"),
    "thumb_tack": SampleText("Thumb tack of §8.2", "A known shape: compare its ± with the truth"),
    "blocked_rows": SampleText(
        "Rows blocked by the torch", "Frames 3 to 5 are to be corrected by hand"
    ),
    "concave": SampleText("A concave pool", "Dots in inverse order: see the correspondence"),
    "five_lines": SampleText("Five lines, §3.2.1", "From no pool to a convex one: see Trends"),
    "gmaw": SampleText(
        "One line on a GMAW pool, §3.3", "1500 frames/s, pulsed current: see the timeline"
    ),
}
"""The sample sessions by folder name; here, not in the sessions, as it is needed at the start."""
