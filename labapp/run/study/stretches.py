"""The tasks of a study, for processes on any machine: examine a recording, measure a stretch.

Each task atomically writes one file, named by a digest of its inputs: a finished task is not
repeated, and a repeated one writes the same bytes. The files are plain JSON and NumPy arrays;
nothing in them is ever executed.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import threading
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.config.setup import Setup
from labapp.core.pipeline import Settings
from labapp.core.recording.residual_check import MOST, Residuals
from labapp.core.surface.mesh import grid_nodes
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.export.meshes import SPACING_MM, refuse_too_large
from labapp.export.tables import Columns, frame_tables
from labapp.files import as_bytes, write_atomically
from labapp.media import open_source
from labapp.media.identity import identify, stamp
from labapp.run import measurers
from labapp.run.measurers import ColdMeasurer, WarmMeasurer
from labapp.run.runner import Measurer
from labapp.run.study.plan import COLUMNS
from labapp.system import sync_folder
from labapp.version import VERSION

FORMAT = 3
"""Format of the files; increased when a new program cannot use old ones."""

KEPT_RESIDUALS = 2 * MOST
"""Most frames of a recording whose residuals are stored, for the check of the set-up."""

LARGEST_INDEX = 1 << 28
LARGEST_STRETCH = 1 << 32
"""Limits of a file's content, bytes."""

ROOM = "a writable folder with enough disk space; finished frames are stored: run again"


class CannotStore(InputError):
    """A result cannot be written, which ends the run, as no other could be."""


_turn = threading.Lock()
"""Lock for one stretch at a time per process, as a cluster's workers may have several threads."""


# --- recordings ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class FoundRecording:
    """Facts about a recording that its tasks need."""

    stamp: str
    """Names, sizes and times of its files (`identity.stamp`)."""
    size: int
    sha256: str
    """Its identity (`identity.identify`)."""
    frames: int
    frame_rate_hz: float | None
    shape: tuple[int, int]
    warnings: tuple[str, ...]
    index: bytes | None
    """See `FrameSource.index`."""


def recording_file(folder: Path, recording: Path) -> Path:
    """Return the path of the facts about a recording, in the folder of the results."""
    name = hashlib.sha256(as_bytes(str(recording))).hexdigest()[:32]
    return folder / "recordings" / f"{name}.json"


def look_at_recording(recording: Path, folder: Path) -> None:
    """Open a recording, identify it, and write the facts about it.

    Raises
    ------
    InputError
        If it is missing, empty or corrupt; `CannotStore` if the file cannot be written.
    """
    before = stamp(recording)
    with open_source(recording) as source:
        source.frame(0)
        size, sha256 = identify(recording)
        found = FoundRecording(
            before,
            size,
            sha256,
            len(source),
            source.frame_rate_hz,
            source.shape,
            tuple(source.warnings),
            source.index,
        )
    packed = None if found.index is None else base64.b64encode(zlib.compress(found.index)).decode()
    content = {"format": FORMAT, **asdict(found), "index": packed}
    _write(recording_file(folder, recording), as_bytes(json.dumps(content)))


def found_recording(recording: Path, folder: Path) -> FoundRecording | None:
    """Return the facts about a recording; None if not examined yet, or changed since.

    Raises
    ------
    InputError
        If it is missing.
    """
    now = stamp(recording)
    try:
        read = json.loads(recording_file(folder, recording).read_bytes())
        if read.pop("format") != FORMAT or read["stamp"] != now:
            return None
        index = read.pop("index")
        if index is not None:
            index = zlib.decompressobj().decompress(base64.b64decode(index), LARGEST_INDEX)
        rows, columns = read.pop("shape")
        warnings = tuple(map(str, read.pop("warnings")))
        return FoundRecording(**read, shape=(rows, columns), warnings=warnings, index=index)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, zlib.error):
        return None


# --- stretches ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames of a recording, to be measured by one task."""

    folder: Path
    """Folder of the results."""
    recording: Path
    found: str
    """Identity of the recording, size and SHA-256."""
    setup: Setup
    settings: Settings
    warm: bool
    frames: range
    kept: range
    """Frames whose residuals are stored."""
    surfaces: bool = False
    """Whether surfaces are also stored."""
    version: str = VERSION

    @property
    def key(self) -> str:
        """Digest of all inputs of the result."""
        facts = {
            "format": FORMAT,
            "version": self.version,
            "recording": self.found,
            "setup": self.setup.text,
            "settings": asdict(self.settings),
            "warm": self.warm,
            "frames": repr(self.frames),
            "kept": repr(self.kept),
        }
        return hashlib.sha256(as_bytes(json.dumps(facts, sort_keys=True))).hexdigest()[:40]

    def file(self, surfaces: bool) -> Path:
        """Return the path of the result, with or without surfaces."""
        return self.folder / "stretches" / f"{self.key}{'-surfaces' * surfaces}.npz"

    @property
    def done(self) -> Path | None:
        """Path of the result; None if there is none yet. A file with surfaces has all results."""
        choices = [self.file(True)] if self.surfaces else [self.file(False), self.file(True)]
        return next((each for each in choices if each.is_file()), None)


def stretches_of(
    folder: Path,
    recording: Path,
    found: FoundRecording,
    setup: Setup,
    settings: Settings,
    frames: range,
    *,
    warm: bool,
    surfaces: bool,
) -> list[Stretch]:
    """Return the tasks for the frames of a recording, divided as by `RecordingMeasurer`."""
    length = measurers.STRETCH
    every = -(-len(frames) // KEPT_RESIDUALS)
    identity = f"{found.size} {found.sha256}"
    tasks = []
    for at in range(0, len(frames), length):
        kept = frames[at + -at % every : at + length : every]
        tasks.append(
            Stretch(
                *(folder, recording, identity, setup, settings, warm),
                frames[at : at + length],
                kept,
                surfaces,
            )
        )
    return tasks


def measure_stretch(stretch: Stretch) -> None:
    """Measure a stretch and write its file, unless it exists already.

    Raises
    ------
    InputError
        If the recording has changed or cannot be opened, or this is another version of labapp;
        `CannotStore` if the file cannot be written.
    """
    if stretch.version != VERSION:
        wanted = f"{stretch.version}, the version that runs the study"
        raise InputError("worker", "labapp", VERSION, wanted)
    with _turn:
        if stretch.done is not None:
            return
        found = found_recording(stretch.recording, stretch.folder)
        if found is None or f"{found.size} {found.sha256}" != stretch.found:
            raise InputError(stretch.recording, "recording", "has changed", "the study run again")
        cv2.setNumThreads(1)
        with open_source(stretch.recording, found.index) as source:
            measurer: Measurer = (
                WarmMeasurer(source.frame, stretch.setup, stretch.settings)
                if stretch.warm
                else ColdMeasurer(source.frame, stretch.setup, stretch.settings)
            )
            content = _measured(stretch, measurer)
    _write(stretch.file(stretch.surfaces), content)


def _measured(stretch: Stretch, measurer: Measurer) -> bytes:
    """Return the results of a stretch as the content of a file."""
    rows: list[Columns] = []
    residuals: list[tuple[int, Residuals]] = []
    surfaces: list[tuple[int, FloatArray, tuple[int, int]]] = []
    for result in measurer(stretch.frames):
        rows.append(frame_tables(result, stretch.setup.calibration)["measures"])
        kept = Residuals.of(result.measurement) if result.frame in stretch.kept else None
        if kept is not None:
            residuals.append((result.frame, kept))
        surface = result.measurement.reconstruction
        if stretch.surfaces and surface is not None:
            surfaces.append((result.frame, *_grid(surface)))
    arrays: dict[str, npt.NDArray[Any]] = {"key": np.array(stretch.key)}
    for column in COLUMNS:
        values = np.concatenate([row[column.name] for row in rows])
        arrays[f"measures/{column.name}"] = values.astype(str) if values.dtype == object else values
    arrays |= _residual_arrays(residuals)
    for frame, z_mm, low in surfaces:
        arrays |= {f"surfaces/{frame}/z_mm": z_mm, f"surfaces/{frame}/low": np.array(low)}
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return content.getvalue()


def _residual_arrays(residuals: Sequence[tuple[int, Residuals]]) -> dict[str, npt.NDArray[Any]]:
    """Return residuals as arrays of all frames, which are read much faster than one per frame.

    Each has beside it the number of its rows in each frame.
    """
    arrays = {"residuals/frame": np.array([frame for frame, _ in residuals], int)}
    parts: dict[str, list[npt.NDArray[Any]]] = {
        "ray": [one.ray for _, one in residuals],
        "residual_mm": [one.residual_mm for _, one in residuals],
        "x_knots": [one.surface.basis.x_knots for _, one in residuals],
        "y_knots": [one.surface.basis.y_knots for _, one in residuals],
        "coefficients": [one.surface.coefficients for _, one in residuals],
    }
    for name, each in parts.items():
        arrays[f"residuals/{name}"] = np.concatenate(each) if each else np.empty(0)
        arrays[f"residuals/{name}/rows"] = np.array([len(one) for one in each], int)
    return arrays


def _grid(surface: Reconstruction) -> tuple[FloatArray, tuple[int, int]]:
    """Return heights on a grid, shape (rows, columns), NaN outside, and its first (row, column).

    Node (row, column) is at Y = row · spacing, X = column · spacing.
    """
    refuse_too_large(surface, SPACING_MM)
    x, y, z = grid_nodes(surface, SPACING_MM)
    if not len(x):
        return np.empty((0, 0), np.float32), (0, 0)
    column, row = (np.round(each / SPACING_MM).astype(int) for each in (x, y))
    low = int(row.min()), int(column.min())
    heights = np.full((int(row.max()) - low[0] + 1, int(column.max()) - low[1] + 1), np.nan)
    heights[row - low[0], column - low[1]] = z
    return heights.astype(np.float32), low


class StretchFile:
    """The result of a stretch, read from its file.

    Raises
    ------
    ValueError
        If the file is damaged or belongs to another stretch; by the constructor and all methods.
    """

    def __init__(self, stretch: Stretch, path: Path) -> None:
        try:
            with zipfile.ZipFile(path) as archive:
                if sum(part.file_size for part in archive.infolist()) > LARGEST_STRETCH:
                    raise ValueError(f"{path.name} is too large")
            self._arrays = np.load(path, allow_pickle=False)
        except (OSError, zipfile.BadZipFile, EOFError) as error:
            raise ValueError(f"{path.name} cannot be read") from error
        if str(self._array("key")) != stretch.key:
            raise ValueError(f"{path.name} is of another stretch")
        self._frames = stretch.frames

    def _array(self, name: str) -> npt.NDArray[Any]:
        try:
            found: npt.NDArray[Any] = self._arrays[name]
        except (KeyError, OSError, zipfile.BadZipFile, zlib.error, EOFError) as error:
            raise ValueError(f"{name} is damaged") from error
        return found

    def measures(self) -> Columns:
        """Return the columns `plan.COLUMNS`, one row per frame."""
        table = {c.name: self._array(f"measures/{c.name}") for c in COLUMNS}
        frames = table["frame"].tolist()
        if frames != list(self._frames) or any(len(v) != len(frames) for v in table.values()):
            raise ValueError("rows are missing")
        return table

    def residuals(self) -> dict[int, Residuals]:
        """Return the residuals of the frames that have any."""
        frames = self._array("residuals/frame").tolist()
        names = ("ray", "residual_mm", "x_knots", "y_knots", "coefficients")
        found = {}
        for frame, ray, residual, x, y, coefficients in zip(
            frames, *map(self._by_frame, names), strict=True
        ):
            surface = SplineSurface(SplineBasis(x, y), coefficients)
            found[frame] = Residuals(ray, residual, surface)
        return found

    def _by_frame(self, name: str) -> list[npt.NDArray[Any]]:
        """Return the part of each frame of an array of `_residual_arrays`."""
        ends = np.cumsum(self._array(f"residuals/{name}/rows"))
        return np.split(self._array(f"residuals/{name}"), ends)[:-1]

    def surfaces(self) -> Sequence[int]:
        """Return the frames that have a surface."""
        names = [name for name in self._arrays.files if name.endswith("/z_mm")]
        return [int(name.split("/")[1]) for name in names]

    def low(self, frame: int) -> tuple[int, int]:
        """Return the indices (row, column) of the first node of a frame's surface."""
        row, column = self._array(f"surfaces/{frame}/low").tolist()
        return row, column

    def surface(self, frame: int) -> FloatArray:
        """Return the heights of a frame's surface, shape (rows, columns), mm."""
        return np.asarray(self._array(f"surfaces/{frame}/z_mm"))

    def __enter__(self) -> StretchFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._arrays.close()


def _write(path: Path, content: bytes) -> None:
    """Write a file atomically, and flush it and its name to disk."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)
        sync_folder(path.parent)
    except OSError as error:
        raise CannotStore(path.parent, "results", error.strerror or error, ROOM) from error
