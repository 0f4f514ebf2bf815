"""Export of a session: selection of the results, and their provenance."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from labapp.errors import PATH, InputError, os_errors_as_input, require
from labapp.export.folder import ExportChoice, ExportedFile, export
from labapp.export.formats import REPORT_FILE
from labapp.export.frame_result import FrameResult
from labapp.export.line_results import line_tables, of_lines
from labapp.export.rendering.drawing import Camera, Direction
from labapp.export.rendering.film import Extent, film_times, write_film
from labapp.export.rendering.studio import drawing_errors, drawing_process
from labapp.session.contents import SessionContents
from labapp.session.frames import Progress
from labapp.session.report import report_pdf
from labapp.session.results.measured import Result, scheme_name

CHOICES_OF_DOTS = (
    "tables", "surfaces", "solid", "hdf5", "together", "pictures", "spacing_mm", "sigma_parts",
)  # fmt: skip
"""Fields of `ExportChoice` without effect on lines; the others are options of pictures."""


def export_session(
    session: SessionContents,
    folder: str | os.PathLike[str],
    choice: ExportChoice,
    frames: Sequence[int] | None,
    scheme: str | None,
    report: bool,
    progress: Progress | None,
) -> tuple[ExportedFile, ...]:
    """Write a session's results into a folder; see `Session.export`."""
    require(folder, PATH, "export", "folder", "the path of a folder")
    require(choice, ExportChoice, "export", "choice", "labapp.export.folder.ExportChoice")
    scheme = scheme or scheme_name(session.settings)
    report_progress = progress or (lambda done, total: None)
    if session.has_lines:
        _refuse_choices_of_dots(choice, report)
        numbers = _current_frames(session, scheme, frames)
        return _export_lines(session, folder, scheme, numbers, report_progress)
    numbers = _current_frames(session, scheme, frames)
    before = len(numbers) * report
    total = before + len(numbers) * (2 if "film" in choice.pictures else 1)

    def write_report() -> bytes:
        return report_pdf(
            session, scheme, numbers, progress=lambda done: report_progress(done, total)
        )

    return export(
        folder,
        _Measured(session, scheme, numbers),
        session.setup.calibration,
        _provenance(session, scheme, numbers),
        choice,
        image_of=lambda number: session.frame(number).image,
        extras={REPORT_FILE: write_report} if report else None,
        progress=lambda done: report_progress(before + done, total),
    )


def write_view_film(
    session: SessionContents,
    path: Path,
    camera: Direction | Camera,
    size_px: tuple[int, int],
    report_progress: Progress,
) -> None:
    """Write a film (MP4) of the surfaces of all frames by the settings' scheme.

    Raises
    ------
    InputError
        If the pattern is of lines, a result is stale, nothing was measured, or the film cannot be
        drawn or written.
    """
    if session.has_lines:
        raise InputError(session.path, "film", "the session is of lines", "a pattern of dots")
    scheme = scheme_name(session.settings)
    numbers = _current_frames(session, scheme, None)
    measured, extent = _Measured(session, scheme, numbers), Extent()
    frames = []
    for result in measured:
        extent.add(result.measurement)
        frames.append((result.frame, result.time_s))
    if not extent.known:
        raise InputError(session.path, "results", "no frame has a surface", "one that has")
    with (
        drawing_errors("film"),
        os_errors_as_input(path, "film", "a file that can be written"),
        drawing_process(size_px, camera) as process,
    ):
        times_s, count = film_times(frames), len(numbers)
        write_film(
            path, measured, times_s, extent, process, lambda done: report_progress(done, count)
        )


def _refuse_choices_of_dots(choice: ExportChoice, report: bool) -> None:
    """Refuse an export of lines with anything but the usual choice: only its tables exist."""
    usual = ExportChoice()
    chosen = [name for name in CHOICES_OF_DOTS if getattr(choice, name) != getattr(usual, name)]
    if chosen := chosen + ["report"] * report:
        right = "the usual choice: lines are exported as their tables, without options"
        raise InputError("export", "choice", ", ".join(chosen), right)


def _export_lines(
    session: SessionContents,
    folder: str | os.PathLike[str],
    scheme: str,
    numbers: Sequence[int],
    report_progress: Progress,
) -> tuple[ExportedFile, ...]:
    """Write all tables of a pattern of lines, or of a followed line."""

    def measured() -> Iterator[FrameResult]:
        for done, result in enumerate(_Measured(session, scheme, numbers), 1):
            yield result
            report_progress(done, len(numbers))

    texts = line_tables(of_lines(measured()), session.setup.calibration, session.setup_status)
    return export(
        folder,
        (),
        session.setup.calibration,
        _provenance(session, scheme, numbers),
        ExportChoice(tables=frozenset(), surfaces=frozenset()),
        extras={name: partial(str.encode, text) for name, text in texts.items()},
    )


class _Measured:
    """Results of frames, read from the session during each iteration."""

    def __init__(self, session: SessionContents, scheme: str, numbers: Sequence[int]) -> None:
        self._session, self._scheme, self._numbers = session, scheme, numbers

    def __iter__(self) -> Iterator[FrameResult]:
        return self._session.frame_results(scheme=self._scheme, frames=self._numbers)


def _current_frames(
    session: SessionContents, scheme: str, frames: Sequence[int] | None
) -> list[int]:
    """Return the measured frames, or those of ``frames``; raise if any is stale."""
    seen = session.overview(scheme)
    chosen = np.array([status != "" for status in seen.status], bool)
    if frames is not None:
        chosen &= np.isin(seen.frame, frames)
    stale = seen.frame[chosen & seen.stale]
    if len(stale):
        why = ", ".join(_result(session, int(stale[0]), scheme).stale)
        raise InputError(
            session.path,
            "results",
            f"{len(stale)} of {chosen.sum()} frames are out of date: {why}",
            "them to be measured again, or the change undone",
        )
    if not chosen.any():
        raise InputError(session.path, "results", f"none by {scheme}", "frames to be measured")
    return [int(number) for number in seen.frame[chosen]]


def _result(session: SessionContents, frame: int, scheme: str) -> Result:
    result = session.result(frame, scheme)
    assert result is not None
    return result


def _provenance(session: SessionContents, scheme: str, frames: Sequence[int]) -> dict[str, object]:
    """Return source, set-up, settings and versions of an export as plain values."""
    recording, first = session.recording, _result(session, frames[0], scheme)
    verdict = session.setup_verdict
    source = {} if recording is None else asdict(recording)
    source.pop("index", None)
    return {
        "session": session.path.name,
        "record": asdict(session.record),
        "source": source,
        "setup": {"toml": first.setup},
        "setup_status": session.setup_status,
        "setup_check": None if verdict is None else asdict(verdict),
        "settings": asdict(first.settings),
        "measured_by": sorted({version for name, version in session.measured_by if name == scheme}),
        "corrected_frames": sorted(set(session.corrected_frames().tolist()) & set(frames)),
    }
