"""`labapp dynamics`: oscillations, modes, events and step responses over a recording."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labapp.cli.shared import finite, progress_shown, writable_folder
from labapp.errors import InputError, os_errors_as_input
from labapp.export.owned_files import check_owned, write_owned

if TYPE_CHECKING:
    from labapp.core.dynamics.analysis import Dynamics, DynamicsSettings
    from labapp.session.signals import Signals

LARGEST_HZ = 1e9

Segment = Annotated[
    float | None,
    typer.Option(
        min=1e-6,
        help="Duration of a segment of the spectrogram (s). Default: an eighth of the series.",
    ),
]

Start = Annotated[
    float | None,
    typer.Option(
        callback=finite,
        help="Time of the signals' start in the recording (s). Default: 0, or the session's.",
    ),
]


def dynamics(
    source: Annotated[
        Path, typer.Argument(help="A session, or a folder that `labapp reconstruct` wrote.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for tables and pictures. Earlier ones are replaced if unchanged."
        ),
    ],
    *,
    of: Annotated[
        str,
        typer.Option(
            metavar="SERIES", help="Series for the spectra: width_mm, height_mm, convexity_mm …"
        ),
    ] = "height_mm",
    band: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH",
            help="Frequencies to look at (Hz). Default: from two periods in the recording to half "
            "the frame rate.",
        ),
    ] = None,
    segment: Segment = None,
    signals: Annotated[
        Path | None,
        typer.Option(help="Current, voltage, wire feed: CSV, TDMS or WAV; else the session's."),
    ] = None,
    full_scale: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="A V M/MIN", help="Full scale of a WAV's channels."),
    ] = (1.0, 1.0, 1.0),
    start: Start = None,
    align: Annotated[
        Path | None,
        typer.Option(
            metavar="RECORDING", help="Estimate --start from the brightness of these frames."
        ),
    ] = None,
    film: Annotated[
        str | None, typer.Option(metavar="MODE", help='Write a film of a mode: "(0,1)", "POD1" …')
    ] = None,
) -> None:
    """Determine oscillations, modes, events and step responses from measured frames.

    Writes series.csv, modes.csv, spectrum.csv, spectrogram.csv, peak.csv, events.csv and
    responses.csv, with standard uncertainties; dynamics.png, modes.png; with --film, mode.mp4.
    """
    from labapp.core.dynamics.analysis import DynamicsSettings
    from labapp.export.dynamics import dynamics_files
    from labapp.session.signals import read_signals

    folder = writable_folder(out)
    check_owned(folder, "dynamics")
    settings = DynamicsSettings(of, _band(band), segment)
    given = read_signals(signals, full_scale) if signals else None
    with progress_shown():
        found = _analysed(source, given, start, align, settings)
    with os_errors_as_input(folder, "results", "enough disk space"):
        write_owned(folder, "dynamics", dynamics_files(found, film))
    _print(found)
    typer.echo(f"Results are in {folder.absolute()}")


def _analysed(
    source: Path,
    given: Signals | None,
    start: float | None,
    align: Path | None,
    settings: DynamicsSettings,
) -> Dynamics:
    """Analyse a session or a results folder, with the given signals or the session's."""
    from labapp.export.dynamics import dynamics_of, measured_of
    from labapp.export.result_folder import measured_in
    from labapp.session.session import Session

    with ExitStack() as at_end:
        if source.is_dir():
            signals, measured = given, measured_in(source)
        else:
            session = at_end.enter_context(Session.open(source, read_only=True))
            signals = given or session.signals
            measured = measured_of(session.frame_results(stale=False))
        if start is not None or align is not None:
            signals = _aligned(signals, start, align)
        return dynamics_of(measured, signals.timed() if signals else {}, settings)


def _band(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = 0.0
    if not 0 < low < high <= LARGEST_HZ:
        right = f"LOW:HIGH, two frequencies above 0, up to {LARGEST_HZ:g} (Hz)"
        raise InputError("--band", "band", text, right)
    return low, high


def _aligned(signals: Signals | None, start: float | None, align: Path | None) -> Signals:
    """Return the signals with the given start, or one estimated from a recording's brightness."""
    from dataclasses import replace

    from labapp.media import open_source
    from labapp.session.signals import align_signals

    if signals is None:
        raise InputError("--signals", "file", "none", "one, or a session that has signals")
    if align is None:
        assert start is not None
        return replace(signals, start_s=start)
    with open_source(align) as recording:
        frames = (recording.frame(number) for number in range(len(recording)))
        aligned, offset = align_signals(signals, frames)
    start_text = f"{offset.start_s:.4f} ± {offset.sigma_s:.4f} s"
    typer.echo(f"signals start at {start_text}, correlation {offset.correlation:.2f}")
    if offset.rival_s is not None:
        typer.echo(f"warning: {offset.rival_s:.4f} s fits about as well: give --start", err=True)
    return aligned


def _print(found: Dynamics) -> None:
    """Print frequencies, events and responses."""
    for one in found.modes:
        if figures := one.figures:
            hertz, mm, rate = (
                figures[n] for n in ("frequency_hz", "amplitude_mm", "damping_per_s")
            )
            typer.echo(
                f"mode {one.name}: {hertz[0]:.3f} ± {hertz[1]:.3f} Hz, {1e3 * mm[0]:.2f} ± "
                f"{1e3 * mm[1]:.2f} µm, damping {rate[0]:.2f} ± {rate[1]:.2f} /s, {one.share:.0%}"
            )
    for name, events in found.events.items():
        for event in events:
            typer.echo(f"{name} changes at {event.time_s:.4f} ± {event.sigma_s:.4f} s")
    for step in found.responses:
        value, sigma = step.response.value, step.response.sigma
        values = ", ".join(f"{n} {value[n]:.4g} ± {sigma[n]:.2g}" for n in value)
        typer.echo(f"{step.series} after {step.signal} at {step.step.time_s:.4f} s: {values}")
