"""The summary of a study as one HTML file with its plots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from labapp.core.surface.measures import SIZES
from labapp.run.study.plan import Condition, named_condition, shown_condition
from labapp.run.study.status import STATE_WORDS, count_states
from labapp.run.study.summary import GroupSummary, Mean, StudySummary
from labapp.studies.plotting import INCHES, as_bytes, new_figure
from labapp.text import SIGMA_OF, axis_label, column_heading, with_sigma

MOST_SHOWN = 60
"""Most outliers that are listed; all are in outliers.csv."""

MOST_ROWS = 6
"""Most conditions that are plotted."""

COLOURS = "#0072b2 #d55e00 #009e73 #cc79a7 #56b4e9 #e69f00 #333333 #999999".split()
"""Colours that can be distinguished with poor colour vision (Okabe and Ito)."""

APART = 0.02
"""Distance between symbols of different colours, as a share of the range of the axis."""

PANEL_INCHES = (2.0, 1.8)

CSS = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 75rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
p.note { color: #555; margin-top: .2rem; } .bad { color: #a40000; }
.scroll { overflow-x: auto; } svg { max-width: 100%; height: auto; }
table { border-collapse: collapse; font-size: 13px; } th, td { padding: .25rem .6rem; }
th { text-align: left; border-bottom: 1px solid #888; } td { border-bottom: 1px solid #e4e4e4; }
td:first-child { white-space: nowrap; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
"""


def summary_page(summary: StudySummary, made: str) -> str:
    """Return the page as self-contained HTML with inline SVG, ``made`` at this date and time."""
    parts = [f"<h1>{escape(summary.title)}</h1>", _head(summary)]
    parts += _problems(summary)
    if summary.groups:
        parts += ["<h2>Measures against conditions</h2>", _plots_note(summary), _plots(summary)]
        parts += ["<h2>Means</h2>", _groups(summary)]
    parts += ["<h2>Outliers</h2>", _outliers(summary)]
    parts += ["<h2>Recordings</h2>", _recordings(summary)]
    parts.append(f"<p class=note>Made by labapp, {escape(made)}.</p>")
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(summary.title)}</title><style>{CSS}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def _head(summary: StudySummary) -> str:
    measured = sum(one.statuses.get("ok", 0) for one in summary.recordings)
    frames = sum(one.status.frames_done for one in summary.recordings)
    counts = count_states(one.status for one in summary.recordings)
    return f"<p>{counts}. {frames} frames measured, {measured} of them with a surface.</p>"


def _problems(summary: StudySummary) -> list[str]:
    rows = [
        (one.status.recording.name, one.status.problem or f"The set-up is doubtful: {one.doubt}.")
        for one in summary.recordings
        if one.status.problem or one.doubt
    ]
    if not rows:
        return []
    table = _table(["recording", "problem"], [[_t(name), _t(text)] for name, text in rows])
    return ['<h2 class="bad">Problems</h2>', table]


# --- plots --------------------------------------------------------------------------------------


def _plots_note(summary: StudySummary) -> str:
    varying = varying_conditions(summary)
    colours = (
        " Colours distinguish the other conditions and are drawn slightly apart."
        if len(varying) > 1
        else ""
    )
    return (
        "<p class=note>Large symbols: mean of the recordings under one condition, with its "
        f"standard uncertainty ({SIGMA_OF}). Small symbols: mean of each recording.{colours} "
        "The set-up's part of ± is common to all recordings of one bench: differences have a "
        "smaller uncertainty.</p>"
    )


def varying_conditions(summary: StudySummary) -> list[str]:
    """Return the conditions that have more than one value."""
    values = {
        name: {one.conditions.get(name) for one in summary.groups} for name in summary.conditions
    }
    return [name for name, each in values.items() if len(each) > 1]


def condition_picture(summary: StudySummary, condition: str) -> bytes:
    """Plot each size against one condition, as PNG, with the other conditions by colour.

    Parameters
    ----------
    condition
        One of `varying_conditions`; empty: none, all recordings at one position.
    """
    others = [name for name in varying_conditions(summary) if name != condition]
    with new_figure(INCHES, 3.8) as figure:
        axes = figure.subplots(2, 3, sharex=True).flatten()
        _draw_row(axes, summary, condition, others)
        for axis, size in zip(axes, SIZES, strict=True):
            axis.set_title(axis_label(size))
        return as_bytes(figure, dpi=150)


def _plots(summary: StudySummary) -> str:
    """Plot small multiples: one row per varying condition, one column per size."""
    varying = varying_conditions(summary)[:MOST_ROWS] or [""]
    width, height = PANEL_INCHES
    with new_figure(width * len(SIZES) + 1.2, height * len(varying) + 0.3) as figure:
        shape = len(varying), len(SIZES)
        axes = figure.subplots(*shape, squeeze=False, sharex="row", sharey="col")
        for row, condition in enumerate(varying):
            others = [name for name in varying if name not in ("", condition)]
            _draw_row(axes[row], summary, condition, others)
        for axis, size in zip(axes[0], SIZES, strict=True):
            axis.set_title(axis_label(size))
        svg = as_bytes(figure, "svg").decode()
    return f'<div class="scroll">{svg[svg.index("<svg") :]}</div>'


def _draw_row(
    axes: Sequence[Any], summary: StudySummary, condition: str, others: Sequence[str]
) -> None:
    """Draw every size against one condition; a colour for each combination of the others."""
    by_name = {one.status.recording.name: one for one in summary.recordings}
    places, ticks = _places(summary.groups, condition)
    kinds = _kinds(summary.groups, others)
    colours = dict(zip(dict.fromkeys(kinds), COLOURS, strict=False))
    step = APART * (max(places, default=0.0) - min(places, default=0.0) or 1.0)
    apart = {kind: step * (k - (len(colours) - 1) / 2) for k, kind in enumerate(colours)}
    for axis, size in zip(axes, SIZES, strict=True):
        if all(group.means[size].mean == 0 for group in summary.groups):
            axis.set_axis_off()
            axis.text(0.5, 0.5, "0 everywhere", ha="center", transform=axis.transAxes)
            continue
        for group, place, kind in zip(summary.groups, places, kinds, strict=True):
            each = [by_name[name].means[size].mean for name in group.recordings]
            _draw(axis, place + apart[kind], group.means[size], each, colours[kind])
        axis.grid(True, color="0.9", linewidth=0.5)
        axis.set_axisbelow(True)
        if ticks is not None:
            axis.set_xticks(range(len(ticks)), ticks)
            axis.margins(x=0.15)
        axis.set_xlabel(axis_label(condition) or "all recordings")
        axis.tick_params(labelbottom=True)
    if len(colours) > 1:
        for kind, colour in colours.items():
            axes[-1].plot([], [], "o", color=colour, markersize=3.5, label=kind)
        axes[-1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), frameon=False)


def _draw(axis: Any, place: float, mean: Mean, each: Sequence[float], colour: str) -> None:
    axis.plot([place] * len(each), each, ".", color=colour, markersize=2.5, alpha=0.45)
    sigma = mean.sigma if math.isfinite(mean.sigma) else 0.0
    axis.errorbar(
        [place],
        [mean.mean],
        [sigma],
        fmt="o",
        color=colour,
        markersize=3.5,
        capsize=2,
        elinewidth=0.9,
    )


def _places(groups: Sequence[GroupSummary], condition: str) -> tuple[list[float], list[str] | None]:
    """Return the position of each group on a condition's axis, and tick labels if it is text."""
    values = [group.conditions.get(condition) for group in groups]
    if condition and all(isinstance(value, int | float) for value in values):
        return [float(value) for value in values if not isinstance(value, str | None)], None
    ticks = list(dict.fromkeys(shown_condition(value) for value in values))
    return [float(ticks.index(shown_condition(value))) for value in values], ticks


def _kinds(groups: Sequence[GroupSummary], others: Sequence[str]) -> list[str]:
    """Return the other conditions of each group as text; empty if there are too many."""
    kinds = [
        "\n".join(named_condition(name, one.conditions.get(name)) for name in others)
        for one in groups
    ]
    return kinds if len(set(kinds)) <= len(COLOURS) else [""] * len(kinds)


# --- tables -------------------------------------------------------------------------------------


def _t(value: object) -> str:
    return f"<td>{escape(str(value))}</td>"


def _n(value: object) -> str:
    return f'<td class="n">{escape(str(value))}</td>'


def _link(path: str) -> str:
    """Return a cell with a link to a file."""
    return f'<td><a href="{escape(Path(path).as_uri())}">{escape(path)}</a></td>'


def _cell(value: Condition | None) -> str:
    return _t(value) if isinstance(value, str) else _n(shown_condition(value))


def _table(head: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    names = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "\n".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{names}</tr>\n{body}</table></div>'


def _mean_cells(means: Mapping[str, Mean]) -> list[str]:
    return [_n(with_sigma(means[s].mean, means[s].sigma)) if s in means else _n("") for s in SIZES]


def _groups(summary: StudySummary) -> str:
    return _table(
        map(column_heading, (*summary.conditions, "recordings", "frames", *SIZES)),
        (
            [
                *(_cell(one.conditions.get(name)) for name in summary.conditions),
                *(_n(len(one.recordings)), _n(one.frames), *_mean_cells(one.means)),
            ]
            for one in summary.groups
        ),
    )


def _outliers(summary: StudySummary) -> str:
    if not summary.outliers:
        return "<p>No frame and no recording is far from the others.</p>"
    rows = [
        [
            *(_t(one.recording), _n("all" if one.frame is None else one.frame)),
            *(_t(column_heading(one.measure)), _n(f"{one.value:.4g}"), _n(f"{one.usual:.4g}")),
            *(_n(f"{one.times:.1f}"), _link(one.file)),
        ]
        for one in summary.outliers[:MOST_SHOWN]
    ]
    left = len(summary.outliers) - len(rows)
    more = f"<p>{left} more are in outliers.csv.</p>" if left else ""
    head = ["recording", "frame", "measure", "value", "typical", "standard deviations off", "file"]
    return _table(head, rows) + more


def _recordings(summary: StudySummary) -> str:
    conditions = map(column_heading, summary.conditions)
    return _table(
        [
            "recording",
            *conditions,
            "state",
            "frames",
            "with a surface",
            *map(column_heading, SIZES),
        ],
        (
            [
                _t(one.status.recording.name),
                *(_cell(one.status.recording.conditions.get(c)) for c in summary.conditions),
                *(_t(STATE_WORDS[one.status.state]), _n(one.status.frames_done)),
                *(_n(one.statuses.get("ok", 0)), *_mean_cells(one.means)),
            ]
            for one in summary.recordings
        ),
    )
