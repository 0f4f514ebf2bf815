"""`labapp cameras` and `labapp record`: list connected cameras, and record from one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from labapp.cli.shared import NOTHING_MEASURED, finite, print_above, progress_bar
from labapp.errors import InputError
from labapp.text import pluralize

if TYPE_CHECKING:
    from labapp.media.cameras import Camera, CameraFrame, CameraSettings, Range
    from labapp.media.events import Event
    from labapp.media.recording.recorder import Plan
    from labapp.media.recording.take_files import Take
    from labapp.session.session import Session

POLL_S = 0.05


def cameras() -> None:
    """List the connected cameras and their settings."""
    from labapp.media.cameras import CameraError, find_cameras, open_camera

    found, problems = find_cameras()
    if not found:
        problems.append("No camera is connected, or none that can be seen from here.")
    for info in found:
        typer.echo(f"{info.id}  {info.name} ({info.kind})")
        try:
            with open_camera(info.id) as camera:
                typer.echo("\n".join(f"    {line}" for line in _abilities(camera)))
        except CameraError as error:
            typer.echo(f"    {error}")
    typer.echo("simulated:FILE  a scenario or a recording, played as if a camera filmed it")
    for problem in problems:
        typer.echo(problem, err=True)


def _abilities(camera: Camera) -> list[str]:
    """Return lines about a camera's settings: ranges and current values."""
    limits, settings = camera.limits, camera.settings

    def span(name: str, limit: Range | None, value: float | None, unit: str) -> str:
        if limit is None:
            return f"{name:10}cannot be set"
        now = "" if value is None else f", now {value:.6g}"
        return f"{name:10}{limit.lowest:.6g} to {limit.highest:.6g} {unit}{now}"

    width, height = limits.sensor
    region = "whole" if limits.least_region is None else "any region"
    return [
        f"{'picture':10}{width}×{height} px, {camera.bit_depth} bit, {region}",
        span("exposure", limits.exposure_us, settings.exposure_us, "µs"),
        span("gain", limits.gain_db, settings.gain_db, "dB"),
        span("rate", limits.rate_hz, settings.rate_hz, "frames/s"),
        f"{'trigger':10}{', '.join(limits.triggers)}",
    ]


def record(
    camera: Annotated[
        str, typer.Argument(metavar="CAMERA", help="Id of the camera, see labapp cameras.")
    ],
    *,
    out: Annotated[
        Path | None, typer.Option(help="File of the recording (.nut); must not exist yet.")
    ] = None,
    session: Annotated[
        Path | None,
        typer.Option(help="Session to record into; the file is written beside it and imported."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.001, callback=finite, help="Duration (s); without it, until Ctrl-C."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Every n-th frame.")] = 1,
    codec: Annotated[
        Literal["raw", "ffv1"],
        typer.Option(help="Both are lossless; ffv1 is less than half the size, and slower."),
    ] = "raw",
    exposure: Annotated[
        float | None, typer.Option(callback=finite, help="Exposure time (µs).")
    ] = None,
    gain: Annotated[float | None, typer.Option(callback=finite, help="Amplification (dB).")] = None,
    rate: Annotated[float | None, typer.Option(callback=finite, help="Frame rate (Hz).")] = None,
    region: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(metavar="U V WIDTH HEIGHT", help="Part of the sensor to read out (px)."),
    ] = None,
    trigger: Annotated[
        Literal["free", "line"] | None,
        typer.Option(help="Free-running (free, the default), or triggered by the input (line)."),
    ] = None,
) -> None:
    """Record losslessly from a camera: docs/cameras.md.

    Exposure time, gain, frame rate and region are those of the camera where no option sets them.

    Events are reported on stderr, and written beside the recording as FILE-notes.csv.

    Ctrl-C or SIGTERM ends the recording: what was recorded is kept, and the exit code is 0.
    """
    from labapp.media.cameras import CameraSettings
    from labapp.media.recording.recorder import Plan

    if (out is None) == (session is None):
        raise InputError("labapp record", "--out", out, "either --out or --session")
    if out is not None and out.suffix.lower() != ".nut":
        raise InputError("labapp record", "--out", out, "a file that ends in .nut")
    settings = CameraSettings(
        exposure_us=exposure, gain_db=gain, rate_hz=rate, region=region, trigger=trigger
    )
    plan = Plan(every=every, codec=codec)
    with _opened(session) as into:
        taken = _film(camera, _place(out, session), plan, settings, seconds)
        _finish(taken, into)
    if taken.trouble:
        raise InputError(taken.path, "recording", taken.trouble, "a place that can be written")
    if not taken.frames:
        raise typer.Exit(NOTHING_MEASURED)


def _film(
    camera: str,
    place: Callable[[], Path],
    plan: Plan,
    settings: CameraSettings,
    seconds: float | None,
) -> Take:
    """Record for some seconds, or until Ctrl-C or SIGTERM; events are reported on stderr."""
    from labapp.media.cameras import CameraError, Feed
    from labapp.media.events import logged
    from labapp.media.recording.recorder import Recorder
    from labapp.simulated.cameras import camera_opener

    recorders: list[Recorder] = []

    def deliver(frame: CameraFrame) -> None:
        for recorder in recorders:
            recorder.take(frame)

    with progress_bar() as bar:
        task = bar.add_task(camera, total=None)
        log = logged(lambda event: print_above(bar, str(event)))

        def say(event: Event) -> None:
            log(event)
            for recorder in recorders:
                recorder.note(event)

        try:
            opener = camera_opener(
                camera, lambda _, done, of: bar.update(task, completed=done, total=of)
            )
            bar.update(task, completed=0, total=None)
            with (
                Feed(camera, opener, deliver, say, settings) as feed,
                Recorder(place, plan, feed.bit_depth, feed.settings.rate_hz, log) as recorder,
            ):
                take = recorder.trigger()
                recorders.append(recorder)
                until_s = time.monotonic() + (math.inf if seconds is None else seconds)
                try:
                    while feed.state != "ended" and not take.trouble and time.monotonic() < until_s:
                        time.sleep(POLL_S)
                        bar.update(task, completed=take.frames)
                except KeyboardInterrupt:
                    print_above(bar, "stopped: the recording ends here")
                finally:
                    recorders.clear()
            return take
        except CameraError as error:
            expected = "a camera that answers: labapp cameras lists them"
            raise InputError(camera, "camera", error, expected) from error


def _place(out: Path | None, session: Path | None) -> Callable[[], Path]:
    """Return a function that returns the recording's path: ``out``, or one beside the session."""
    from labapp.media.recording.recorder import recording_path

    if session is None:
        return lambda: out or Path()
    return lambda: recording_path(session.parent, "recording")


@contextmanager
def _opened(path: Path | None) -> Iterator[Session | None]:
    """Open the session to record into; raise before recording if it cannot take a recording."""
    from labapp.session.session import Session

    if path is None:
        yield None
        return
    if not path.is_file():
        raise InputError(path, "--session", "does not exist", "one: labapp session new")
    with Session.open(path) as session:
        session.refuse_another_recording()
        yield session


def _finish(take: Take, session: Session | None) -> None:
    """Report what was recorded, and import it into the session, if any."""
    lost = f", {pluralize(take.lost, 'frame')} lost" * (take.lost > 0)
    typer.echo(f"{pluralize(take.frames, 'frame')}{lost} in {take.path.absolute()}")
    if session is not None and take.frames:
        session.import_recording(take.path)
        typer.echo(f"Imported into {session.path}")
