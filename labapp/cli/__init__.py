"""The command line: `main`, and the commands that have no module of their own here.

Commands are thin, over the calls that the pages make too.

What measures is imported inside the commands: `labapp --help` answers at once, and Ctrl-C while
it loads is handled like any other.
"""

from __future__ import annotations

import errno
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
import typer.core
import typer.main

from labapp.cli import (
    advise,
    analyze,
    bench,
    benchmark,
    cameras,
    dynamics,
    fold,
    lines,
    pattern,
    penetration,
    reconstruct,
    session,
    simulate,
    study,
)
from labapp.cli.shared import (
    BAD_INPUT,
    DETECTOR_HELP,
    FAULT,
    FRAMES_HELP,
    FRAMES_METAVAR,
    INTERRUPTED,
    NOTHING_MEASURED,
    ROWS_HELP,
    TERMINATED,
    Commands,
    DetectorName,
    RowsName,
    choose_frames,
    measure_frames,
    warned,
)
from labapp.cli.window import asks_for_app, open_app, show_in_app
from labapp.errors import InputError
from labapp.log import log_file, start_log
from labapp.version import VERSION

if TYPE_CHECKING:
    from labapp.core.calibration.imaging_plane import Calibration
    from labapp.core.calibration.plane_calibration import PlaneCalibration

IMPATIENT_S = 2.0
"""A second request to stop within this time is ignored: the first is being carried out."""

app = typer.Typer(
    name="labapp",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # which takes as long to load as all else
    cls=Commands,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 1000,  # the terminal's
    },
    help="Measure the 3-D surface of a molten weld pool from a reflected laser dot matrix. "
    "Alone, labapp opens the app; labapp FILE opens a session or a recording in it. "
    "Lengths are in mm, angles in degrees, places in an image in px (u right, v down, the "
    "centre of the first pixel is 0, 0), times in s.",
    epilog="Exit codes: 0 done; 1 done, but nothing could be measured, or a session is not whole; "
    "2 bad input or output; 3 a fault in labapp; 130 stopped by Ctrl-C; 143 by SIGTERM.",
)
calibrate = typer.Typer(
    no_args_is_help=True, cls=Commands, help="Calibrate laser or imaging plane, or check both."
)
app.add_typer(calibrate, name="calibrate")
calibrate.command("bench")(bench.calibrate_bench)
calibrate.command("pattern")(pattern.calibrate_pattern)
calibrate.command("fold")(fold.calibrate_fold)
app.add_typer(analyze.app, name="analyze")
app.add_typer(session.app, name="session")
app.add_typer(study.app, name="study")
app.add_typer(penetration.app, name="penetration")
app.command()(simulate.simulate)
app.command()(advise.advise)
app.command()(cameras.cameras)
app.command()(cameras.record)
app.command()(benchmark.benchmark)

SetupToChange = Annotated[
    Path | None,
    typer.Option("--setup", help="Setup file (TOML) to write the values into; made if missing."),
]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit: bad input in a line or two, never a traceback."""
    log = start_log()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without "±" is no reason to stop
    with _stoppable() as stops:
        try:
            given = sys.argv[1:] if arguments is None else arguments
            if asks_for_app(given, _commands()):
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
                # Compiled modules that are being loaded turn the interrupt into an ImportError.
                sys.exit(INTERRUPTED)
            if isinstance(error, OSError) and error.errno == errno.ENOSPC:
                typer.echo("labapp: output: no space left where it goes; make some", err=True)
                sys.exit(BAD_INPUT)
            typer.echo(
                f"labapp: a fault in the program: {type(error).__name__}: {error}\n"
                f"Details are in {log_file()}",
                err=True,
            )
            sys.exit(FAULT)
    sys.exit(0)


def _commands() -> frozenset[str]:
    """Names of the commands."""
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    return frozenset(group.commands)


@contextmanager
def _stoppable() -> Iterator[list[tuple[float, int]]]:
    """Interrupt at Ctrl-C or SIGTERM, but not what the first one set going.

    Yields when which of them came, (s, number of the signal). A program that SIGTERM interrupted
    says so and has a code of its own: who sent it sees neither a terminal nor a ^C.
    """
    stops: list[tuple[float, int]] = []

    def interrupt(number: int, _: object) -> None:
        now = time.monotonic()
        if not stops or now - stops[-1][0] > IMPATIENT_S:
            stops.append((now, number))
            raise KeyboardInterrupt

    heeded = {  # a job in the background ignores Ctrl-C
        number: usual
        for number, usual in (
            (signal.SIGINT, signal.default_int_handler),
            (signal.SIGTERM, signal.SIG_DFL),
        )
        if signal.getsignal(number) is usual
    }
    for number in heeded:
        signal.signal(number, interrupt)
    try:
        yield stops
    except SystemExit as ended:
        if ended.code != INTERRUPTED or not stops or stops[-1][1] != signal.SIGTERM:
            raise
        typer.echo("labapp: stopped by SIGTERM", err=True)
        sys.exit(TERMINATED)
    finally:
        came = {number for _, number in stops}
        for number, usual in heeded.items():
            signal.signal(number, signal.SIG_IGN if number in came else usual)


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
    """Hold the options of the program itself."""


app.command()(reconstruct.reconstruct)
app.command()(lines.lines)
app.command()(dynamics.dynamics)


@app.command()
def detect(
    image: Annotated[
        Path, typer.Argument(help="An image; of a video or a folder, the first frame is taken.")
    ],
    out: Annotated[
        Path, typer.Option(help="CSV file for the dots: px, reflected row and column, SNR.")
    ],
    size: Annotated[
        float | None,
        typer.Option(
            min=0.5,
            max=20.0,
            metavar="PX",
            help="Standard deviation of a dot's light (px), about a quarter of what is seen "
            "across; without it, it is estimated from the image. Of band-pass alone.",
        ),
    ] = None,
    detector: Annotated[DetectorName, typer.Option(help=DETECTOR_HELP)] = "band-pass",
    rows: Annotated[RowsName, typer.Option(help=ROWS_HELP)] = "grow",
) -> None:
    """Find the dots of one image and their rows and columns, without a setup.

    Rows are counted from the bottom up, columns from left to right.

    A dot in doubt has none: its cells are empty. Exit code 1: no dot has any.
    """
    from labapp.core.images.dots import BandPassSettings
    from labapp.core.images.find_dots import DotSettings
    from labapp.core.rows.find_lattice import LatticeSettings
    from labapp.run.detect import detect_dots, write_detected

    if size is not None and detector != "band-pass":
        raise InputError("--size", "size", size, "--detector band-pass, which alone has it")
    how = DotSettings(detector, BandPassSettings(size_px=size)), LatticeSettings(rows)
    dots, lattice, doubt = detect_dots(image, *how)
    if out.exists() and out.samefile(image):
        raise InputError(out, "--out", "the image itself", "another file, for the dots (CSV)")
    write_detected(out, dots, lattice)
    if doubt:
        typer.echo(f"{image}: {doubt}", err=True)
    placed = 0 if lattice is None else int((lattice.row > 0).sum())
    message = placed or "none"
    typer.echo(f"{len(dots)} dots, {message} with a row and a column, in {out.absolute()}")
    if not placed:
        raise typer.Exit(NOTHING_MEASURED)


@calibrate.command("laser")
def calibrate_laser(
    l1: Annotated[
        list[float],
        typer.Option(help="Half length of the cross on the laser's side (mm); repeat for more."),
    ],
    l2: Annotated[
        list[float], typer.Option(help="Half length on the far side (mm); repeat for more.")
    ],
    l3: Annotated[list[float], typer.Option(help="Half length across (mm); repeat for more.")],
    fan_angle: Annotated[
        float, typer.Option(help="Fan angle of the cross-hair lens (degrees).")
    ] = 10.0,
    fan_angle_sigma: Annotated[
        float,
        typer.Option(min=0, max=10, help="Its standard uncertainty (degrees); 0.1 is assumed."),
    ] = 0.1,
    resolution: Annotated[
        float, typer.Option(min=0, max=10, help="Smallest step of the callipers (mm).")
    ] = 0.05,
    setup: SetupToChange = None,
) -> None:
    """Find the laser's angle, distance and height from its cross-hair (Appendix I).

    Read every length three times or more: ± comes from their scatter, with Student's factor for
    few readings. A --setup gets values, standard uncertainties and their correlation.
    """
    from labapp.core.calibration import laser_calibration as core

    settings = core.LaserCalibrationSettings(
        resolution_mm=resolution, fan_angle_sigma_deg=fan_angle_sigma
    )
    try:
        found = core.calibrate_laser(l1, l2, l3, fan_angle, settings)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    typer.echo(f"projection angle {found.angle_deg:.3f} ± {found.angle_sigma_deg:.3f} degrees")
    typer.echo(f"distance         {found.distance_mm:.3f} ± {found.distance_sigma_mm:.3f} mm")
    typer.echo(f"height           {found.height_mm:.3f} ± {found.height_sigma_mm:.3f} mm")
    typer.echo(f"correlation      {found.correlation:+.2f} of angle and distance")
    for warning in found.warnings:
        typer.echo(f"warning: {warning}", err=True)
    _write_values(setup, {"laser": found.setup_keys})


@calibrate.command("plane")
def calibrate_plane(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Picture of the target or a board in the imaging plane; of a board, more pictures "
            "of it held anyhow may follow."
        ),
    ],
    unit_mm: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=1000,
            help="Length of a unit of the target's axes, from one flag of a bar to the next (mm): "
            "measure it on the target. labapp's printed target and its sample run have 6.35.",
        ),
    ] = 6.35,
    board: Annotated[
        str | None,
        typer.Option(
            help="The board: a name (charuco_4_inch, …) or KIND:COLUMNSxROWS:SQUARE_MM. Default: "
            "what is printed by labapp is recognised."
        ),
    ] = None,
    square_mm: Annotated[
        float | None,
        typer.Option(
            min=0.1, max=1000, help="Edge of the board's squares as measured on the print (mm)."
        ),
    ] = None,
    setup: SetupToChange = None,
) -> None:
    """Find the imaging plane, and with a board the lens, in a picture of the target (§5.1)."""
    from labapp.core.calibration.plane_calibration import PlaneCalibration

    found = _calibrated(images, unit_mm, board, setup)
    if isinstance(found, PlaneCalibration):
        _show_target(found, unit_mm)
    elif square_mm is not None:
        found = found.with_square(square_mm)
    (x_scale, z_scale), angle = found.px_per_mm, found.angle_deg
    x_sigma, z_sigma, angle_sigma = found.scales_and_angle_sigma
    typer.echo(
        f"scale      {x_scale:.4f} ± {x_sigma:.4f} px/mm along X′, "
        f"{z_scale:.4f} ± {z_sigma:.4f} px/mm along Z′, "
        f"{angle:.2f} ± {angle_sigma:.2f} degrees between them"
    )
    for line in found.fit_lines():
        typer.echo(line)
    _write_values(setup, found.setup_keys)


def _calibrated(
    images: Sequence[Path], unit_mm: float, board: str | None, setup: Path | None
) -> Calibration:
    """Calibrate by pictures; with the lens that the setup has, where they show the target."""
    from labapp.config.setup import lens_of
    from labapp.core.calibration.boards import A_BOARD, parse_board
    from labapp.core.calibration.imaging_plane import calibrate_imaging_plane
    from labapp.core.calibration.plane_calibration import PlaneCalibrationSettings
    from labapp.core.values import CannotMeasure
    from labapp.media import read_picture

    pictures = [read_picture(path) for path in images]
    try:
        named = None if board is None else parse_board(board)
    except ValueError as error:
        raise InputError("--board", "board", f"{board} ({error})", A_BOARD) from error
    lens = lens_of(setup.read_text("utf-8")) if setup is not None and setup.is_file() else None
    settings = PlaneCalibrationSettings(unit_mm=unit_mm)
    try:
        return calibrate_imaging_plane(pictures, settings, named, lens)
    except CannotMeasure as answer:
        if answer.status != "no-target":
            shown = "a picture in which the board is seen, flat and sharp"
            raise InputError(images[0], "board", answer.reason, shown) from answer
        typer.echo(f"{images[0]}: {answer}", err=True)
        raise typer.Exit(NOTHING_MEASURED) from answer


def _show_target(found: PlaneCalibration, unit_mm: float) -> None:
    """Print where the target's three points are, as they go into a set-up."""
    points = dict(zip(("origin_px", "x_axis_px", "z_axis_px"), found.points_px, strict=True))
    lengths = {"x_axis_mm": found.x_axis_mm, "z_axis_mm": found.z_axis_mm}
    for (name, (u, v)), sigma in zip(points.items(), found.points_sigma_px, strict=True):
        typer.echo(f"{name}  {u:.3f}, {v:.3f} ± {sigma:.3f} px")
    for name, length in lengths.items():
        typer.echo(f"{name}  {length:.4f} mm")
    typer.echo(f"unit       {unit_mm:g} mm between flags (--unit-mm)")


def _write_values(setup: Path | None, values: Mapping[str, Mapping[str, object]]) -> None:
    """Write calibrated values into a setup file and say what the file still lacks."""
    from labapp.config.setup import read_setup, update_setup

    if setup is None:
        return
    update_setup(setup, values)
    typer.echo(f"Written to [{'], ['.join(values)}] of {setup.absolute()}")
    try:
        warned(read_setup(setup))
    except InputError as lacking:
        typer.echo(f"It is not complete yet:\n{lacking}", err=True)


@app.command()
def samples(
    folder: Annotated[Path, typer.Argument(help="Where to copy them; made if it is missing.")],
) -> None:
    """Copy the sample runs, the scenarios to simulate and the targets to print into a folder.

    The examples of the documents can be typed as they are in that folder. Nothing is replaced.
    """
    import shutil

    from labapp.bundled import bundled

    for name in ("sample_sessions", "resources"):
        if (folder / name).exists():
            raise InputError(folder, "folder", f"it has {name}", "a folder without it")
    for name in ("sample_sessions", "resources"):
        shutil.copytree(bundled(name), folder / name, ignore=shutil.ignore_patterns(".*"))
    typer.echo(f"sample_sessions and resources are in {folder}")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo_results"),
    frames: Annotated[str, typer.Option(metavar=FRAMES_METAVAR, help=FRAMES_HELP)] = ":",
    window: Annotated[
        bool, typer.Option(help="Open the session in the app, where there is a display.")
    ] = True,
) -> None:
    """Measure the sample run in a session of yours, export its results and draw pictures."""
    from labapp.export.folder import ExportChoice
    from labapp.simulated.demo import draw_surface, open_demo

    out = out.absolute()
    with open_demo(out) as session:
        summary = measure_frames(session, choose_frames(session, frames))
        typer.echo(summary.text())
        pictures = frozenset({"frames", "trends"})
        session.export(out / "results", ExportChoice(hdf5=True, pictures=pictures), report=True)
        typer.echo(f"The session is {session.path}")
    typer.echo(f"Results are in {out / 'results'}: tables, surfaces, pictures, report.pdf")
    if summary.example is None:
        raise typer.Exit(NOTHING_MEASURED)
    surface = summary.example.measurement.reconstruction
    assert surface is not None
    picture = out / f"surface_{summary.example.frame:06d}.png"
    problem = draw_surface(surface, picture)
    typer.echo(f"No picture in 3-D: {problem}" if problem else f"In 3-D: {picture}")
    if window:
        show_in_app(session.path)
