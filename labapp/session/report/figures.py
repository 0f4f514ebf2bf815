"""Figures of the report, as PNG: black on white, lengths in mm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.pipeline import Measurement
from labapp.core.surface.mesh import surface_mesh
from labapp.core.values import FloatArray
from labapp.export.meshes import drawn_spacing
from labapp.media import GreyImage
from labapp.session.report.layout import DPI
from labapp.simulation import positioning
from labapp.simulation.positioning import SideView
from labapp.studies.plotting import INCHES, as_bytes, new_figure, row_colour
from labapp.studies.side_picture import draw_side

STATES = {
    "measured": {"marker": "o", "color": "#1b4f8a", "markerfacecolor": "#1b4f8a"},
    "corrected by hand": {"marker": "s", "color": "#1b7a3d", "markerfacecolor": "#1b7a3d"},
    "doubtful": {"marker": "o", "color": "#c05a00", "markerfacecolor": "white"},
    "stale": {"marker": "x", "color": "0.6", "markerfacecolor": "0.6"},
}
"""Markers of frames over time; they differ by shape as well as colour."""


@dataclass(frozen=True)
class Series:
    """A size over n frames."""

    label: str
    values: FloatArray
    sigma: FloatArray
    """Values and their σ, shape (n,); NaN if unknown."""


def side_view(rig: Rig, pool_mm: tuple[float, float, float]) -> bytes:
    """Draw the rig from the side, to scale, with a pool of (width, length, height), mm."""
    width, length, height = pool_mm
    possible = abs(height) < width / 2
    view = positioning.side_view(rig, width, length, height if possible else 0.0)
    ends = np.array([*view.plane_mm, view.laser_mm])
    low, high = ends[:, 0].min() - 8, view.laser_mm[0] + 12
    floor, roof = -9.0, max(ends[:, 1].max(), 3 * view.tip_mm[1]) + 7
    with new_figure(INCHES, min(INCHES * (roof - floor) / (high - low) + 0.45, 4.5)) as figure:
        plot = figure.subplots()
        plot.axhspan(floor, 0, color="0.9", lw=0)
        draw_side(plot, view, roof)
        _label_rig(plot, rig, view)
        plot.set(xlim=(low, high), ylim=(floor, roof), xlabel="Y, along the weld (mm)")
        figure.legend(loc="outside upper right", ncols=2, frameon=False, fontsize=7)
        return as_bytes(figure, dpi=DPI)


def _label_rig(plot: Any, rig: Rig, view: SideView) -> None:
    laser, (origin, top) = view.laser_mm, view.plane_mm
    angle = rig.laser.projection_angle_deg
    plot.annotate("laser", laser, (6, 4), textcoords="offset points")
    plot.annotate("imaging plane", top, (-6, 4), textcoords="offset points")
    plot.annotate("O′", origin, (-4, 0), textcoords="offset points", ha="right")
    torch = (1.2, max(view.tip_mm[1] + 5, 0.55 * top[1]))
    plot.annotate("torch", torch, (5, 0), textcoords="offset points")
    plot.annotate("pool", (0, 0), (0, -11), textcoords="offset points", ha="center")
    reach = 0.42 * rig.laser.distance_mm
    arc = np.radians(np.linspace(0, angle, 40))
    plot.plot(reach * np.cos(arc), reach * np.sin(arc), "k", lw=0.6)
    half = np.radians(angle / 2)
    at = (reach * np.cos(half), reach * np.sin(half))
    plot.annotate(f"α = {angle:.4g}°", at, (5, -3), textcoords="offset points")
    along = laser * 0.72
    plot.annotate(
        f"{rig.laser.distance_mm:.4g} mm", along, (-3, 5), textcoords="offset points", ha="right"
    )
    arrow = {"arrowstyle": "<->", "lw": 0.6, "color": "0.3"}
    plot.annotate("", (0, -6), (origin[0], -6), arrowprops=arrow)
    plot.annotate(f"{-origin[0]:.4g} mm", (origin[0] / 2, -5.6), ha="center", va="bottom")


def target_picture(image: GreyImage, points_px: Sequence[Sequence[float]]) -> bytes:
    """Draw the calibration picture with O′ and both axes."""
    origin, *ends = (np.array(point) for point in points_px)
    tips = [origin + 1.25 * (end - origin) for end in ends]
    corners = np.array([origin, *tips])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.2 * np.ptp(corners, axis=0).max()
    box = np.clip([low - margin, high + margin], -0.5, np.array(image.shape[::-1]) - 0.5)
    wide, tall = box[1] - box[0]
    with new_figure(INCHES * 0.85, float(np.clip(INCHES * 0.8 * tall / wide, 1.5, 4.5))) as figure:
        view = figure.subplots()
        view.imshow(image, cmap="gray", interpolation="antialiased")
        for name, end, tip, colour in zip(
            ("X′", "Z′"), ends, tips, ("#ff5a36", "#45a5ff"), strict=True
        ):
            arrow = {"arrowstyle": "->", "color": colour, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
            view.annotate("", tip, origin, arrowprops=arrow)
            view.plot(*end, "x", color=colour, ms=8, mew=1.6)
            at = tip + 0.08 * (end - origin)
            view.text(*at, name, color=colour, ha="center", va="center", fontsize=9)
        view.plot(*origin, "o", color="#50e070", ms=11, mfc="none", mew=1.4)
        view.annotate(
            "O′",
            origin,
            (-9, -9),
            textcoords="offset points",
            color="#50e070",
            ha="right",
            va="top",
        )
        view.set(xlim=box[:, 0], ylim=box[::-1, 1], xlabel="u (px)", ylabel="v (px)")
        return as_bytes(figure, dpi=DPI)


def trends(axis: FloatArray, label: str, series: list[Series], states: list[str]) -> bytes:
    """Plot sizes over time, one panel each, with ± one σ; markers show the state of each frame.

    Parameters
    ----------
    axis, label
        Time or number of each frame, shape (n,), and the label of the axis.
    states
        State of each frame; frames with states other than `STATES` are not drawn.
    """
    with new_figure(INCHES, 1.2 * len(series) + 0.4) as figure:
        plots = figure.subplots(len(series), sharex=True, squeeze=False)[:, 0]
        for plot, one in zip(plots, series, strict=True):
            _draw_trend(plot, axis, one, states)
        plots[-1].set_xlabel(label)
        handles, names = plots[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper right", ncols=len(names), frameon=False)
        return as_bytes(figure, dpi=DPI)


def _draw_trend(plot: Any, axis: FloatArray, series: Series, states: list[str]) -> None:
    kept = np.array([state in STATES and state != "stale" for state in states], bool)
    line = np.where(kept, series.values, np.nan)
    plot.plot(axis, line, "-", color="0.75", lw=0.7, zorder=1)
    mean = np.nanmean(line) if np.isfinite(line).any() else np.nan
    plot.axhline(mean, color="0.4", lw=0.6, ls=":", zorder=1)
    for state, look in STATES.items():
        chosen = np.array([s == state for s in states], bool)
        if not chosen.any():
            continue
        plot.errorbar(
            axis[chosen],
            series.values[chosen],
            np.nan_to_num(series.sigma[chosen]),
            ls="none",
            ms=3.2,
            elinewidth=0.7,
            label=state,
            **look,
        )
    plot.set_ylabel(series.label)
    plot.grid(alpha=0.25, lw=0.4)


def dots_picture(image: GreyImage | None, measurement: Measurement) -> bytes:
    """Draw a frame as a negative with its dots circled, coloured by row of rays.

    Parameters
    ----------
    image
        The frame; None if it cannot be read: only the dots are drawn.
    measurement
        Its measurement, with dots.
    """
    dots, match = measurement.dots, measurement.match
    assert dots is not None
    u, v = dots.image_px.T
    box = (u.min() - 45, u.max() + 25, v.max() + 18, v.min() - 22)
    tall = INCHES * (box[2] - box[3]) / (box[1] - box[0])
    with new_figure(INCHES, float(np.clip(tall + 0.3, 1.5, 5.0))) as figure:
        view = figure.subplots()
        if image is not None:
            low, high = np.percentile(image, [1, 99.8])
            view.imshow(image, cmap="gray_r", vmin=low, vmax=max(high, low + 1e-9))
        rays = {} if match is None else dict(zip(match.dot, match.ray, strict=True))
        first: dict[int, tuple[float, float]] = {}
        for k, (x, y) in enumerate(dots.image_px):
            ray = rays.get(k)
            colour = "0.6" if ray is None else row_colour(int(ray[0]))
            view.plot(x, y, "o", ms=6.5, mfc="none", mec=colour, mew=0.8)
            if ray is None:
                continue
            at = {"textcoords": "offset points", "color": colour, "fontsize": 4.5}
            view.annotate(str(ray[1]), (x, y), (0, 4.2), ha="center", **at)
            first[int(ray[0])] = min(first.get(int(ray[0]), (x, y)), (x, y))
        for row, place in first.items():
            at = {"textcoords": "offset points", "color": row_colour(row), "fontsize": 5.5}
            view.annotate(f"row {row}", place, (-6, 0), ha="right", va="center", **at)
        view.set(xlim=box[:2], ylim=box[2:], aspect="equal", xlabel="u (px)", ylabel="v (px)")
        return as_bytes(figure, dpi=DPI)


def height_map(measurement: Measurement) -> bytes:
    """Draw the surface from above: height, boundary, reflection points, centre and peak."""
    found, size = measurement.reconstruction, measurement.measures
    assert found is not None
    assert size is not None
    vertices, triangles = surface_mesh(found, drawn_spacing(found, 0.1))
    # An interpolating surface may not extend to the boundary everywhere.
    triangles = triangles[np.isfinite(vertices[triangles]).all(axis=(1, 2))]
    x, y, z = np.nan_to_num(vertices).T
    outline = np.vstack([found.boundary.points_mm, found.boundary.points_mm[:1]])
    wide = INCHES * 0.55
    ratio = np.ptp(outline[:, 1]) / np.ptp(outline[:, 0])
    with new_figure(wide, float(np.clip((wide - 1.1) * ratio + 0.5, 2.0, 3.3))) as figure:
        view = figure.subplots()
        flat = np.ptp(z) < 1e-6
        levels = [z.min() - 1e-3, z.max() + 1e-3] if flat else 14
        heights = view.tricontourf(x, y, triangles, z, levels=levels, cmap="viridis")
        view.plot(outline[:, 0], outline[:, 1], "k", lw=1)
        points = found.points_mm
        view.plot(points[:, 0], points[:, 1], "o", ms=2.2, mfc="white", mec="k", mew=0.3)
        view.plot(size.center_x_mm, size.center_y_mm, "k+", ms=8, mew=1.1)
        view.plot(size.peak_x_mm, size.peak_y_mm, "^", color="#d02020", ms=5)
        view.set(aspect="equal", xlabel="X (mm)", ylabel="Y, along the weld (mm)")
        figure.colorbar(heights, ax=view, label="height (mm)", shrink=0.85)
        return as_bytes(figure, dpi=DPI)


def dots_compared(measurement: Measurement) -> bytes:
    """Draw captured and computed reflected dots on the imaging plane."""
    found, match = measurement.reconstruction, measurement.match
    assert found is not None
    assert match is not None
    seen = match.plane_mm
    computed = seen + found.residual_mm
    tall = 1.0 if not len(seen) else np.ptp(seen[:, 1]) / max(np.ptp(seen[:, 0]), 1e-9)
    with new_figure(INCHES * 0.8, float(np.clip(INCHES * 0.8 * tall + 0.6, 1.6, 5.0))) as figure:
        view = figure.subplots()
        view.plot(*seen.T, "o", ms=5, mfc="none", mec="k", mew=0.7, label="captured")
        view.plot(*computed.T, "x", ms=4, color="#c01030", mew=0.8, label="computed")
        view.set(aspect="equal", xlabel="X′ (mm)", ylabel="Z′ (mm)")
        figure.legend(loc="outside upper right", ncols=2, frameon=False)
        return as_bytes(figure, dpi=DPI)


def positions(axis: FloatArray, label: str, places: Mapping[str, FloatArray]) -> bytes:
    """Plot the pool's centre and peak over time, X above Y (Fig. 7-15)."""
    with new_figure(INCHES, 2.3) as figure:
        plots = figure.subplots(2, sharex=True)
        for (name, place), look in zip(places.items(), ("k+-", "r^-"), strict=True):
            for plot, values in zip(plots, place.T, strict=True):
                plot.plot(axis, values, look, ms=4, lw=0.5, mew=0.8, label=name)
        for plot, name in zip(plots, "XY", strict=True):
            plot.set_ylabel(f"{name} (mm)")
            plot.grid(alpha=0.25, lw=0.4)
        plots[-1].set_xlabel(label)
        handles, names = plots[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper right", ncols=2, frameon=False)
        return as_bytes(figure, dpi=DPI)
