"""`labapp study …`: measure and compare many recordings, by the functions of `run.study`."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labapp.cli.shared import (
    INTERRUPTED,
    NOTHING_MEASURED,
    command_group,
    print_above,
    progress_bar,
)
from labapp.system import quoted
from labapp.text import pluralize, with_sigma

if TYPE_CHECKING:
    from labapp.run.study.status import StudyProgress
    from labapp.run.study.study import Study

app = command_group()

File = Annotated[Path, typer.Argument(metavar="STUDY", help="The study file (TOML or CSV).")]
Out = Annotated[
    Path | None,
    typer.Option(help="Folder for the results. Default: STUDY_results beside the study file."),
]

SHOWN = 20
"""Most groups that are printed one by one."""


@app.command()
def new(
    study: Annotated[
        Path, typer.Argument(metavar="STUDY", help="The study file to write, .toml or .csv.")
    ],
    recordings: Annotated[
        list[str],
        typer.Argument(
            help="Recordings, or a quoted pattern, with {name} for a condition and * for other "
            'parts that vary: "runs/I{current_a}_*.avi".'
        ),
    ],
    setup: Annotated[Path, typer.Option(help="Setup file of all recordings (TOML).")],
) -> None:
    """Write a study file that lists recordings; conditions can be added by hand."""
    from labapp.run.study.plan import write_study

    plan = write_study(study, recordings, setup)
    names = f", conditions {', '.join(plan.conditions)}" if plan.conditions else ""
    typer.echo(f"{pluralize(len(plan.recordings), 'recording')}{names}, in {study.absolute()}")
    typer.echo(f"  labapp study run {quoted(str(study))}")


@app.command()
def run(
    study: File,
    out: Out = None,
    workers: Annotated[
        int | None,
        typer.Option(min=0, max=1024, help="Number of processes. Default: one per core."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Use this Dask scheduler: tcp://HOST:8786."),
    ] = None,
    surfaces: Annotated[
        bool, typer.Option("--surfaces", help="Also store surfaces, and write surfaces.zarr.")
    ] = False,
) -> None:
    """Measure the frames that are not measured yet, and write tables and a summary.

    An interrupted study can be continued by running it again. A recording that cannot be measured
    does not stop the others. Exit code 1: not everything is measured.
    """
    from labapp.run.study.status import count_states
    from labapp.run.study.study import Study, require_extra

    opened = Study(study, out)
    require_extra()
    noted = set[str]()
    with progress_bar() as bar:
        task = bar.add_task(study.stem, total=None)

        def show(now: StudyProgress) -> None:
            words = f"{study.stem}: {now.recordings_done} of {now.recordings} recordings, frames"
            bar.update(task, description=words, completed=now.frames_done, total=now.frames or None)

        def noting(text: str) -> None:
            noted.add(text)
            print_above(bar, text)

        try:
            opened.run(workers, scheduler, surfaces=surfaces, progress=show, note=noting)
        except KeyboardInterrupt:
            counts = count_states(opened.status(surfaces=surfaces))
            print_above(bar, f"stopped: {counts}; what was measured is kept: run it again")
            raise typer.Exit(INTERRUPTED) from None
    _finish(opened, surfaces, noted)


@app.command()
def status(study: File, out: Out = None) -> None:
    """List what is measured of each recording, and why others are not.

    Exit code 1: not everything is measured.
    """
    from labapp.run.study.status import count_states
    from labapp.run.study.study import Study

    opened = Study(study, out)
    found = opened.status()
    for one in found:
        frames = f"{one.frames_done} of {one.frames} frames" if one.frames else ""
        typer.echo("  ".join(filter(None, (f"{one.state:8}{one.recording.name}", frames))))
        if one.problem:
            typer.echo(f"        {one.problem}")
    typer.echo(count_states(found))
    if any(one.state != "done" for one in found):
        raise typer.Exit(NOTHING_MEASURED)


@app.command()
def results(
    study: File,
    out: Out = None,
    surfaces: Annotated[
        bool,
        typer.Option("--surfaces", help="Also write surfaces.zarr, after a run with --surfaces."),
    ] = False,
) -> None:
    """Write tables and a summary of the frames measured so far, with the current conditions.

    Exit code 1: not everything is measured.
    """
    from labapp.run.study.study import Study

    _finish(Study(study, out), surfaces)


def _finish(study: Study, surfaces: bool, noted: Collection[str] = ()) -> None:
    """Write the results, print the means, and exit with 1 unless all is measured.

    Problems that were ``noted`` already are not printed again.
    """
    summary = study.results(surfaces=surfaces)
    from labapp.run.study.plan import named_condition
    from labapp.run.study.status import count_states

    states = [one.status for one in summary.recordings]
    for one in states:
        problem = f"{one.recording.name}: {one.problem}"
        if one.state != "done" and one.problem and problem not in noted:
            typer.echo(problem, err=True)
    for group in summary.groups[:SHOWN]:
        at = ", ".join(named_condition(name, v) for name, v in group.conditions.items())
        means = (
            f"{size} {with_sigma(mean.mean, mean.sigma)} mm"
            for size in ("width", "length", "height")
            for mean in [group.means[f"{size}_mm"]]
        )
        count = pluralize(len(group.recordings), "recording")
        typer.echo(f"{at or 'all'} ({count}): {', '.join(means)}")
    if len(summary.groups) > SHOWN:
        typer.echo(f"… and {len(summary.groups) - SHOWN} more, in summary.csv")
    if summary.outliers:
        typer.echo(f"{pluralize(len(summary.outliers), 'outlier')}: outliers.csv")
    typer.echo(count_states(states))
    typer.echo(f"Results are in {study.folder}: summary.html, measures.parquet")
    if any(one.state != "done" for one in states):
        raise typer.Exit(NOTHING_MEASURED)
