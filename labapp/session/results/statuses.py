"""Meaning of the status of a frame; an empty status: the frame is not measured yet."""

from __future__ import annotations

PULSE = "pulse"
"""A current pulse outshines the line of a one-line pattern: nothing to measure, and no failure."""


def is_measured(status: str) -> bool:
    """Whether a frame has a surface or, for a pattern of one line, the place of the line."""
    return status in ("ok", "followed")


def is_failed(status: str) -> bool:
    """Whether a frame could not be measured."""
    return status not in ("", PULSE) and not is_measured(status)
