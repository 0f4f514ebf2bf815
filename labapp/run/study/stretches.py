"""The tasks of a study, which processes anywhere do: a recording looked at, a stretch measured.

Each writes one file, complete or absent, that is named by all that its content follows from: a task
that was done once is not done again, and one that is done twice writes the same bytes. The files
are plain JSON and NumPy arrays; nothing in them is ever executed.
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
from labapp.export.tables import Table, frame_tables
from labapp.files import as_bytes, write_atomically
from labapp.media import open_source
from labapp.media.identity import identify, stamp
from labapp.run import measurers
from labapp.run.measurers import ColdMeasurer, WarmMeasurer
from labapp.run.runner import Measurer
from labapp.run.study.plan import COLUMNS
from labapp.system import sync_folder
from labapp.version import VERSION

FORMAT = 2
"""Of the files; raised when a new program cannot use old ones."""

KEPT_RESIDUALS = 2 * MOST
"""Frames of a recording whose residuals are kept, at most, to judge its set-up by."""

LARGEST_INDEX = 1 << 28
LARGEST_STRETCH = 1 << 32
"""Bounds of a file's content, bytes."""

ROOM = "a folder that can be written, with room on its disk; what was done is kept: run again"


class CannotStore(InputError):
    """A result cannot be written: no other one could."""


_turn = threading.Lock()
"""One stretch at a time in a process: a cluster's workers may have several threads."""


# --- recordings ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class FoundRecording:
    """What a recording is, as far as its tasks need to know."""

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
    """File about a recording in the folder of the results."""
    name = hashlib.sha256(as_bytes(str(recording))).hexdigest()[:32]
    return folder / "recordings" / f"{name}.json"


def look_at_recording(recording: Path, folder: Path) -> None:
    """Open a recording, identify it, and write what was found.

    Raises
    ------
    InputError
        If it is missing, empty or corrupt; `CannotStore` if the file cannot be written.
    """
    before = stamp(recording)
    with open_source(recording) as source:
        source.frame(0)
        size, sha256 = identify(recording)
        index = None if source.index is None else base64.b64encode(zlib.compress(source.index))
        found = {
            "format": FORMAT,
            "stamp": before,
            "size": size,
            "sha256": sha256,
            "frames": len(source),
            "frame_rate_hz": source.frame_rate_hz,
            "shape": list(source.shape),
            "warnings": list(source.warnings),
            "index": None if index is None else index.decode(),
        }
    _write(recording_file(folder, recording), as_bytes(json.dumps(found)))


def found_recording(recording: Path, folder: Path) -> FoundRecording | None:
    """What was found of a recording, unless it has changed since, or was not looked at yet.

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
    """Some frames of a recording that follow on each other, to be measured by one task."""

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
    """Frames whose residuals are kept."""
    surfaces: bool = False
    """Whether surfaces are kept, too."""
    version: str = VERSION

    @property
    def key(self) -> str:
        """Digest of everything that the result follows from."""
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
        """File of the result, with surfaces or without."""
        return self.folder / "stretches" / f"{self.key}{'-surfaces' * surfaces}.npz"

    @property
    def done(self) -> Path | None:
        """File of the result; None if there is none yet. Surfaces bring all the rest, too."""
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
    """Tasks that measure frames of a recording: as `RecordingMeasurer` divides them."""
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
    """Measure a stretch and write its file; if it is there already, nothing is done.

    Raises
    ------
    InputError
        If the recording is no longer what it was, or cannot be opened, or this is another version
        of labapp; `CannotStore` if the file cannot be written.
    """
    if stretch.version != VERSION:
        wanted = f"{stretch.version}, as where the study is run"
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
    """The results of a stretch as one file."""
    from labapp.export.dynamics import shape_row  # with what only a worker has a use for

    rows: list[Table] = []
    residuals: list[tuple[int, Residuals]] = []
    surfaces: list[tuple[int, FloatArray, tuple[int, int]]] = []
    for result in measurer(stretch.frames):
        measures = frame_tables(result, stretch.setup.calibration)["measures"]
        rows.append(measures | shape_row(result.measurement.reconstruction))
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
    for frame, one in residuals:
        arrays |= {
            f"residuals/{frame}/ray": one.ray,
            f"residuals/{frame}/residual_mm": one.residual_mm,
            f"residuals/{frame}/x_knots": one.surface.basis.x_knots,
            f"residuals/{frame}/y_knots": one.surface.basis.y_knots,
            f"residuals/{frame}/coefficients": one.surface.coefficients,
        }
    for frame, z_mm, low in surfaces:
        arrays |= {f"surfaces/{frame}/z_mm": z_mm, f"surfaces/{frame}/low": np.array(low)}
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return content.getvalue()


def _grid(surface: Reconstruction) -> tuple[FloatArray, tuple[int, int]]:
    """Heights on a grid, shape (rows, columns), NaN outside; indices (row, column) of the first.

    Node (row, column) lies at Y = row · spacing, X = column · spacing.
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
        If the file is damaged, or not that of the stretch; here and from every method.
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

    def measures(self) -> Table:
        """The columns `plan.COLUMNS`, a row a frame."""
        table = {c.name: self._array(f"measures/{c.name}") for c in COLUMNS}
        frames = table["frame"].tolist()
        if frames != list(self._frames) or any(len(v) != len(frames) for v in table.values()):
            raise ValueError("rows are missing")
        return table

    def residuals(self) -> dict[int, Residuals]:
        """Residuals of some frames."""
        found = {}
        for frame in self._numbers("residuals/", "/ray"):
            of = f"residuals/{frame}/"
            basis = SplineBasis(self._array(f"{of}x_knots"), self._array(f"{of}y_knots"))
            surface = SplineSurface(basis, self._array(f"{of}coefficients"))
            ray, residual = self._array(f"{of}ray"), self._array(f"{of}residual_mm")
            found[frame] = Residuals(ray, residual, surface)
        return found

    def surfaces(self) -> Sequence[int]:
        """Frames that have a surface."""
        return self._numbers("surfaces/", "/z_mm")

    def low(self, frame: int) -> tuple[int, int]:
        """Indices (row, column) of the first node of a frame's surface."""
        row, column = self._array(f"surfaces/{frame}/low").tolist()
        return row, column

    def surface(self, frame: int) -> FloatArray:
        """Heights of a frame's surface, shape (rows, columns), mm."""
        return np.asarray(self._array(f"surfaces/{frame}/z_mm"))

    def _numbers(self, begin: str, end: str) -> list[int]:
        names = [name for name in self._arrays.files if name.startswith(begin)]
        return [int(name[len(begin) : -len(end)]) for name in names if name.endswith(end)]

    def __enter__(self) -> StretchFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._arrays.close()


def _write(path: Path, content: bytes) -> None:
    """Write a file, complete or absent, and its name, to the disk."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)
        sync_folder(path.parent)
    except OSError as error:
        raise CannotStore(path.parent, "results", error.strerror or error, ROOM) from error
