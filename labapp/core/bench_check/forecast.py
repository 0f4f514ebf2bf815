"""What pictures of mirrors would do for the ± of a pool's height, before they are taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.bench_check.adjustment import Sighting, System
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate, landing_points, placed
from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes import fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import BoolArray, CannotMeasure, FloatArray

DOT_MM = 0.03
"""Standard uncertainty of a dot's place on the plane that is expected."""

EXPECTED = Cap(6.7, 0.3)
"""A pool of the usual size (Table of §7.3)."""

CANDIDATES: Mapping[str, tuple[Mirror, ...]] = {
    "plate at 0 mm": (Plate(0.0),),
    "plate at 0 and 2 mm": (Plate(0.0), Plate(2.0)),
    "thumb tack": (Cap(9.75, 0.91),),
    "plate at 0 mm, thumb tack": (Plate(0.0), Cap(9.75, 0.91)),
    "plate at 0 and 2 mm, thumb tack": (Plate(0.0), Plate(2.0), Cap(9.75, 0.91)),
}
"""Candidate sets of pictures."""


@dataclass(frozen=True)
class Forecast:
    """Standard uncertainty of the expected pool's height, mm.

    Parameters
    ----------
    name
        The pictures, in words.
    setup_sigma_mm, total_sigma_mm
        The set-up's part of it, and with noise and level, once the bench is checked with these
        pictures.
    """

    name: str
    setup_sigma_mm: float
    total_sigma_mm: float


def forecast(
    rig: Rig, candidates: Mapping[str, Sequence[Mirror]] = CANDIDATES, pool: Cap = EXPECTED
) -> tuple[Forecast, ...]:
    """Predict the ± of a pool's height as the set-up is known, and after each set of pictures.

    By linear propagation of the covariance; the first of the results is without pictures. Pictures
    with a mirror none of whose dots would be on the imaging plane are left out.

    Raises
    ------
    CannotMeasure
        If the pool cannot be measured with this set-up.
    """
    made = [_of_height("as it is", rig, pool)]
    for name, mirrors in candidates.items():
        known = rig.uncertainty
        sightings = [one for mirror in mirrors if (one := expected_sighting(mirror, rig))]
        if known is None or len(sightings) < len(mirrors):
            continue
        system = System.of(rig, sightings, None)
        covariance = system.adjustment(np.zeros(system.size), 1.0).covariance
        after = replace(rig, uncertainty=replace(known, covariance=covariance))
        made.append(_of_height(name, after, pool))
    return tuple(made)


def height_sigma(rig: Rig, pool: Cap = EXPECTED) -> Forecast:
    """± of the height of an expected pool with a set-up as it is known."""
    return _of_height("as it is", rig, pool)


def expected_sighting(mirror: Mirror, rig: Rig) -> Sighting | None:
    """The dots of a mirror in its expected pose that are expected on the plane; None: no dots."""
    mirror = placed(mirror, rig)
    plane, shown = _shown(mirror, rig)
    if not shown.any():
        return None
    covariance = np.tile(DOT_MM**2 * np.eye(2), (int(shown.sum()), 1, 1))
    return Sighting(mirror, np.argwhere(shown), plane[shown], covariance)


def _shown(mirror: Mirror, rig: Rig) -> tuple[FloatArray, BoolArray]:
    plane, hit = landing_points(mirror, mirror.pose, rig)
    size = rig.imaging_plane.width_mm, rig.imaging_plane.height_mm
    with np.errstate(invalid="ignore"):
        shown = hit & ((plane >= 0) & (plane <= size)).all(axis=-1)
    for i, j in rig.pattern.absent_rays:
        shown[i - 1, j - 1] = False
    return plane, shown


def _of_height(name: str, rig: Rig, pool: Cap) -> Forecast:
    plane, shown = _shown(pool, rig)
    ray = np.argwhere(shown) + 1
    ground = intersect_level(rig.laser.position_mm, ray_directions(rig.laser, rig.pattern))
    outside = np.hypot(ground[..., 0], ground[..., 1]) > pool.diameter_mm / 2
    witness = np.where(shown, 1, np.where(outside, -1, 0))
    for i, j in rig.pattern.absent_rays:
        witness[i - 1, j - 1] = 0
    match = Match(
        orientation="S/S",
        dot=np.arange(len(ray)),
        ray=ray,
        reflected=ray,
        plane_mm=plane[shown],
        plane_covariance_mm2=np.tile(DOT_MM**2 * np.eye(2), (len(ray), 1, 1)),
        witness=witness,
    )
    made = fit.reconstruct(match, rig, FitSettings())
    height = 2
    setup, total = float(made.size_sigma_setup[height]), float(made.size_sigma[height])
    if not np.isfinite(total):
        raise CannotMeasure("no-surface", "the pool that is expected could not be measured")
    return Forecast(name, setup, total)
