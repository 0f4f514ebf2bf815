"""Results in the report: sizes and trends, an example frame, error budget, corrections."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from labapp.config.setup import parse_setup
from labapp.core.pipeline import Measurement
from labapp.core.surface.measures import sigma_name
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.session.report import data, figures
from labapp.session.report.data import FrameLine, ReportData
from labapp.session.report.layout import Story
from labapp.studies.measured_budget import measured_budget
from labapp.text import SIGMA_OF

LATEST_CHANGES = 40
"""Number of latest changes that are listed."""

NOT_COVERED = (
    "Not included: deviations of the pool from a mirror and of the imaging plane from a diffuse, "
    "flat one; a wrong correspondence (shifted by a row or a column); the length of the "
    "calibration target's unit; motion of the pool during the exposure. Quantities are varied one "
    "by one, to first order."
)


def add_results(story: Story, report: ReportData) -> None:
    """Add the results: outcomes, means, trends, every frame."""
    story.heading("4  Results")
    lines = report.lines
    if not lines:
        story.text("There are no frames: nothing was measured.")
        return
    counted = [line for line in lines if line.counts]
    story.text(
        f"{len(lines)} frames, scheme {report.scheme}: {len(counted)} with a current surface. "
        "Means do not include stale results, whose calibrations, settings or corrections were "
        "changed since."
    )
    story.table("Outcomes of the frames.", data.status_cells(lines), "llrl", (0.2, 0.4, 0.1, 0.3))
    if counted:
        story.table(
            f"Sizes over the {len(counted)} frames in the mean. Standard deviation: root of the "
            "variance of Eq. 7-2 … 7-4 (divided by the number of frames). ±: standard uncertainty "
            f"of the mean, and the median of each frame's ({SIGMA_OF}): level errors of frames "
            "with the same outline are correlated. –: the scheme gives none.",
            data.statistics_cells(lines),
            "lrrrrrrrr",
            (0.19, 0.09, *[0.102] * 7),
        )
        if report.setup is not None:
            story.text(report.session.setup_words)
        _trends(story, lines)
    elif any(line.status for line in lines):
        story.text("No frame has a current surface, so there is no mean.")
    else:
        story.text("Nothing was measured yet.")
        return
    if by_rows := data.rows_sentence(lines):
        story.text(by_rows)
    more = len(lines) > data.ALL_FRAMES
    story.table(
        "Frame by frame, mm and mm³"
        + ("; all frames are in measures.csv of an export." if more else "."),
        data.frame_cells(lines),
        "rrrrrrrrl",
        (0.08, 0.1, 0.07, 0.11, 0.11, 0.11, 0.11, 0.11, 0.2),
    )


def _trends(story: Story, lines: list[FrameLine]) -> None:
    if sum(line.measures is not None for line in lines) < 2:
        return
    times = np.array([line.time_s for line in lines])
    timed = bool(np.isfinite(times).all())
    axis = times if timed else np.array([float(line.frame) for line in lines])
    label = "time (s)" if timed else "frame"
    concave = abs(data.values(lines, "depth_mm").mean()) > abs(
        data.values(lines, "height_mm").mean()
    )
    peak = "depth_mm" if concave else "height_mm"
    series = [
        figures.Series(data.STATISTICS[name][0], _each(lines, name), _each(lines, sigma_name(name)))
        for name in ("width_mm", "length_mm", peak, "volume_mm3", "are_mm")
    ]
    states = [line.state for line in lines]
    story.figure(
        f"Sizes over time with ± one σ of each frame ({SIGMA_OF}); dotted: mean. Doubtful: the "
        f"residual of another correspondence is within a factor of {data.DOUBTFUL_MARGIN:g}; "
        "stale: inputs were changed since, not in the mean.",
        figures.trends(axis, label, series, states),
    )
    counts = np.array([[line.counts] for line in lines])
    places = {
        name: np.where(
            counts,
            np.column_stack([_each(lines, f"{key}_x_mm"), _each(lines, f"{key}_y_mm")]),
            np.nan,
        )
        for name, key in (
            ("centre of the pool", "center"),
            ("farthest from the work piece", "peak"),
        )
    }
    story.figure(
        "Position of the pool's centre and of its highest (concave: lowest) point.",
        figures.positions(axis, label, places),
    )


def _each(lines: Sequence[FrameLine], name: str) -> FloatArray:
    return np.array([line.size(name) for line in lines])


def add_example(story: Story, report: ReportData) -> None:
    """Add pictures of one frame: that of median height, else the first with dots."""
    line = data.representative(report.lines) or next((x for x in report.lines if x.dots), None)
    if line is None:
        return
    result = report.session.result(line.frame, report.scheme)
    assert result is not None
    found = result.measurement
    if line.counts:
        story.part(f"Frame {line.frame}: its height (concave: depth) is nearest to the median")
    else:
        why = "; ".join(line.stale) or line.status
        story.part(f"Frame {line.frame}: the first with dots, not in the mean ({why})")
    _dots(story, report, line.frame, found)
    if found.reconstruction is not None and found.measures is not None:
        story.figure(
            f"Frame {line.frame}: height above the work piece. Black: boundary; white: reflection "
            "points; cross: centre; triangle: point farthest from the work piece. "
            "The electrode is above X = Y = 0.",
            figures.height_map(found),
        )
        own = found.measures.own_are_mm
        story.figure(
            f"Frame {line.frame}: captured reflected dots and those computed from the surface, "
            f"on the imaging plane; mapped onto the work piece ARE {found.measures.are_mm:.4f} mm, "
            f"MRE {found.measures.mre_mm:.4f} mm"
            + (f"; ARE of the scheme's own points {own:.4f} mm." if math.isfinite(own) else "."),
            figures.dots_compared(found),
        )


def _dots(story: Story, report: ReportData, frame: int, found: Measurement) -> None:
    missing = ""
    try:
        image = report.session.frame(frame).image
    except InputError:
        image, missing = None, " The frame itself cannot be read."
    story.figure(
        f"Frame {frame}, as a negative, with its {0 if found.dots is None else len(found.dots)} "
        "dots. Left: row i of the ray; above a dot: its column j; grey ring: no ray." + missing,
        figures.dots_picture(image, found),
    )


def add_budget(story: Story, report: ReportData) -> None:
    """Add the error budget of the frame of median height."""
    story.heading("5  Error budget")
    line = data.representative(report.lines)
    if line is None:
        story.text("No frame has a current surface, so there is none.")
        return
    session = report.session
    result = session.result(line.frame, report.scheme)
    assert result is not None
    setup = parse_setup(result.setup, session.path)
    contributions = measured_budget(result.measurement, setup, result.settings)
    story.table(
        f"Effect of each ± (one σ) on the sizes. Set-up: frame {line.frame}, measured again with "
        "the quantity changed by its ± in either direction, for the same correspondence. *: no ± "
        "was given; a usual one is assumed. The last row includes correlations.",
        data.budget_cells(report.lines, contributions, setup.rig),
        "lrrrrrrr",
        (0.31, 0.1, *[0.0983] * 6),
    )
    if not len(data.values(report.lines, "height_sigma_mm")):
        story.text(f"The scheme {report.scheme} gives no ± of its own: it is not in the total.")
    if any(np.isnan(one.change).any() for one in contributions):
        story.text("–: no surface was found with the changed quantity; not in the total.")
    story.text(
        "It covers the noise of the dots' centres, the level of the work piece if the scheme "
        "estimates it, and the positions of laser, imaging plane and camera. " + NOT_COVERED
    )


def add_corrections(story: Story, report: ReportData) -> None:
    """Add manual corrections and the session's history."""
    story.heading("6  Corrections by hand, and history")
    cells = data.corrections_cells(report.session, [line.frame for line in report.lines])
    if len(cells) > 1:
        story.table(
            "Frames whose dots and rows were corrected by hand.",
            cells,
            "rrrl",
            (0.1, 0.1, 0.2, 0.6),
        )
    else:
        story.text("No dots or rows were corrected by hand.")
    history = report.session.history
    if not history:
        story.text("No change is in the history.")
        return
    earlier = len(history) - LATEST_CHANGES
    story.table(
        "Changes of the record, the set-up, the settings, calibrations and corrections"
        + (f"; the newest {LATEST_CHANGES} of {len(history)}." if earlier > 0 else "."),
        [
            ["no.", "made", "change", ""],
            *(
                [
                    str(change.number),
                    change.made.replace("T", " "),
                    change.label,
                    "undone" if change.undone else "",
                ]
                for change in history[-LATEST_CHANGES:]
            ),
        ],
        "rlll",
        (0.08, 0.3, 0.5, 0.12),
    )
