"""Current, voltage and wire feed of a weld, read from a logger's file: CSV, TDMS or WAV."""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
import warnings
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from labapp.config.csv_tables import (
    LARGEST,
    PROBLEMS_SHOWN,
    NumberCells,
    bounded_lines,
    open_table,
    split_header,
)
from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.errors import InputError
from labapp.files import regular_size

if TYPE_CHECKING:
    from labapp.core.dynamics.alignment import Offset
    from labapp.media import Frame

A_TABLE = (
    "a table (CSV, UTF-8) with a header line: a time (s, ms, µs), and a current (A), a voltage (V) "
    "or a wire feed (m/min)"
)
A_TDMS = "TDMS with channels for current, voltage or wire feed, and a time or an increment"
A_WAV = "WAV (PCM of 8, 16 or 32 bits, or floats): current, voltage, wire feed, one channel each"

LARGEST_FILE = 1 << 28
MOST_ROWS = 500_000
LINES_ABOVE = 60
"""Most lines up to the header line; loggers write information above it."""

NAMES = {
    "time": "time|zeit|t|seconds",
    "current": "current|weld_?current|welding_?current|strom|i|amps?|amperes?",
    "voltage": "voltage|weld_?voltage|welding_?voltage|arc_?voltage|spannung|u|v|volts?",
    "wire": "wire|wire_?feed|wire_?feed_?(speed|rate)|wfs|drahtvorschub",
}
UNITS = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6},
    "current": {"a": 1.0, "ma": 1e-3, "ka": 1e3, "amps": 1.0, "amperes": 1.0},
    "voltage": {"v": 1.0, "mv": 1e-3, "kv": 1e3, "volts": 1.0},
    "wire": {"m/min": 1.0, "mm/s": 0.06, "cm/s": 0.6, "m/s": 60.0, "in/min": 0.0254, "ipm": 0.0254},
}
"""Units of each quantity in s, A, V, m/min, which are also the defaults."""

CHANNELS = ("current", "voltage", "wire")


@dataclass(frozen=True)
class Signals(ReadOnlyArrays):
    """Current, voltage and wire feed of a weld; n samples."""

    file: str
    """Name of the source file."""
    time_s: FloatArray
    """Time of each sample by the logger's clock, ascending, shape (n,), s."""
    current_a: FloatArray
    voltage_v: FloatArray
    """Samples, shape (n,), A and V; NaN if missing."""
    start_s: float = 0.0
    """Time of the logger's zero in the recording, s."""
    wire_m_min: FloatArray = field(default_factory=lambda: np.empty(0))
    """Wire feed, shape (n,), m/min; NaN if missing, as in older files."""

    def __post_init__(self) -> None:
        if not len(self.wire_m_min):
            object.__setattr__(self, "wire_m_min", np.full(len(self.time_s), np.nan))
        super().__post_init__()

    @property
    def channels(self) -> dict[str, FloatArray]:
        """The channels that have samples: name → values, shape (n,)."""
        every = zip(CHANNELS, (self.current_a, self.voltage_v, self.wire_m_min), strict=True)
        return {name: value for name, value in every if np.isfinite(value).any()}

    def timed(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return the channels with their times in the recording, s."""
        return {name: (self.time_s + self.start_s, of) for name, of in self.channels.items()}


def align_signals(signals: Signals, frames: Iterable[Frame]) -> tuple[Signals, Offset]:
    """Estimate the signals' start by correlation with the mean brightness of frames.

    The channel with the largest correlation is used, usually the current.

    Raises
    ------
    InputError
        If no channel correlates, frames have no time, or the signals are far too long.
    """
    from labapp.core.dynamics.alignment import find_offset

    seen = [(frame.time_s, float(frame.image.mean())) for frame in frames]
    times = [time_s for time_s, _ in seen if time_s is not None]
    if len(times) < len(seen):
        raise InputError("signals", "start", "unknown", "a recording that has a time base")
    light = np.array([bright for _, bright in seen])
    try:
        found = [
            offset
            for of in signals.channels.values()
            if (offset := find_offset(signals.time_s, of, np.array(times), light)) is not None
        ]
    except ValueError as error:
        right = "signals about as long as the recording, their time in the unit that it names"
        raise InputError(signals.file, "time", str(error), right) from error
    if not found:
        right = "signals that correlate with the frames' brightness; or enter their start"
        raise InputError(signals.file, "start", "not found: light and signals differ", right)
    best = max(found, key=lambda one: abs(one.correlation))
    return replace(signals, start_s=best.start_s), best


@dataclass(frozen=True)
class _Column:
    """Column of a quantity: header, index, and factor of its unit."""

    quantity: str
    name: str
    place: int
    factor: float


def read_signals(
    path: str | os.PathLike[str], full_scale: Sequence[float] = (1.0, 1.0, 1.0)
) -> Signals:
    """Read current, voltage and wire feed from CSV, TDMS (``.tdms``) or WAV (``.wav``).

    The header line of a CSV file may follow other lines. A header is the name of the quantity, with
    its unit in brackets or after an underscore: ``time_s``, ``Current (A)``, ``U [V]``,
    ``WFS [m/min]``. The separator is a comma, a semicolon or a tab; the decimal sign a point or,
    with the latter two, a comma. An empty cell is a missing sample. Other columns are ignored.
    TDMS channels are named likewise, or have their unit in the property ``unit_string``. More than
    `MOST_ROWS` samples of TDMS and WAV are averaged in blocks.

    Parameters
    ----------
    full_scale
        For WAV: full scale of the first, second and third channel, A, V and m/min.

    Raises
    ------
    InputError
        If the file cannot be read, or anything in it is missing or invalid; the first ten problems
        of a table are reported together, each with its line and column.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in (".tdms", ".wav"):
        wanted = A_TDMS if suffix == ".tdms" else A_WAV
        with _hostile(path, wanted):
            found = _read_tdms(path) if suffix == ".tdms" else _read_wav(path, full_scale)
    else:
        with open_table(path, A_TABLE, LARGEST_FILE) as file:
            found = _read(path, file)
    if not found.channels:
        named = ", ".join(CHANNELS)
        raise InputError(path, named, "no numbers", "numbers in one of the channels")
    for name, values in {"time": found.time_s, **found.channels}.items():
        largest = float(np.nanmax(np.abs(values)))
        if largest > LARGEST:
            raise InputError(
                path, name, f"{largest:g}", f"numbers from {-LARGEST:g} to {LARGEST:g}"
            )
    return found


@contextmanager
def _hostile(path: Path, wanted: str) -> Iterator[None]:
    """Check the size of an untrusted binary file, and convert all errors to `InputError`."""
    try:
        size = regular_size(path)
        if size > LARGEST_FILE:
            raise InputError(path, "size", f"{size} bytes", f"at most {LARGEST_FILE} bytes")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # unknown chunks
            yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(path, "file", error.strerror or error, wanted) from error
    except Exception as error:  # malformed bytes can raise anything in the reader
        words = str(error) if isinstance(error, ValueError) and str(error) else "cannot be decoded"
        raise InputError(path, "content", words, wanted) from error


def _read_tdms(path: Path) -> Signals:
    try:
        from nptdms import TdmsFile
    except ImportError as error:
        wanted = "the package nptdms: pip install 'labapp[tdms]'"
        raise InputError(path, "format", "TDMS", wanted) from error
    found: dict[str, FloatArray] = {}
    time_s: FloatArray | None = None
    with path.open("rb") as raw, TdmsFile.open(raw) as file:
        for channel in (channel for group in file.groups() for channel in group.channels()):
            unit = str(channel.properties.get("unit_string") or "") or None
            named = _named(channel.name, 0, unit)
            if not named and unit and (other := _named(channel.name, 0)):
                right = f"one of {', '.join(UNITS[other[0].quantity])}"
                raise InputError(path, f"unit of {channel.name}", unit, right)
            if not named:
                continue
            if named[0].quantity in found:
                right = f"one channel for {named[0].quantity}"
                raise InputError(path, "channels", f"{channel.name}, another one", right)
            bytes_held = len(channel) * max(getattr(channel.dtype, "itemsize", 8), 1)
            if bytes_held > path.stat().st_size or channel.dtype.kind not in "iuf":
                shown = f"{len(channel)} samples of {channel.dtype}"
                raise InputError(path, channel.name, shown, "numbers that the file holds")
            found[named[0].quantity] = np.asarray(channel[:], float) * named[0].factor
            if time_s is None and channel.properties.get("wf_increment"):
                start = float(channel.properties.get("wf_start_offset", 0.0))
                step = float(channel.properties["wf_increment"])
                time_s = np.asarray(start + step * np.arange(len(channel)), float)
    return _signals(path, found.pop("time", time_s), found, A_TDMS)


def _read_wav(path: Path, full_scale: Sequence[float]) -> Signals:
    from scipy.io import wavfile

    rate, data = wavfile.read(path, mmap=True)
    if not all(math.isfinite(scale) and scale for scale in full_scale):
        raise InputError(path, "full scale", full_scale, "finite numbers that are not 0")
    data = data.reshape(len(data), -1)[:, : len(CHANNELS)]
    if data.dtype.kind == "f":
        offset, scale = 0.0, 1.0
    else:  # 8-bit WAV is unsigned
        scale = 2.0 ** (8 * data.itemsize - 1)
        offset = scale if data.dtype.kind == "u" else 0.0
    found = {
        name: (values.astype(float) - offset) / scale * factor
        for name, values, factor in zip(CHANNELS, data.T, full_scale, strict=False)
    }
    return _signals(path, np.arange(len(data)) / rate, found, A_WAV)


def _signals(
    path: Path, time_s: FloatArray | None, found: dict[str, FloatArray], wanted: str
) -> Signals:
    """Return signals, averaged in blocks to at most `MOST_ROWS` samples."""
    if time_s is None or not found:
        raise InputError(path, "channels", ", ".join(found) or "none of these", wanted)
    count = len(time_s)
    if not count or any(len(values) != count for values in found.values()):
        shown = ", ".join(f"{name} {len(values)}" for name, values in found.items())
        raise InputError(path, "samples", f"time {count}, {shown}", "as many of each, and some")
    if not np.isfinite(time_s).all() or (np.diff(time_s) <= 0).any():
        raise InputError(path, "time", "not ascending", "times that ascend")
    block = -(-count // MOST_ROWS)
    begins = np.arange(0, count, block)
    share = np.diff(np.append(begins, count))

    def mean(values: FloatArray) -> FloatArray:
        values = np.where(np.isfinite(values), values, np.nan)
        return np.asarray(np.add.reduceat(values, begins) / share)

    of = {
        name: mean(found[name]) if name in found else np.full(len(begins), np.nan)
        for name in CHANNELS
    }
    return Signals(path.name, mean(time_s), of["current"], of["voltage"], wire_m_min=of["wire"])


def _read(path: Path, file: TextIO) -> Signals:
    lines = bounded_lines(path, file, A_TABLE)
    above, separator, columns, width = _find_names(path, lines)
    problems: list[InputError] = []
    held = {column.quantity: array("d") for column in columns}
    last, last_line = -math.inf, 0
    reader, number = csv.reader(lines, delimiter=separator, strict=True), NumberCells(separator)
    for cells in reader:
        line = above + reader.line_num
        if not any(map(str.strip, cells)):
            continue
        if len(cells) != width:
            hint = "; decimal commas need ; between the columns" * (separator == ",")
            wanted = f"{width}, as in the line of names{hint}"
            problems.append(InputError(path, f"line {line}, cells", len(cells), wanted))
        else:
            time_s = _take(path, line, cells, columns, number, held, problems)
            if time_s is not None and time_s <= last:
                wanted = f"a time after that of line {last_line}"
                cell = cells[columns[0].place].strip()
                problems.append(InputError(path, f"line {line}, {columns[0].name}", cell, wanted))
            if time_s is not None:
                last, last_line = time_s, line
        if len(problems) >= PROBLEMS_SHOWN:
            break
        if len(held["time"]) > MOST_ROWS:
            raise InputError(path, f"line {line}", "one more sample", f"at most {MOST_ROWS}")
    if problems:
        raise InputError.gather(problems)
    if not len(held["time"]):
        raise InputError(path, "rows", "none", "a row for each sample")
    missing = np.full(len(held["time"]), np.nan)
    current, voltage, wire = (
        np.array(held[name]) if name in held else missing for name in CHANNELS
    )
    return Signals(path.name, np.array(held["time"]), current, voltage, wire_m_min=wire)


def _find_names(path: Path, lines: Iterator[str]) -> tuple[int, str, list[_Column], int]:
    """Return the number of the header line, the separator, the columns, and the cells per line."""
    found = ""
    for above, text in enumerate(itertools.islice(lines, LINES_ABOVE), 1):
        separator, cells = split_header(text)
        columns = [column for place, cell in enumerate(cells) for column in _named(cell, place)]
        quantities = [column.quantity for column in columns]
        if "time" in quantities and len(set(quantities)) > 1:
            twice = next((q for q in NAMES if quantities.count(q) > 1), None)
            if twice is not None:
                raise InputError(path, f"line {above}, names", f"{twice} twice", A_TABLE)
            columns.sort(key=lambda column: column.quantity != "time")
            return above, separator, columns, len(cells)
        found = found or text.strip()
    raise InputError(path, "columns", found or "nothing", A_TABLE)


def _named(cell: str, place: int, channel_unit: str | None = None) -> list[_Column]:
    """Return the column with that header; empty if it is not one of a known quantity and unit.

    ``channel_unit`` is its unit if the header has none.
    """
    name = cell.strip()
    parts = re.fullmatch(r"(.*?)[\s_]*(?:[\[(]\s*(\S+?)\s*[\])])?", name)
    word, unit = (parts[1], parts[2]) if parts else (name, None)
    for quantity, units in UNITS.items():
        end = word.lower().replace(" ", "_")
        own = unit.lower() if unit is not None else None
        if own is None and (behind := end.rpartition("_"))[0] and behind[2] in units:
            end, own = behind[0], behind[2]
        if own is None and channel_unit is not None:
            own = channel_unit.strip().lower()
        if re.fullmatch(NAMES[quantity], end) and (own is None or own in units):
            return [_Column(quantity, name, place, units[own] if own is not None else 1.0)]
    return []


def _take(
    path: Path,
    line: int,
    cells: list[str],
    columns: list[_Column],
    number: NumberCells,
    held: dict[str, array[float]],
    problems: list[InputError],
) -> float | None:
    """Append a line's values to ``held``; returns its time, None if invalid."""
    time_s = None
    for column in columns:
        cell = cells[column.place].strip()
        value = number.parse(cell)
        if column.quantity == "time":
            time_s = None if value is None else value * column.factor
        elif not cell:
            value = math.nan
        if value is None:
            wanted = number.expected + ", or nothing" * (column.quantity != "time")
            shown = cell or "nothing"
            problems.append(InputError(path, f"line {line}, {column.name}", shown, wanted))
            value = math.nan
        held[column.quantity].append(value * column.factor)
    return time_s
