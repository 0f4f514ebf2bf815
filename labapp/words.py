"""Words that the window, the command line, files and messages have alike."""

from __future__ import annotations

SIGMA_OF = "noise and level only"
"""What the ± of a measured pool hold: not that the set-up may be off."""


def several(count: int, thing: str) -> str:
    """A number of things: "1 frame", "2 frames"."""
    return f"{count} {thing}{'s' * (count != 1)}"
