"""Data of plots: curves of points with their σ, marks and keys. Without Qt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays
from labapp.text import rounded


@dataclass(frozen=True)
class Mark:
    """Symbol of a point, and its meaning."""

    sign: str
    """● or ○ (circles, filled and open), ■ or ▪ (squares, the small one red), × (a cross)."""
    words: str


GAP = 2
"""A line is interrupted where the frame numbers of its points differ by more than their usual
difference times this: a single missing frame does not interrupt it."""

PLAIN = Mark("●", "")


def _none() -> IntArray:
    return np.zeros(0, np.int64)


def titled(name: str, unit: str) -> str:
    """Name of a quantity, and its unit if it has one."""
    return f"{name} ({unit})" if unit else name


@dataclass(frozen=True)
class Curve(ReadOnlyArrays):
    """One curve of a plot; n points."""

    name: str
    unit: str
    """Quantity and unit of the vertical axis."""
    x: FloatArray
    y: FloatArray
    """Shape (n,); x ascends, a NaN in y is a gap."""
    sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    """± of each y, shape (n,); NaN where it is unknown. Empty: no error bars."""
    key: IntArray = field(default_factory=_none)
    """Frame number of each point, ascending, shape (n,). If empty, only the line is drawn and no
    point can be selected.
    """
    mark: IntArray = field(default_factory=_none)
    """Index of each point's mark, shape (n,); empty if ``key`` is."""
    marks: tuple[Mark, ...] = (PLAIN,)
    """The marks, the usual one first."""
    level: float = float("nan")
    """Height of a dashed line (the mean); NaN for none."""
    decimals: int = 3
    """Decimals of y where σ is unknown."""
    from_zero: bool = False
    limits: tuple[float | None, float | None] = (None, None)
    """Lower and upper limit of y, drawn as lines that are always in view; None for none."""
    events: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Positions on the axis where the curve changes, each drawn as a dotted line."""
    quick: bool = False
    """Whether marks are drawn only where they are not the usual one, because the curve is redrawn
    many times per second.
    """

    @property
    def line(self) -> tuple[FloatArray, FloatArray]:
        """Points of its line, which is interrupted where frames are missing (`GAP`)."""
        if self.quick or len(self.key) < 3:
            return self.x, self.y
        step = np.diff(self.key)
        gap = np.flatnonzero(step > GAP * np.median(step)) + 1
        return np.insert(self.x, gap, self.x[gap]), np.insert(self.y, gap, np.nan)

    @property
    def title(self) -> str:
        """Name and unit."""
        return titled(self.name, self.unit)


@dataclass(frozen=True)
class Axis:
    """The horizontal axis."""

    name: str
    unit: str
    """"Time", "s"."""
    decimals: int = 4
    """Decimals of a position on the axis, in text."""
    span: tuple[float, float] | None = None
    """Both ends of the range that is always visible; None: the range of the curves."""

    @property
    def title(self) -> str:
        """Name and unit."""
        return titled(self.name, self.unit)


def point_text(curve: Curve, index: int, axis: Axis) -> str:
    """Text of a point for the read-out and the screen reader."""
    sigma = float(curve.sigma[index]) if len(curve.sigma) else None
    value, spread = rounded(float(curve.y[index]), sigma, curve.decimals)
    message = f"{curve.name} {value}{f' ± {spread}' if spread else ''} {curve.unit}".strip()
    place, _ = rounded(float(curve.x[index]), None, axis.decimals)
    where = f"{axis.name.lower()} {place} {axis.unit}".strip()
    if len(curve.key):
        where = f"frame {curve.key[index]}" + (f", {place} s" * (axis.unit == "s"))
        mark = curve.mark[index]
        where += f", {curve.marks[mark].words}" if mark else ""
    return f"{where[0].upper()}{where[1:]}: {message}"


def nearest(curve: Curve, x: float) -> int | None:
    """Index of the point nearest to a position on the axis; None if there is no point."""
    if not len(curve.x):
        return None
    after = int(np.searchsorted(curve.x, x))
    around = [k for k in (after - 1, after) if 0 <= k < len(curve.x)]
    return min(around, key=lambda k: abs(float(curve.x[k]) - x))


def next_key(curves: Sequence[Curve], current: int, step: int) -> int | None:
    """The key ``step`` points after the current one (negative: before it); None without points."""
    keyed = [curve.key for curve in curves if len(curve.key)]
    if not keyed:
        return None
    keys = np.unique(np.concatenate(keyed))
    place = int(np.searchsorted(keys, current))
    there = place < len(keys) and keys[place] == current
    if step > 0 and not there:
        place -= 1
    return int(keys[min(max(place + step, 0), len(keys) - 1)])


def as_table(curves: Sequence[Curve], axis: Axis) -> str:
    """Values of all curves with keys as tab-separated text with a header, for a spreadsheet."""
    keyed = [curve for curve in curves if len(curve.key)]
    keys = np.unique(np.concatenate([curve.key for curve in keyed])) if keyed else _none()
    names = ["frame", axis.title]
    columns: list[list[str]] = [[str(key) for key in keys], _spread_out(keys, keyed)]
    for curve in keyed:
        names.append(curve.title)
        columns.append(_cells(keys, curve.key, _numbers(curve.y)))
        if np.isfinite(curve.sigma).any():
            names.append(titled(f"{curve.name} σ", curve.unit))
            columns.append(_cells(keys, curve.key, _numbers(curve.sigma)))
    if keyed:
        names.append("mark")
        words = [keyed[0].marks[mark].words for mark in keyed[0].mark]
        columns.append(_cells(keys, keyed[0].key, words))
    lines = ["\t".join(names), *("\t".join(cells) for cells in zip(*columns, strict=True))]
    return "\n".join(lines) + "\n"


def _spread_out(keys: IntArray, keyed: Sequence[Curve]) -> list[str]:
    places: dict[int, float] = {}
    for curve in keyed:
        places.update(zip(curve.key.tolist(), curve.x.tolist(), strict=True))
    return [f"{places[key]:.9g}" for key in keys.tolist()]


def _numbers(values: FloatArray) -> list[str]:
    return ["" if np.isnan(value) else f"{value:.9g}" for value in values]


def _cells(keys: IntArray, own: IntArray, texts: Sequence[str]) -> list[str]:
    held = dict(zip(own.tolist(), texts, strict=True))
    return [held.get(key, "") for key in keys.tolist()]
