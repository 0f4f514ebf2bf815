"""Parts shared by commands: exit codes, progress, messages about frames and results, files."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer
import typer.core
import typer.main

from labapp.core.schemes import SCHEMES, algorithm_names, scheme_words
from labapp.errors import InputError, os_errors_as_input
from labapp.session.results.statuses import is_failed
from labapp.system import quoted
from labapp.text import pluralize

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from labapp.config.setup import Setup
    from labapp.export.frame_result import FrameResult
    from labapp.export.summary import Summary
    from labapp.run.runner import Sink
    from labapp.session.session import Session
    from labapp.simulation import parallel

    SchemeName: TypeAlias = str
    ResultsName: TypeAlias = str
    Algorithm: TypeAlias = str
else:  # typer reads the allowed values of an option from its type
    SchemeName = Literal[tuple(SCHEMES)]
    ResultsName = Literal[tuple(scheme_words())]
    Algorithm = Literal[algorithm_names()]

ABOUT_SCHEMES = ", ".join(scheme.about for scheme in SCHEMES.values())
ALGORITHM_HELP = "algorithm of {}; not used by the other schemes.".format(
    " or ".join(one.about.partition(" (")[0] for one in SCHEMES.values() if one.algorithms)
)

TERMINATED, INTERRUPTED, FAULT, BAD_INPUT, NOTHING_MEASURED = 143, 130, 3, 2, 1
"""Exit codes besides 0. `NOTHING_MEASURED`: nothing was measured, or a session is not whole."""

RUNS_SHOWN = 6

FRAMES_METAVAR = "A:B:STEP"
FRAMES_HELP = (
    "Frames A up to but not including B, from 0, every STEP-th; parts may be omitted. "
    "A alone: that frame. Negative: counted from the end."
)

SessionFile = Annotated[Path, typer.Argument(metavar="FILE", help="The session (.labsession).")]
Recording = Annotated[
    Path,
    typer.Argument(
        help="A video, an image, a folder of images, a TIFF or NumPy stack, a Phantom .cine, "
        "a Photron .mraw or its header."
    ),
]
FrameRange = Annotated[str, typer.Option(metavar=FRAMES_METAVAR, help=FRAMES_HELP)]

Warm = Annotated[
    bool,
    typer.Option(
        "--warm",
        help="Start each frame from the previous frame's result: more than ten times as fast, for "
        "recordings with a high frame rate.",
    ),
]

DetectorName: TypeAlias = Literal["band-pass", "block-threshold", "wavelet"]
RowsName: TypeAlias = Literal["grow", "rows", "masks"]
DETECTOR_HELP = "How dots are found: band-pass, block threshold (§5.2.1), wavelet chain (§5.3)."
ROWS_HELP = "How rows are found: grown from dot to dot, row search (§5.2.2), masks (§5.3)."
Detector = Annotated[DetectorName, typer.Option(help=DETECTOR_HELP)]
Rows = Annotated[RowsName, typer.Option(help=ROWS_HELP)]

SigmaParts = Annotated[
    bool,
    typer.Option(
        "--sigma-parts",
        help="Also write the parts of each ± to measures.csv: noise, level, set-up.",
    ),
]


KINDS_OF_VALUE = {
    "int": "INTEGER",
    "float": "NUMBER",
    "str": "TEXT",
    "path": "PATH",
    "Path": "PATH",
}


@contextmanager
def _values_in_errors(parameter: Any, ctx: Any, value: object) -> Iterator[None]:
    """Name the value in errors about what it should be, which otherwise have only the latter.

    An empty path, which would mean the current folder, is an error.
    """
    given = value if isinstance(value, list | tuple) else [value]
    if parameter.type_descriptor.annotation is Path and "" in given:
        raise typer.BadParameter("the path is empty; . is the current folder", ctx, parameter)
    try:
        yield
    except typer.BadParameter as error:
        message = error.message.removeprefix("Value error, ")
        if message != (expected := message.removeprefix("Input should be ")):
            number = "a number " if expected.startswith(("greater", "less")) else ""
            shown = " ".join(map(str, given))
            message = f"{shown}; expected {number}{expected.partition(', unable')[0]}"
        error.message = message
        raise


class Argument(typer.core.TyperArgument):
    """Argument that the help names in capitals, without its type."""

    def process_value(self, ctx: Any, value: Any) -> Any:
        """Convert the text of the command line."""
        with _values_in_errors(self, ctx, value):
            return super().process_value(ctx, value)

    @property
    def display_name_raw(self) -> str:
        """The name in usage, help and errors."""
        return self.metavar or (self.name or "").upper()

    def display_type_rich(self, ctx: Any) -> str:
        """Return no type: the help's text describes it."""
        return ""

    def get_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the argument as usage lines have it: ``NAME``, ``[NAME]`` or ``NAME...``."""
        name = self.display_name_raw
        name += "..." * (self.nargs != 1)
        return [name if self.required else f"[{name}]"]


class Option(typer.core.TyperOption):
    """Option whose kind of value is in capitals, such as NUMBER, or a list of choices."""

    def process_value(self, ctx: Any, value: Any) -> Any:
        """Convert the text of the command line."""
        with _values_in_errors(self, ctx, value):
            return super().process_value(ctx, value)

    def display_type(self, ctx: Any) -> str:
        """Return the kind of value of an option without ``metavar``."""
        kind = super().display_type(ctx).strip("<>").removesuffix(" range")
        kind = kind.removeprefix("list[").removesuffix("]")
        return KINDS_OF_VALUE.get(kind, kind)


class Commands(typer.core.TyperGroup):
    """Command group whose help lists the complete first sentence of each command."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for command in attributes["commands"].values():
            for one in command.params:  # Typer has no setting for the class of a parameter
                is_option = isinstance(one, typer.core.TyperOption)
                one.__class__ = Option if is_option else Argument

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of names and sentences."""
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, one.get_short_help_str(limit=1000)) for name, one in self.commands.items()]
            )


def command_group() -> typer.Typer:
    """Return an empty group of commands."""
    return typer.Typer(cls=Commands, rich_markup_mode=None)


def lazy_commands(module: str) -> type[Commands]:
    """Return a class of group whose commands are those of a module, loaded when they are needed.

    Most of the time that the command line needs to start goes into commands that are not run.
    """

    class LoadedCommands(Commands):
        @cached_property
        def loaded(self) -> MutableMapping[str, Any]:
            """Commands by name."""
            return typer.main.get_group(import_module(module).app).commands

        @property
        def commands(self) -> MutableMapping[str, Any]:
            return self.loaded

        @commands.setter
        def commands(self, none: object) -> None:
            """Ignore the empty dictionary that a group is created with."""

    return LoadedCommands


def progress_bar() -> Progress:
    """Return a progress bar on stderr, disabled if stderr is not a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )


def print_above(progress: Progress, text: str) -> None:
    """Print a line on stderr, above the progress bar."""
    progress.console.print(text, markup=False, highlight=False, emoji=False, soft_wrap=True)


def show_warnings(setup: Setup) -> Setup:
    """Print a warning on stderr for each unusual value of a set-up, and return it."""
    for warning in setup.warnings:
        typer.echo(f"warning: {warning}", err=True)
    return setup


def progress_sink(progress: Progress, name: str, count: int) -> Sink:
    """Return a sink that shows the number of results, and why a frame could not be measured."""
    task = progress.add_task(name, total=count)

    def show(result: FrameResult) -> None:
        progress.advance(task)
        measurement = result.measurement
        if is_failed(measurement.status):
            why = f"{measurement.status}: {measurement.reason}"
            print_above(progress, f"frame {result.frame}: {why}")

    return show


def session_command(name: str, file: Path) -> str:
    """Return the shell command line of a session command, the file name quoted."""
    return f"labapp session {name} {quoted(str(file))}"


def frames_text(frames: Collection[int]) -> str:
    """Return frames as ranges: "frames 0 to 3, 7", or "no frame"."""
    from labapp.export.summary import format_ranges

    if not frames:
        return "no frame"
    return f"frame{'s' * (len(frames) > 1)} {format_ranges(frames, ' to ', RUNS_SHOWN)}"


def finite(value: float | None) -> float | None:
    """Refuse nan and inf as the value of an option."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a number")
    return value


def choose_frames(session: Session, text: str) -> list[int]:
    """Return the frames of a session selected by ``A:B:STEP``, numbers in its recording.

    Raises
    ------
    InputError
        If the text is not of that form, or the session has none of these frames.
    """
    from labapp.run.runner import select_frames

    recording = session.recording
    if recording is None:
        raise InputError(session.path, "recording", "none", "one: labapp session import")
    requested, known = select_frames(text, recording.frames), session.frames.tolist()
    chosen = [frame for frame in known if frame in requested]
    if not chosen:
        raise InputError("--frames", "frames", text, f"some of {frames_text(known)}")
    return chosen


def measure_frames(session: Session, frames: Sequence[int], *, warm: bool = False) -> Summary:
    """Measure frames of a session, with progress and failures on stderr.

    Ctrl-C ends the program; finished frames are stored.
    """
    from labapp.export.summary import Summary

    summary = Summary()
    with progress_bar() as progress:
        sinks = [summary.add, progress_sink(progress, session.path.name, len(frames))]
        try:
            for _ in session.measure_each(frames, warm=warm, sinks=sinks):
                pass
        except KeyboardInterrupt:
            done = f"stopped: {len(summary.frames)} of {len(frames)} frames are done and kept"
            print_above(progress, f"{done}; the others: {session_command('measure', session.path)}")
            raise typer.Exit(INTERRUPTED) from None
        except InputError:
            if len(summary.frames) == len(frames):  # the error is about unreadable frames
                typer.echo(summary.text())
            elif summary.frames:
                done = f"stopped: {len(summary.frames)} of {len(frames)} frames are done and kept"
                print_above(progress, done)
            raise
    return summary


@contextmanager
def report_stale_results(session: Session) -> Iterator[None]:
    """Report which results the block makes stale, and which it makes valid again."""
    before = _stale(session)
    yield
    after = _stale(session)
    if newly_stale := after - before:
        typer.echo(f"Now stale: {_results(newly_stale)}; to measure again:")
        typer.echo(f"  {session_command('measure', session.path)}")
    if valid_again := before - after:
        typer.echo(f"No longer stale: {_results(valid_again)}")


def _stale(session: Session) -> set[tuple[int, str]]:
    """Return (frame, scheme) of every stale result."""
    stale: set[tuple[int, str]] = set()
    for scheme in {scheme for scheme, _ in session.measured_by}:
        seen = session.overview(scheme)
        stale.update((int(frame), scheme) for frame in seen.frame[seen.stale])
    return stale


def _results(results: Collection[tuple[int, str]]) -> str:
    frames = {frame for frame, _ in results}
    return f"{pluralize(len(results), 'result')} ({frames_text(frames)})"


def check_target(
    out: Path, *suffixes: str, inputs: Collection[Path] = (), option: str = "--out"
) -> None:
    """Refuse to overwrite a file without one of these suffixes, or an input, with results.

    Raises
    ------
    InputError
        If there is such a file; devices and pipes are written to. It names ``option``.
    """
    if not out.is_file():
        return
    kinds = " or ".join(suffixes)
    expected = f"a new file, or an earlier result to replace ({kinds})"
    if any(path.exists() and out.samefile(path) for path in inputs):
        raise InputError(out, option, "is an input of the command", expected)
    if not {out.suffix.lower(), Path(os.path.realpath(out)).suffix.lower()} <= set(suffixes):
        raise InputError(out, option, "is there already, and of another kind", expected)


def check_distinct(pictures: Collection[Path]) -> None:
    """Raise `InputError` if a picture is given twice: its dots would count twice in every ±."""
    seen = set[str]()
    for picture in pictures:
        if (place := os.path.realpath(picture)) in seen:
            raise InputError(picture, "pictures", "given twice", "each picture once")
        seen.add(place)


def results_folder(out: Path | None, tables: bool = True) -> Path | None:
    """Return the folder for tables and pictures, created if missing; None if ``out`` is None.

    Raises
    ------
    InputError
        If the folder is not writable, or neither a folder nor printed ``tables`` are requested.
    """
    if out is not None:
        return writable_folder(out)
    if not tables:
        raise InputError("--out", "folder", "none", "one for tables and pictures, or --tables")
    return None


def writable_folder(folder: Path, option: str = "--out") -> Path:
    """Return the folder given by an option, created if missing.

    Raises
    ------
    InputError
        If it is not writable.
    """
    with os_errors_as_input(folder, option, "a folder that can be written"):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    return folder


@contextmanager
def progress_shown(
    stopped: str = "stopped: the tables and pictures that were finished are kept",
) -> Iterator[parallel.Progress]:
    """Show progress on stderr; Ctrl-C prints ``stopped`` and ends the program."""
    with progress_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def show(what: str, done: int, count: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=count)
            bar.update(tasks[what], completed=done, total=count)

        try:
            yield show
        except KeyboardInterrupt:
            print_above(bar, stopped)
            raise typer.Exit(INTERRUPTED) from None
