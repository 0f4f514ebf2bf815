"""`labapp session …`: an experiment in one file, by the functions of the Python API."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from labapp.cli.session.correct import InOrder, correct
from labapp.cli.session.info import info
from labapp.cli.shared import (
    ABOUT_SCHEMES,
    ALGORITHM_HELP,
    DETECTOR_HELP,
    FRAMES_HELP,
    FRAMES_METAVAR,
    NOTHING_MEASURED,
    ROWS_HELP,
    Algorithm,
    DetectorName,
    FrameRange,
    Recording,
    ResultsName,
    RowsName,
    SchemeName,
    SessionFile,
    SigmaParts,
    Warm,
    choose_frames,
    command_group,
    finite,
    frames_text,
    measure_frames,
    progress_shown,
    report_stale_results,
    session_command,
    show_warnings,
)
from labapp.core.schemes import scheme_words
from labapp.errors import InputError, printable
from labapp.export.formats import RUN_FORMATS, SURFACE_FORMATS
from labapp.session.results.statuses import is_measured
from labapp.text import local_time, now, pluralize

if TYPE_CHECKING:
    from labapp.core.pipeline import Settings
    from labapp.session.frames import Progress
    from labapp.session.session import Session

app = command_group()

Frames = Annotated[
    str | None, typer.Option(metavar=FRAMES_METAVAR, help=f"{FRAMES_HELP} Default: all.")
]

WhoseResults = Annotated[
    ResultsName | None,
    typer.Option(
        metavar="SCHEME",
        help=f"Scheme of the results: {', '.join(scheme_words())}. Default: that of the session's "
        "settings.",
    ),
]
Tables = Annotated[
    bool, typer.Option(help="Measures, dots, points and boundaries as CSV (mm, px).")
]
View = Annotated[
    Literal["free", "top", "side", "front"],
    typer.Option(help="View of surface pictures and the film; free: oblique."),
]
Size = Annotated[
    str, typer.Option(metavar="WIDTHxHEIGHT", help="Size of these pictures (px, even numbers).")
]
FilmRate = Annotated[
    float | None,
    typer.Option(
        callback=finite,
        help="Frame rate of the film (Hz). Default: that of the recording.",
    ),
]


def _quantity(text: str) -> Any:
    return typer.Option(min=0, callback=finite, help=text)


def _some(names: Iterable[str], words: str = "Some", unit: str = "") -> Any:
    return typer.Option(metavar="A,B,…", help=f"{words} of {', '.join(names)}, or none{unit}.")


@app.command()
def new(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The new session; its name ends in .labsession.")
    ],
    setup: Annotated[
        Path | None, typer.Option(help="Setup file to copy into it (TOML; mm, degrees, px).")
    ] = None,
    *,
    title: Annotated[str, typer.Option(help="Title of the experiment.")] = "",
    operator: Annotated[str, typer.Option(help="Name of the operator.")] = "",
    material: Annotated[str, typer.Option(help="Material of the work piece.")] = "",
    thickness_mm: Annotated[float | None, _quantity("Thickness of the work piece (mm).")] = None,
    current_a: Annotated[float | None, _quantity("Welding current (A).")] = None,
    voltage_v: Annotated[float | None, _quantity("Arc voltage (V).")] = None,
    travel_speed_mm_s: Annotated[float | None, _quantity("Travel speed (mm/s).")] = None,
    gas: Annotated[str, typer.Option(help="Shielding gas.")] = "",
    notes: Annotated[str, typer.Option(help="Further notes.")] = "",
) -> None:
    """Create a session; set-up and experiment record may be added later."""
    from labapp.config.setup import read_setup
    from labapp.session.record import Record
    from labapp.session.session import Session

    text = None if setup is None else show_warnings(read_setup(setup, lines=True)).text
    record = Record(
        title=title,
        operator=operator,
        material=material,
        thickness_mm=thickness_mm,
        current_a=current_a,
        voltage_v=voltage_v,
        travel_speed_mm_s=travel_speed_mm_s,
        gas=gas,
        notes=notes,
    )
    with Session.create(file, None if record == Record() else record) as session:
        if text is not None:
            session.set_setup(text)
        typer.echo(f"{session.path} is made")
    if text is None:
        typer.echo(f"It has no set-up yet:\n  {session_command('setup', file)} SETUP.toml")
    typer.echo(f"Import a recording:\n  {session_command('import', file)} RECORDING")


@app.command("setup")
def set_setup(
    file: SessionFile,
    setup: Annotated[Path, typer.Argument(help="Setup file (TOML; mm, degrees, px).")],
) -> None:
    """Replace the set-up: rig and image calibration. This can be undone."""
    from labapp.config.setup import read_setup
    from labapp.session.session import Session

    text = show_warnings(read_setup(setup, lines=True)).text
    with Session.open(file) as session, report_stale_results(session):
        same = session.setup_text == text
        session.set_setup(text)
        typer.echo("The set-up is the same as before" if same else f"The set-up is that of {setup}")


@app.command("import")
def import_recording(
    file: SessionFile,
    recording: Recording,
    frames: FrameRange = ":",
    frame_rate: Annotated[
        float | None,
        typer.Option(
            min=0,
            callback=finite,
            help="Frame rate (Hz), if the recording has none or a wrong one.",
        ),
    ] = None,
    embed: Annotated[
        bool, typer.Option("--embed", help="Store the frames in the session itself, lossless.")
    ] = False,
) -> None:
    """Import a recording: read all of it, check it, and describe it."""
    from labapp.media.base import format_frame_rate
    from labapp.session.session import Session

    with Session.open(file) as session:
        with _counted(f"reading {recording.name}") as progress:
            found = session.import_recording(
                recording, frames, frame_rate_hz=frame_rate, embed=embed, progress=progress
            )
        for warning in found.warnings:
            typer.echo(f"warning: {warning}", err=True)
        used = pluralize(len(session.frames), "frame")
        start, stop, step = found.selected
        if found.frame_rate_hz is None:
            time_base = "none: give --frame-rate, or the frames have no times"
        else:
            whose = "as given" if found.rate_is_given else "the recording's own"
            time_base = f"{format_frame_rate(found.frame_rate_hz)}, {whose}"
        exact = "frame-exact" if found.frame_exact else INEXACT
        typer.echo(f"{recording.name}: {found.description}")
        typer.echo(
            f"frames     {found.frames} in it, {used} in the session ({start}:{stop}:{step})"
        )
        typer.echo(f"time base  {time_base}")
        typer.echo(f"seeking    {exact}")
        typer.echo(f"kept       {'in the session itself' if embed else f'as {found.path}'}")
        if session.setup_problems:
            typer.echo(
                f"The set-up is not complete:\n  {session_command('setup', file)} SETUP.toml"
            )
        typer.echo(f"Measure it:\n  {session_command('measure', file)}")


INEXACT = (
    "not frame-exact: frames that come out wrong are refused; encode it again, "
    "as FFV1 or MJPG in AVI"
)


@app.command()
def relink(
    file: SessionFile, recording: Annotated[Path, typer.Argument(help="New path of the recording.")]
) -> None:
    """Set the new path of a moved recording. Only the imported recording is accepted."""
    from labapp.session.session import Session

    with Session.open(file) as session:
        session.relink(recording)
    typer.echo(f"{session.path} finds its recording at {recording}")


@app.command()
def measure(
    file: SessionFile,
    frames: Frames = None,
    everything: Annotated[
        bool, typer.Option("--all", help="All frames, including those with current measures.")
    ] = False,
    scheme: Annotated[
        SchemeName | None, typer.Option(help=f"From now on: {ABOUT_SCHEMES}.")
    ] = None,
    algorithm: Annotated[
        Algorithm | None,
        typer.Option(help=f"From now on: {ALGORITHM_HELP}"),
    ] = None,
    correspondence: Annotated[
        Literal["auto", "S/S", "S/I", "I/I"] | None,
        typer.Option(help="From now on: order of dots relative to rays, columns/rows."),
    ] = None,
    *,
    detector: Annotated[
        DetectorName | None, typer.Option(help=f"From now on. {DETECTOR_HELP}")
    ] = None,
    rows: Annotated[RowsName | None, typer.Option(help=f"From now on. {ROWS_HELP}")] = None,
    warm: Warm = False,
) -> None:
    """Measure frames: those that are not measured yet or whose measures are out of date.

    Scheme, algorithm, correspondence, detector and search for rows are stored as settings of the
    session; this can be undone.

    Ctrl-C or SIGTERM stops after a complete frame; finished frames are stored.
    """
    from labapp.session.session import Session

    if everything and frames is not None:
        raise InputError("--all", "frames", f"and --frames {frames}", "one of the two")
    with Session.open(file) as session:
        _ = session.setup  # raises before any change if the set-up is incomplete
        chosen = choose_frames(session, frames or ":")
        options = {"scheme": scheme, "algorithm": algorithm, "correspondence": correspondence}
        given = {name: value for name, value in options.items() if value is not None}
        _set(session, given, detector, rows)
        if frames is None and not everything:
            chosen = session.stale_frames().tolist()
        if not chosen:
            typer.echo("Nothing to measure: the measures of all frames stand (--all: once more)")
            return
        summary = measure_frames(session, chosen, warm=warm)
    typer.echo(summary.text())
    if not any(map(is_measured, summary.statuses)):
        raise typer.Exit(NOTHING_MEASURED)


def _set(
    session: Session,
    options: dict[str, str],
    detector: DetectorName | None,
    rows: RowsName | None,
) -> None:
    """Store options as the session's settings, as one change of its history."""
    from labapp.config.settings import check_algorithm, with_methods

    settings: Settings = replace(session.settings, **options)  # type: ignore[arg-type]
    settings = with_methods(settings, detector, rows)
    if "algorithm" in options:
        check_algorithm(settings, "--algorithm")
    if settings != session.settings:
        methods = (("detector", detector), ("rows", rows))
        named = options | {name: value for name, value in methods if value is not None}
        message = ", ".join(f"{name} {value}" for name, value in named.items())
        session.set_settings(settings, message)
        typer.echo(f"Settings: {message} (labapp session undo takes it back)")


app.command(cls=InOrder)(correct)


@app.command()
def undo(file: SessionFile) -> None:
    """Undo the last change of set-up, calibration, settings, dots or rows."""
    _step(file, "undo")


@app.command()
def redo(file: SessionFile) -> None:
    """Redo the change that was undone last."""
    _step(file, "redo")


@app.command()
def export(
    file: SessionFile,
    out: Annotated[
        Path,
        typer.Option(help="Folder for the results: new, empty, or an earlier export, replaced."),
    ],
    *,
    frames: Frames = None,
    scheme: WhoseResults = None,
    tables: Tables = True,
    sigma_parts: SigmaParts = False,
    surfaces: Annotated[str, _some(SURFACE_FORMATS, unit=" (mm)")] = "csv,stl",
    solid: Annotated[
        bool, typer.Option("--solid", help="Also write each surface as a watertight solid.")
    ] = False,
    together: Annotated[str, _some(RUN_FORMATS, "Everything in one file, some")] = "none",
    hdf5: Annotated[
        bool, typer.Option("--hdf5", help="Everything in one HDF5 file: --together hdf5.")
    ] = False,
    pictures: Annotated[str, _some(("frames", "surfaces", "trends", "film"))] = "none",
    view: View = "free",
    size: Size = "1280x720",
    film_rate: FilmRate = None,
    picture_format: Annotated[
        str, typer.Option(metavar="FORMAT", help="Format of pictures of frames: png, jpg or tif.")
    ] = "png",
    report: Annotated[bool, typer.Option("--report", help="A PDF report.")] = False,
) -> None:
    """Export results into a folder with a manifest; an incomplete folder is never left.

    Results that are out of date are an error: measure again first.
    """
    from labapp.export.folder import ExportChoice
    from labapp.export.tables import TABLES
    from labapp.session.session import Session

    if surfaces == pictures == together == "none" and not (tables or hdf5 or report):
        raise InputError("export", "choice", "nothing", "tables, surfaces, HDF5, pictures, report")
    choice = ExportChoice(
        tables=frozenset(TABLES if tables else ()),
        sigma_parts=sigma_parts,
        surfaces=_words(surfaces),
        solid=solid,
        hdf5=hdf5,
        together=_words(together),
        pictures=_words(pictures),
        view=view,
        size_px=_size(size),
        film_rate_hz=film_rate,
        picture_format=picture_format,
    )
    with Session.open(file, read_only=True) as session, _counted(f"writing {out.name}") as progress:
        chosen = None if frames is None else choose_frames(session, frames)
        wanted = set(session.frames.tolist() if chosen is None else chosen)
        seen = session.overview(scheme)
        status = dict(zip(seen.frame.tolist(), seen.status, strict=True))
        missing = {frame for frame in wanted if not status[frame]}
        files = session.export(
            out, choice, frames=chosen, scheme=scheme, report=report, progress=progress
        )
    if missing:
        typer.echo(f"Not measured, so not in it: {frames_text(missing)}")
    typer.echo(f"{pluralize(len(files), 'file')} and the manifest are in {out.absolute()}")


def _size(text: str) -> tuple[int, int]:
    """Read ``1280x720``."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError("--size", "size", text, "WIDTHxHEIGHT, two whole numbers (px)")
    return int(width), int(height)


def _words(text: str) -> frozenset[str]:
    """Split ``a,b,c``; ``none`` means nothing."""
    return frozenset() if text == "none" else frozenset(map(str.strip, text.split(",")))


def _step(file: Path, way: Literal["undo", "redo"]) -> None:
    from labapp.session.session import Session

    with Session.open(file) as session, report_stale_results(session):
        change = session.undo() if way == "undo" else session.redo()
        done = "Undone" if way == "undo" else "Done again"
        message = f"{done}: {change.label} (of {change.made})" if change else f"Nothing to {way}"
        typer.echo(message)


app.command()(info)


@app.command()
def checklist(
    file: SessionFile,
    tick: Annotated[
        list[int] | None, typer.Option(min=1, help="Tick the item of this number; repeat for more.")
    ] = None,
    untick: Annotated[
        list[int] | None, typer.Option(min=1, help="Remove the tick; repeat for more.")
    ] = None,
) -> None:
    """Show the checklists of Appendix II (safety, equipment, steps), and tick items.

    The session stores the time of each tick.
    """
    from labapp.session import checklist as lists
    from labapp.session.session import Session

    items = [item for some in lists.LISTS.values() for item, _ in some]
    for option, numbers in (("--tick", tick), ("--untick", untick)):
        for number in numbers or ():
            if number > len(items):
                raise InputError(option, "item", number, f"1 to {len(items)}")
    with Session.open(file, read_only=not (tick or untick)) as session:
        for ticked, numbers in ((True, tick), (False, untick)):
            for number in numbers or ():
                item = items[number - 1]
                session.set_record(lists.tick(session.record, item, ticked, now()))
        times, number = dict(lists.ticked(session.record)), 0
        for name, some in lists.LISTS.items():
            typer.echo(f"{name}: {sum(item in times for item, _ in some)} of {len(some)}")
            for item, meaning in some:
                number += 1
                mark = f"ticked {local_time(times[item])}" if item in times else ""
                typer.echo(f"{number:3} {'[x]' if mark else '[ ]'} {item}  {mark}".rstrip())
                typer.echo(f"        {meaning}")


@app.command()
def verify(
    file: SessionFile,
    recording: Annotated[
        bool, typer.Option(help="Also read all of the recording, or of the stored frames.")
    ] = True,
) -> None:
    """Check the whole session; print one problem per line, with exit code 1 if there is any."""
    from labapp.session.session import Session

    with Session.open(file, read_only=True) as session:
        with _counted("checking") as progress:
            problems = session.problems(progress, recording)
        for problem in problems:
            typer.echo(printable(problem))
        if problems:
            typer.echo(
                f"What helps\n  a missing recording: {session_command('relink', file)} RECORDING\n"
                f"  a damaged result of frame N: {session_command('measure', file)} --frames N\n"
                "  anything else: a copy from before, or export --frames of what can be read",
                err=True,
            )
            raise typer.Exit(NOTHING_MEASURED)
        results = sum(session.measured_by.values())
        parts = ((len(session.frames), "frame"), (results, "result"))
        texts = [
            pluralize(count, thing) for count, thing in (*parts, (len(session.history), "change"))
        ]
        typer.echo(f"whole: {', '.join(texts)}")


@contextmanager
def _counted(what: str) -> Iterator[Progress]:
    """Show the progress of an operation that Ctrl-C ends without a change.

    Yields a function of the number done and the total.
    """
    with progress_shown(f"stopped {what}; nothing was changed") as progress:
        yield partial(progress, what)
