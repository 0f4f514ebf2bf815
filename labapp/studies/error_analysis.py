"""Errors of the schemes on surfaces of known shape (ch. 8).

Non-optimal configuration error CE (§8.3.1), system limitation error LE (§8.3.2) and
reconstruction methodology error ME (§8.3.3): exact reflections of known caps are reconstructed
with known rig and correspondence, so that only configuration, pattern and scheme cause errors. As
in the text, no ray is blocked, every reflection is followed to the plane even if it would meet the
pool a second time, and the boundary model of IRS and ERS is the circle.

Caps exactly under the centre of the pattern are a special case: slopes are 0 there, and Eq. 6-1
uses the sign of a slope. Therefore the caps are slightly shifted, as on a real bench.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labapp.core.geometry.rig import DotPattern, Laser, Rig
from labapp.core.match import Match
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.measures import Measures, measure_surface
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.simulation.forward import PoolSurface, Reflections, exact_match, trace
from labapp.simulation.parallel import Progress, in_parallel
from labapp.simulation.pools import Pool, caps_8_3_1
from labapp.studies import SCHEME_NAMES
from labapp.studies.correspondence_table import OPEN_BENCH
from labapp.studies.tables import Cell, Table

ERRORS = ("depth", "boundary", "are_mm", "actual_are_mm")
"""CE-D, CE-B (Eq. 8-2, 8-3), computed and actual ARE (Eq. 6-3, 8-4)."""

ANGLES_DEG, DISTANCES_MM = (25.0, 35.0), (25.0, 35.0)
"""Ranges of the laser's positions in §8.3.2."""

OFF_CENTRE_MM = 0.1
"""Maximum distance of the caps' centres from the origin in X and Y: a fifth of the dot spacing."""

CENTERS = {"CE": 5, "LE": 1, "ME": 1}
"""Number of centres of each cap."""

DENSE = DotPattern(39, 39, 0.385)
"""The pattern of §8.3.3."""

TEXT = {
    ("CE", "D", "convex"): (None, 0.1085),
    ("CE", "D", "concave"): (None, 0.269),
    ("CE", "D", "all"): (0.080025, 0.269),
    ("CE", "B", "all"): (None, 0.0251),
    ("LE", "D", "all"): (None, 0.006),
    ("LE", "B", "all"): (None, 0.001),
    ("ME", "D", "all"): (None, 0.0),
    ("ME", "B", "all"): (None, 0.0),
}
"""Mean and worst error in the text, with ERS (Fig. 8-6, 8-8, 8-10)."""


def circle_settings(scheme: str) -> Settings:
    """Settings with the circle as boundary model (§8.2.1); fit uses its own boundary."""
    settings = Settings(scheme=scheme)
    own: Any = getattr(settings, scheme, None)
    if not hasattr(own, "boundary"):
        return settings
    with_circle: dict[str, Any] = {scheme: replace(own, boundary="circle")}
    return replace(settings, **with_circle)


def trace_once(pool: PoolSurface, rig: Rig) -> Reflections:
    """Reflections as computed in the text: without second reflections on the pool."""
    seen = trace(pool, rig)
    return replace(seen, hits_again=np.zeros_like(seen.hits_again))


def relative_errors(measures: Measures, cap: Pool) -> tuple[float, float]:
    """Relative error of depth (or height) and of diameter, signed (Eq. 8-2, 8-3)."""
    depth = measures.height_mm if cap.peak_mm > 0 else -measures.depth_mm
    diameter = (measures.width_mm + measures.length_mm) / 2
    return depth / abs(cap.peak_mm) - 1, diameter / cap.footprint.width_mm - 1


def computed_are(measures: Measures) -> float:
    """Computed ARE as in the text, mm; for IRS and ERS that of their own points."""
    own = measures.own_are_mm
    return own if np.isfinite(own) else measures.are_mm


def scheme_errors(match: Match, rig: Rig, cap: Pool, scheme: str) -> tuple[float, float, float]:
    """`relative_errors` and `computed_are` of a reconstruction; or `CannotMeasure`."""
    measures = measure_surface(reconstruct(match, rig, circle_settings(scheme)), match, rig)
    return *relative_errors(measures, cap), computed_are(measures)


def errors_of(match: Match, seen: Reflections, rig: Rig, cap: Pool, scheme: str) -> FloatArray:
    """`ERRORS` of one reconstruction, shape (4,); NaN if the scheme finds no surface."""
    try:
        made = reconstruct(match, rig, circle_settings(scheme))
        measures = measure_surface(made, match, rig)
    except CannotMeasure:
        return np.full(len(ERRORS), np.nan)
    true = seen.point_mm[tuple(match.ray.T - 1)]
    actual = np.linalg.norm(made.points_mm - true, axis=-1).mean()
    depth, boundary = relative_errors(measures, cap)
    return np.array([abs(depth), abs(boundary), computed_are(measures), actual])


@dataclass(frozen=True)
class ErrorSurvey(ReadOnlyArrays):
    """Errors of the schemes on caps, with the laser at one or more positions."""

    kind: str
    """``CE``, ``LE`` or ``ME``."""
    caps: tuple[Pool, ...]
    """The n known surfaces."""
    schemes: tuple[str, ...]
    """The s schemes."""
    errors: FloatArray
    """`ERRORS` of each cap by each scheme, shape (n, s, 4), as fractions and mm: for each error the
    least over the laser's positions; NaN if no position gives a surface.
    """
    lost: FloatArray
    """Number of times that a scheme found no surface, shape (s,)."""

    def of(self, scheme: str, error: str, surface: str = "all") -> FloatArray:
        """One of `ERRORS` for the ``convex``, the ``concave`` or ``all`` caps."""
        sign = {"convex": 1, "concave": -1, "all": 0}[surface]
        chosen = [sign * cap.peak_mm >= 0 for cap in self.caps]
        return self.errors[chosen, self.schemes.index(scheme), ERRORS.index(error)]


def survey(
    kind: str,
    schemes: Sequence[str] = SCHEME_NAMES,
    step: float = 2.0,
    caps: Sequence[Pool] | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
) -> ErrorSurvey:
    """Compute the errors of the schemes on the caps of §8.3.1.

    Parameters
    ----------
    kind
        ``CE``: the laser at its actual position, 31.14°, 31.48 mm. ``LE``: the least error with the
        laser at 25° to 35° and 25 to 35 mm. ``ME``: the same with 39 × 39 rays, 0.385° apart.
    step
        Step between the laser's positions, degrees and mm.
    caps
        The surfaces. None: the 28 of §8.3.1, each at its `CENTERS`.
    """
    caps, schemes = tuple(caps or off_centre(caps_8_3_1(), CENTERS[kind])), tuple(schemes)
    pattern = DENSE if kind == "ME" else DotPattern()
    lasers = [OPEN_BENCH.laser] if kind == "CE" else laser_places(step)
    rigs = [replace(OPEN_BENCH, laser=laser, pattern=pattern) for laser in lasers]
    tasks = [(cap, rig, schemes) for rig in rigs for cap in caps]
    found = np.array(in_parallel(_errors, tasks, kind, progress, workers))
    found = found.reshape(len(rigs), len(caps), len(schemes), len(ERRORS))
    lost = np.isnan(found[..., 0]).sum(axis=(0, 1))
    least = np.where(np.isnan(found), np.inf, found).min(axis=0)
    return ErrorSurvey(kind, caps, schemes, np.where(np.isinf(least), np.nan, least), lost)


def off_centre(caps: Sequence[Pool], centers: int) -> tuple[Pool, ...]:
    """Each cap at a number of centres near the origin (`OFF_CENTRE_MM`), the same at each call."""
    rng = np.random.default_rng(83)
    at = rng.uniform(-OFF_CENTRE_MM, OFF_CENTRE_MM, (len(caps), centers, 2)).tolist()
    return tuple(
        replace(cap, footprint=replace(cap.footprint, center_mm=tuple(center)))
        for cap, own in zip(caps, at, strict=True)
        for center in own
    )


def laser_places(step: float) -> list[Laser]:
    """Positions of the laser in §8.3.2, ``step`` degrees and mm apart, including both ends."""
    angles, distances = (
        np.linspace(low, high, max(round((high - low) / step), 1) + 1)
        for low, high in (ANGLES_DEG, DISTANCES_MM)
    )
    return [Laser(float(angle), float(distance)) for angle in angles for distance in distances]


def _errors(task: tuple[Pool, Rig, tuple[str, ...]]) -> FloatArray:
    cap, rig, schemes = task
    seen = trace_once(cap, rig)
    match = exact_match(seen)
    return np.array([errors_of(match, seen, rig, cap, scheme) for scheme in schemes])


def error_table(surveys: Sequence[ErrorSurvey]) -> Table:
    """CE, LE and ME of depth and boundary: mean and worst, and those of the text with ERS; %."""
    rows = []
    for one in surveys:
        for letter, error in (("D", "depth"), ("B", "boundary")):
            for surface in ("convex", "concave", "all"):
                published = TEXT.get((one.kind, letter, surface), (None, None))
                row: dict[str, Cell] = {"error": f"{one.kind}-{letter}", "surface": surface}
                for scheme in one.schemes:
                    values = 100 * one.of(scheme, error, surface)
                    row[f"{scheme}_mean_pct"] = float(np.nanmean(values))
                    row[f"{scheme}_worst_pct"] = float(np.nanmax(values))
                for what, value in zip(("mean", "worst"), published, strict=True):
                    row[f"text_{what}_pct"] = None if value is None else 100 * value
                rows.append(row)
    return Table.of(
        "errors",
        "Errors of depth (D) and boundary (B) on the caps of §8.3.1, %; text: ERS, Fig. 8-6 … 8-10",
        rows,
    )


def are_table(surveys: Sequence[ErrorSurvey]) -> Table:
    """Mean computed and actual ARE (Eq. 6-3, 8-4; Fig. 8-7, 8-9, 8-11), and their difference."""
    rows = []
    for one in surveys:
        for surface in ("convex", "concave"):
            for scheme in one.schemes:
                computed = one.of(scheme, "are_mm", surface)
                actual = one.of(scheme, "actual_are_mm", surface)
                apart = np.abs(computed - actual)
                row: dict[str, Cell] = {
                    "error": one.kind,
                    "surface": surface,
                    "scheme": scheme,
                    "are_mm": float(np.nanmean(computed)),
                    "actual_are_mm": float(np.nanmean(actual)),
                    "least_difference_mm": float(np.nanmin(apart)),
                    "largest_difference_mm": float(np.nanmax(apart)),
                }
                rows.append(row)
    return Table.of(
        "are",
        "Computed ARE (Eq. 6-3) and actual ARE (Eq. 8-4), mm; text (CE, ERS): "
        "0.0021 to 0.2543 mm apart",
        rows,
    )


def cap_table(surveys: Sequence[ErrorSurvey]) -> Table:
    """Every error of every cap by every scheme."""
    rows: list[dict[str, Cell]] = [
        {
            "error": one.kind,
            "diameter_mm": cap.footprint.width_mm,
            "height_mm": cap.peak_mm,
            "scheme": scheme,
            **dict(zip(ERRORS, map(float, one.errors[n, k]), strict=True)),
            "center_x_mm": cap.footprint.center_mm[0],
            "center_y_mm": cap.footprint.center_mm[1],
        }
        for one in surveys
        for n, cap in enumerate(one.caps)
        for k, scheme in enumerate(one.schemes)
    ]
    return Table.of(
        "errors_by_cap", "Errors of every cap: depth and boundary as fractions, ARE in mm", rows
    )
