"""Files that come with labapp and are not code: samples, scenarios, the target, the guide."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path


def bundled(name: str) -> Path:
    """Place of a file or folder that comes with labapp, whether it is there or not.

    The folders ``resources``, ``sample_sessions`` and ``docs/guide`` are beside the package in a
    checkout; a wheel has them inside it (``pyproject.toml``).

    Parameters
    ----------
    name
        From the top of the repository: "resources/simulations".
    """
    package = Path(str(files("labapp")))
    inside = package / name
    return inside if inside.exists() else package.parent / name


@dataclass(frozen=True)
class SampleText:
    """A sample session in words."""

    title: str
    shows: str
    """What it shows or what to try, in a line."""


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
"""The sample sessions by the names of their folders; kept apart, as it is needed at the start."""
