"""Summary of a study: mean sizes by condition, with ±, and outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from labapp.core.sequence.mean import (
    level_sigma_of_mean,
    noise_sigma_of_mean,
    setup_sigma_of_mean,
)
from labapp.core.surface.measures import SIZES, sigma_name
from labapp.core.values import FloatArray, robust_sigma
from labapp.export.tables import Columns
from labapp.run.study.plan import Condition
from labapp.run.study.status import RecordingStatus

FAR = 5.0
"""Distance of an outlying frame from the median, in standard deviations and in its own ±."""

SURE = 0.999
"""A recording outside the interval that contains others with this probability is an outlier."""

FEWEST_FRAMES, FEWEST_RECORDINGS = 10, 4
"""Outliers are looked for only among this many or more."""

MOST_OUTLIERS = 100
"""Most outliers listed of one recording."""


@dataclass(frozen=True)
class Mean:
    """Mean of a size, and its uncertainty."""

    mean: float
    noise: float
    level: float
    setup: float
    """Parts of its standard uncertainty; NaN if the scheme gives none."""
    scatter: float
    """Standard deviation of frames in a recording, or of recordings under one condition."""
    count: int
    """Number of frames or recordings."""

    @property
    def sigma(self) -> float:
        """Its standard uncertainty (`core.sequence.mean.sigma_of_mean`)."""
        return float(np.linalg.norm([self.noise, self.level, self.setup]))


@dataclass(frozen=True)
class Outlier:
    """A frame far from the others of its recording, or a recording far from similar ones."""

    recording: str
    file: str
    frame: int | None
    """None: the mean of the recording."""
    measure: str
    value: float
    usual: float
    """Median of the others."""
    times: float
    """Distance in standard deviations."""


@dataclass(frozen=True)
class RecordingSummary:
    """Results of a recording."""

    status: RecordingStatus
    statuses: Mapping[str, int]
    """Number of frames with each status."""
    setup_status: str
    """Status of the set-up (`Measurement.setup_status`)."""
    doubt: str
    """Reason for the status ``doubtful``; otherwise empty."""
    means: Mapping[str, Mean]
    """Mean of each of `SIZES` over its frames with a surface."""


@dataclass(frozen=True)
class GroupSummary:
    """Results of the recordings with the same conditions."""

    conditions: Mapping[str, Condition]
    recordings: tuple[str, ...]
    frames: int
    """Frames with a surface."""
    means: Mapping[str, Mean]
    """Mean of each of `SIZES`; recordings have equal weight."""


@dataclass(frozen=True)
class StudySummary:
    """The results of a study."""

    title: str
    conditions: tuple[str, ...]
    recordings: tuple[RecordingSummary, ...]
    groups: tuple[GroupSummary, ...]
    outliers: tuple[Outlier, ...]


def recording_means(table: Columns) -> dict[str, Mean]:
    """Return the mean of each size over the frames with a surface; empty if there is none.

    The table has the columns of `measures.csv`.
    """
    measured = table["status"] == "ok"
    if not measured.any():
        return {}
    series = {name: values[measured] for name, values in table.items() if values.dtype.kind in "fi"}
    means = {}
    for size in SIZES:
        values = series[size]
        means[size] = Mean(
            float(values.mean()),
            noise_sigma_of_mean(size, series),
            level_sigma_of_mean(size, series),
            setup_sigma_of_mean(size, series),
            _deviation(values),
            len(values),
        )
    return means


def group_recordings(
    conditions: Sequence[str], recordings: Sequence[RecordingSummary]
) -> tuple[GroupSummary, ...]:
    """Return means over the recordings with the same conditions.

    Noise is independent between recordings. Errors of the level and of the set-up are assumed to
    be common to all of them, and do not average out.
    """
    groups: dict[tuple[Condition | None, ...], list[RecordingSummary]] = {}
    for one in recordings:
        if one.means:
            values = one.status.recording.conditions
            groups.setdefault(tuple(map(values.get, conditions)), []).append(one)
    found = []
    for given, members in sorted(groups.items(), key=lambda item: _order(item[0])):
        known = {k: v for k, v in zip(conditions, given, strict=True) if v is not None}
        names = tuple(one.status.recording.name for one in members)
        frames = sum(one.statuses.get("ok", 0) for one in members)
        means = {size: _common([one.means[size] for one in members]) for size in SIZES}
        found.append(GroupSummary(known, names, frames, means))
    return tuple(found)


def _order(values: Sequence[Condition | None]) -> list[tuple[int, float, str]]:
    """Return a sort key: numbers before text before missing values."""
    return [
        (2, 0.0, "") if v is None else (1, 0.0, v) if isinstance(v, str) else (0, float(v), "")
        for v in values
    ]


def _common(means: Sequence[Mean]) -> Mean:
    count = len(means)
    values = np.array([one.mean for one in means])
    noise = float(np.linalg.norm([one.noise for one in means])) / count
    level, setup = (
        float(np.mean([getattr(one, part) for one in means])) for part in ("level", "setup")
    )
    return Mean(float(values.mean()), noise, level, setup, _deviation(values), count)


def _deviation(values: FloatArray) -> float:
    """Return the sample standard deviation; NaN for one value."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def outlying_frames(status: RecordingStatus, table: Columns) -> list[Outlier]:
    """Return frames with a size far from the recording's median, the farthest first.

    Far is more than `FAR` times the robust standard deviation of the frames, and `FAR` times the
    frame's own standard uncertainty from noise and level.
    """
    measured = np.flatnonzero(table["status"] == "ok")
    if len(measured) < FEWEST_FRAMES:
        return []
    found = []
    for size in SIZES:
        values = table[size][measured]
        noise, level = (table[sigma_name(size, part)][measured] for part in ("noise", "level"))
        times = _times(values, np.nan_to_num(np.hypot(noise, level)))
        for place in np.flatnonzero(times > FAR):
            frame = int(table["frame"][measured[place]])
            found.append(
                _outlier(status, frame, size, float(values[place]), values, float(times[place]))
            )
    return sorted(found, key=lambda one: -one.times)[:MOST_OUTLIERS]


def outlying_recordings(
    groups: Sequence[GroupSummary], recordings: Sequence[RecordingSummary]
) -> list[Outlier]:
    """Return recordings whose mean is far from that of the others under the same conditions.

    Far is outside the prediction interval of Student's t for one more recording, with
    probability `SURE`.
    """
    by_name = {one.status.recording.name: one for one in recordings}
    found = []
    for group in groups:
        members = [by_name[name] for name in group.recordings]
        count = len(members) - 1
        if len(members) < FEWEST_RECORDINGS:
            continue
        limit = stdtrit(count - 1, (1 + SURE) / 2)
        for size in SIZES:
            values = np.array([one.means[size].mean for one in members])
            for place, one in enumerate(members):
                others = np.delete(values, place)
                spread = max(_deviation(others), np.nan_to_num(one.means[size].noise))
                spread *= math.sqrt(1 + 1 / count)
                times = abs(values[place] - others.mean()) / spread if spread > 0 else 0.0
                if times > limit:
                    value = float(values[place])
                    found.append(_outlier(one.status, None, size, value, others, float(times)))
    return found


def _times(values: FloatArray, own: FloatArray) -> FloatArray:
    """Return the distance of values from their median in standard deviations, shape (n,).

    The unit is the robust standard deviation of all values, or the value's own σ if larger.
    """
    away = np.abs(values - np.median(values))
    deviation = np.maximum(robust_sigma(away), own)
    return np.asarray(
        np.divide(away, deviation, out=np.zeros_like(away), where=deviation > 0), np.float64
    )


def _outlier(
    status: RecordingStatus,
    frame: int | None,
    size: str,
    value: float,
    values: FloatArray,
    times: float,
) -> Outlier:
    recording = status.recording
    usual = float(np.median(values))
    return Outlier(recording.name, str(recording.path), frame, size, value, usual, times)
