"""Atomic export of many frames into one folder with a manifest.

The folder is written as ``.NAME.….part`` beside the target, and renamed when it is complete. Only
then is an earlier export replaced, and only if it is unchanged: other files are never deleted.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.errors import InputError
from labapp.export.formats import (
    FILM_FILE,
    MANIFEST,
    RUN_FORMATS,
    SURFACE_FORMATS,
    TREND_FILE,
    RunFormat,
    mesh_formats,
)
from labapp.export.frame_result import FrameResult
from labapp.export.meshes import SMALLEST_SPACING_MM, SPACING_MM, refuse_too_large
from labapp.export.rendering.drawing import VIEWS, Direction
from labapp.export.rendering.film import TICKS_HZ, Extent, film_times, write_film
from labapp.export.rendering.pictures import (
    SMALL,
    write_frame_picture,
    write_surface_picture,
    write_trend_picture,
)
from labapp.export.rendering.studio import PICTURE_PX, drawing_errors, drawing_process
from labapp.export.results import SURFACES, surface_files
from labapp.export.summary import Summary
from labapp.export.tables import TABLES, csv_header, csv_rows, frame_tables
from labapp.files import as_bytes, as_json, beside, only_writer, sha256_of
from labapp.media import GreyImage
from labapp.system import sync_folder
from labapp.text import SIGMA_OF, now
from labapp.version import VERSION

OLD = ".old"
PICTURES = ("frames", "surfaces", "trends", "film")

SIZES_PX = range(320, 3841, 2)
"""Allowed widths and heights of surface pictures; those of a film must be even."""

UNITS = (
    "lengths in mm, angles in degrees, times in s, places in a frame in px; see the column names"
)
LARGEST_MANIFEST = 1 << 28
AN_EXPORT = "a folder that labapp exported"
ROOM = "a writable folder with enough disk space; the former content is unchanged"
OWN_FOLDER = "a new or empty folder, or an unchanged earlier export (it is replaced)"


@dataclass(frozen=True)
class ExportChoice:
    """Contents of an export.

    Parameters
    ----------
    tables
        Tables as CSV: some of ``measures``, ``dots``, ``points``, ``boundary``.
    surfaces
        Formats of each surface: ``csv``, ``stl``, ``stl-ascii``, ``ply``, ``vtp``, or added ones.
    solid
        Whether to add each surface as a watertight solid, in the mesh formats of `surfaces`.
    hdf5
        Short for ``hdf5`` in `together`.
    pictures
        Some of ``frames`` (dots over each frame), ``surfaces`` (each in 3-D), ``trends``, ``film``.
    spacing_mm
        Distance between the surfaces' nodes, mm.
    view
        View in pictures and the film: ``free`` (oblique), ``top``, ``side`` or ``front``.
    size_px
        Width and height of these, even, px.
    film_rate_hz
        Frame rate of the film, Hz; None: that of the recording (`film.film_times`).
    together
        Formats with everything in one file: ``hdf5``, and those added by `add_export_format`.
    picture_format
        Format of pictures of frames: ``png``, ``jpg`` or ``tif``.
    sigma_parts
        Whether `measures.csv` also has the parts of standard uncertainties.

    Raises
    ------
    InputError
        If a value is invalid.
    """

    tables: frozenset[str] = frozenset(TABLES)
    surfaces: frozenset[str] = frozenset(SURFACES)
    solid: bool = False
    hdf5: bool = False
    pictures: frozenset[str] = frozenset()
    spacing_mm: float = SPACING_MM
    view: Direction = "free"
    size_px: tuple[int, int] = PICTURE_PX
    film_rate_hz: float | None = None
    together: frozenset[str] = frozenset()
    picture_format: str = "png"
    sigma_parts: bool = False

    def __post_init__(self) -> None:
        allowed: dict[str, Collection[str]] = {
            "tables": TABLES,
            "surfaces": SURFACE_FORMATS,
            "pictures": PICTURES,
            "together": RUN_FORMATS,
        }
        for field, words in allowed.items():
            if unknown := sorted(getattr(self, field) - frozenset(words)):
                raise InputError("export", field, unknown[0], f"some of {', '.join(words)}")
        if self.solid and not self.surfaces & frozenset(mesh_formats()):
            wanted = f"one of {', '.join(mesh_formats())}"
            raise InputError("export", "solid", "no mesh format", wanted)
        if not SMALLEST_SPACING_MM <= self.spacing_mm <= 1:
            raise InputError(
                "export", "spacing_mm", self.spacing_mm, f"from {SMALLEST_SPACING_MM} to 1 mm"
            )
        if self.view not in VIEWS:
            raise InputError("export", "view", self.view, f"one of {', '.join(VIEWS)}")
        if any(side not in SIZES_PX for side in self.size_px):
            size = "{}x{}".format(*self.size_px)
            wanted = f"even numbers from {SIZES_PX[0]} to {SIZES_PX[-1]}"
            raise InputError("export", "size_px", size, wanted)
        if (suffix := f".{self.picture_format}") not in SMALL:
            wanted = f"one of {', '.join(each[1:] for each in SMALL)}"
            raise InputError("export", "picture_format", suffix[1:], wanted)
        rate = self.film_rate_hz
        if rate is not None and not 0 < rate <= TICKS_HZ:
            raise InputError("export", "film_rate_hz", rate, f"above 0, at most {TICKS_HZ}")

    @property
    def run_formats(self) -> list[RunFormat]:
        """The chosen formats with everything in one file."""
        chosen = self.together | {"hdf5"} if self.hdf5 else self.together
        return [each for name, each in RUN_FORMATS.items() if name in chosen]


@dataclass(frozen=True)
class ExportedFile:
    """A file of an export, as its manifest lists it.

    ``size`` is in bytes, ``sha256`` in hex; ``rows`` is the number of rows of a CSV file without
    its header, else None.
    """

    name: str
    size: int
    sha256: str
    rows: int | None


def export(
    folder: str | os.PathLike[str],
    measured: Iterable[FrameResult],
    calibration: ImageCalibration,
    provenance: Mapping[str, object],
    choice: ExportChoice,
    *,
    image_of: Callable[[int], GreyImage] | None = None,
    extras: Mapping[str, Callable[[], bytes]] | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[ExportedFile, ...]:
    """Write results into a folder atomically: on an error the folder is unchanged.

    Parameters
    ----------
    folder
        Destination: a new or an empty folder, or an earlier export, which is replaced.
    measured
        Result of each frame; iterated once, and once more for a film.
    calibration
        Pixel ↔ imaging plane, for the dots' positions on the plane.
    provenance
        Source, set-up and settings, for the manifest and for files of all frames; plain values.
    image_of
        Reads a frame's grey levels; needed for pictures of frames.
    extras
        Further files, such as a report: name → function that returns the content, called after the
        check that the folder can be written.
    progress
        Called with the number of frames done, those of a film counted again; may raise to stop.

    Returns
    -------
    tuple[ExportedFile, ...]
        The files written, by name; the manifest, which lists them, is not among them.

    Raises
    ------
    InputError
        If the folder has other contents or cannot be written, or a picture cannot be drawn.
    """
    target = Path(os.path.realpath(folder))
    if not target.name:
        raise InputError(target, "folder", "is the root of the disk", OWN_FOLDER)
    if "frames" in choice.pictures and image_of is None:
        raise InputError(target, "pictures", "frames", "a recording that can be read")
    with _translated_errors(target, ROOM), _beside(target) as part:
        files = _Files(part)
        for name, content_of in (extras or {}).items():
            files.new(name)
            files.add(name, content_of())
        progress = progress or (lambda _: None)
        summary, extent = _write_results(
            files, measured, calibration, provenance, choice, image_of, progress
        )
        frames = len(summary.frames)
        if "film" in choice.pictures and extent.known:
            times_s = film_times([each[:2] for each in summary.frames], choice.film_rate_hz)
            path = files.new(FILM_FILE)
            with drawing_errors("film"), drawing_process(choice.size_px, choice.view) as process:
                write_film(path, measured, times_s, extent, process, lambda k: progress(frames + k))
        return files.finish({"frames": frames, "units": UNITS, "provenance": provenance})


def verify_export(folder: str | os.PathLike[str]) -> list[str]:
    """Return sentences about differences between a folder and its manifest; empty if none.

    Raises
    ------
    InputError
        If the folder has no readable manifest.
    """
    folder = Path(folder)
    listed = {file.name: file for file in _manifest(folder)}
    with _translated_errors(folder, AN_EXPORT):
        there = {path.name: path for path in folder.iterdir() if path.name != MANIFEST}
        problems = [f"{name} is not in the manifest" for name in sorted(there.keys() - listed)]
        for name, file in sorted(listed.items()):
            if name not in there:
                problems.append(f"{name} is missing")
            elif there[name].is_symlink() or not there[name].is_file():
                problems.append(f"{name} is not a file")
            elif there[name].stat().st_size != file.size:
                size = there[name].stat().st_size
                problems.append(f"{name} has {size} bytes instead of {file.size}")
            elif sha256_of(there[name]) != file.sha256:
                problems.append(f"{name} was changed")
    return problems


class _Files:
    """The folder while it is written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._rows: dict[str, int] = {}

    def add(self, name: str, content: bytes) -> None:
        """Write a file."""
        self.new(name).write_bytes(content)
        if name.endswith(".csv"):
            self._rows[name] = content.count(b"\n") - 1

    def new(self, name: str) -> Path:
        """Return the path of a new file."""
        path = self.folder / name
        if path.name != name or name.startswith("."):
            raise InputError(self.folder, "name", name, "a plain file name")
        if path.exists():
            raise InputError(self.folder, "name", name, "each file only once")
        return path

    def extend(self, name: str, text: str, rows: int) -> None:
        """Add rows to a CSV file."""
        with (self.folder / name).open("ab") as file:
            file.write(as_bytes(text))
        self._rows[name] += rows

    def finish(self, about: Mapping[str, object]) -> tuple[ExportedFile, ...]:
        """Write the manifest and sync all files to the disk; returns the files, by name."""
        written = tuple(
            ExportedFile(path.name, path.stat().st_size, _synced(path), self._rows.get(path.name))
            for path in sorted(self.folder.iterdir())
        )
        manifest = {**_made(), **about, "files": [asdict(file) for file in written]}
        self.add(MANIFEST, as_json(manifest))
        _synced(self.folder / MANIFEST)
        return written


def _write_results(
    files: _Files,
    measured: Iterable[FrameResult],
    calibration: ImageCalibration,
    provenance: Mapping[str, object],
    choice: ExportChoice,
    image_of: Callable[[int], GreyImage] | None,
    progress: Callable[[int], None],
) -> tuple[Summary, Extent]:
    """Write everything but a film, frame by frame; returns the summary and the common extent."""
    summary, extent = Summary(), Extent()
    for name in choice.tables:
        files.add(f"{name}.csv", csv_header(name, choice.sigma_parts).encode())
    with ExitStack() as stack:
        process, about = None, _about(provenance)
        together = [
            stack.enter_context(each.open(files.new(each.file), about, choice.spacing_mm))
            for each in choice.run_formats
        ]
        if "surfaces" in choice.pictures:
            process = stack.enter_context(drawing_process(choice.size_px, choice.view))
        for result in measured:
            frame, measurement = result.frame, result.measurement
            reconstruction = measurement.reconstruction
            if reconstruction is not None and (choice.surfaces or together):
                refuse_too_large(reconstruction, choice.spacing_mm)
            tables = frame_tables(result, calibration)
            for name in choice.tables:
                rows = csv_rows(name, tables[name], choice.sigma_parts)
                files.extend(f"{name}.csv", rows, len(tables[name]["frame"]))
            surfaces = surface_files(
                frame, reconstruction, choice.surfaces, choice.spacing_mm, as_solid=choice.solid
            )
            for name, content in surfaces.items():
                files.add(name, content)
            for writer in together:
                writer.write(frame, tables, reconstruction)
            drawn = "frames" in choice.pictures and measurement.status != "unreadable"
            if image_of is not None and drawn:
                path = files.new(f"frame_{frame:06d}.{choice.picture_format}")
                write_frame_picture(path, image_of(frame), measurement)
            if process is not None and reconstruction is not None:
                with drawing_errors("surfaces"):
                    path = files.new(f"surface_{frame:06d}.png")
                    write_surface_picture(path, reconstruction, process)
            summary.add(result)
            extent.add(measurement)
            progress(len(summary.frames))
    if "trends" in choice.pictures and summary.example is not None:
        _draw_trend(files.new(TREND_FILE), summary)
    return summary, extent


def _made() -> dict[str, object]:
    return {"program": "labapp", "version": VERSION, "created": now(), "sigma_of": SIGMA_OF}


def _about(provenance: Mapping[str, object]) -> dict[str, object]:
    """Return attributes of a file of all frames: program, provenance, the set-up as TOML text."""
    about = {**_made(), **provenance}
    setup = about.get("setup")
    if isinstance(setup, Mapping) and "toml" in setup:
        about["setup"] = setup["toml"]
    return about


def _draw_trend(path: Path, summary: Summary) -> None:
    times = [time_s for _, time_s, _ in summary.frames if time_s is not None]
    timed = len(times) == len(summary.frames)
    axis = times if timed else [frame for frame, _, _ in summary.frames]
    height, depth = (np.nansum(np.abs(summary.series(name))) for name in ("height_mm", "depth_mm"))
    names = ("width", "length", "depth" if depth > height else "height")
    series = {
        name: (summary.series(f"{name}_mm"), summary.series(f"{name}_sigma_mm")) for name in names
    }
    write_trend_picture(path, axis, "time (s)" if timed else "frame", series)


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """Yield a temporary folder, which replaces the target unless the block raises."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with only_writer(target) as locked:
        if locked:
            _tidy(target)
        _check_replaceable(target)
        part = beside(target)
        part.mkdir()
        try:
            yield part
            sync_folder(part)
            _check_replaceable(target)
            _swap(part, target, part.with_suffix(OLD))
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _tidy(target: Path) -> None:
    """Delete folders left by a killed export, or restore the folder it was replacing."""
    ours = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{16}}\.(part|old)")
    for path in target.parent.iterdir():
        if not ours.fullmatch(path.name) or path.is_symlink() or not path.is_dir():
            continue
        if path.suffix == OLD and not target.exists():  # killed between the renames of `_swap`
            path.rename(target)
        else:
            shutil.rmtree(path, ignore_errors=True)


def _swap(part: Path, target: Path, old: Path) -> None:
    """Rename the folder to the target; the former one is restored on failure, else deleted."""
    try:
        if target.exists():
            target.rename(old)
        part.rename(target)
    except BaseException:
        if old.exists() and not target.exists():
            old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _check_replaceable(target: Path) -> None:
    """Raise if the target contains anything but an unchanged export."""
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError(target, "folder", "is a file", OWN_FOLDER)
    names = sorted(path.name for path in target.iterdir())
    if not names:
        return
    if MANIFEST not in names:
        raise InputError(target, "folder", f"holds {names[0]} and no {MANIFEST}", OWN_FOLDER)
    lost = [problem for problem in verify_export(target) if not problem.endswith("is missing")]
    if lost:
        raise InputError(target, "folder", f"{lost[0]}: it may be yours", OWN_FOLDER)


def _manifest(folder: Path) -> tuple[ExportedFile, ...]:
    """Return the files that a folder's manifest lists."""
    path = folder / MANIFEST
    try:
        if not path.is_file() or path.stat().st_size > LARGEST_MANIFEST:
            raise InputError(folder, MANIFEST, "does not exist", AN_EXPORT)
        content = json.loads(path.read_bytes())
        if content["program"] != "labapp":
            raise ValueError
        entries = content["files"]
        for entry in entries:
            if [type(entry[key]) for key in ("name", "size", "sha256")] != [str, int, str]:
                raise ValueError
        return tuple(ExportedFile(**entry) for entry in entries)
    except OSError as error:
        raise InputError(folder, MANIFEST, error.strerror, AN_EXPORT) from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputError(folder, MANIFEST, "is not one of labapp", AN_EXPORT) from error


def _synced(path: Path) -> str:
    """Flush a file to disk, and return its SHA-256."""
    with path.open("rb+") as file:  # Windows can only flush files opened for writing
        os.fsync(file.fileno())
    return sha256_of(path)


@contextmanager
def _translated_errors(folder: Path, expected: str) -> Iterator[None]:
    """Translate errors of the file system into `InputError`."""
    try:
        yield
    except OSError as error:
        what = error.strerror or str(error)
        name = f" ({Path(error.filename).name})" if error.filename else ""
        raise InputError(folder, "export", f"{what}{name}", expected) from error
