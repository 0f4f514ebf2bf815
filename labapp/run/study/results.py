"""Assembly of the results of a study from the files of its tasks.

::

    measures.parquet/NAME.parquet    row per frame: recording, conditions, `plan.COLUMNS`
    surfaces.zarr/NAME               z_mm(frame, y, x), if surfaces were stored
    recordings.csv                   row per recording: state, problem, frames, means and ±
    summary.csv                      row per condition: means, ±, scatter between recordings
    outliers.csv                     frames and recordings far from the others
    summary.html                     the same as a page
"""

from __future__ import annotations

import secrets
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from labapp.core.pipeline import Measurement
from labapp.core.recording.residual_check import (
    DOUBTFUL,
    ResidualRecord,
    SetupVerdict,
    judged_status,
)
from labapp.core.surface.measures import SIZES, sigma_name
from labapp.errors import os_errors_as_input
from labapp.export.meshes import SPACING_MM
from labapp.export.tables import MM_DIGITS, Columns, number
from labapp.files import as_bytes, atomic_file, write_file
from labapp.run.study.page import summary_page
from labapp.run.study.plan import COLUMNS, Condition, StudyPlan
from labapp.run.study.status import RecordingStatus, Tasks
from labapp.run.study.stretches import ROOM, StretchFile
from labapp.run.study.summary import (
    Mean,
    Outlier,
    RecordingSummary,
    StudySummary,
    group_recordings,
    outlying_frames,
    outlying_recordings,
    recording_means,
)
from labapp.text import csv_text, now

CHUNK = 64
"""Frames per chunk of surfaces."""


def write_results(
    folder: Path,
    plan: StudyPlan,
    parts: Sequence[tuple[RecordingStatus, Tasks | None]],
    surfaces: bool,
) -> StudySummary:
    """Write the results of a study, status and tasks of each recording, into its folder.

    See `Study.results`.
    """
    recordings: list[RecordingSummary] = []
    outliers: list[Outlier] = []
    numbers = [name for name in plan.conditions if _is_number(plan, name)]
    # More threads are slower for the small matrices of the set-up's check.
    with os_errors_as_input(folder, "results", ROOM), threadpool_limits(1, "blas"):
        dataset = folder / "measures.parquet"
        dataset.mkdir(exist_ok=True)
        for known, tasks in parts:
            status, name = known, known.recording.name
            table, verdict = (None, None) if tasks is None else assembled(tasks)
            file = dataset / f"{name}.parquet"
            if tasks is None or table is None:
                file.unlink(missing_ok=True)
                recordings.append(RecordingSummary(_counted(status, 0), {}, "", "", {}))
                continue
            status = _counted(status, len(table["frame"]))
            _write_parquet(file, table, plan.conditions, numbers, status)
            recordings.append(_summarised(status, tasks, table, verdict))
            outliers += outlying_frames(status, table)
            if surfaces:
                _write_surfaces(folder, status, tasks, table)
        names = {one.name for one in plan.recordings}
        for file in dataset.glob("*.parquet"):
            if file.stem not in names:
                file.unlink()
        groups = group_recordings(plan.conditions, recordings)
        outliers = [*outlying_recordings(groups, recordings), *outliers]
        summary = StudySummary(
            plan.title, plan.conditions, tuple(recordings), groups, tuple(outliers)
        )
        write_file(folder / "recordings.csv", as_bytes(csv_text(_recording_rows(summary))))
        write_file(folder / "summary.csv", as_bytes(csv_text(_group_rows(summary))))
        write_file(folder / "outliers.csv", as_bytes(csv_text(_outlier_rows(summary))))
        write_file(folder / "summary.html", as_bytes(summary_page(summary, now())))
    return summary


def _is_number(plan: StudyPlan, name: str) -> bool:
    """Whether a condition is a number in all recordings that have it."""
    values = [one.conditions[name] for one in plan.recordings if name in one.conditions]
    return not any(isinstance(value, str) for value in values)


def _counted(status: RecordingStatus, frames: int) -> RecordingStatus:
    """Return the status with the number of readable frames, without those of damaged files."""
    if frames == status.frames_done:
        return status
    return replace(status, state="part" if frames else "waiting", frames_done=frames)


def assembled(tasks: Tasks) -> tuple[Columns | None, SetupVerdict | None]:
    """Return all measured rows of a recording, and their verdict on the set-up.

    A damaged file is deleted, so that its stretch is measured again.
    """
    tables: list[Columns] = []
    record = ResidualRecord(tasks.setup.rig)
    scheme = tasks.recording.settings.scheme
    for stretch in tasks.stretches:
        path = stretch.done
        if path is None:
            continue
        try:
            with StretchFile(stretch, path) as read:
                table, residuals = read.measures(), read.residuals()
        except ValueError:
            path.unlink()
            continue
        tables.append(table)
        for frame, status in zip(table["frame"].tolist(), table["status"].tolist(), strict=True):
            record.add(Measurement(status, "", scheme), residuals.get(frame))
    if not tables:
        return None, None
    whole = {name: np.concatenate([one[name] for one in tables]) for name in tables[0]}
    verdict = record.verdict()
    status = judged_status(tasks.setup.rig, verdict)
    if status == DOUBTFUL:
        whole["setup_status"] = np.where(whole["setup_status"] != "", status, "")
    return whole, verdict


def _summarised(
    status: RecordingStatus, tasks: Tasks, table: Columns, verdict: SetupVerdict | None
) -> RecordingSummary:
    is_doubtful = verdict is not None and verdict.is_doubtful
    return RecordingSummary(
        status,
        Counter(table["status"].tolist()),
        judged_status(tasks.setup.rig, verdict),
        verdict.reason if verdict is not None and is_doubtful else "",
        recording_means(table),
    )


# --- one table of all frames --------------------------------------------------------------------


def _write_parquet(
    path: Path,
    table: Columns,
    conditions: Sequence[str],
    numbers: Sequence[str],
    status: RecordingStatus,
) -> None:
    """Write the rows of a recording; unknown values are null."""
    import pyarrow as pa
    from pyarrow import parquet

    count = len(table["frame"])
    given = status.recording.conditions
    text = pa.dictionary(pa.int32(), pa.string())
    name = pa.array([status.recording.name] * count, pa.string())
    columns = [name.dictionary_encode()]
    fields = [_field("recording", text, "1", "name of the recording")]
    for condition in conditions:
        kind = pa.float64() if condition in numbers else pa.string()
        value = given.get(condition)
        cell = None if value is None else float(value) if condition in numbers else str(value)
        columns.append(pa.array([cell] * count, kind))
        fields.append(_field(condition, kind, "", "condition"))
    for column in COLUMNS:
        values = table[column.name]
        kind = {"i": pa.int64(), "f": pa.float64()}.get(values.dtype.kind, pa.string())
        columns.append(
            pa.array(values.tolist() if kind == pa.string() else values, kind, from_pandas=True)
        )
        fields.append(_field(column.name, kind, column.unit, column.description))
    with atomic_file(path) as part:
        rows = pa.Table.from_arrays(columns, schema=pa.schema(fields))
        parquet.write_table(rows, part, compression="zstd", row_group_size=10_000)


def _field(name: str, kind: Any, unit: str, description: str) -> Any:
    import pyarrow as pa

    return pa.field(name, kind, metadata={"units": unit, "description": description})


# --- surfaces -----------------------------------------------------------------------------------


def _write_surfaces(folder: Path, status: RecordingStatus, tasks: Tasks, table: Columns) -> None:
    """Write the surfaces of a recording as one array, stretch by stretch; complete or absent."""
    import zarr

    files = [(each, each.file(True)) for each in tasks.stretches if each.file(True).is_file()]
    low, high = np.full(2, np.iinfo(np.int64).max), np.full(2, np.iinfo(np.int64).min)
    frames: list[int] = []
    for stretch, path in files:
        with StretchFile(stretch, path) as read:
            for frame in read.surfaces():
                first = np.array(read.low(frame))
                low = np.minimum(low, first)
                high = np.maximum(high, first + read.surface(frame).shape)
            frames += list(stretch.frames)
    if not frames or (high <= low).any():
        return
    times_s = dict(zip(table["frame"].tolist(), table["time_s"].tolist(), strict=True))
    root = folder / "surfaces.zarr"
    zarr.open_group(root, mode="a", zarr_format=2)
    with _replaced(root / status.recording.name, folder) as part:
        group = zarr.open_group(part, mode="w", zarr_format=2)
        group.attrs.update({"recording": status.recording.name, **status.recording.conditions})
        rows, columns = (np.arange(a, b) * SPACING_MM for a, b in zip(low, high, strict=True))
        _put(group, "y", rows, ("y",), "mm", "Y, along the weld")
        _put(group, "x", columns, ("x",), "mm", "X")
        _put(group, "frame", np.array(frames), ("frame",), "1", "number of the frame")
        seconds = np.array([times_s[frame] for frame in frames])
        _put(group, "time_s", seconds, ("frame",), "s", "time since the first frame")
        heights = group.create_array(
            "z_mm",
            shape=(len(frames), len(rows), len(columns)),
            chunks=(min(CHUNK, len(frames)), len(rows), len(columns)),
            dtype="float32",
            fill_value=np.nan,
            attributes=_about(("frame", "y", "x"), "mm", "height above the work piece"),
        )
        at = 0
        for stretch, path in files:
            block = np.full((len(stretch.frames), *heights.shape[1:]), np.nan, np.float32)
            with StretchFile(stretch, path) as read:
                for frame in read.surfaces():
                    z_mm = read.surface(frame)
                    row, column = np.array(read.low(frame)) - low
                    place = block[stretch.frames.index(frame)]
                    place[row : row + z_mm.shape[0], column : column + z_mm.shape[1]] = z_mm
            heights[at : at + len(block)] = block
            at += len(block)


def _put(
    group: Any, name: str, values: Any, dimensions: Sequence[str], unit: str, description: str
) -> None:
    about = _about(dimensions, unit, description)
    # No fill value, which readers would interpret as missing.
    group.create_array(name, data=values, fill_value=None, attributes=about)


def _about(dimensions: Sequence[str], unit: str, description: str) -> dict[str, object]:
    return {"_ARRAY_DIMENSIONS": list(dimensions), "units": unit, "long_name": description}


@contextmanager
def _replaced(target: Path, beside: Path) -> Iterator[Path]:
    """Yield a temporary folder, which replaces ``target`` unless the block raises."""
    part = beside / f".{secrets.token_hex(8)}.part"
    part.mkdir()
    try:
        yield part
        if target.exists():
            shutil.rmtree(target)
        part.rename(target)
    finally:
        shutil.rmtree(part, ignore_errors=True)


# --- tables -------------------------------------------------------------------------------------


def _mean_names(size: str) -> list[str]:
    return [size, sigma_name(size), sigma_name(size, "scatter").replace("sigma_", "")]


def _mean_cells(mean: Mean | None) -> list[str]:
    if mean is None:
        return [""] * 3
    return [number(value, MM_DIGITS) for value in (mean.mean, mean.sigma, mean.scatter)]


def _conditions(names: Iterable[str], values: dict[str, Condition]) -> list[Condition]:
    return [values.get(name, "") for name in names]


def _recording_rows(summary: StudySummary) -> Iterator[list[object]]:
    sizes = [name for size in SIZES for name in _mean_names(size)]
    head = ["recording", "file", *summary.conditions, "state", "frames", "frames_done", "ok"]
    yield [*head, *sizes, "setup_status", "doubt", "problem"]
    for one in summary.recordings:
        status, recording = one.status, one.status.recording
        yield [
            *(recording.name, str(recording.path)),
            *_conditions(summary.conditions, dict(recording.conditions)),
            *(status.state, status.frames, status.frames_done, one.statuses.get("ok", 0)),
            *(cell for size in SIZES for cell in _mean_cells(one.means.get(size))),
            *(one.setup_status, one.doubt, status.problem),
        ]


def _group_rows(summary: StudySummary) -> Iterator[list[object]]:
    sizes = [name for size in SIZES for name in _mean_names(size)]
    yield [*summary.conditions, "recordings", "frames", *sizes]
    for one in summary.groups:
        yield [
            *_conditions(summary.conditions, dict(one.conditions)),
            *(len(one.recordings), one.frames),
            *(cell for size in SIZES for cell in _mean_cells(one.means[size])),
        ]


def _outlier_rows(summary: StudySummary) -> Iterator[list[object]]:
    yield ["recording", "file", "frame", "measure", "value", "usual", "times"]
    for one in summary.outliers:
        yield [
            *(one.recording, one.file, "" if one.frame is None else one.frame, one.measure),
            *(number(one.value), number(one.usual), number(one.times, 1)),
        ]
