"""Plan of an export, reasons against it, and its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from labapp.core.schemes import scheme_words
from labapp.core.values import FloatArray, IntArray
from labapp.export.folder import (
    ExportChoice,
    ExportedFile,
    verify_export,
)
from labapp.export.formats import (
    FILM_FILE,
    MANIFEST,
    REPORT_FILE,
    RUN_FORMATS,
    SURFACE_FORMATS,
    TREND_FILE,
    RunFormat,
    SurfaceFormat,
    mesh_formats,
)
from labapp.export.meshes import SPACING_MM
from labapp.export.rendering.drawing import Direction
from labapp.export.rendering.film import UNTIMED_HZ, film_times
from labapp.export.rendering.studio import PICTURE_PX
from labapp.gui.drafts import folder_of
from labapp.session.frames import Progress
from labapp.session.results.measured import SETUP_CHANGED, scheme_name
from labapp.session.results.statuses import is_failed
from labapp.session.session import Session
from labapp.text import format_bytes, marked_setup_words, pluralize

MANIFEST_LINE = f"{MANIFEST}: source, set-up, versions, every file with its SHA-256"

LINES = "Lines are exported as their tables; the choices are for patterns of dots."
"""Reason why nothing can be chosen for a pattern of lines."""

SHOWN_PROBLEMS = 5

BRIEF_S = 3.0
"""Duration, s, below which a film is too short to watch."""

VIEWS = (
    ("free", "oblique"),
    ("top", "from the top"),
    ("side", "from the side"),
    ("front", "from the front, as the camera"),
)
FORMATS = (("png", "PNG: exact"), ("jpg", "JPEG: small"), ("tif", "TIFF: exact, large"))
SIZES = ((1280, 720), (1920, 1080), (2560, 1440), (800, 600))


@dataclass(frozen=True)
class Item:
    """An item that can be ticked."""

    key: str
    """``tables:dots``, ``surfaces:stl``, ``solid``, ``together:hdf5``, ``report``."""
    name: str
    tip: str


def groups() -> tuple[tuple[str, tuple[Item, ...]], ...]:
    """Items that can be ticked: (heading, items) of each group."""
    return (
        ("Tables (CSV)", (
            Item("tables:measures", "Measures", "One row per frame: width, length, height…"),
            Item("tables:dots", "Dots", "One row per dot: its place, row, column and ray"),
            Item("tables:points", "Points", "One row per reflection point, with its residual"),
            Item("tables:boundary", "Boundary", "The pool's boundary, point by point"),
        )),
        ("Surfaces, one file per frame", (
            *_formats("surfaces", SURFACE_FORMATS),
            Item("solid", "Also as solids", "Each surface as a watertight body, mesh formats only"),
        )),
        ("Pictures, film (MP4)", (
            Item("pictures:frames", "Frames", "Each frame with its dots, rows and columns"),
            Item("pictures:surfaces", "Surfaces",
                "Each surface in 3-D, seen from where you choose"),
            Item("pictures:trends", "Trends", "Width, length and height over time"),
            Item("pictures:film", "Film", "The surface in 3-D over all frames, each at its time"),
        )),
        ("Everything together", (
            *_formats("together", RUN_FORMATS),
            Item("report", "Report (PDF)", "Set-up, calibration, results, error budget, versions"),
        )),
    )  # fmt: skip


def _formats(kind: str, formats: Mapping[str, SurfaceFormat | RunFormat]) -> list[Item]:
    return [Item(f"{kind}:{name}", each.title, each.tip) for name, each in formats.items()]


USUAL = frozenset(
    "tables:measures tables:dots tables:points tables:boundary surfaces:csv surfaces:stl".split()
)


@dataclass(frozen=True)
class ExportRequest:
    """Export requested by the operator."""

    ticked: frozenset[str] = USUAL
    """Keys of the ticked `Item`."""
    which: str = "all"
    """``all``, ``view`` (the frame in view) or ``part``."""
    first: int = 0
    last: int = 0
    every: int = 1
    """Frames of the part: ``first``, ``first + every`` … up to ``last``."""
    scheme: str = ""
    """Scheme whose results are written; empty: that of the settings."""
    spacing_mm: float = SPACING_MM
    """Spacing of the surfaces' nodes."""
    view: Direction = "free"
    size_px: tuple[int, int] = PICTURE_PX
    picture_format: str = "png"
    film_rate_hz: float | None = None
    """As in `ExportChoice`."""

    def some(self, kind: str) -> frozenset[str]:
        """Ticked items of a kind."""
        return frozenset(key.partition(":")[2] for key in self.ticked if key.startswith(f"{kind}:"))

    @property
    def has_mesh(self) -> bool:
        """Whether surfaces are written as triangles, which solids need."""
        return bool(self.some("surfaces") & frozenset(mesh_formats()))

    @property
    def has_view(self) -> bool:
        """Whether surfaces are drawn in 3-D, which needs a camera and a size."""
        return bool(self.some("pictures") & {"surfaces", "film"})

    def choice(self) -> ExportChoice:
        """The request in the form required by the session."""
        return ExportChoice(
            tables=self.some("tables"),
            surfaces=self.some("surfaces"),
            solid="solid" in self.ticked and self.has_mesh,
            together=self.some("together"),
            pictures=self.some("pictures"),
            spacing_mm=self.spacing_mm,
            view=self.view,
            size_px=self.size_px,
            film_rate_hz=self.film_rate_hz,
            picture_format=self.picture_format,
        )


@dataclass(frozen=True)
class ExportPlan:
    """What would be written."""

    scheme: str
    """Scheme whose results are written."""
    frames: IntArray
    """Numbers of the chosen frames that are measured, shape (n,)."""
    again: IntArray
    """Chosen frames that are stale or unmeasured, shape (k,)."""
    why_not: str
    """Reason why nothing can be written; empty if it can."""
    locked: str
    """Reason why the files cannot be chosen; empty if they can."""
    notes: tuple[str, ...]
    """Further notes, a sentence each."""
    files: tuple[str, ...]
    """Files in the folder, a line each."""
    surfaces: int
    """Number of frames with a surface."""
    area_mm2: float
    """Mean area of the surfaces; 0 without any, and of lines."""


def plan(session: Session, request: ExportRequest, frame: int) -> ExportPlan:
    """Plan of an export, and the reason if it is impossible."""
    own = scheme_name(session.settings)
    locked = LINES if session.has_lines else ""
    request = replace(request, ticked=USUAL) if locked else request
    scheme = request.scheme or own
    seen = session.overview(scheme)
    chosen = _chosen(seen.frame, request, frame)
    status = np.array(seen.status, dtype=object)
    measured = chosen & (status != "")
    stale = seen.frame[measured & seen.stale]
    unmeasured = seen.frame[chosen & (status == "")]
    surfaces = int((measured & (status == "ok")).sum())
    notes = [locked]
    if len(seen.frame[measured]):
        notes.append(marked_setup_words(session.setup_status, session.setup_words))
    if len(unmeasured):
        notes.append(
            f"{pluralize(len(unmeasured), 'frame')} not measured by {_named(scheme)}: left out."
        )
    if failed := sum(map(is_failed, status[measured])):
        why = "without a surface: in the tables with the reason"
        of_lines = "that could not be measured: in features.csv with their status"
        words = of_lines if locked else why
        notes.append(f"{pluralize(failed, 'frame')} {words}.")
    if "film" in request.some("pictures") and surfaces:
        notes.append(film_note(seen.frame[measured], seen.time_s[measured], request.film_rate_hz))
    frames = seen.frame[measured]
    files = _files_of_lines(session, surfaces) if locked else _files(request, len(frames), surfaces)
    again = np.union1d(stale, unmeasured) if scheme == own else np.zeros(0, np.int64)
    return ExportPlan(
        scheme=scheme,
        frames=frames,
        again=np.asarray(again, np.int64),
        why_not=_why_not(session, request, scheme, frames, stale)
        if chosen.any() or not len(chosen)
        else f"There is no frame from {request.first} to {request.last}.",
        locked=locked,
        notes=tuple(filter(None, notes)),
        files=(*files, MANIFEST_LINE) if len(frames) else (),
        surfaces=surfaces,
        area_mm2=0.0
        if locked or not surfaces
        else float(np.nanmean(seen.measures["area_mm2"][measured])),
    )


def film_note(frames: IntArray, time_s: FloatArray, rate_hz: float | None) -> str:
    """Text of the duration of the film, with advice if it is too short."""
    timed = [(int(k), t if np.isfinite(t) else None) for k, t in zip(frames, time_s, strict=True)]
    lasts_s = float(film_times(timed, rate_hz)[-1])
    message = f"The film lasts {lasts_s:.3g} s."
    if rate_hz is None and not np.isfinite(time_s).all():
        return f"{message} The recording has no time base: {UNTIMED_HZ:g} frames/s."
    if rate_hz is None and len(frames) > 1 and lasts_s < BRIEF_S:
        return f"{message} To see it slowed, enter its frames/s, for example 10."
    return message


def _chosen(
    frames: IntArray, request: ExportRequest, frame: int
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    if request.which == "view":
        return np.asarray(frames == frame)
    if request.which == "part":
        step = (frames - request.first) % max(1, request.every) == 0
        return np.asarray((frames >= request.first) & (frames <= request.last) & step)
    return np.ones(len(frames), bool)


def _why_not(
    session: Session, request: ExportRequest, scheme: str, frames: IntArray, stale: IntArray
) -> str:
    if not len(frames):
        return f"None of these frames is measured by {_named(scheme)}: measure them first."
    if len(stale):
        result = session.result(int(stale[0]), scheme)
        why = " and ".join(result.stale) if result is not None else SETUP_CHANGED
        return (
            f"{pluralize(len(stale), 'frame')} out of date, because {why}. "
            "Measure again, or undo the change."
        )
    if not request.ticked - {"solid"}:
        return "Tick what is to be exported."
    missing = session.missing_recording
    if "frames" in request.some("pictures") and missing is not None:
        return f"Pictures of frames need the recording, and {missing.name} is missing."
    return ""


def _files_of_lines(session: Session, surfaces: int) -> list[str]:
    """Return the tables of a pattern of lines, as `labapp.export.line_results.line_tables`."""
    lines = ["features.csv", "lines.csv", "line_points.csv"]
    rig = None if session.setup_problems else session.setup.line_rig
    if rig is not None and rig.pattern.count == 1:
        return [*lines, "track.csv"]
    lines.append("edges.csv, if the solid metal shows the ends of lines")
    if surfaces:
        lines.append(f"surface_NNNNNN.csv ({pluralize(surfaces, 'file')})")
    return lines


def _files(request: ExportRequest, count: int, surfaces: int) -> list[str]:
    lines = [f"{name}.csv" for name in ("measures", "dots", "points", "boundary")]
    lines = [line for line in lines if line.removesuffix(".csv") in request.some("tables")]
    formats = request.some("surfaces")
    many = [each.end for name, each in SURFACE_FORMATS.items() if name in formats]
    if "surfaces" in request.some("pictures"):
        many.append(".png")
    lines += [f"surface_NNNNNN{end} ({pluralize(surfaces, 'file')})" for end in many if surfaces]
    if request.choice().solid and surfaces:
        lines.append(f"the same as solids, {surfaces} of each format")
    if "frames" in request.some("pictures"):
        lines.append(f"frame_NNNNNN.{request.picture_format} ({pluralize(count, 'file')})")
    if "trends" in request.some("pictures"):
        lines.append(TREND_FILE)
    if "film" in request.some("pictures") and surfaces:
        lines.append(FILM_FILE)
    whole = request.some("together")
    lines += [each.file for name, each in RUN_FORMATS.items() if name in whole]
    lines += [REPORT_FILE] * ("report" in request.ticked)
    return lines


def _named(scheme: str) -> str:
    words = scheme_words().get(scheme)
    return scheme if words is None else words.short


def schemes(session: Session) -> tuple[tuple[str, str], ...]:
    """Schemes to choose from, (key, words): the settings' first, then others with results."""
    own = scheme_name(session.settings)
    others = sorted({scheme for scheme, _ in session.measured_by} - {own})
    return (
        ("", f"{_named(own)} (as in the settings)"),
        *((scheme, _named(scheme)) for scheme in others),
    )


def proposed_folder(session: Session) -> Path:
    """Default folder of an export."""
    return folder_of(session) / f"{session.path.stem}-results"


def folder_within(folder: Path, session: Session) -> Path:
    """The folder if it can contain the export, otherwise a subfolder of it."""
    try:
        own = not any(folder.iterdir()) or (folder / MANIFEST).is_file()
    except OSError:
        own = True  # the export reports the problem
    return folder if own else folder / proposed_folder(session).name


@dataclass(frozen=True)
class Written:
    """Result of an export."""

    folder: Path
    files: tuple[ExportedFile, ...]
    problems: tuple[str, ...]
    """Differences from its manifest; empty if there are none."""

    @property
    def words(self) -> str:
        """Text for the operator."""
        size = format_bytes(sum(file.size for file in self.files))
        files = pluralize(len(self.files), "file")
        message = f"{files} and the manifest, {size}, are in {self.folder}."
        if not self.problems:
            return f"{message} Verified against the manifest."
        shown = "; ".join(self.problems[:SHOWN_PROBLEMS])
        return f"{message} But not all agrees with the manifest: {shown}."


def write(
    session: Session,
    request: ExportRequest,
    frames: Sequence[int],
    folder: Path,
    progress: Progress,
) -> Written:
    """Export, then read all files again and compare them with the manifest."""
    if session.has_lines:
        request = replace(request, ticked=USUAL, spacing_mm=SPACING_MM)
    # The report's matrices are small, so several threads would slow each other down.
    with threadpool_limits(limits=1, user_api="blas"):
        files = session.export(
            folder,
            request.choice(),
            frames=frames,
            scheme=request.scheme or None,
            report="report" in request.ticked,
            progress=progress,
        )
    return Written(folder, files, tuple(verify_export(folder)))
