"""The tables of `labapp lines`: lines, their points, features and states, surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.lines.frame import LineFrame
from labapp.core.lines.metal import PoolEdges
from labapp.core.lines.states import LineSeries, State, line_states
from labapp.core.lines.surface import LineSurface
from labapp.export.frame_result import FrameResult
from labapp.text import csv_text

LINE_COLUMNS = (
    "frame", "line", "number", "left_u_px", "left_v_px", "right_u_px", "right_v_px", "left_cut",
    "right_cut", "left_x_mm", "left_z_mm", "right_x_mm", "right_z_mm", "length_px", "width_px",
    "light", "gap_px", "folded",
)  # fmt: skip
POINT_COLUMNS = ("frame", "line", "u_px", "v_px", "sigma_px", "plane_x_mm", "plane_z_mm")
FEATURE_COLUMNS = (
    "frame", "time_s", "status", "state", "lines", "left_out", "plane_length_mm",
    "plane_width_mm", "plane_height_mm", "plane_area_mm2", "plane_spacing_mm",
    "plane_curvature_per_mm", "plane_asymmetry", "pool_height_mm",
    "pool_height_sigma_mm", "pool_width_mm", "pool_curvature_per_mm", "misfit", "margin",
    "setup_status", "pool_width_sigma_mm", "pool_curvature_sigma_per_mm",
    "numbered",
)  # fmt: skip
"""``plane_…`` are quantities of the lines on the imaging plane. ``pool_…_sigma_…`` do not include
the set-up, unlike ``…_sigma_mm`` of dots; ``setup_status`` is its reliability. ``numbered`` is 0 if
other numbers of the lines agree as well: the surface may lie elsewhere along Y."""
TRACK_COLUMNS = (
    "frame", "time_s", "pulse", "pulse_probability", "followed", "shift_px", "tilt_px", "bend_px",
    "agreeing_share",
)  # fmt: skip
EDGE_COLUMNS = ("frame", "line", "side", "x_mm", "y_mm", "sigma_mm")
SURFACE_COLUMNS = ("x_mm", "y_mm", "z_mm", "z_sigma_mm")
"""``z_sigma_mm`` does not include the set-up either."""

SPACING_MM = 0.1


class FrameOfLines(NamedTuple):
    """The lines of a frame that could be read."""

    frame: int
    time_s: float | None
    lines: LineFrame


def of_lines(results: Iterable[FrameResult]) -> list[FrameOfLines]:
    """Return the frames that could be read."""
    seen = ((one, one.measurement.lines) for one in results)
    return [FrameOfLines(one.frame, one.time_s, lines) for one, lines in seen if lines is not None]


def line_rows(frame: int, found: LineFrame, calibration: ImageCalibration) -> list[list[str]]:
    """Return rows of ``lines.csv``: one per line, from the lowest in the picture up."""
    rows = []
    numbers = _numbers(found)
    for k, one in enumerate(found.seen.lines):
        ends, plane = one.ends_px, calibration.to_plane(one.ends_px)
        rows.append(
            [
                *(str(frame), str(k + 1), numbers[k]),
                *(f"{value:.3f}" for value in ends.ravel()),
                *(str(int(cut)) for cut in one.cut),
                *(f"{value:.4f}" for value in plane.ravel()),
                *(f"{value:.2f}" for value in (one.length_px, one.width_px, one.light)),
                f"{one.gap_px:.1f}",
                str(int(one.folded)),
            ]
        )
    return rows


def _numbers(found: LineFrame) -> list[str]:
    """Return the number of each line in the pattern; empty if undetermined."""
    lines = found.seen.lines
    if found.status != "ok" or found.surface is None or not found.surface.numbered:
        return [""] * len(lines)
    known = iter(found.surface.numbers.tolist())
    return ["" if one.folded else str(next(known)) for one in lines]


def point_rows(frame: int, found: LineFrame, calibration: ImageCalibration) -> list[list[str]]:
    """Return rows of ``line_points.csv``: the ridge of each line at about every pixel."""
    rows = []
    for k, one in enumerate(found.seen.lines):
        plane = calibration.to_plane(one.image_px)
        for place, sigma, on in zip(one.image_px, one.sigma_px, plane, strict=True):
            values = (*place, sigma, *on)
            rows.append([str(frame), str(k + 1), *(f"{value:.4f}" for value in values)])
    return rows


def feature_rows(
    frames: Sequence[FrameOfLines], states: Sequence[State], setup_status: str
) -> list[list[str]]:
    """Return rows of ``features.csv``: one per frame."""
    rows = []
    for (frame, time_s, one), state in zip(frames, states, strict=True):
        seen = one.features
        surface = one.surface if one.status == "ok" else None
        measured: tuple[float, ...] = (np.nan,) * 6
        sigma: tuple[float, ...] = (np.nan,) * 2
        if surface is not None:
            sigma = surface.width_sigma_mm, surface.curvature_sigma_per_mm
            measured = (
                *(surface.height_mm, surface.height_sigma_mm, surface.width_mm),
                *(surface.curvature_per_mm, surface.misfit, surface.margin),
            )
        rows.append(
            [
                *(str(frame), _cell(time_s), one.status, state, str(seen.count)),
                str(one.seen.left_out),
                *map(_cell, (seen.length_mm, seen.width_mm, seen.height_mm, seen.area_mm2)),
                *map(_cell, (seen.spacing_mm, seen.curvature_per_mm, seen.asymmetry)),
                *map(_cell, measured),
                setup_status,
                *map(_cell, sigma),
                "" if surface is None else str(int(surface.numbered)),
            ]
        )
    return rows


def track_rows(frames: Sequence[FrameOfLines]) -> list[list[str]]:
    """Return rows of ``track.csv``: one per frame of a followed line."""
    rows = []
    for frame, time_s, one in frames:
        line = one.track
        shape = (
            [""] * 4
            if line is None
            else [_cell(x) for x in (line.shift_px, line.tilt_px, line.bend_px, line.share)]
        )
        state = "on" if one.status == "pulse" else "off"
        followed = str(int(line is not None))
        rows.append([str(frame), _cell(time_s), state, f"{one.pulse:.4f}", followed, *shape])
    return rows


def edge_rows(frame: int, edges: PoolEdges) -> list[list[str]]:
    """Return rows of ``edges.csv``: one per line end on the solid metal."""
    ends = zip(edges.line, edges.side, edges.point_mm, edges.sigma_mm, strict=True)
    return [
        [str(frame), str(line), str(side), *(f"{value:.4f}" for value in (*place, sigma))]
        for line, side, place, sigma in ends
    ]


def surface_rows(surface: LineSurface) -> list[list[str]]:
    """Return rows of ``surface_NNNNNN.csv``: nodes between lines, on the pool's side of z = 0."""
    low, high = surface.point_mm[:, :2].min(axis=0), surface.point_mm[:, :2].max(axis=0)
    x, y = np.meshgrid(*(np.arange(a, b, SPACING_MM) for a, b in zip(low, high, strict=True)))
    x, y = x.ravel(), y.ravel()
    z = surface.surface.height(x, y)
    inside = np.isfinite(z) & (z * np.sign(surface.height_mm) >= 0)
    x, y, z = x[inside], y[inside], z[inside]
    sigma = surface.sigma_mm(x, y)
    return [
        [f"{a:.3f}", f"{b:.3f}", f"{c:.5f}", f"{d:.5f}"]
        for a, b, c, d in zip(x, y, z, sigma, strict=True)
    ]


def _cell(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.5f}"


def line_tables(
    frames: Sequence[FrameOfLines], calibration: ImageCalibration, setup_status: str
) -> dict[str, str]:
    """Return all tables of a recording's frames as CSV text, by file name."""
    numbered = [(one.frame, one.lines) for one in frames]
    states = line_states(LineSeries.of([one for _, one in numbered]))
    features = feature_rows(frames, states, setup_status)
    lines = [row for k, one in numbered for row in line_rows(k, one, calibration)]
    points = [row for k, one in numbered for row in point_rows(k, one, calibration)]
    tables = {
        "features.csv": csv_text([FEATURE_COLUMNS, *features]),
        "lines.csv": csv_text([LINE_COLUMNS, *lines]),
        "line_points.csv": csv_text([POINT_COLUMNS, *points]),
    }
    if any(np.isfinite(one.pulse) for _, one in numbered):
        tables["track.csv"] = csv_text([TRACK_COLUMNS, *track_rows(frames)])
    edges = [row for k, one in numbered if one.edges for row in edge_rows(k, one.edges)]
    if edges:
        tables["edges.csv"] = csv_text([EDGE_COLUMNS, *edges])
    for k, one in numbered:
        if one.status == "ok" and one.surface is not None:
            text = csv_text([SURFACE_COLUMNS, *surface_rows(one.surface)])
            tables[f"surface_{k:06d}.csv"] = text
    return tables
