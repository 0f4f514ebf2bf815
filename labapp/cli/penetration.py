"""`labapp penetration …`: models of back-side width or depth from the pool's surface."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from labapp.cli.shared import check_target, command_group, progress_shown
from labapp.errors import InputError
from labapp.files import as_bytes, write_file
from labapp.system import quoted
from labapp.text import csv_text, number_cell, pluralize

if TYPE_CHECKING:
    from labapp.core.dynamics.penetration import Kind, LeftOut, PenetrationModel, Prediction
    from labapp.core.dynamics.weld_series import WeldSeries

app = command_group()

MATCHED_S = 0.2
"""Largest time difference between a transition and its prediction, s."""


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="Table of features to write (.csv or .mat).")],
    welds: Annotated[int, typer.Option(min=1, max=1000, help="Number of welds.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
) -> None:
    """Simulate welds with a known law of penetration, as test data for the other commands."""
    from labapp.export.features import FeatureTable
    from labapp.simulation.penetration import FEATURES, TARGET, simulate_welds

    check_target(out, ".csv", ".mat")
    made = tuple(one.series for one in simulate_welds(welds, seed))
    FeatureTable(FEATURES, TARGET, made).write(out)
    typer.echo(f"{pluralize(welds, 'weld')}, in {out.absolute()}")


@app.command()
def table(
    study: Annotated[
        Path, typer.Argument(metavar="STUDY", help="Study file whose recordings are measured.")
    ],
    sections: Annotated[
        Path,
        typer.Argument(
            help="CSV: recording, position_mm (start_mm, travel_mm_s) or time_s, a column of "
            "penetration such as back_width_mm, and its ± such as back_width_sigma_mm."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Table to write: .csv, or .mat for MATLAB.")],
    results: Annotated[
        Path | None, typer.Option(help="Folder of the study's results, if not the default.")
    ] = None,
) -> None:
    """Write the features of every frame, with ±, and the penetration measured on sections."""
    from labapp.run.study.sections import study_features
    from labapp.run.study.study import Study

    check_target(out, ".csv", ".mat", inputs=[study, sections])
    opened = Study(study, results)
    found, unused = study_features(opened.plan, opened.tables(), sections)
    found.write(out)
    if unused:
        why = "no frame with a surface is near"
        typer.echo(f"warning: {pluralize(unused, 'section')} left out: {why}", err=True)
    count = pluralize(len(found.welds), "weld")
    typer.echo(f"{found.target} of {count} and their features, in {out.absolute()}")


@app.command()
def fit(
    features: Annotated[
        Path, typer.Argument(metavar="TABLE", help="What `labapp penetration table` wrote (CSV).")
    ],
    out: Annotated[Path, typer.Option(help="File for the model (JSON).")],
    model: Annotated[
        Literal["best", "arx", "gp"],
        typer.Option(
            help="Linear model (arx), Gaussian process (gp), or the one with the smaller error."
        ),
    ] = "best",
    use: Annotated[
        str, typer.Option(metavar="NAMES", help="Features, separated by commas.")
    ] = "width_mm,length_mm,convexity_mm",
    orders: Annotated[
        tuple[int, int, int],
        typer.Option(
            metavar="N_A N_B N_K",
            help="Number of time constants (0 to 2), of feature steps, and of steps of delay.",
        ),
    ] = (1, 1, 0),
    step: Annotated[
        float, typer.Option(min=1e-3, max=100, help="Step over which features are averaged (s).")
    ] = 0.1,
    full: Annotated[
        float | None,
        typer.Option(min=1e-3, max=1000, help="Threshold of full penetration (mm). Default: none."),
    ] = None,
    left_out: Annotated[
        Path | None, typer.Option(help="CSV file for the cross-validation predictions.")
    ] = None,
) -> None:
    """Fit models, cross-validate each by leaving out welds, and write the better one."""
    from labapp.core.dynamics.penetration import ModelSettings
    from labapp.core.dynamics.weld_series import Orders
    from labapp.export.features import FeatureTable
    from labapp.export.penetration import write_model

    check_target(out, ".json")
    if left_out is not None:
        check_target(left_out, ".csv", inputs=[features], option="--left-out")
    read = FeatureTable.read(features)
    if not read.target:
        raise InputError(features, "columns", "no penetration", "one, such as back_width_mm")
    if not (0 <= orders[0] <= 2 and 1 <= orders[1] <= 50 and 0 <= orders[2] <= 1000):
        raise InputError("--orders", "orders", orders, "0 to 2, 1 to 50, 0 to 1000")
    names = tuple(name.strip() for name in use.split(","))
    settings = ModelSettings(names, read.target, step, Orders(*orders), full)
    kinds: tuple[Kind, ...] = ("arx", "gp") if model == "best" else (model,)
    tried: list[tuple[PenetrationModel, LeftOut]] = []
    with progress_shown("stopped: no model was written") as progress:
        for kind in kinds:
            tried.append(read.fit(kind, settings, partial(progress, kind)))
    for one, errors in tried:
        typer.echo(_validation_text(one, errors))
    best, errors = min(tried, key=lambda each: each[1].rmse_mm)
    write_model(out, best)
    if left_out is not None:
        write_file(left_out, as_bytes(csv_text(_left_out_rows(errors))))
    typer.echo(f"The {best.kind} model is in {out.absolute()}")
    typer.echo(f"  labapp penetration predict {quoted(str(out))} SOURCE --out FILE.csv")


def _validation_text(model: PenetrationModel, errors: LeftOut) -> str:
    """Describe the cross-validation of a model in one line."""
    import numpy as np

    constants = ", ".join(f"{one:.2f}" for one in model.time_constants_s) or "none"
    text = (
        f"{model.kind}: error {errors.rmse_mm:.3f} mm, bias {errors.bias_mm:+.3f} mm, "
        f"{errors.cover:.1%} in the 95 % interval, of {pluralize(len(errors.measured), 'section')} "
        f"of {pluralize(len(set(errors.weld)), 'weld')} left out; time constants {constants} s"
    )
    known, found = errors.transitions()
    if len(known):
        near = int(np.sum(np.abs(known - found) <= MATCHED_S))
        text += f"; {near} of {len(known)} transitions to full within {MATCHED_S:g} s"
    return text


def _left_out_rows(errors: LeftOut) -> list[list[str]]:
    columns = vars(errors)
    names = ["time_s", "measured", "measured_sigma", "predicted", "sigma"]
    head = ["recording", "time_s", *(f"{name}_mm" for name in names[1:])]
    numbers = zip(*(columns[name].tolist() for name in names), strict=True)
    rows = zip(errors.weld, numbers, strict=True)
    return [head, *([weld, *map(number_cell, each)] for weld, each in rows)]


@app.command()
def predict(
    model: Annotated[Path, typer.Argument(help="What `labapp penetration fit` wrote.")],
    source: Annotated[
        Path,
        typer.Argument(
            help="A study file, a session, a folder that `labapp reconstruct` wrote, or a table "
            "of features (CSV)."
        ),
    ],
    out: Annotated[Path, typer.Option(help="CSV file for the predictions.")],
) -> None:
    """Predict penetration over time, with 95 % intervals and transitions to full."""
    from labapp.core.dynamics.weld_series import find_transitions
    from labapp.export.penetration import prediction_csv, read_model

    check_target(out, ".csv", inputs=[source])
    chosen = read_model(model)
    found: dict[str, Prediction] = {}
    for one in _series_of(source, chosen.settings.features):
        try:
            found[one.name] = chosen.predict(one)
        except ValueError as error:
            typer.echo(f"{one.name}: {error}", err=True)
    write_file(out, as_bytes(prediction_csv(model.stem, chosen, found)))
    for name, each in found.items():
        outside = int(each.is_outside.sum())
        if outside:
            typer.echo(f"warning: {name}: {outside} of {len(each.time_s)} steps are beyond the "
                       f"features that the model was fitted to", err=True)  # fmt: skip
        if chosen.settings.full_mm is not None:
            for at in find_transitions(each.time_s, each.value, chosen.settings.full_mm):
                typer.echo(f"{name}: full penetration from {at:.2f} s (model)")
    typer.echo(
        f"Model {model.stem} ({chosen.kind}, error {chosen.rmse_mm:.3f} mm of welds left out) of "
        f"{pluralize(len(found), 'recording')}, in {out.absolute()}"
    )


def _series_of(source: Path, features: tuple[str, ...]) -> tuple[WeldSeries, ...]:
    """Return the feature series of every weld in a source."""
    from labapp.export.dynamics import measured_of
    from labapp.export.features import FeatureTable, measured_series
    from labapp.export.result_folder import measured_in
    from labapp.run.study.study import Study
    from labapp.session.session import Session

    if source.is_dir():
        return (measured_series(source.name, measured_in(source), features),)
    if source.suffix.lower() == ".labsession":
        with Session.open(source, read_only=True) as session:
            measured = measured_of(session.frame_results(stale=False))
            return (measured_series(source.stem, measured, features),)
    if source.suffix.lower() == ".csv" and _is_table(source):
        return FeatureTable.read(source).chosen(features).welds
    return Study(source).features().chosen(features).welds


def _is_table(source: Path) -> bool:
    """Whether a CSV file is a table of features, not a study."""
    from labapp.config.csv_tables import open_table

    with open_table(source, "a table of features, or a study", 1 << 29) as file:
        return "time_s" in file.readline(1 << 14)


@app.command()
def onnx(
    model: Annotated[Path, typer.Argument(help="What `labapp penetration fit` wrote.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
) -> None:
    """Write a model as ONNX: from feature means of the last steps to penetration, without ±."""
    from labapp.export.penetration import read_model, write_onnx

    check_target(out, ".onnx")
    read = read_model(model)
    write_onnx(out, read)
    names = ", ".join(read.settings.features)
    typer.echo(f"input features ({read.memory} steps of {read.settings.step_s:g} s, {names})")
    typer.echo(f"In {out.absolute()}")
