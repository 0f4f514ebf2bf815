"""Data of the window of studies, and sessions of single recordings. Without Qt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from labapp.config.setup import read_setup
from labapp.core.surface.measures import SIZES
from labapp.errors import InputError
from labapp.gui.digits import with_sigma
from labapp.run.study.plan import StudyPlan, StudyRecording, matching_recordings, shown_condition
from labapp.run.study.status import STATE_WORDS, RecordingStatus, State
from labapp.run.study.summary import StudySummary
from labapp.session.creation import new_session
from labapp.session.file.database import SUFFIX
from labapp.session.record import Record
from labapp.simulation.parallel import Progress
from labapp.studies.tables import Table
from labapp.text import axis_label, column_heading, pluralize

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
        f"{count} without conditions, the first {first}. Write a name in braces for each part of "
        "the path that is one: {current_a}"
    )


def is_setup(path: Path) -> bool:
    """Whether a file is a setup file, which a study file resembles by its name."""
    try:
        read_setup(path, lines=True)
    except InputError:
        return False
    return True


def session_path(folder: Path, recording: StudyRecording) -> Path:
    """Path of the session of a study's recording, in the folder of the results."""
    return folder / "sessions" / f"{recording.name}{SUFFIX}"


def begin_session(folder: Path, recording: StudyRecording, progress: Progress) -> Path:
    """Create a session of a study's recording, measured as in the study, unless it exists.

    Parameters
    ----------
    folder
        Folder of the study's results.
    progress
        Called with the current stage, the frames done, and their total; may raise to stop. If it
        raises during the import, no session is left; later, the measured frames are kept.

    Raises
    ------
    InputError
        If the recording or its setup file cannot be read, or the session cannot be written.
    """
    path = session_path(folder, recording)
    if path.exists():
        return path
    text = read_setup(recording.setup, lines=True).text
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_session(path, _record(recording)) as session:
        session.set_setup(text)
        session.set_settings(recording.settings)
        session.import_recording(
            recording.path,
            recording.frames,
            progress=lambda done, total: progress("importing", done, total),
        )
    with session:
        total = len(session.frames)
        for done, _ in enumerate(session.measure_each(warm=recording.warm), 1):
            progress("measuring", done, total)
    return path


def _record(recording: StudyRecording) -> Record:
    """Record of a recording: conditions with a field of their own, others as notes."""
    kinds = {each.name: str(each.type) for each in fields(Record)}
    known, others = {}, []
    for name, value in recording.conditions.items():
        wanted = "str" if isinstance(value, str) else "float | None"
        if kinds.get(name) == wanted and name not in ("title", "notes"):
            known[name] = value
        else:
            others.append(f"{name} = {shown_condition(value)}")
    return Record(title=recording.name, notes="\n".join(others), **known)  # type: ignore[arg-type]
