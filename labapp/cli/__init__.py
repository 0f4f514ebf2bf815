"""The command line: `main` and its commands, one module each.

Commands are thin layers over the functions that the app's pages call too.

Modules that take long to load are imported inside the commands, so that `labapp --help` is fast
and Ctrl-C during an import is handled like any other.
"""

from __future__ import annotations

import _thread
import errno
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, NoReturn

import typer
import typer.core
import typer.main

from labapp.cli import cameras, demo, detect, dynamics, lines, reconstruct
from labapp.cli.shared import (
    BAD_INPUT,
    FAULT,
    INTERRUPTED,
    TERMINATED,
    Commands,
    lazy_commands,
)
from labapp.cli.simulation import advise, benchmark, simulate
from labapp.cli.window import asks_for_app, open_app
from labapp.errors import InputError
from labapp.log import log_file, start_log
from labapp.version import VERSION

IMPATIENT_S = 2.0
"""A further interrupt within this time is ignored, as the first is still being handled, s."""

OF_THE_USER = {
    errno.ENOSPC: "some space where it goes",
    errno.EFBIG: "files as large as the results to be allowed",
    errno.EROFS: "a place that can be written",
    errno.ENAMETOOLONG: "a shorter name",
    errno.ELOOP: "links that end at a file or folder",
}
"""System errors that are no fault of labapp, wherever they are raised, and what would be right."""

GROUPS = {
    "calibrate": ("labapp.cli.calibrate", "Calibrate laser or imaging plane, or check both."),
    "analyze": (
        "labapp.cli.simulation.analyze",
        "Reproduce tables and figures of chapters 4, 6 and 8; the error budget of a set-up.",
    ),
    "session": (
        "labapp.cli.session",
        "Keep an experiment in one file: set-up, recording, corrections, results.",
    ),
    "study": (
        "labapp.cli.study",
        "Measure many recordings with the same settings, on all cores or a cluster, and compare "
        "them.",
    ),
    "penetration": (
        "labapp.cli.penetration",
        "Predict penetration from the pool's surface by models fitted to sections.",
    ),
}
"""Modules whose ``app`` has the commands of a group, and what these do."""

app = typer.Typer(
    name="labapp",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # would double the import time
    cls=Commands,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 1000,  # use the terminal's width
    },
    help="Measure the 3-D surface of a molten weld pool from a reflected laser dot matrix. "
    "Alone, labapp opens the app; labapp FILE opens a session or a recording in it. "
    "Lengths are in mm, angles in degrees, places in an image in px (u right, v down, the "
    "centre of the first pixel is 0, 0), times in s.",
    epilog="Exit codes: 0 done; 1 done, but nothing could be measured, or a session is not whole; "
    "2 bad input or output; 3 a fault in labapp; 130 stopped by Ctrl-C; 143 by SIGTERM.",
)
for name, (module, about) in GROUPS.items():
    app.add_typer(
        typer.Typer(), name=name, cls=lazy_commands(module), help=about, no_args_is_help=True
    )
app.command()(simulate.simulate)
app.command()(advise.advise)
app.command()(cameras.cameras)
app.command()(cameras.record)
app.command()(benchmark.benchmark)
app.command()(reconstruct.reconstruct)
app.command()(detect.detect)
app.command()(lines.lines)
app.command()(dynamics.dynamics)
app.command()(demo.samples)
app.command()(demo.demo)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit; bad input is reported without a traceback."""
    log = start_log()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without "±" is no reason to stop
    with _stoppable() as stops:
        try:
            given = sys.argv[1:] if arguments is None else arguments
            if asks_for_app(given, _commands):
                sys.exit(open_app(given))
            app(args=arguments)
        except InputError as error:
            log.error("bad input", exc_info=True)
            typer.echo(f"labapp: {error}", err=True)
            sys.exit(BAD_INPUT)
        except KeyboardInterrupt:
            sys.exit(INTERRUPTED)
        except Exception as error:
            log.exception("fault")
            if stops:
                # An interrupt during the import of a compiled module raises ImportError.
                sys.exit(INTERRUPTED)
            if isinstance(error, OSError) and error.errno in OF_THE_USER:
                typer.echo(f"labapp: {_about(error)}", err=True)
                sys.exit(BAD_INPUT)
            typer.echo(
                f"labapp: a fault in the program: {type(error).__name__}: {error}\n"
                f"Details are in {log_file()}",
                err=True,
            )
            sys.exit(FAULT)
    sys.exit(0)


def _about(error: OSError) -> InputError:
    """Return a system error as bad input or output."""
    where = "output" if error.filename is None else str(error.filename)
    return InputError(where, "file", error.strerror, OF_THE_USER[error.errno or 0])


def _commands() -> frozenset[str]:
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    return frozenset(group.commands)


@contextmanager
def _stoppable() -> Iterator[list[tuple[float, int]]]:
    """Raise KeyboardInterrupt on Ctrl-C or SIGTERM, but not again while the first is handled.

    Yields the list of received signals, (time in s, signal number). After SIGTERM the program
    reports it and exits with a separate code, as there is no ^C on the terminal.
    """
    stops: list[tuple[float, int]] = []

    def interrupt(number: int, _: object) -> None:
        now = time.monotonic()
        if not stops or now - stops[-1][0] > IMPATIENT_S:
            stops.append((now, number))
            raise KeyboardInterrupt

    usual_hook = sys.unraisablehook

    def interrupt_again(lost: sys.UnraisableHookArgs) -> None:
        """Send a signal again whose exception was lost in a callback, as of the compiler."""
        if not (stops and issubclass(lost.exc_type, KeyboardInterrupt)):
            usual_hook(lost)
            return
        again = threading.Timer(0.1, _thread.interrupt_main, [stops.pop()[1]])
        again.daemon = True
        again.start()

    handled = {  # not a signal that is ignored, such as Ctrl-C in a background job
        number: usual
        for number, usual in (
            (signal.SIGINT, signal.default_int_handler),
            (signal.SIGTERM, signal.SIG_DFL),
        )
        if signal.getsignal(number) is usual
    }
    for number in handled:
        signal.signal(number, interrupt)
    sys.unraisablehook = interrupt_again
    try:
        yield stops
    except SystemExit as ended:
        if ended.code != INTERRUPTED or not stops or stops[-1][1] != signal.SIGTERM:
            raise
        typer.echo("labapp: stopped by SIGTERM", err=True)
        sys.exit(TERMINATED)
    finally:
        sys.unraisablehook = usual_hook
        received = {number for _, number in stops}
        for number, usual in handled.items():
            signal.signal(number, signal.SIG_IGN if number in received else usual)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"labapp {VERSION}")
        raise typer.Exit


@app.callback()
def program(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Define the options of the program itself."""
