"""`labapp benchmark`: speed and accuracy of measuring a simulated recording on this machine."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labapp.cli.shared import progress_shown, writable_folder

if TYPE_CHECKING:
    from labapp.simulated.benchmark import Latency, Run, Spread


def benchmark(
    frames: Annotated[
        int, typer.Option(min=40, max=100_000, help="Frames of the simulated video.")
    ] = 2000,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder to store the video in. Default: the user's cache folder."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=0, help="Worker processes; 0: measure in this process. Default: one per core."
        ),
    ] = None,
) -> None:
    """Measure a simulated video of an oscillating pool: speed, wrong labels, ±, frequency.

    The video is simulated once, which takes minutes, and stored: two files, 0.3 MB per frame each.
    """
    import platformdirs

    from labapp.simulated.benchmark import make_video, run_video, time_frames

    folder = cache or Path(platformdirs.user_cache_dir("labapp")) / "benchmark"
    writable_folder(folder, "--cache")
    with progress_shown() as progress:
        video = make_video(folder, frames, workers or None, progress)
    typer.echo(f"{frames} frames of 480 × 640 px, 200 frames/s: {video.path}")
    with tempfile.TemporaryDirectory(dir=folder) as out, progress_shown() as progress:
        done = 0

        def advance() -> None:
            nonlocal done
            done += 1
            progress("frames", done, frames)

        run = run_video(video, Path(out) / "results", workers, advance)
    _print_run(run)
    _print_latency(time_frames(video, min(frames, 400)))


def _print_run(run: Run) -> None:
    whole = run.frames / (run.seconds + run.start_s)
    typer.echo(f"\nfrom file to CSV        {run.frames / run.seconds:.1f} frames/s")
    typer.echo(f"start of processes      {run.start_s:.1f} s more; with it {whole:.1f} frames/s")
    ms = 1e3 * run.processor_s / run.frames
    typer.echo(f"processor time          {ms:.1f} ms a frame, the start of all processes included")
    typer.echo(
        f"measured                {100 * run.measured / run.frames:.2f} % of the frames, "
        f"{run.cold} by the cold chain"
    )
    typer.echo(f"wrong labels            {run.wrong}; {100 * run.labelled:.2f} % of the dots shown")
    typer.echo(f"height: error over σ    {run.normalized_error:.2f} (root mean square)")
    typer.echo(f"height: frequency       {run.frequency_hz:.3f} Hz, true {run.true_hz:.3f} Hz")


def _print_latency(latency: Latency) -> None:
    def line(name: str, spread: Spread) -> str:
        return f"{name:22}{spread.median:8.2f}{spread.worst:8.2f}"

    typer.echo(f"\n{'one frame, one core':22}{'median':>8}{'99 %':>8}  ms")
    typer.echo(line("frame", latency.frame))
    typer.echo(line("  of its processor", latency.processor))
    for name, spread in latency.steps.items():
        typer.echo(line(f"  {name}", spread))
    ratio = 1e3 * latency.cold_s / latency.processor.median
    typer.echo(f"cold chain            {1e3 * latency.cold_s:8.0f}, {ratio:.0f} times as much")
