"""The study file: recordings, each with set-up, settings and conditions.

TOML, with defaults for all recordings at the top::

    title = "Current and gas"
    setup = "bench.toml"

    [[recording]]
    file = "runs/I100_1.avi"
    conditions = { current_a = 100, gas = "Ar" }

    [[recording]]
    file = "runs/I{current_a}_{repeat}.avi"     # every matching file

or CSV with a column ``file``, columns named like the other keys, and a column for each condition.
"""

from __future__ import annotations

import csv
import glob
import itertools
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from labapp.config.csv_tables import bounded_lines, open_table, parse_number, split_header
from labapp.config.settings import check_algorithm
from labapp.config.setup import read_setup
from labapp.config.toml_keys import Rule, check_keys, is_number, parse_toml, shown, unknown_key
from labapp.core.pipeline import Settings
from labapp.core.schemes import SCHEMES, algorithm_names
from labapp.errors import InputError, os_errors_as_input
from labapp.export.tables import TABLES
from labapp.files import as_bytes, relative_path, write_file
from labapp.media import RECORDING_SUFFIXES
from labapp.text import split_unit, unescaped_csv_text

A_STUDY = "a study file (TOML or CSV, UTF-8)"

LARGEST_FILE = 8_000_000
MOST_RECORDINGS = 10_000
MOST_CONDITIONS = 64
LONGEST_TEXT = 200

COLUMNS = TABLES["measures"]
"""Columns of the table of all frames, after the recording's name and conditions."""

RESERVED = frozenset({"recording", *(column.name for column in COLUMNS)})
"""Names that conditions cannot have, as the table of all frames has such columns."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
CONDITION = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,49}")
FIELD = re.compile(r"\{([^{}]*)\}")

PARTS_OF_NAME = (slice(-1, None), slice(-2, -1), slice(-2, None), slice(-3, None))
"""Parts of a recording's path that may become its name, the first that are unique: file name,
folder name, both …"""

Condition = float | str


def shown_condition(value: Condition | None) -> str:
    """Return a condition's value as text; a dash if unknown."""
    if value is None:
        return "–"
    return value if isinstance(value, str) else f"{value:g}"


def named_condition(name: str, value: Condition | None) -> str:
    """A condition's name, value and unit: "current 80 A", "gas Ar"."""
    words, unit = split_unit(name)
    known = "" if value is None or isinstance(value, str) else unit
    return " ".join(filter(None, (words, shown_condition(value), known)))


@dataclass(frozen=True)
class StudyRecording:
    """A recording of a study."""

    name: str
    """Name in results, also of its files there."""
    path: Path
    """Path of the recording."""
    setup: Path
    """Path of the setup file."""
    frames: str = ":"
    """Frames to measure, ``A:B:STEP``."""
    settings: Settings = field(default_factory=Settings)
    """Settings of the measurement."""
    warm: bool = True
    """Whether frames are tracked from the previous ones."""
    conditions: Mapping[str, Condition] = field(default_factory=dict)
    """Experimental conditions; a missing one is unknown."""


@dataclass(frozen=True)
class StudyPlan:
    """Contents of a study file."""

    title: str
    recordings: tuple[StudyRecording, ...]
    conditions: tuple[str, ...]
    """Names of all conditions, in the order in which they occur."""


def _text(longest: int = LONGEST_TEXT) -> Rule:
    return Rule(
        f"text of 1 to {longest} characters",
        lambda value: isinstance(value, str) and 0 < len(value) <= longest and "\0" not in value,
        required=False,
    )


def _one_of(words: Sequence[str]) -> Rule:
    return Rule(f"one of {', '.join(words)}", lambda value: value in words, required=False)


DEFAULTS: dict[str, Rule] = {
    "setup": _text(4096),
    "frames": _text(),
    "scheme": _one_of(tuple(SCHEMES)),
    "algorithm": _one_of(algorithm_names()),
    "correspondence": _one_of(("auto", "S/S", "S/I", "I/I")),
    "warm": Rule("true or false", lambda value: isinstance(value, bool), required=False),
}
"""Keys that are allowed at the top, for all recordings, and in each recording."""

OF_RECORDING: dict[str, Rule] = {
    "file": Rule(
        "the path of a recording, or of many: {condition} or * for a part that varies",
        lambda value: isinstance(value, str) and 0 < len(value) <= 4096 and "\0" not in value,
    ),
    "name": Rule(
        "letters, digits, ., - and _, a letter or digit first, at most 100",
        lambda value: isinstance(value, str) and NAME.fullmatch(value) is not None,
        required=False,
    ),
    "conditions": Rule("a table of conditions", lambda v: isinstance(v, dict), required=False),
    **DEFAULTS,
}


def read_study(path: str | os.PathLike[str]) -> StudyPlan:
    """Read a study file; its paths are relative to its folder.

    Raises
    ------
    InputError
        If it cannot be read, or anything in it is unknown, missing or invalid; all problems are
        reported together. Recordings and setup files need not exist.
    """
    path = Path(path)
    read = _read_csv if path.suffix.lower() == ".csv" else _read_toml
    return _plan(path, *read(path))


def _plan(path: Path, top: Mapping[str, Any], entries: Sequence[tuple[str, Any]]) -> StudyPlan:
    """Check the keys at the top and (location, keys) of each recording; see `read_study`."""
    problems: list[InputError] = []
    found: list[tuple[str, dict[str, Any], Path, dict[str, Condition]]] = []
    for where, entry in entries:
        wrong = [
            *check_keys(path, where, entry, OF_RECORDING, where),
            *_conditions(path, where, entry),
        ]
        problems += wrong
        if wrong:
            continue
        keys = {**top, **entry}
        if "setup" not in keys:
            problems.append(InputError(path, f"{where}.setup", "missing", "its setup file"))
            continue
        try:
            files = list(itertools.islice(_files(path, where, keys["file"]), MOST_RECORDINGS + 1))
        except InputError as error:
            problems.append(error)
            continue
        if len(files) > 1 and "name" in keys:
            named = f"{shown(keys['name'])} for {len(files)} files"
            problems.append(InputError(path, f"{where}.name", named, "no name beside a pattern"))
        found += [(where, keys, file, varied) for file, varied in files]
        if len(found) > MOST_RECORDINGS:
            many = f"more than {MOST_RECORDINGS}"
            raise InputError(path, "recording", many, f"at most {MOST_RECORDINGS} recordings")
    if not problems and not found:
        problems.append(InputError(path, "recording", "none", "one recording or more"))
    if problems:
        raise InputError.gather(problems[:10])
    names = _names(path, found)
    recordings = tuple(
        _recording(path, name, *each) for name, each in zip(names, found, strict=True)
    )
    conditions = dict.fromkeys(name for one in recordings for name in one.conditions)
    if len(conditions) > MOST_CONDITIONS:
        few = f"at most {MOST_CONDITIONS}"
        raise InputError(path, "conditions", f"{len(conditions)} different ones", few)
    return StudyPlan(str(top.get("title", path.stem)), recordings, tuple(conditions))


def write_study(
    path: str | os.PathLike[str],
    recordings: Sequence[str],
    setup: str | os.PathLike[str],
    replace: bool = False,
) -> StudyPlan:
    """Write a new study file that lists recordings, with relative paths if possible.

    Parameters
    ----------
    path
        Path of the file, ``.toml`` or ``.csv``.
    recordings
        Paths or patterns of recordings, relative to the current directory.
    setup
        Setup file of all recordings.
    replace
        Whether to replace an existing study file; other files are never replaced.

    Raises
    ------
    InputError
        If the file exists already or cannot be written, a pattern matches nothing, a recording or a
        condition is refused, or the set-up is not valid. Nothing is written then.
    """
    path = Path(path)
    if path.suffix.lower() not in (".toml", ".csv"):
        raise InputError(path, "name", path.suffix or "no suffix", ".toml or .csv")
    if path.exists() and replace:
        read_study(path)  # raises if it is not a study file
    elif path.exists():
        raise InputError(path, "file", "is there already", "a new file")
    read_setup(setup)  # otherwise each recording would fail by it
    folder = path.parent.absolute()
    found = [each for text in recordings for each in matching_recordings(text)]
    bench = relative_path(Path(setup), folder)
    files = [(relative_path(file, folder), varied) for file, varied in found]
    entries = [
        (f"recording[{k}]", {"file": file, "setup": bench, "conditions": varied})
        for k, (file, varied) in enumerate(files, 1)
    ]
    names = _plan(path, {}, entries).conditions
    if path.suffix.lower() == ".csv":
        rows = [[file, bench, *(varied.get(name, "") for name in names)] for file, varied in files]
        text = unescaped_csv_text([["file", "setup", *names], *rows])
    else:
        text = f"title = {_toml(path.stem)}\nsetup = {_toml(bench)}\n"
        for file, varied in files:
            text += f"\n[[recording]]\nfile = {_toml(file)}\n"
            each = ", ".join(f"{name} = {_toml(value)}" for name, value in varied.items())
            text += f"conditions = {{ {each} }}\n" if each else ""
    write_file(path, as_bytes(text))
    return read_study(path)


def matching_recordings(text: str) -> list[tuple[Path, dict[str, Condition]]]:
    """Return the recordings that match a path or a pattern, with the conditions in their paths.

    Raises
    ------
    InputError
        If the pattern is invalid or matches nothing.
    """
    return list(itertools.islice(_files(Path("study"), "recording", text), MOST_RECORDINGS))


def folder_pattern(folder: Path) -> Path:
    """Return a pattern for the recordings in a folder, or else in its subfolders.

    Of several file types, the most frequent one is matched.

    Raises
    ------
    InputError
        If there is no recording.
    """
    with os_errors_as_input(folder, "folder", "a folder that can be read"):
        for depth in ("*", "*/*"):
            names = Counter(
                f"*{path.suffix}" if depth == "*" else f"*/{path.name}"
                for path in itertools.islice(folder.glob(depth), MOST_RECORDINGS)
                if path.suffix.lower() in RECORDING_SUFFIXES
            )
            if names:
                return folder / names.most_common(1)[0][0]
    raise InputError(folder, "folder", "no recording in it", "a folder with recordings")


def _toml(value: Condition) -> str:
    whole = isinstance(value, float) and value.is_integer()
    return str(tomlkit.item(int(value) if whole else value).as_string())


def _recording(
    path: Path,
    name: str,
    where: str,
    keys: Mapping[str, Any],
    file: Path,
    varied: Mapping[str, Condition],
) -> StudyRecording:
    chosen = {key: keys[key] for key in ("scheme", "algorithm", "correspondence") if key in keys}
    settings = Settings(**chosen)
    check_algorithm(settings, path, f"{where}.algorithm")
    return StudyRecording(
        name,
        file,
        path.parent.absolute() / keys["setup"],
        keys.get("frames", ":"),
        settings,
        keys.get("warm", True),
        {**keys.get("conditions", {}), **varied},
    )


def _read_toml(path: Path) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """Read the keys at the top, and (location, keys) of each recording."""
    with open_table(path, A_STUDY, LARGEST_FILE) as file:
        values = parse_toml(file.read(), path, A_STUDY)
    entries = values.pop("recording", [])
    if not isinstance(entries, list):
        raise InputError(path, "recording", shown(entries), "tables [[recording]]")
    rules = {"title": _text(), **DEFAULTS}
    problems = [
        unknown_key(path, key, {**rules, "recording": None})
        if key not in rules
        else InputError(path, key, shown(value), rules[key].expected)
        for key, value in values.items()
        if key not in rules or not rules[key].accepts(value)
    ]
    if problems:
        raise InputError.gather(problems)
    return values, [(f"recording[{place}]", each) for place, each in enumerate(entries, 1)]


def _read_csv(path: Path) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """Read a table likewise: one row per recording; columns that are not keys are conditions."""
    entries: list[tuple[str, Any]] = []
    with open_table(path, A_STUDY, LARGEST_FILE) as file:
        lines = bounded_lines(path, file, A_STUDY)
        head = next(lines, "")
        separator, header = split_header(head)
        twice = [name for name, count in Counter(header).items() if count > 1]
        if "file" not in header or twice:
            named = f"{shown(twice[0])} twice" if twice else head.strip() or "empty"
            raise InputError(path, "line 1", named, "the names of the columns, file among them")
        if "conditions" in header:
            each = "a column of its own for each condition"
            raise InputError(path, "line 1", "conditions", each)
        rows = csv.reader(lines, delimiter=separator, strict=True)
        for number, cells in enumerate(rows, 2):
            if not any(cells):
                continue
            if len(cells) > len(header):
                more = f"{len(cells)} cells"
                raise InputError(path, f"line {number}", more, f"at most {len(header)}")
            given = {k: v.strip() for k, v in zip(header, cells, strict=False) if v.strip()}
            entry: dict[str, Any] = {k: v for k, v in given.items() if k in OF_RECORDING}
            if entry.get("warm", "").lower() in ("true", "false"):
                entry["warm"] = entry["warm"].lower() == "true"
            entry["conditions"] = {
                name: _value(cell, separator)
                for name, cell in given.items()
                if name not in OF_RECORDING
            }
            entries.append((f"line {number}", entry))
            if len(entries) > MOST_RECORDINGS:
                raise InputError(path, "rows", "more", f"at most {MOST_RECORDINGS} recordings")
    return {}, entries


def _value(cell: str, separator: str = ",") -> Condition:
    """Return a condition's value, as a number if it is one."""
    number = parse_number(cell, separator)
    return cell if number is None else number


def _conditions(path: Path, where: str, entry: object) -> Iterator[InputError]:
    """Yield the problems of a recording's conditions."""
    given = entry.get("conditions") if isinstance(entry, dict) else None
    if not isinstance(given, dict):
        return
    for name, value in given.items():
        full = f"{where}.conditions.{name}"
        problem = _wrong_condition(name)
        if problem is not None:
            yield InputError(path, full, shown(name), problem)
        elif not (is_number(value) or (isinstance(value, str) and len(value) <= LONGEST_TEXT)):
            expected = f"a number, or text of at most {LONGEST_TEXT} characters"
            yield InputError(path, full, shown(value), expected)


def _wrong_condition(name: str) -> str | None:
    """Return what is expected instead of an invalid name of a condition; None if it is valid."""
    if not CONDITION.fullmatch(name):
        return "a name of letters, digits and _, a letter first, at most 50"
    if name.lower() in RESERVED:
        return "another name: results have a column of this one"
    if name in OF_RECORDING:
        return "another name: a key of each recording has this one"
    return None


def _files(path: Path, where: str, text: str) -> Iterator[tuple[Path, dict[str, Condition]]]:
    """Yield the recordings that match a path, sorted, with the conditions in their names."""
    folder = path.parent.absolute()
    if os.path.exists(folder / text) or not set(text) & set("*{}"):
        yield folder / text, {}
        return
    fields = FIELD.findall(text)
    for name in fields:
        expected = _wrong_condition(name)
        if expected is not None:
            raise InputError(path, f"{where}.file", f"{{{name}}}", expected)
    twice = [name for name, count in Counter(fields).items() if count > 1]
    if twice or "**" in text:
        named = f"{{{twice[0]}}} twice" if twice else "**"
        raise InputError(path, f"{where}.file", named, "* and each {condition} once")
    whole = (folder / text).as_posix()
    parts = re.split(r"(\{[^{}]*\}|\*)", whole)
    pattern = "".join("*" if k % 2 else glob.escape(part) for k, part in enumerate(parts))
    form = "".join(
        re.escape(part) if k % 2 == 0 else "[^/]*" if part == "*" else f"(?P<{part[1:-1]}>[^/]+?)"
        for k, part in enumerate(parts)
    )
    matched = 0
    for found in sorted(itertools.islice(glob.iglob(pattern), MOST_RECORDINGS + 1)):
        fits = re.fullmatch(form, Path(found).as_posix())
        if fits is not None:
            matched += 1
            yield Path(found), {name: _value(cell) for name, cell in fits.groupdict().items()}
    if not matched:
        raise InputError(path, f"{where}.file", text, "a pattern that some files match")


def _names(path: Path, found: Sequence[tuple[str, dict[str, Any], Path, Any]]) -> list[str]:
    """Return a name for each recording, unique even if case is ignored."""
    level = [0] * len(found)
    while True:
        names = [
            str(keys.get("name") or _plain(file, PARTS_OF_NAME[k]))
            for (_, keys, file, _), k in zip(found, level, strict=True)
        ]
        counts = Counter(name.casefold() for name in names)
        alike = {k for k, name in enumerate(names) if counts[name.casefold()] > 1}
        if not alike:
            return names
        if any(level[k] + 1 == len(PARTS_OF_NAME) for k in alike):
            break
        level = [one + (k in alike) for k, one in enumerate(level)]
    twice = [k for k in sorted(alike) if names[k].casefold() == names[min(alike)].casefold()]
    expected = f"each file once, with a name that {found[twice[0]][0]} does not have"
    raise InputError(path, f"{found[twice[1]][0]}.name", names[twice[1]], expected)


def _plain(file: Path, parts: slice) -> str:
    """Return a name from parts of a path, with plain characters."""
    chosen = [*file.parts[1:-1], file.stem][parts]
    name = re.sub(r"[^A-Za-z0-9.-]+", "_", "-".join(chosen)).strip("._-")
    return name[-100:].lstrip("._-") or "x"
