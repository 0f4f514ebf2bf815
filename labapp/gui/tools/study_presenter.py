"""Data of the window of studies. Without Qt."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from labapp.config.setup import read_setup
from labapp.core.surface.measures import SIZES
from labapp.errors import InputError
from labapp.run.study.plan import StudyPlan, matching_recordings, shown_condition
from labapp.run.study.status import STATE_WORDS, RecordingStatus, State
from labapp.run.study.summary import StudySummary
from labapp.studies.tables import Table
from labapp.text import axis_label, column_heading, pluralize, with_sigma

SIGNS: dict[State, str] = {"done": "✓", "part": "◐", "waiting": "○", "failed": "▲"}


def recordings_table(plan: StudyPlan, found: Sequence[RecordingStatus]) -> Table:
    """Table with a row per recording: conditions, state, progress, and reason of a failure."""
    rows = tuple(
        (
            one.recording.name,
            *(shown_condition(one.recording.conditions.get(name)) for name in plan.conditions),
            f"{SIGNS[one.state]} {STATE_WORDS[one.state]}",
            f"{one.frames_done} of {one.frames}" if one.frames else "",
            one.problem.removeprefix(f"{one.recording.path}: "),
        )
        for one in found
    )
    columns = ("recording", *plan.conditions, "state", "frames", "reason")
    return Table("recordings", "Recordings of the study", columns, rows)


def means_table(summary: StudySummary) -> Table:
    """Table with a row per group of equal conditions: mean of each size and its ±."""
    rows = tuple(
        (
            *(shown_condition(one.conditions.get(name)) for name in summary.conditions),
            str(len(one.recordings)),
            str(one.frames),
            *(with_sigma(one.means[size].mean, one.means[size].sigma) for size in SIZES),
        )
        for one in summary.groups
    )
    columns = (*summary.conditions, "recordings", "frames", *SIZES)
    return Table("summary", "Means of each condition, with ±", columns, rows)


def outliers_table(summary: StudySummary) -> Table:
    """Table with a row per frame or recording that is far from the others."""
    rows = tuple(
        (
            one.recording,
            "all" if one.frame is None else str(one.frame),
            column_heading(one.measure),
            f"{one.value:.4g}",
            f"{one.usual:.4g}",
            f"{one.times:.1f}",
        )
        for one in summary.outliers
    )
    columns = ("recording", "frame", "measure", "value", "typical", "standard deviations off")
    return Table("outliers", "Frames and recordings far from the others", columns, rows)


def matches_text(pattern: str) -> str:
    """Text of the number of recordings that match a pattern, and of conditions in their paths."""
    if not pattern:
        return ""
    try:
        found = matching_recordings(pattern)
    except InputError as error:
        return f"⚠ {error.expected}"
    count = pluralize(len(found), "recording")
    names = ", ".join(dict.fromkeys(axis_label(name) for _, varied in found for name in varied))
    if names:
        return f"{count}; conditions: {names}"
    first = "/".join(found[0][0].parts[-2:])
    return (
        f"{count}, the first {first}, without conditions. Where a part of the path is a condition, "
        "write its name in braces instead, as {current_a}"
    )


def is_setup(path: Path) -> bool:
    """Whether a file is a setup file, which a study file resembles by its name."""
    try:
        read_setup(path, lines=True)
    except InputError:
        return False
    return True
