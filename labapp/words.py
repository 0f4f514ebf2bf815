"""Numbers of things in words, for the window, the command line and messages alike."""

from __future__ import annotations


def several(count: int, thing: str) -> str:
    """A number of things: "1 frame", "2 frames"."""
    return f"{count} {thing}{'s' * (count != 1)}"
