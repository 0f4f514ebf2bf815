"""Scene of the pool in 3-D, independent of the renderer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.surface.mesh import surface_mesh
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays
from labapp.export.meshes import drawn_spacing, known_part
from labapp.export.rendering.heights import between_points, difference_at

EXAGGERATION = 3.0
"""Default vertical exaggeration, as pools are flat."""

RAY_MM = 3.0
"""Drawn length of each ray, mm, as laser and imaging plane are far away."""

SPACING_MM = 0.15
"""Largest distance between rings of the drawn mesh, mm."""

HEIGHT = "height (mm)"

HEIGHT_MAP, ERROR_MAP, DIFFERENCE_MAP = "viridis", "cividis", "coolwarm"
"""Colour maps of heights; of ± and residuals, from 0; of differences, centred at 0."""

Colour = Literal["height", "sigma", "residual"]
"""Quantity that colours a surface."""

SPOKES = 120
"""Approximate number of vertices per ring, for an error of a thousandth of the pool's radius."""

EMPTY = np.empty((0, 3))


@dataclass(frozen=True)
class Scene(ReadOnlyArrays):
    """Content of a 3-D picture, mm, UCS; n vertices."""

    vertices_mm: FloatArray
    triangles: IntArray
    """The surface, shapes (n, 3) and (k, 3)."""
    values: FloatArray
    """Values for the colours, shape (n,)."""
    label: str
    """Name of the values, with their unit."""
    limits: tuple[float, float]
    """Values at both ends of the colour scale."""
    colour_map: str = HEIGHT_MAP
    """Matplotlib's name of the colour map."""
    contours: bool = False
    """Whether to draw lines of equal height."""
    plate_mm: FloatArray = field(default_factory=lambda: EMPTY)
    """Edge of the pool, shape (m, 3), around which the work piece is drawn; empty: not drawn."""
    points_mm: FloatArray = field(default_factory=lambda: EMPTY)
    """Reflection points, shape (p, 3)."""
    lines_mm: dict[str, FloatArray] = field(default_factory=dict)
    """Closed or open lines by name, each of shape (q, 3): ``boundary``, ``section``."""
    rays_mm: dict[str, FloatArray] = field(default_factory=dict)
    """Both ends of rays by name, each of shape (r, 2, 3): ``incident``, ``reflected``."""
    electrode: bool = True
    """Whether to mark the electrode's axis, X = Y = 0."""
    exaggeration: float = EXAGGERATION
    """Vertical exaggeration; the axes show true heights."""
    within_mm: FloatArray = field(default_factory=lambda: EMPTY)
    """Points that the axes must include, shape (k, 3), common to the pictures of a film."""
    mark_mm: FloatArray = field(default_factory=lambda: EMPTY)
    """A marked point of the surface, shape (1, 3); empty without one."""
    mark_words: str = ""
    """Label of the marked point."""
    stamp: str = ""
    """Text in a frame in the lower right corner."""
    notice: str = ""
    """Text in the middle: why there is no surface."""
    foreground: str = "#202020"
    background: str = "#ffffff"
    """Colours of texts and axes, and of the background."""


def scene_of(
    reconstruction: Reconstruction,
    colour: Colour = "height",
    limits: tuple[float, float] | None = None,
) -> Scene:
    """Return the scene of a pool's surface, boundary and reflection points.

    Parameters
    ----------
    colour
        Colour by height, by its standard uncertainty, or by the length of the residual on the
        imaging plane, interpolated between the reflection points; by height if unavailable.
    limits
        Ends of the colour scale, mm; None: those of this surface.
    """
    vertices, triangles = _mesh(reconstruction)
    used, triangles = known_part(triangles, vertices[:, 2])
    vertices = vertices[used]
    values, label, colours = vertices[:, 2], HEIGHT, HEIGHT_MAP
    if colour != "height":
        by = {
            "sigma": ("± height (mm)", reconstruction.sigma_mm),
            "residual": ("residual (mm)", np.linalg.norm(reconstruction.residual_mm, axis=1)),
        }
        found = between_points(reconstruction, by[colour][1], *vertices[:, :2].T)
        if np.isfinite(found).all() and len(found):
            values, label, colours = found, by[colour][0], ERROR_MAP
            limits = (0.0, max(float(found.max()), 1e-9)) if limits is None else limits
    edge = _closed(reconstruction.boundary.points_mm)
    return Scene(
        vertices,
        triangles,
        values,
        label,
        _limits(values) if limits is None else limits,
        colour_map=colours,
        points_mm=reconstruction.points_mm,
        lines_mm={"boundary": edge},
        plate_mm=edge[:-1],
    )


def difference_scene(one: Reconstruction, other: Reconstruction) -> Scene:
    """Return the scene of the first pool, coloured by its height minus the other's."""
    vertices, triangles = _mesh(one)
    # Slightly inside, so that the rim of equal boundaries is not lost by rounding.
    x, y = (one.boundary.center_mm + (vertices[:, :2] - one.boundary.center_mm) * (1 - 1e-9)).T
    difference = difference_at(one, other, x, y)
    used, triangles = known_part(triangles, difference)
    values = difference[used]
    reach = float(np.abs(values).max(initial=1e-6))
    return Scene(
        vertices[used],
        triangles,
        values,
        "difference (mm)",
        (-reach, reach),
        colour_map=DIFFERENCE_MAP,
        lines_mm={"boundary": _closed(one.boundary.points_mm)},
        within_mm=one.boundary.points_mm,  # vertices exist only where the two overlap
    )


def rays_of(reconstruction: Reconstruction, match: Match, rig: Rig) -> dict[str, FloatArray]:
    """Return the ends of incident and reflected rays near the pool, by name, shape (n, 2, 3), mm.

    Reflected rays point to the computed dots on the imaging plane; rays without one are omitted.
    """
    met = np.isfinite(reconstruction.residual_mm).all(axis=1)
    points = reconstruction.points_mm[met]
    computed = match.plane_mm[met] + reconstruction.residual_mm[met]
    seen = rig.imaging_plane.to_universal(computed)
    return {
        name: np.stack([points, points + RAY_MM * way / np.linalg.norm(way, axis=1)[:, None]], 1)
        for name, way in (
            ("incident", rig.laser.position_mm - points),
            ("reflected", seen - points),
        )
    }


def _mesh(reconstruction: Reconstruction) -> tuple[FloatArray, IntArray]:
    """Return vertices and triangles, coarse enough for a responsive view."""
    boundary = reconstruction.boundary
    some = slice(None, None, max(len(boundary.points_mm) // SPOKES, 1))
    thinned = replace(
        boundary, theta_deg=boundary.theta_deg[some], points_mm=boundary.points_mm[some]
    )
    spacing_mm = drawn_spacing(reconstruction, SPACING_MM)
    return surface_mesh(replace(reconstruction, boundary=thinned), spacing_mm)


def _closed(line: FloatArray) -> FloatArray:
    return np.vstack([line, line[:1]])


def _limits(values: FloatArray) -> tuple[float, float]:
    low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
    return (low, high) if high > low else (min(low, 0.0), max(low, 0.0) + 1e-6)


def empty_scene(
    within_mm: FloatArray, limits: tuple[float, float], stamp: str, notice: str
) -> Scene:
    """Return a scene without a surface, for a film; parameters as for `Scene`."""
    return Scene(
        *(EMPTY, np.empty((0, 3), int), np.empty(0), HEIGHT, limits),
        electrode=False,
        within_mm=within_mm,
        stamp=stamp,
        notice=notice,
    )
