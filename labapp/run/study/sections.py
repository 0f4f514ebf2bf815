"""Assignment of sections and back-side scans to the frames of a study's recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from labapp.config.csv_tables import read_columns
from labapp.core.dynamics.weld_series import WeldSeries
from labapp.core.surface.measures import WITH_SIGMA, sigma_name
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.export.features import FeatureTable, weld_series
from labapp.export.tables import Columns
from labapp.run.study.plan import RESERVED, StudyPlan

LARGEST_FILE = 64_000_000

WANTED = (
    "a table with recording, position_mm or time_s, one column of penetration such as "
    "back_width_mm, and optionally its ± such as back_width_sigma_mm"
)

PLACES = ("time_s", "position_mm", "start_mm", "travel_mm_s")
"""Columns for the position of a section."""

NEAR_S = 0.1
"""Largest time between a section and the nearest frame with a surface, s."""


def study_features(
    plan: StudyPlan, tables: Mapping[str, Columns], sections: Path | None
) -> tuple[FeatureTable, int]:
    """Return features of the recordings with sections, and the number of unassigned sections.

    Parameters
    ----------
    plan
        The study; ``start_mm`` (weld position under the electrode at the recording's first frame)
        and ``travel_mm_s`` may be conditions.
    tables
        Columns of each recording (`Study.tables`).
    sections
        Table of sections (`WANTED`); ``start_mm`` and ``travel_mm_s`` may be columns, which
        override conditions. None: no sections, and all recordings.

    Raises
    ------
    InputError
        If the table of sections is invalid, or none of them is near a frame.
    """
    series = {name: _series(name, table) for name, table in tables.items()}
    if not series:
        raise InputError("study", "results", "none", "labapp study run first")
    if sections is None:
        return FeatureTable(WITH_SIGMA, "", tuple(series.values())), 0
    target, names, time_s, value, sigma = _read(plan, sections)
    found, unused = [], 0
    for name, one in series.items():
        rows = names == name
        if rows.any():
            joined, left = _joined(one, time_s[rows], value[rows], sigma[rows])
            found.append(joined)
            unused += left
    if not any(np.isfinite(one.target).any() for one in found):
        right = f"sections within {NEAR_S:g} s of frames that have a surface and a time"
        raise InputError(sections, "sections", "none near a frame", right)
    return FeatureTable(WITH_SIGMA, target, tuple(found)), unused


def _series(name: str, table: Columns) -> WeldSeries:
    there = (table["status"] == "ok") & np.isfinite(table["time_s"])
    columns = {key: of[there] for key, of in table.items() if of.dtype.kind in "fi"}
    return weld_series(name, columns["time_s"], columns, WITH_SIGMA)


def _read(
    plan: StudyPlan, path: Path
) -> tuple[str, np.ndarray, FloatArray, FloatArray, FloatArray]:
    """Read the name of the penetration; recording, time, penetration and ± of each section."""
    words, columns = read_columns(path, WANTED, LARGEST_FILE, ("recording",))
    names = words.get("recording")
    others = [name for name in columns if name not in PLACES]
    targets = [name for name in others if len(others) == 1 or sigma_name(name) in others]
    if not names or len(targets) != 1 or len(others) > 2:
        raise InputError(path, "columns", ", ".join(columns) or "none", WANTED)
    target = targets[0]
    if target in RESERVED:
        right = "another name: a size of the pool has this one"
        raise InputError(path, "columns", target, right)
    unknown = sorted(set(names) - {one.name for one in plan.recordings})
    if unknown:
        right = "names of the study's recordings, as in its recordings.csv"
        raise InputError(path, "recording", ", ".join(unknown), right)
    of, missing = np.array(names), np.full(len(names), np.nan)
    value, sigma = columns[target], columns.get(sigma_name(target), missing)
    if (value < 0).any() or (sigma < 0).any():
        raise InputError(path, target, "negative", "0 or more")
    time_s = columns.get("time_s", missing).copy()
    if "position_mm" in columns:
        start, travel = (_given(plan, of, columns, name) for name in ("start_mm", "travel_mm_s"))
        by_place = (columns["position_mm"] - start) / np.where(travel > 0, travel, np.nan)
        time_s = np.where(np.isfinite(time_s), time_s, by_place)
    bad = np.flatnonzero(~np.isfinite(time_s) & np.isfinite(value))
    if len(bad):
        right = "time_s; or position_mm with start_mm and travel_mm_s above 0, as columns of this "
        right += "table or conditions of the recording"
        raise InputError(path, f"section of {of[bad[0]]}", "no time", right)
    known = np.isfinite(value)
    return target, of[known], time_s[known], value[known], sigma[known]


def _given(
    plan: StudyPlan, of: np.ndarray, columns: Mapping[str, FloatArray], name: str
) -> FloatArray:
    """Return a column of sections; where it is empty, the condition of that name."""
    conditions = {one.name: one.conditions.get(name) for one in plan.recordings}
    by_name = [conditions[each] for each in of.tolist()]
    condition = np.array([np.nan if isinstance(v, str) or v is None else v for v in by_name], float)
    column = columns.get(name, condition)
    return np.where(np.isfinite(column), column, condition)


def _joined(
    one: WeldSeries, time_s: FloatArray, value: FloatArray, sigma: FloatArray
) -> tuple[WeldSeries, int]:
    """Assign sections to the nearest frames; also returns the number of unassigned sections."""
    target, target_sigma = np.full((2, len(one.time_s)), np.nan)
    if not len(one.time_s):
        return one, len(time_s)
    after = np.clip(np.searchsorted(one.time_s, time_s), 1, max(len(one.time_s) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(one.time_s) - 1)
    is_after = one.time_s[after] - time_s < time_s - one.time_s[before]
    nearest = np.where(is_after, after, before)
    near = np.abs(one.time_s[nearest] - time_s) <= NEAR_S
    for frame in np.unique(nearest[near]):
        these = near & (nearest == frame)
        target[frame] = value[these].mean()
        target_sigma[frame] = np.sqrt(np.sum(sigma[these] ** 2)) / these.sum()
    return replace(one, target=target, target_sigma=target_sigma), int((~near).sum())
