"""An advice as text, tables and a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from labapp.simulation.positioning import side_view
from labapp.studies.adviser.bench_limits import CONSTRAINTS
from labapp.studies.adviser.search import MOVED, Advice, Candidate, constraint_text
from labapp.studies.plotting import INCHES, new_figure
from labapp.studies.side_picture import draw_side
from labapp.studies.tables import Cell, Table

WORDS = {
    "projection_angle_deg": ("laser, projection angle", "°"),
    "distance_mm": ("laser, distance", "mm"),
    "plane_mm": ("imaging plane, distance", "mm"),
    "s_mm": ("imaging plane, s", "mm"),
    "h_mm": ("imaging plane, h", "mm"),
}
"""Name and unit of each quantity of `Place`."""

KEPT, BROKEN = "#1b7a3d", "#b01030"


def advice_text(advice: Advice) -> str:
    """The recommended set-up, its expected error and its margins, as Markdown."""
    best = advice.best
    if advice.possible:
        lines = [
            "Recommended set-up:",
            "",
            *_place_lines(best),
            "",
            f"Expected mean height error: {error_words(advice)}{_exact_words(advice)}."
            f"{unknown_words(advice)}",
            "",
            "Its margins:",
            "",
            *(f"* {constraint_text(name, margin)}" for name, margin in best.margins.items()),
        ]
    else:
        lines = [
            "No set-up within these limits meets all conditions for every expected pool.",
            "",
            "The nearest set-up is:",
            "",
            *_place_lines(best),
            "",
            "It does not meet:",
            "",
            *(
                f"* {constraint_text(name, margin)}"
                for name, margin in best.margins.items()
                if margin < 0
            ),
        ]
    return "\n".join(lines)


def _place_lines(candidate: Candidate) -> list[str]:
    return [
        f"* {words}: {getattr(candidate.place, name):.2f} {unit}"
        for name, (words, unit) in WORDS.items()
    ]


def error_words(advice: Advice) -> str:
    """Expected mean error of a possible set-up, with its ± if this is known."""
    height = advice.expected.mean_height_mm
    sigma = f" ± {_micro(advice.sigma_mm)}" if np.isfinite(advice.sigma_mm) else ""
    share = f"{100 * advice.error_mm / height:.2g} % of {height:.3g} mm"
    return f"{_micro(advice.error_mm)}{sigma} µm, {share}"


def _exact_words(advice: Advice) -> str:
    if not np.isfinite(advice.random_mm):
        return ""
    return f"; {_micro(advice.random_mm)} µm with the calibration known exactly"


def unknown_words(advice: Advice) -> str:
    """A sentence, after a space, about what pools without a surface leave unknown; or nothing."""
    if not advice.lost:
        return ""
    counts = f" {advice.lost} of {advice.pools} simulated pools gave no surface"
    if np.isfinite(advice.sigma_mm):
        return f"{counts} with the calibration known exactly: the error with it is unknown."
    return f"{counts}: the error is only predicted, and its ± unknown."


def _micro(value_mm: float) -> str:
    return f"{1000 * value_mm:.2f}"


def advice_table(advice: Advice) -> Table:
    """The recommended set-up (first), the compared ones, and those at each mm and degree away."""
    rows = [
        _row("recommended" if advice.possible else "nearest", advice.best, advice.error_mm),
        *(_row("grid", one, one.error_mm) for one in advice.grid),
    ]
    for sweep in advice.sweeps:
        for value, error, margins in zip(sweep.value, sweep.error_mm, sweep.margins, strict=True):
            place = {name: getattr(advice.best.place, name) for name in MOVED}
            place[sweep.name] = float(value)
            known = float(error) if np.isfinite(error) else None
            rows.append(("away", *place.values(), known, *margins.values()))
    columns = [f"{name}_margin_{unit}" for name, (_, unit) in CONSTRAINTS.items()]
    return Table(
        "advice",
        "Set-ups: predicted mean height error, mm, and margins of the conditions",
        ("what", *MOVED, "error_mm", *columns),
        tuple(rows),
    )


def _row(what: str, one: Candidate, error_mm: float) -> tuple[Cell, ...]:
    place = [getattr(one.place, name) for name in MOVED]
    return (what, *place, error_mm if np.isfinite(error_mm) else None, *one.margins.values())


def cost_table(advice: Advice) -> Table:
    """Mean cost of each mm and degree away, up to the first violated constraints."""
    rows: list[dict[str, Cell]] = []
    for sweep in advice.sweeps:
        own = int(np.argmin(np.abs(sweep.value - getattr(advice.best.place, sweep.name))))
        # The reflected rays change from pool to pool: the slope over a short way is chance.
        short = np.ptp(sweep.value) / 2 / max(len(sweep.value) - 1, 1)
        for way in (-1, 1):
            path = list(range(own + way, len(sweep.value) if way > 0 else -1, way))
            broken = [k for k in path if sweep.breaks(k)]
            kept = path[: path.index(broken[0])] if broken else path
            far = [k for k in path if abs(sweep.value[k] - sweep.value[own]) >= short]
            end = next((k for k in reversed(kept) if k in far), far[0] if far else None)
            more = None
            if end is not None:
                apart = abs(sweep.value[end] - sweep.value[own])
                if np.isfinite(sweep.error_mm[[own, end]]).all():
                    more = float(1000 * (sweep.error_mm[end] - sweep.error_mm[own]) / apart)
            wrong = broken[0] if broken else None
            breaks = () if wrong is None else sweep.breaks(wrong)
            words, unit = WORDS[sweep.name]
            rows.append(
                {
                    "quantity": words,
                    "unit": unit,
                    "way": "less" if way < 0 else "more",
                    "more_error_um_per_unit": more,
                    "kept_to": float(sweep.value[kept[-1] if kept else own]),
                    "broken_at": None if wrong is None else float(sweep.value[wrong]),
                    "what_breaks": "; ".join(CONSTRAINTS[name][0] for name in breaks),
                }
            )
    return Table.of(
        "cost",
        "Cost of each mm and degree away from the recommended set-up, µm of error; last value that "
        "meets all conditions and first that does not, of those checked",
        rows,
    )


def advice_picture(advice: Advice) -> Figure:
    """Draw the bench from the side, the possible laser positions and the cost of deviations."""
    with new_figure(INCHES, INCHES * 1.15) as figure:
        plots = figure.subplot_mosaic(
            [["side"] * 6, ["map"] * 2 + ["a"] * 2 + ["b"] * 2, ["c"] * 2 + ["d"] * 2 + ["e"] * 2],
            height_ratios=[1.4, 1, 1],
        )
        _draw_bench(plots["side"], advice)
        _draw_map(plots["map"], advice)
        for key, sweep in zip("abcde", advice.sweeps, strict=False):
            _draw_sweep(plots[key], advice, sweep)
        for key in "abcde"[len(advice.sweeps) :]:
            plots[key].remove()
        return figure


def _draw_bench(plot: Any, advice: Advice) -> None:
    place = advice.best.place
    pools = advice.expected
    width, length = (sum(ends) / 2 for ends in (pools.width_mm, pools.length_mm))
    height = pools.sign * pools.mean_height_mm
    view = side_view(advice.limits.rig(place), width, length, height)
    draw_side(plot, view)
    top = view.plane_mm[1]
    plot.annotate("laser", view.laser_mm, (5, 3), textcoords="offset points")
    plot.annotate("imaging plane", top, (5, -8), textcoords="offset points")
    plot.set(xlabel="Y (mm)", ylim=(-5, top[1] + 5))
    message = "recommended" if advice.possible else "nearest; not possible"
    plot.set_title(
        f"{message}: laser {place.projection_angle_deg:.1f}°, {place.distance_mm:.1f} mm; "
        f"plane {place.plane_mm:.1f} mm, s {place.s_mm:.1f}, h {place.h_mm:.1f} mm",
        loc="left",
        fontsize=8,
    )


def _draw_map(plot: Any, advice: Advice) -> None:
    """Draw the least error over the plane's distances by laser position; crosses: impossible."""
    least: dict[tuple[float, float], float] = {}
    for one in advice.grid:
        at = (one.place.projection_angle_deg, one.place.distance_mm)
        error = one.error_mm if one.possible else np.inf
        least[at] = min(least.get(at, np.inf), error)
    places, micro = np.array(list(least)), 1000 * np.array(list(least.values()))
    known = np.isfinite(micro)
    plot.plot(*places[~known].T, "x", color=BROKEN, ms=4)
    if known.any():
        dots = plot.scatter(*places[known].T, c=micro[known], s=45, cmap="viridis")
        plot.figure.colorbar(dots, ax=plot, label="predicted error (µm)")
    best = advice.best.place
    plot.plot(best.projection_angle_deg, best.distance_mm, "*", ms=9, color="k", mfc="w")
    plot.set(xlabel="projection angle (°)", ylabel="laser distance (mm)")
    plot.set_title("laser positions (×: not possible)", loc="left", fontsize=7.5)


def _draw_sweep(plot: Any, advice: Advice, sweep: Any) -> None:
    words, unit = WORDS[sweep.name]
    wrong = np.array([bool(sweep.breaks(k)) for k in range(len(sweep.value))])
    error = 1000 * sweep.error_mm
    plot.plot(sweep.value, error, color="0.6")
    plot.plot(sweep.value[~wrong], error[~wrong], "o", ms=3, color=KEPT)
    plot.plot(sweep.value[wrong], error[wrong], "x", ms=4, color=BROKEN)
    plot.axvline(getattr(advice.best.place, sweep.name), color="k", lw=0.6, ls=":")
    known = error[np.isfinite(error)]
    plot.set(xlabel=f"{words} ({unit})", ylabel="error (µm)", ylim=(0, 1.15 * known.max()))
    plot.grid(alpha=0.25, lw=0.4)
