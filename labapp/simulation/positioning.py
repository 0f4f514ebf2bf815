"""Positioning of laser, torch and imaging plane: which rays reach the plane (§4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from labapp.core.geometry.rig import Rig
from labapp.core.values import FloatArray
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import ellipsoidal_cap

USUAL_WIDTH_MM, USUAL_LENGTH_MM = 5.0, 6.0
"""Largest pool in gas tungsten arc welding (§4.2.1.1)."""

RUN_OUT_MM = 60.0
"""Length drawn of a ray that does not meet the imaging plane."""


@dataclass(frozen=True)
class Clearance:
    """Room left by the torch, in the plane through laser and electrode (§4.2.1.1)."""

    l1_mm: float
    """Longest tail, from the electrode to the pool's end at −Y, whose incident rays pass the torch
    (Eq. 4-14); infinite for a laser no higher than the tip.
    """
    l2_mm: float
    """Longest head, from the electrode to the pool's end at +Y, whose reflected rays pass the torch
    (Eq. 4-15, 4-17, 4-18).
    """
    least_plane_mm: float
    most_plane_mm: float
    """Distances from the electrode between which a vertical imaging plane with the rig's edges
    catches the steepest of those rays, which grazes the tip (Eq. 4-16 with H the height of the
    lower and of the upper edge).
    """


def clearance(rig: Rig, head_slope_deg: float = 0.0) -> Clearance:
    """Calculate L1, L2 and the plane distances of §4.2.1.1 (Eq. 4-14 … 4-18).

    Parameters
    ----------
    head_slope_deg
        Slope of the pool towards the edge of its head: 0 for a flat pool, β of Eq. 4-17 for a
        convex one, −γ of Eq. 4-18 for a concave one, degrees.

    Notes
    -----
    With H2 the height of the tip and the diode at height H3 and horizontal distance D2, Eq. 4-17 is
    ``L2·tan(C + 2β) = H2``, ``(D2 − L2)·tan C = H3``. Eliminating C gives the quadratic
    ``t·L2² − (H2 + H3 + t·D2)·L2 + H2·(D2 − t·H3) = 0`` with t = tan 2β. The root that becomes
    Eq. 4-15 for t = 0 is used.
    """
    tip = rig.electrode.height_mm
    _, away, height = rig.laser.position_mm
    turn = np.tan(np.radians(2 * head_slope_deg))
    l1 = tip * away / (height - tip) if height > tip else np.inf
    linear, constant = tip + height + turn * away, tip * (away - turn * height)
    root = np.sqrt(linear**2 - 4 * turn * constant)
    l2 = float(np.clip(2 * constant / (linear + root), 0, away))
    plane = rig.imaging_plane
    low, high = (
        l2 * (edge - tip) / tip if tip > 0 else np.inf
        for edge in (plane.origin_mm[2], plane.origin_mm[2] + plane.height_mm * plane.z_axis[2])
    )
    return Clearance(float(l1), l2, max(float(low), 0.0), max(float(high), 0.0))


class Fate(Enum):
    """Fate of a ray."""

    CAUGHT = "meets the imaging plane"
    PAST = "misses the imaging plane"
    BLOCKED = "is blocked by the torch"
    UNUSED = "does not meet the pool"


@dataclass(frozen=True)
class SideRay:
    """A ray of the central column, seen from the side."""

    row: int
    """i of the ray, from 1."""
    fate: Fate
    path_mm: FloatArray
    """(y, z) of the laser, of the point on pool or work piece, and of the ray's end, shape
    (2 or 3, 2), mm.
    """


@dataclass(frozen=True)
class SideView:
    """Drawing of the bench from the side, looking along −X: (y, z), mm."""

    rays: tuple[SideRay, ...]
    """Rays of the central column."""
    pool_mm: FloatArray
    plane_mm: FloatArray
    """The pool's profile at x = 0, shape (n, 2); the plane's lower and upper edge, shape (2, 2)."""
    laser_mm: FloatArray
    tip_mm: FloatArray
    """The diode; the electrode's tip, shape (2,)."""
    clearance: Clearance
    """L1, L2 and the plane distances."""
    tally: dict[Fate, int]
    """Number of rays of the whole pattern by fate."""


def side_view(
    rig: Rig,
    width_mm: float = USUAL_WIDTH_MM,
    length_mm: float = USUAL_LENGTH_MM,
    height_mm: float = 0.0,
) -> SideView:
    """Trace the rays via a pool of the expected size, centred under the electrode.

    Parameters
    ----------
    width_mm, length_mm, height_mm
        Size of the pool, which is part of an ellipsoid; a negative height makes it concave.

    Raises
    ------
    ValueError
        If no pool can have this size.
    """
    pool = ellipsoidal_cap(width_mm, length_mm, height_mm)
    edge = np.array([length_mm / 2 * (1 - 1e-9)])
    slope = float(pool.gradient(np.zeros(1), edge)[0, 1])
    along = np.linspace(-1, 1, 81) * edge
    plane = rig.imaging_plane
    middle = np.array([[plane.width_mm / 2, 0.0], [plane.width_mm / 2, plane.height_mm]])
    seen = trace(pool, rig)
    return SideView(
        rays=_central_rays(seen, rig),
        pool_mm=np.stack([along, pool.height(np.zeros_like(along), along)], axis=-1),
        plane_mm=plane.to_universal(middle)[:, 1:],
        laser_mm=rig.laser.position_mm[1:],
        tip_mm=np.array([0.0, rig.electrode.height_mm]),
        clearance=clearance(rig, float(np.degrees(np.arctan(-slope)))),
        tally=_tally(seen),
    )


def _central_rays(seen: Reflections, rig: Rig) -> tuple[SideRay, ...]:
    column = (rig.pattern.columns - 1) // 2
    fates = _fates(seen)[:, column]
    return tuple(
        SideRay(row + 1, fates[row], _path(seen, (row, column), rig))
        for row in range(rig.pattern.rows)
        if not seen.absent[row, column] and seen.incident[row, column, 2] < 0
    )


def _path(seen: Reflections, ray: tuple[int, int], rig: Rig) -> FloatArray:
    laser = rig.laser.position_mm
    if not seen.hit[ray]:
        incident = seen.incident[ray]
        ground = laser - laser[2] / incident[2] * incident
        return np.stack([laser, ground])[:, 1:]
    point, place = seen.point_mm[ray], seen.plane_mm[ray]
    end = point + RUN_OUT_MM * seen.reflected[ray]
    if np.isfinite(place).all():
        end = rig.imaging_plane.to_universal(place)
    return np.stack([laser, point, end])[:, 1:]


def _fates(seen: Reflections) -> npt.NDArray[np.object_]:
    fates = np.full(seen.hit.shape, Fate.PAST, object)
    fates[seen.on_plane] = Fate.CAUGHT
    fates[seen.blocked] = Fate.BLOCKED
    fates[~seen.hit] = Fate.UNUSED
    return fates


def _tally(seen: Reflections) -> dict[Fate, int]:
    fates = _fates(seen)[~seen.absent].tolist()
    return {fate: fates.count(fate) for fate in Fate}
