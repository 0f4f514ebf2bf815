"""Shape of a pool's surface as numbers: what later work takes penetration from.

Width, length and convexity together predicted the width of the back-side bead best (W. J. Zhang et
al., "Characterization of Three-Dimensional Weld Pool Surface in GTAW", Weld. J. 91 (2012) 195-s).
Asymmetry and slope at the boundary tell of a torch beside the joint, of undercut and of wetting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.dynamics.modes import DISK_WEIGHT, PHI, RING_WEIGHT, RINGS, SPOKES, disk_nodes
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.surface import Surface
from labapp.core.values import FloatArray

RIM = 0.99
"""Share of the way from the centre to the boundary where its slope is taken."""


@dataclass(frozen=True)
class Shape:
    """Shape of one surface.

    Parameters
    ----------
    convexity_mm
        Mean height of the longitudinal section through the middle of the boundary: its area over
        its length. Negative of a concave pool.
    asymmetry
        Volume between surface and work piece right of that section (+X) minus that left of it, over
        both; hollows count as heights.
    wetting_slope_deg
        Angle of the surface to the work piece at the boundary, the mean along it; positive where
        the surface rises inwards.
    """

    convexity_mm: float
    asymmetry: float
    wetting_slope_deg: float


def shape_of(surface: Surface, boundary: Boundary) -> Shape:
    """Measure the shape of a surface that has a height and a slope everywhere in its boundary."""
    nodes = disk_nodes(boundary)
    height = surface.height(nodes[:, 0], nodes[:, 1])
    # The disk's area, so that both halves weigh the same; each spoke reaches to the boundary.
    volume = np.abs(height) * DISK_WEIGHT * np.tile(_reach(nodes) ** 2, RINGS)
    right = np.cos(PHI)
    sides = np.sum(volume[right > 1e-9]), np.sum(volume[right < -1e-9])
    along = height.reshape(RINGS, SPOKES)[:, [SPOKES // 4, 3 * SPOKES // 4]].T @ RING_WEIGHT
    reach = _reach(nodes)[[SPOKES // 4, 3 * SPOKES // 4]]
    outline = boundary.points_mm[:, :2]
    tangent = (np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)) / 2
    length = np.linalg.norm(tangent, axis=1)
    rim = boundary.center_mm + RIM * (outline - boundary.center_mm)
    inward = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / length[:, None]
    rise = np.sum(surface.gradient(rim[:, 0], rim[:, 1]) * inward, axis=1)
    return Shape(
        float(along @ reach / reach.sum()),
        float((sides[0] - sides[1]) / max(sum(sides), 1e-30)),
        float(np.degrees(np.arctan(rise)) @ length / length.sum()),
    )


def _reach(nodes_mm: FloatArray) -> FloatArray:
    """Length of each spoke, but for a factor that all share, shape (SPOKES,)."""
    grid = nodes_mm.reshape(RINGS, SPOKES, 2)
    return np.asarray(np.linalg.norm(grid[-1] - grid[0], axis=-1))
