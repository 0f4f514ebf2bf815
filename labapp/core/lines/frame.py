"""Measurement of one frame of a line pattern: lines, their features and the fitted surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.line_pattern import LineRig
from labapp.core.images.dots import Image
from labapp.core.lines.correction import LineCorrection
from labapp.core.lines.data import line_data
from labapp.core.lines.detection.find_lines import LightLine, find_lines
from labapp.core.lines.detection.numbering import LinesSeen, number_lines
from labapp.core.lines.fit import fit_lines
from labapp.core.lines.metal import PoolEdges, pool_edges, without_metal
from labapp.core.lines.surface import LineSurface
from labapp.core.lines.track import TrackedLine
from labapp.core.values import CannotMeasure, FloatArray, IntArray

FOLDED = "the pool gathers the lines to points: they show how many they are, and no shape"

FOLLOWED = {
    "pulse": "a pulse of the current outshines the line",
    "line-lost": "the line is not where it is expected",
}
"""Reasons why the line of a one-line pattern was not measured in a frame."""

UNNUMBERED = "the lines, or the numbers given by hand, are not those of neighbours in the pattern"


@dataclass(frozen=True)
class LineFeatures:
    """Features of a frame's lines on the imaging plane.

    Parameters
    ----------
    count
        Number of the pattern's lines that are visible: the pool's size in units of the line spacing
        (Fig. 3-14: from five to four as the pool shrinks).
    length_mm
        Total length of all lines.
    width_mm, height_mm
        Extent of the lines along X′ and Z′.
    area_mm2
        Area between the lowest and the highest line.
    spacing_mm
        Mean distance of neighbouring lines at their middles.
    curvature_per_mm
        Median of the lines' curvature at their middles, positive if they are arched upwards.
    asymmetry
        Mean asymmetry of the lines about their highest points: (right − left)/(right + left) of
        their extents along X′.
    """

    count: int
    length_mm: float = 0.0
    width_mm: float = 0.0
    height_mm: float = 0.0
    area_mm2: float = 0.0
    spacing_mm: float = float("nan")
    curvature_per_mm: float = float("nan")
    asymmetry: float = float("nan")


@dataclass(frozen=True)
class LineFrame:
    """Results of a frame of a line pattern.

    Parameters
    ----------
    status
        ``ok``; ``profile`` if the lines do not fully determine the surface; ``no-lines``,
        ``folded-lines``, ``too-few-lines``, ``line-numbers``, ``no-surface``. For a tracked single
        line: ``followed``, ``pulse``, ``line-lost``.
    reason
        One sentence if there is no surface; empty otherwise.
    surface
        The fitted surface; a measurement only if the status is ``ok``.
    track, pulse
        For a pattern of one line: the tracked line, or None; and the probability that a current
        pulse is on, NaN for other patterns.
    edges
        Points of the pool's edge from lines reflected by the solid metal beside it; or None.
    """

    status: str
    reason: str
    seen: LinesSeen
    features: LineFeatures
    surface: LineSurface | None
    track: TrackedLine | None = None
    pulse: float = float("nan")
    edges: PoolEdges | None = None

    @classmethod
    def of_track(cls, track: TrackedLine | None, on: bool, pulse: float) -> LineFrame:
        """Result of a frame with a tracked single line; ``on``: a pulse outshines it."""
        status = "pulse" if on else "line-lost" if track is None else "followed"
        reason = FOLLOWED.get(status, "")
        nothing = LinesSeen((), False, False, 0)
        features = LineFeatures(0 if track is None else 1)
        return cls(status, reason, nothing, features, None, track, pulse)


def measure_lines(
    image: Image,
    rig: LineRig,
    calibration: ImageCalibration,
    correction: LineCorrection | None = None,
) -> LineFrame:
    """Measure one grey frame, shape (height, width), of a line pattern.

    A ``correction`` replaces the detected lines.
    """
    count = rig.pattern.count
    edges = pool_edges(image, rig, calibration)
    if correction is None:
        lines = find_lines(image)
        if edges is not None:
            lines = without_metal(lines, edges, rig, calibration)
        correction = LineCorrection.of(number_lines(lines, count))
    found = _measured(correction, rig, calibration)
    return replace(found, edges=edges)


def _measured(correction: LineCorrection, rig: LineRig, calibration: ImageCalibration) -> LineFrame:
    """Determine the features of the lines and fit the surface."""
    count, seen = rig.pattern.count, correction.seen
    features = line_features(seen.lines, calibration)
    if not seen.lines:
        return LineFrame("no-lines", "no line stands out of the noise", seen, features, None)
    open_lines = [k for k, one in enumerate(seen.lines) if not one.folded]
    if len(open_lines) < len(seen.lines) / 2:
        return LineFrame("folded-lines", FOLDED, seen, features, None)
    data = line_data(tuple(seen.lines[k] for k in open_lines), calibration)
    numberings = [each[open_lines] for each in _numberings(seen, correction.number, count)]
    if not numberings:
        return LineFrame("line-numbers", UNNUMBERED, seen, features, None)
    try:
        surface = fit_lines(data, numberings, rig)
    except CannotMeasure as problem:
        return LineFrame(problem.status, problem.reason, seen, features, None)
    open_ = "" if surface.status == "ok" else "the lines leave a direction of the surface open"
    return LineFrame(surface.status, open_, seen, features, surface)


def _numberings(seen: LinesSeen, by_hand: IntArray, count: int) -> list[FloatArray]:
    """Possible numbers of the lines, from the lowest up, in increasing or decreasing order."""
    if by_hand.all():
        return [by_hand.astype(float)]
    given = by_hand > 0
    same = given[1:] & (np.diff(by_hand) == 0)  # pieces of one line
    pieces = np.concatenate([[0], np.cumsum(~same)])
    runs = [
        (first + sign * steps).astype(float)
        for steps in ([pieces] if same.any() else seen.steps(count))
        for sign in (1, -1)
        for first in (
            range(1, count + 1)
            if given.any()
            else seen.first_numbers(count, int(steps[-1]) + 1, same_order=sign > 0)
        )
    ]
    return [
        run
        for run in runs
        if run.min() >= 1 and run.max() <= count and (run == by_hand)[given].all()
    ]


def line_features(lines: tuple[LightLine, ...], calibration: ImageCalibration) -> LineFeatures:
    """Return the features of lines, from the lowest up, on the imaging plane."""
    if not lines:
        return LineFeatures(0)
    places = [calibration.to_plane(one.image_px) for one in lines]
    every = np.concatenate(places)
    width, height = np.ptp(every, axis=0)
    middles = np.array([each[len(each) // 2] for each in places])
    spacing = np.linalg.norm(np.diff(middles, axis=0), axis=-1)
    scale = float(np.sqrt(np.abs(np.linalg.det(calibration.jacobian(lines[0].image_px[:1])[0]))))
    bends = [one.curvature[len(one.curvature) // 2] / scale for one in lines]
    return LineFeatures(
        count=len(lines),
        length_mm=float(sum(np.linalg.norm(np.diff(p, axis=0), axis=-1).sum() for p in places)),
        width_mm=float(width),
        height_mm=float(height),
        area_mm2=_area_between(places[0], places[-1]) if len(lines) > 1 else 0.0,
        spacing_mm=float(spacing.mean()) if len(spacing) else float("nan"),
        curvature_per_mm=float(np.median(bends)),
        asymmetry=float(np.mean([_asymmetry(each) for each in places])),
    )


def _area_between(low: FloatArray, high: FloatArray) -> float:
    """Area of the polygon between two lines, mm²."""
    x, z = np.concatenate([low, high[::-1]]).T
    return float(abs(np.sum(x * np.roll(z, -1) - z * np.roll(x, -1))) / 2)


def _asymmetry(place: FloatArray) -> float:
    x = place[:, 0]
    top = x[int(np.argmax(place[:, 1]))]
    right, left = x.max() - top, top - x.min()
    return float((right - left) / max(right + left, 1e-9))
