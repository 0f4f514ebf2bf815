"""`labapp reconstruct`: measure a recording and write the results as tables and surfaces.

Data flow: `media.open_source` reads a frame. A measurer (`run.measurers`) measures it: cold by
`core.pipeline.measure`, or tracked by `core.recording.chain`, which calls the same function with a
prior. Neighbouring frames vote on its rows (`core.recording.row_vote`), and its residuals are added
to the check of the set-up (`core.recording.residual_check`). `run.runner.run` passes its
`FrameResult` to the sinks: the results folder (`export.results`), the summary, streams, progress.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from labapp.cli.shared import (
    ABOUT_SCHEMES,
    ALGORITHM_HELP,
    INTERRUPTED,
    NOTHING_MEASURED,
    Algorithm,
    Detector,
    FrameRange,
    Recording,
    Rows,
    SchemeName,
    SigmaParts,
    Warm,
    print_above,
    progress_bar,
    progress_sink,
    show_warnings,
)
from labapp.files import as_bytes, write_file

if TYPE_CHECKING:
    from labapp.core.pipeline import Settings
    from labapp.export.penetration import Predictor
    from labapp.export.summary import Summary
    from labapp.run.runner import Measurer, Sink
    from labapp.run.streams import Stream


ModelFile = Annotated[
    Path | None,
    typer.Option(help="Penetration model; its predictions go to penetration.csv and streams."),
]

Anywhere = Annotated[
    bool, typer.Option("--anywhere", help="Let other machines connect, unauthenticated.")
]


def reconstruct(
    source: Recording,
    setup: Annotated[Path, typer.Option(help="Setup file (TOML; mm, degrees, px).")],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the results (CSV, STL; mm). An earlier run in it is replaced."
        ),
    ],
    scheme: Annotated[
        SchemeName, typer.Option(help=f"How the surface is found: {ABOUT_SCHEMES}.")
    ] = "fit",
    algorithm: Annotated[
        Algorithm,
        typer.Option(help=ALGORITHM_HELP[0].upper() + ALGORITHM_HELP[1:]),
    ] = "opa",
    correspondence: Annotated[
        Literal["auto", "S/S", "S/I", "I/I"],
        typer.Option(help="Order of dots relative to rays, columns/rows: same S, inverse I."),
    ] = "auto",
    *,
    detector: Detector = "band-pass",
    rows: Rows = "grow",
    frames: FrameRange = ":",
    surfaces: Annotated[
        Literal["all", "none"], typer.Option(help="Write the surface of every frame, or of none.")
    ] = "all",
    sigma_parts: SigmaParts = False,
    warm: Warm = False,
    model: ModelFile = None,
    lines: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Send measures as lines of JSON over TCP."),
    ] = None,
    opcua: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Publish measures as variables of OPC UA."),
    ] = None,
    anywhere: Anywhere = False,
) -> None:
    """Measure frames and write measures, dots, points, boundaries and surfaces.

    Ctrl-C or SIGTERM stops after a complete frame; the results of finished frames are readable.

    A frame that cannot be measured has a row in measures.csv with its status.
    """
    from labapp.config.settings import check_algorithm, with_methods
    from labapp.core.pipeline import Settings

    settings = Settings(scheme=scheme, algorithm=algorithm, correspondence=correspondence)
    check_algorithm(settings, "--algorithm")
    settings = with_methods(settings, detector, rows)
    addresses = {"lines": lines, "opcua": opcua}
    with ExitStack() as at_end:
        predictor = at_end.enter_context(_predicting(model, out)) if model is not None else None
        more_sinks = _stream_sinks(at_end, addresses, anywhere, predictor)
        summary = _measure_recording(
            *(source, setup, out, settings, frames),
            surfaces=surfaces == "all",
            sigma_parts=sigma_parts,
            warm=warm,
            more_sinks=more_sinks,
        )
    if not summary.statuses["ok"]:
        raise typer.Exit(NOTHING_MEASURED)


@contextmanager
def _predicting(model: Path, out: Path) -> Iterator[Predictor]:
    """Yield a predictor for all frames; write its predictions into ``out`` at the end."""
    from labapp.export.penetration import Predictor, prediction_csv, read_model

    predictor = Predictor(model.stem, read_model(model))
    try:
        yield predictor
    finally:
        found = predictor.predictions()
        if found is not None:
            text = prediction_csv(predictor.name, predictor.model, {out.name: found})
            write_file(out / "penetration.csv", as_bytes(text))


def _stream_sinks(
    at_end: ExitStack, addresses: dict[str, str | None], anywhere: bool, predictor: Predictor | None
) -> list[Sink]:
    """Return a sink for the predictor and one for each stream with an address (`open_stream`).

    Streams are closed by ``at_end``.
    """
    sinks: list[Sink] = [] if predictor is None else [predictor.add]
    requested = {kind: address for kind, address in addresses.items() if address is not None}
    if not requested:
        return sinks
    from labapp.run.streams import open_stream, stream_values

    def sink(stream: Stream) -> Sink:
        more = predictor.values if predictor is not None else dict
        return lambda result: stream.publish({**stream_values(result), **more()})

    for kind, address in requested.items():
        stream = open_stream(kind, address, anywhere)
        at_end.callback(stream.close)
        typer.echo(f"Measures are sent from {stream.address}", err=True)
        sinks.append(sink(stream))
    return sinks


def _measure_recording(
    source_path: Path,
    setup_path: Path,
    out: Path,
    settings: Settings,
    frames: str,
    *,
    surfaces: bool,
    sigma_parts: bool,
    warm: bool,
    more_sinks: Sequence[Sink],
) -> Summary:
    """Measure, with progress and failures on stderr and the summary on stdout.

    Parameters are the command's options (`reconstruct`) and the sinks of predictor and streams.
    """
    from labapp.config.setup import read_setup
    from labapp.core.recording.residual_check import ResidualRecord, judged_status
    from labapp.export.results import ResultsWriter
    from labapp.export.summary import Summary
    from labapp.media import open_source
    from labapp.run.measurers import ColdMeasurer, RecordingMeasurer, stretch_pools
    from labapp.run.runner import provenance, run, select_frames, with_setup_check

    setup = show_warnings(read_setup(setup_path))
    summary, record = Summary(), ResidualRecord(setup.rig)
    with open_source(source_path) as source, progress_bar() as progress:
        for warning in source.warnings:
            print_above(progress, f"warning: {warning}")
        setup.require_size(source.shape, str(source_path))
        selected = select_frames(frames, len(source))
        origin = provenance(source, source_path, setup_path, setup, settings, selected, warm)
        results = ResultsWriter(out, setup.calibration, origin, surfaces, sigma_parts)
        show_progress = progress_sink(progress, source.name, len(selected))
        try:
            with results, ExitStack() as at_end:
                measurer: Measurer = ColdMeasurer(source.frame, setup, settings)
                if warm:
                    measurer = RecordingMeasurer(
                        source_path,
                        source.index,
                        setup,
                        settings,
                        with_surfaces=surfaces,
                        sigma_parts=sigma_parts,
                        pools=at_end.enter_context(stretch_pools(len(selected))),
                    )
                sinks = [results.write, summary.add, *more_sinks, show_progress]
                for _ in run(selected, with_setup_check(measurer, record), sinks):
                    pass
                summary.verdict = record.verdict()
                results.set_setup_status(judged_status(setup.rig, summary.verdict), summary.verdict)
        except KeyboardInterrupt:
            done = f"stopped: {results.frames} of {len(selected)} frames are done, in {out}"
            print_above(progress, done)
            raise typer.Exit(INTERRUPTED) from None
    typer.echo(summary.text())
    typer.echo(f"Results are in {out.absolute()}")
    return summary
