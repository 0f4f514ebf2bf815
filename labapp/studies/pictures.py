"""Pictures of chapters 4 and 8: black on white, lengths in mm."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from labapp.core.geometry.rig import Rig
from labapp.core.schemes import SCHEMES
from labapp.core.values import FloatArray
from labapp.simulation.forward import Reflections
from labapp.simulation.positioning import Fate, SideView, side_view
from labapp.simulation.render import RenderedFrame
from labapp.studies.error_analysis import ErrorSurvey
from labapp.studies.plotting import INCHES, new_figure, row_colour
from labapp.studies.positioning_tables import Coverage
from labapp.studies.side_picture import draw_side

STYLES = (
    *(("#1b7a3d", "^"), ("#1b4f8a", "o"), ("#c05a00", "s")),
    *(("#7a3fa0", "D"), ("#b01030", "v"), ("#5f6b00", "P")),
)
"""Colours and markers of the schemes, in their order; then repeated."""

STYLE_OF = dict(zip(SCHEMES, itertools.cycle(STYLES), strict=False))
COLOURS = {name: colour for name, (colour, _) in STYLE_OF.items()}
COLOURS |= {"predicted": "#8ab0d8", "simulated": "#1b4f8a"}

PLATE_MM = 101.6
"""Edge of the imaging plane of Fig. 4-11."""

OPEN_PLANE_MM = 1e4
"""s and h of the boundless plane of `correspondence_table.OPEN_BENCH`."""


def positioning_picture(rig: Rig, width_mm: float, length_mm: float, height_mm: float) -> Figure:
    """Fig. 4-7 … 4-9: the central rays via a flat, a convex and a concave pool, L1 and L2."""
    with new_figure(INCHES * 0.7, 6.4) as figure:
        plots = figure.subplots(3, sharex=True, sharey=True)
        for plot, name, height in zip(
            plots, ("flat", "convex", "concave"), (0.0, height_mm, -height_mm), strict=True
        ):
            view = side_view(rig, width_mm, length_mm, height)
            _draw_room(plot, view)
            c = view.clearance
            blocked = view.tally[Fate.BLOCKED]
            plot.set_title(
                f"{name}: L1 = {c.l1_mm:.1f}, L2 = {c.l2_mm:.1f} mm, {blocked} rays blocked",
                loc="left",
                fontsize=7.5,
            )
        plots[-1].set_xlabel("Y (mm)")
        plots[0].legend(loc="upper right", fontsize=6)
        return figure


def _draw_room(plot: Any, view: SideView) -> None:
    """Draw the bench with L1 and L2."""
    draw_side(plot, view)
    for place, name in ((-view.clearance.l1_mm, "L1"), (view.clearance.l2_mm, "L2")):
        if np.isfinite(place):
            plot.plot([place, place], [-1.5, 1.5], "k", lw=0.8)
            plot.annotate(name, (place, -1.5), (0, -8), textcoords="offset points", ha="center")
    low = view.plane_mm[:, 0].min()
    plot.set(xlim=(low - 3, view.laser_mm[0] + 4), ylim=(-5, 40))


def coverage_picture(placements: Sequence[Coverage]) -> Figure:
    """Fig. 4-11: the dots on the plane at several distances of the plane."""
    with new_figure(INCHES, INCHES) as figure:
        for plot, one in zip(figure.subplots(2, 2).ravel(), placements, strict=True):
            plot.add_patch(Rectangle((0, 0), PLATE_MM, PLATE_MM, fc="none", ec="k", lw=1))
            plot.plot(*one.plane_mm[one.on_plane].T, "o", ms=2.5, color="#1b4f8a")
            plot.plot(*one.plane_mm[~one.on_plane].T, "x", ms=4, color="#b01030")
            off = int((~one.on_plane).sum())
            plot.set_title(f"plane at {one.distance_mm:g} mm: {off} of {len(one.on_plane)} off it")
            plot.set(xlim=(-8, PLATE_MM + 8), ylim=(-8, 125), aspect="equal")
            plot.set(xlabel="X′ (mm)", ylabel="Z′ (mm)")
        return figure


def correspondence_picture(seen: Reflections, title: str) -> Figure:
    """Fig. 4-17, 4-18, 4-20: reflected dots, and the points where their rays meet the pool.

    One colour per row of rays, alternating markers by column; thin lines join neighbours in a row.
    """
    markers = "os^vD<>p*"
    with new_figure(INCHES, 3.4) as figure:
        plane, pool = figure.subplots(1, 2)
        for row in range(len(seen.lit)):
            columns = np.flatnonzero(seen.lit[row] & np.isfinite(seen.plane_mm[row]).all(axis=-1))
            colour = row_colour(row)
            for plot, places in ((plane, seen.plane_mm[row]), (pool, seen.point_mm[row, :, :2])):
                plot.plot(*places[columns].T, "-", lw=0.4, color=colour)
                for column in columns:
                    marker = markers[column % len(markers)]
                    plot.plot(*places[column], marker, ms=3, color=colour, mew=0)
        plane.set(xlabel="X′ − s (mm)", ylabel="Z (mm)", title="dots on the imaging plane")
        pool.set(xlabel="X (mm)", ylabel="Y (mm)", title="rays on the pool", aspect="equal")
        for axis in (
            plane.xaxis,
            plane.yaxis,
        ):  # measured from the torch's centre and the work piece
            axis.set_major_formatter(lambda value, _: f"{value - OPEN_PLANE_MM:g}")
        figure.suptitle(title, fontsize=8)
        return figure


def error_picture(survey: ErrorSurvey) -> Figure:
    """Fig. 8-6, 8-8, 8-10: errors of depth and boundary against the caps' diameter."""
    rows = (("depth", f"{survey.kind}-D (%)", 100.0), ("boundary", f"{survey.kind}-B (%)", 100.0))
    return _over_caps(survey, rows)


def are_picture(survey: ErrorSurvey) -> Figure:
    """Fig. 8-7, 8-9, 8-11: computed and actual ARE against the caps' diameter."""
    return _over_caps(
        survey, (("are_mm", "computed ARE (mm)", 1.0), ("actual_are_mm", "actual ARE (mm)", 1.0))
    )


def _over_caps(survey: ErrorSurvey, rows: Sequence[tuple[str, str, float]]) -> Figure:
    """One plot per error and kind of surface; solid lines D = B/20, dashed lines D = B/10.

    Lines join the means over the centres of a cap; bars extend from the least to the largest value.
    """
    size = np.array([(cap.footprint.width_mm, cap.peak_mm) for cap in survey.caps])
    with new_figure(INCHES, 4.5) as figure:
        plots = figure.subplots(2, 2, sharex=True, sharey="row")
        for line, (error, label, scale) in zip(plots, rows, strict=True):
            for plot, sign in zip(line, (1, -1), strict=True):
                for scheme in survey.schemes:
                    for ratio, style in ((20, "-"), (10, "--")):
                        values = scale * survey.of(scheme, error)
                        chosen = np.isclose(size[:, 1] * sign * ratio, size[:, 0])
                        chosen &= np.isfinite(values)
                        diameter, cap = np.unique(size[chosen, 0], return_inverse=True)
                        each = [values[chosen][cap == n] for n in range(len(diameter))]
                        least, mean, largest = (
                            np.array([of(own) for own in each]) for of in (np.min, np.mean, np.max)
                        )
                        plot.errorbar(
                            diameter,
                            mean,
                            np.maximum([mean - least, largest - mean], 0.0),  # rounding
                            fmt=style,
                            elinewidth=0.5,
                            marker=STYLE_OF[scheme][1],
                            color=COLOURS[scheme],
                            ms=3,
                            label=f"{scheme}, D = B/{ratio}",
                        )
                plot.grid(alpha=0.25, lw=0.4)
            line[0].set_ylabel(label)
            _capped(line[0], survey, error, scale)
        for plot, surface in zip(plots[0], ("convex", "concave"), strict=True):
            plot.set_title(surface, fontsize=8)
        for plot in plots[1]:
            plot.set_xlabel("diameter B (mm)")
        handles, names = plots[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(survey.schemes))
        return figure


def _capped(plot: Any, survey: ErrorSurvey, error: str, scale: float) -> None:
    """Limit the axis so that ERS and fit are legible where the error of IRS is large."""
    shown = [survey.of(scheme, error) for scheme in survey.schemes if scheme != "irs"]
    most = max((float(np.nanmax(values)) for values in shown), default=np.nan) * scale
    if np.isfinite(most) and plot.get_ylim()[1] > 2 * most:
        plot.set_ylim(0, 1.8 * most)
        plot.annotate("IRS continues above", (0.02, 0.92), xycoords="axes fraction", fontsize=6)


def bars_picture(names: Sequence[str], values: dict[str, FloatArray], label: str) -> Figure:
    """Contributions of several quantities as bars, in the colours of `COLOURS`."""
    with new_figure(INCHES, 0.32 * len(names) + 0.8) as figure:
        plot = figure.subplots()
        at, thick = np.arange(len(names)), 0.8 / len(values)
        for k, (name, each) in enumerate(values.items()):
            where = at + (k - (len(values) - 1) / 2) * thick
            plot.barh(where, each, thick, color=COLOURS[name], label=name)
        plot.set_yticks(at, names)
        plot.invert_yaxis()
        plot.set_xlabel(label)
        plot.grid(axis="x", alpha=0.25, lw=0.4)
        plot.legend(fontsize=6)
        return figure


def frame_picture(frame: RenderedFrame) -> Figure:
    """A rendered frame as a negative, with rings at the true positions of its dots."""
    with new_figure(INCHES / 2, INCHES / 2 * frame.image.shape[0] / frame.image.shape[1]) as figure:
        plot = figure.subplots()
        low, high = np.percentile(frame.image, [1, 99.8])
        plot.imshow(frame.image, cmap="gray_r", vmin=low, vmax=max(high, low + 1))
        plot.plot(*frame.dot_px[frame.shown].T, "o", ms=6, mfc="none", mec="#1b4f8a", mew=0.5)
        plot.set(xlabel="u (px)", ylabel="v (px)")
        return figure
