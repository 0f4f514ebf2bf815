"""IRS on one frame by algorithm, correspondence and base height (Fig. 6-10, 6-13, 6-16).

In addition, the correspondence allowed by the shape of the reflected rows (§7.1).

The dots keep their rows and columns; each correspondence assigns them other rays. Dots whose rays
lie beyond the pattern are left out. Errors are those of the scheme's own points, step 4 of §6.3.1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import ORIENTATIONS, Match, Orientation, signs_of
from labapp.core.schemes.irs import Algorithm, IrsSettings, estimates
from labapp.core.schemes.row_shape import ALLOWED, match_row_shapes
from labapp.core.schemes.slopes import Estimate, ReflectedRays, reflected_rays
from labapp.core.surface.measures import inside_points
from labapp.core.values import CannotMeasure
from labapp.studies.tables import Cell, Table

COLUMNS = ("are_mm", "mre_mm", "are_inner_mm", "mre_inner_mm")


def with_orientation(match: Match, rig: Rig, orientation: Orientation) -> Match:
    """The same dots with the rays of another correspondence, mirrored about the marker's ray.

    No ray is known to be lit or dark then: which of the other rays were reflected is unknown.
    """
    center = np.array(rig.pattern.marker or rig.pattern.center_ray)
    ray = center + (match.ray - center) * signs_of(match.orientation) * signs_of(orientation)
    there = ((ray >= 1) & (ray <= (rig.pattern.rows, rig.pattern.columns))).all(axis=-1)
    return replace(
        match,
        orientation=orientation,
        dot=match.dot[there],
        ray=ray[there],
        reflected=match.reflected[there],
        plane_mm=match.plane_mm[there],
        plane_covariance_mm2=match.plane_covariance_mm2[there],
        ray_states=np.zeros_like(match.ray_states),
    )


def shape_table(match: Match) -> Table:
    """Correspondences allowed by the rows in the picture (§7.1), and that of least residual.

    The residuals are those of the surface fitted with each tried correspondence.
    """
    shapes = match_row_shapes(match)
    allowed = ALLOWED[shapes.shape] if shapes.shape else ()
    residual = {trial.orientation: trial.residual_mm for trial in match.trials}
    words = {True: "yes", False: "no", None: ""}
    row: dict[str, Cell] = {
        "rows": shapes.shape or "neither",
        "convex": shapes.convex,
        "concave": shapes.concave,
        "allowed_by_rows": " ".join(allowed),
        "by_residual": match.orientation,
        **{f"residual_{way.replace('/', '')}_mm": residual.get(way) for way in ORIENTATIONS},
        "agree": words[shapes.allows(match.orientation)],
    }
    return Table.of(
        "section_7_1_row_shape",
        "Correspondence by the shape of the reflected rows (§7.1) and by the residual",
        [row],
    )


def comparison_tables(match: Match, rig: Rig) -> tuple[Table, Table]:
    """Reflection errors of a frame, by algorithm (Fig. 6-10) and by base height (Fig. 6-13, 6-16).

    One row per correspondence and algorithm or base height; empty cells if there is no surface.
    """
    edge: list[tuple[Cell, ...]] = []
    one: list[tuple[Cell, ...]] = []
    for orientation in ORIENTATIONS:
        turned = with_orientation(match, rig, orientation)
        for algorithm in get_args(Algorithm):
            settings = IrsSettings(algorithm=algorithm)
            try:
                rays = reflected_rays(turned, rig)
                found = dict(estimates(turned, rays, settings))
            except CannotMeasure:
                rays, found = None, {}
            errors = {h: _errors(turned, rays, found[h]) for h in found if rays is not None}
            nothing: tuple[Cell, ...] = (None,) * len(COLUMNS)
            if algorithm == "opa":
                one += [(orientation, h, *errors.get(h, nothing)) for h in settings.base_heights_mm]
            else:
                edge.append((orientation, algorithm, *errors.get(0.0, nothing)))
    return (
        Table(
            "figure_6_10_edge_points",
            "Reflection errors of the edge-points algorithms (Fig. 6-10)",
            ("correspondence", "algorithm", *COLUMNS),
            tuple(edge),
        ),
        Table(
            "figure_6_13_base_height",
            "Reflection errors of the one-point algorithm by base height (Fig. 6-13, 6-16)",
            ("correspondence", "base_height_mm", *COLUMNS),
            tuple(one),
        ),
    )


def _errors(match: Match, rays: ReflectedRays, estimate: Estimate) -> tuple[Cell, ...]:
    """`COLUMNS` of an estimate (Eq. 6-3 … 6-8)."""
    captured, gradient = rays.plane_mm, estimate.surface.point_gradient
    residual = (rays.reflected(estimate.points_mm, gradient) - captured)[: rays.measured]
    error = np.hypot(*(residual * rays.scale).T)
    met = np.isfinite(error)
    parts = error[met], error[met & inside_points(match.ray)]
    return tuple(
        float(of(part)) if len(part) else None for part in parts for of in (np.mean, np.max)
    )
