"""`labapp simulate`: a recording of a known pool, with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labapp.bundled import bundled
from labapp.cli.shared import progress_shown
from labapp.system import quoted
from labapp.text import pluralize

SHIPPED = sorted(path.stem for path in bundled("resources/simulations").glob("*.toml"))


def simulate(
    scenario: Annotated[
        Path,
        typer.Argument(
            help="Pool, bench and camera (TOML; mm, degrees, px): docs/simulation.md. Or the name "
            f"of a scenario distributed with labapp: {', '.join(SHIPPED)}."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(help="Folder for the recording and its truth. An earlier one is replaced."),
    ],
    frames: Annotated[
        int | None,
        typer.Option(min=1, max=1_000_000, help="Number of frames, overrides the file's."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Random seed, overrides the file's.")
    ] = None,
) -> None:
    """Simulate a recording of a known pool, with ground truth for every dot.

    It can be measured like any other: labapp reconstruct DIR/recording.avi --setup DIR/setup.toml.

    An incomplete folder is never left. The same file and seed give the same frames.
    """
    from labapp.config.scenario import find_scenario, read_scenario
    from labapp.simulated.simulate import simulate as write

    read = read_scenario(find_scenario(scenario), frames, seed)
    count = len(read.recording.pools)
    with progress_shown(f"stopped: nothing is written in {out}") as progress:
        write(read, out, progress=progress)
    name = read.recording.file
    typer.echo(f"{pluralize(count, 'frame')}, setup, calibration picture and truth are in {out}")
    recording, setup = (quoted(str(out / file)) for file in (name, "setup.toml"))
    typer.echo(f"  labapp reconstruct {recording} --setup {setup} --out results")
