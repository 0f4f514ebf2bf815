"""`labapp session correct`: correct dots and rows of a frame, and apply it to following frames.

Each option is an edit of `labapp.core.rows.correction`; edits are applied in the order given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from itertools import repeat
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from labapp.cli.shared import SessionFile, frames_text, measure_frames, report_stale_results
from labapp.errors import InputError

if TYPE_CHECKING:
    from labapp.core.pipeline import Measurement
    from labapp.core.rows.correction import Correction
    from labapp.core.surface.measures import Measures
    from labapp.session.session import Session

NEAR_PX = 5.0
"""Largest distance between a dot and the position that an option gives for it."""

LABEL_LENGTH = 120

FORMS = {
    "dots": "TABLE.csv",
    "delete": "U,V",
    "add": "U,V",
    "move": "U,V:DU,DV",
    "place": "U,V:ROW,COLUMN",
    "clear": "U,V",
    "shift_row": "ROW:COLUMNS",
    "split_row": "ROW:COLUMN",
    "merge_rows": "ROW:INTO",
    "block_row": "ROW",
    "unblock_row": "ROW",
    "reference": "ROW,COLUMN",
    "automatic": "",
}
"""Edits and the form of their values. U, V, DU and DV are px, the others are whole numbers."""


class InOrder(TyperCommand):
    """A command that stores the order of its options in `context.meta["order"]`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line twice, the first time for the order of the options."""
        _, _, order = self.make_parser(ctx).parse_args(args=list(args))
        ctx.meta["order"] = [parameter.name for parameter in order]
        return super().parse_args(ctx, args)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _edit(name: str, text: str) -> Any:
    return typer.Option(_option(name), metavar=FORMS[name], help=text)


Dots = Annotated[
    list[str] | None,
    _edit("dots", "Read dots, rows and columns from a table, as in dots.csv (px)."),
]
Delete = Annotated[list[str] | None, _edit("delete", "Delete the dot at U,V (px).")]
Add = Annotated[list[str] | None, _edit("add", "Add the dot at U,V (px).")]
Move = Annotated[list[str] | None, _edit("move", "Move the dot at U,V by DU,DV (px).")]
Place = Annotated[list[str] | None, _edit("place", "Give the dot at U,V (px) a row and a column.")]
Clear = Annotated[list[str] | None, _edit("clear", "Remove row and column of the dot at U,V (px).")]
ShiftRow = Annotated[
    list[str] | None, _edit("shift_row", "Shift a row by columns, to the right if positive.")
]
SplitRow = Annotated[
    list[str] | None, _edit("split_row", "Split ROW: from COLUMN on, a new row above it.")
]
MergeRows = Annotated[list[str] | None, _edit("merge_rows", "Move the dots of ROW to row INTO.")]
BlockRow = Annotated[list[str] | None, _edit("block_row", "Mark a row as blocked by the torch.")]
UnblockRow = Annotated[list[str] | None, _edit("unblock_row", "Mark a row as not blocked.")]
Reference = Annotated[
    list[str] | None, _edit("reference", "Row and column of the reference, the absent centre dot.")
]
Automatic = Annotated[
    bool, typer.Option("--automatic", help="Discard the correction; later edits start from this.")
]


def correct(
    context: typer.Context,
    file: SessionFile,
    *,
    frame: Annotated[int, typer.Option(min=0, help="Frame, by its number in the recording.")],
    dots: Dots = None,
    delete: Delete = None,
    add: Add = None,
    move: Move = None,
    place: Place = None,
    clear: Clear = None,
    shift_row: ShiftRow = None,
    split_row: SplitRow = None,
    merge_rows: MergeRows = None,
    block_row: BlockRow = None,
    unblock_row: UnblockRow = None,
    reference: Reference = None,
    automatic: Automatic = False,
    carry_on: Annotated[
        bool,
        typer.Option("--carry-on", help="Correct the following frames too, until they differ."),
    ] = False,
    measure: Annotated[bool, typer.Option(help="Measure the corrected frames.")] = True,
) -> None:
    """Correct the dots and rows of a frame by edits, applied in the order given.

    Rows are counted from the bottom up, columns from left to right, both from 1.

    An edit of a dot applies to the dot nearest to the given position, within 5 px.

    All edits of a call are undone together: labapp session undo.
    """
    from labapp.session.session import Session

    edits = _edits_in_order(context)
    if not edits and not carry_on:
        raise InputError(
            "correct", "edits", "none", f"some of {', '.join(map(_option, FORMS))}, or --carry-on"
        )
    with Session.open(file) as session:
        known = session.frames.tolist()
        if frame not in known:
            raise InputError("--frame", "frame", frame, f"one of {frames_text(known)}")
        kept = _edited(session, frame, edits)
        corrections: dict[int, Correction | None] = {frame: kept}
        if carry_on:
            if kept is None:
                wanted = "edits that leave a correction to be carried on"
                raise InputError("--carry-on", "edits", "--automatic", wanted)
            corrections |= _carried_on(session, frame, kept)
        frames = list(corrections)
        before = session.result(frame)
        with nullcontext() if measure else report_stale_results(session):
            session.correct(corrections, _label(frames, edits))
            typer.echo(f"Corrected: {frames_text(frames)} (labapp session undo takes it back)")
        if measure:
            _measure(session, frames, None if before is None else before.measurement)


def _edits_in_order(context: typer.Context) -> list[tuple[str, str]]:
    """Return (name, value) of every edit, in the order given."""
    given: dict[str, Iterator[str]] = {
        name: iter(values) if isinstance(values, list | tuple) else repeat("")
        for name, values in context.params.items()
        if name in FORMS and values
    }
    return [(name, next(given[name])) for name in context.meta["order"] if name in given]


def _label(frames: list[int], edits: list[tuple[str, str]]) -> str:
    message = ", ".join(f"{name.replace('_', '-')} {value}".rstrip() for name, value in edits)
    label = f"{frames_text(frames)}: {message or 'carried on'}"
    return label if len(label) <= LABEL_LENGTH else f"{label[: LABEL_LENGTH - 1]}…"


def _edited(session: Session, frame: int, edits: list[tuple[str, str]]) -> Correction | None:
    """Return the frame's correction after the edits; None if --automatic is the last of them."""
    resets = [k for k, (name, _) in enumerate(edits) if name == "automatic"]
    if resets:
        edits = edits[resets[-1] + 1 :]
        if not edits:
            return None
    correction = _start(session, frame, automatic=bool(resets))
    for name, value in edits:
        try:
            correction = _apply(session, frame, correction, name, value)
        except ValueError as error:
            wanted = f"an edit that fits frame {frame}: {error}"
            raise InputError(_option(name), FORMS[name], value, wanted) from error
    return correction


def _start(session: Session, frame: int, *, automatic: bool) -> Correction:
    """Return the start of the edits: the frame's correction, or its automatic dots and rows."""
    from labapp.core.pipeline import measure, start_correction

    corrected = session.correction(frame)
    if corrected is not None and not automatic:
        return corrected
    result = session.result(frame)
    if corrected is None and result is not None and not result.stale:
        return start_correction(result.measurement)
    image, setup = session.frame(frame).image, session.setup
    return start_correction(measure(image, setup.bench, session.settings)[0])


def _apply(
    session: Session, frame: int, correction: Correction, name: str, value: str
) -> Correction:
    """Apply one edit; ValueError if it does not fit."""
    from labapp.core.rows import correction as core
    from labapp.session.corrections.csv_file import read_correction

    if name == "dots":
        recording = session.recording
        assert recording is not None
        shape = recording.rows, recording.columns
        return read_correction(value, frame, shape, correction)
    numbers = _numbers(name, value)
    if name == "add":
        image, settings = session.frame(frame).image, session.settings.dots.band_pass
        u, v = numbers
        return core.add_dot(correction, image, u, v, settings)
    if name in ("delete", "move", "place", "clear"):
        of_dot: dict[str, Callable[..., Correction]] = {
            "delete": core.delete_dots,
            "move": core.move_dots,
            "place": core.assign,
            "clear": core.clear_rows,
        }
        u, v, *others = numbers
        return of_dot[name](correction, [_dot_at(correction, u, v)], *others)
    if name == "reference":
        return core.set_reference(correction, (numbers[0], numbers[1]))
    if name in ("block_row", "unblock_row"):
        highest = int(correction.lattice.row.max(initial=0))
        if numbers[0] > highest:
            raise ValueError(f"its highest row is {highest}")
        return core.block_row(correction, numbers[0], blocked=name == "block_row")
    of_row: dict[str, Callable[..., Correction]] = {
        "shift_row": core.shift_row,
        "split_row": core.split_row,
        "merge_rows": core.merge_rows,
    }
    return of_row[name](correction, *numbers)


def _numbers(name: str, text: str) -> list[Any]:
    """Parse the numbers of an edit, of the form in `FORMS`."""
    form = FORMS[name]
    if [c for c in text if c in ",:"] != [c for c in form if c in ",:"]:
        raise ValueError(f"it is of the form {form}")
    numbers: list[Any] = []
    for what, part in zip(*(t.replace(":", ",").split(",") for t in (form, text)), strict=True):
        in_px = what in ("U", "V", "DU", "DV")
        try:
            number = float(part) if in_px else int(part)
        except ValueError:
            wanted = "a number (px)" if in_px else "a whole number"
            raise ValueError(f"{what} is {wanted}") from None
        if not math.isfinite(number):
            raise ValueError(f"{what} is a number (px)")
        numbers.append(number)
    return numbers


def _dot_at(correction: Correction, u_px: float, v_px: float) -> int:
    """Return the index of the dot nearest to a position."""
    import numpy as np

    from labapp.core.rows.correction import named

    dots = correction.dots
    if not len(dots):
        raise ValueError("the frame has no dots; --add adds one")
    away = np.hypot(dots.u_px - u_px, dots.v_px - v_px)
    nearest = int(np.argmin(away))
    if away[nearest] > NEAR_PX:
        far = f"the nearest is {named(dots, nearest)}, {away[nearest]:.1f} px away"
        raise ValueError(f"no dot is within {NEAR_PX:g} px; {far}")
    return nearest


def _carried_on(session: Session, frame: int, correction: Correction) -> dict[int, Correction]:
    """Apply a correction to the frames after it while it fits, and report where it ends."""
    from labapp.session.corrections.carrying_on import carried_on

    carried, words = carried_on(session, frame, correction)
    replaced = [number for number in carried if session.correction(number) is not None]
    if replaced:
        typer.echo(f"It replaces earlier corrections of {frames_text(replaced)}")
    typer.echo(words)
    return carried


def _measure(session: Session, frames: list[int], before: Measurement | None) -> None:
    """Measure the corrected frames, and compare the first with its previous result."""
    summary = measure_frames(session, frames)
    after = session.result(frames[0])
    assert after is not None
    known = "not measured" if before is None else before.status
    typer.echo(f"frame {frames[0]}: {known} → {after.measurement.status}")
    measures = None if before is None else before.measures, after.measurement.measures
    if any(measures):
        typer.echo(_compared(*measures))
    if len(frames) > 1:
        typer.echo(summary.text())


def _compared(before: Measures | None, after: Measures | None) -> str:
    from labapp.export.summary import MEANS

    lines = []
    for label, name in MEANS.items():
        values = [getattr(measures, name, math.nan) for measures in (before, after)]
        if name == "own_are_mm" and not any(map(math.isfinite, values)):
            continue  # the scheme has none
        parts = [f"{value:z8.4f}" if math.isfinite(value) else f"{'–':>8}" for value in values]
        lines.append(f"  {label:7}{parts[0]} → {parts[1]} mm")
    return "\n".join(lines)
