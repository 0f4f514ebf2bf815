"""The result files of a run, complete for every finished frame even after an interruption."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Self

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.recording.residual_check import DOUBTFUL, SetupVerdict
from labapp.core.surface.reconstruction import Reconstruction
from labapp.errors import InputError
from labapp.export.formats import SURFACE_FORMATS
from labapp.export.frame_result import FrameResult
from labapp.export.meshes import SPACING_MM, known_nodes, open_mesh, solid_mesh
from labapp.export.tables import TABLES, csv_header, sigma_of, table_rows
from labapp.files import as_bytes, as_json, is_of_labapp, only_writer, write_all, write_atomically
from labapp.text import now, unescaped_csv_text
from labapp.version import VERSION

RUN_FILE = "run.json"
RESULT_NAMES = re.compile(
    r"(measures|dots|points|boundary|penetration|surface_\d{6,})\.csv|surface_\d{6,}\.stl"
)
"""Names of the files of a run, besides `RUN_FILE`; the next run in the folder deletes them."""

SURFACES = ("csv", "stl")
"""Formats of each surface in a run."""


def surface_files(
    frame: int,
    reconstruction: Reconstruction | None,
    formats: Collection[str],
    spacing_mm: float,
    *,
    as_solid: bool = False,
) -> dict[str, bytes]:
    """Return the files of a frame's surface, name → content; empty without a surface.

    Parameters
    ----------
    formats
        Some of `SURFACE_FORMATS`.
    spacing_mm
        Distance between nodes, mm.
    as_solid
        Whether to add a watertight solid in each of the mesh formats.
    """
    if reconstruction is None:
        return {}
    files: dict[str, bytes] = {}
    chosen = [each for name, each in SURFACE_FORMATS.items() if name in formats]
    shapes = (
        ("surface", "nodes", known_nodes),
        ("surface", "mesh", open_mesh),
        ("solid", "mesh", solid_mesh),
    )
    for stem, of, make in shapes[: 2 + as_solid]:
        alike = [each for each in chosen if each.of == of]
        if alike:
            shape = make(reconstruction, spacing_mm)
            files |= {f"{stem}_{frame:06d}{each.end}": each.content(shape) for each in alike}
    return files


class ResultsWriter:
    """Writes a run's results into a folder, one frame at a time.

    A frame's rows are appended with one write per file, `measures.csv` last: a frame with a row
    there is complete. If a write fails or is interrupted, the frame is rolled back. `run.json`
    contains the provenance of the results and the final state of the run.

    Results of a former run are replaced; a folder with files of the same names but without
    `run.json` is an error, as they may be the user's.

    Parameters
    ----------
    folder
        Destination; created if missing.
    calibration
        Pixel ↔ imaging plane, for the dots' positions on the plane.
    provenance
        Source, set-up and options, for `run.json`.
    surfaces
        Whether to write the surface of each frame, in the formats `SURFACES`.
    sigma_parts
        Whether `measures.csv` also has the parts of standard uncertainties.

    Raises
    ------
    InputError
        If the folder cannot be used; also by all methods that write.
    """

    def __init__(
        self,
        folder: Path,
        calibration: ImageCalibration,
        provenance: Mapping[str, object],
        surfaces: bool = True,
        sigma_parts: bool = False,
    ) -> None:
        self.folder = folder
        self.frames = 0
        self._statuses: set[str] = set()
        self._calibration = calibration
        self.surfaces = surfaces
        self._sigma_parts = sigma_parts
        self._run = {
            "program": "labapp",
            "version": VERSION,
            "sigma_of": "",  # set at the first frame with a standard uncertainty
            "state": "running",
            "started": now(),
            "ended": None,
            "frames_done": 0,
            **provenance,
        }
        self._files: dict[str, io.FileIO] = {}
        self._lock = ExitStack()
        with self._os_errors_as_input():
            try:
                folder.mkdir(parents=True, exist_ok=True)
                self._lock.enter_context(only_writer(Path(os.path.realpath(folder))))
                _earlier_results(folder)
            except BaseException:
                self._close_files()
                raise

    def write(self, result: FrameResult) -> None:
        """Write all results of one frame.

        Raises
        ------
        InputError
            If it cannot be written (disk full, folder removed); earlier frames are complete.
        """
        self._begin()
        before = {file: os.fstat(file.fileno()).st_size for file in self._files.values()}
        formats = SURFACES if self.surfaces else ()
        surfaces = {
            self.folder / name: content
            for name, content in surface_files(
                result.frame, result.measurement.reconstruction, formats, SPACING_MM
            ).items()
        }
        rows = result.rows or table_rows(result, self._calibration, self._sigma_parts)
        with self._os_errors_as_input():
            try:
                for path, content in surfaces.items():
                    write_atomically(path, content)
                for name, text in rows.items():
                    write_all(self._files[name], as_bytes(text))
                if not self._run["sigma_of"] and (covered := sigma_of(result.measurement)):
                    self._run["sigma_of"] = covered
                    self._write_run()
            except BaseException:
                for file, size in before.items():
                    file.truncate(size)
                for path in surfaces:
                    path.unlink(missing_ok=True)
                raise
        self.frames += 1
        self._statuses.add(result.measurement.setup_status)

    def set_setup_status(self, status: str, verdict: SetupVerdict) -> None:
        """Write the check of the set-up by all frames to `run.json` and to every frame's row.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        self._begin()
        self._run |= {"setup_status": status, "setup_check": asdict(verdict)}
        if DOUBTFUL not in (status, *self._statuses):
            return
        path = self.folder / "measures.csv"
        with self._os_errors_as_input():
            with path.open(encoding="utf-8", newline="") as file:
                names, *rows = csv.reader(file)
            place = names.index("setup_status")
            for row in rows:
                row[place] = row[place] and status
            self._files.pop("measures").close()
            write_atomically(path, as_bytes(unescaped_csv_text([names, *rows])))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Write the final state of the run; without a frame, results of an earlier run are kept."""
        with self._os_errors_as_input() if error is None else suppress(OSError):
            try:
                if error is None or not _earlier_results(self.folder):
                    self._begin()
                if self._files:
                    self._write_state(error)
            finally:
                self._close_files()

    def _begin(self) -> None:
        """Replace the results of an earlier run by tables without frames, if not done yet.

        As late as the first frame is done: what prevents its measurement does not cost results.
        """
        if self._files:
            return
        with self._os_errors_as_input():
            try:
                for path in _earlier_results(self.folder):
                    path.unlink()
                self._write_run()
                for name in TABLES:
                    self._files[name] = io.FileIO(self.folder / f"{name}.csv", "a")
                    write_all(self._files[name], as_bytes(csv_header(name, self._sigma_parts)))
            except BaseException as error:
                with suppress(OSError):
                    self._write_state(error)
                raise

    def _write_state(self, error: BaseException | None) -> None:
        """Write the final state of the run, which an error may have ended, to `run.json`."""
        state = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        state = state if error else "finished"
        self._run |= {"state": state, "ended": now(), "frames_done": self.frames}
        self._write_run()

    def _write_run(self) -> None:
        write_atomically(self.folder / RUN_FILE, as_json(self._run))

    def _close_files(self) -> None:
        for file in self._files.values():
            file.close()
        self._lock.close()

    @contextmanager
    def _os_errors_as_input(self) -> Iterator[None]:
        """Convert an `OSError`, and say which frames are complete."""
        try:
            yield
        except OSError as error:
            are = "previous frame is" if self.frames == 1 else f"{self.frames} previous frames are"
            finished = f"; the {are} complete" if self.frames else ""
            raise InputError(
                self.folder,
                "results",
                f"{error.strerror} ({Path(error.filename or self.folder).name})",
                f"a writable folder with enough disk space{finished}",
            ) from error


def _earlier_results(folder: Path) -> list[Path]:
    """Files of an earlier run, `measures.csv` first: if it is deleted, no row lacks its files.

    Raises
    ------
    InputError
        If they may be the user's, or `run.json` is a link.
    """
    if (folder / RUN_FILE).is_symlink():  # `write_atomically` would follow it
        raise InputError(folder, RUN_FILE, "is a link", "a folder whose files are its own")
    ours = [path for path in folder.iterdir() if RESULT_NAMES.fullmatch(path.name)]
    if ours and not is_of_labapp(folder / RUN_FILE):
        raise InputError(
            folder,
            "results",
            f"holds {ours[0].name} and no {RUN_FILE}",
            "an empty folder, or one with an earlier run (it is replaced)",
        )
    return sorted(ours, key=lambda path: path.name != "measures.csv")
