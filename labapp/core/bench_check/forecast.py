"""Predicted ± of a pool's height after a bench check, before the pictures are taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.bench_check.adjustment import Sighting, System
from labapp.core.bench_check.check import BenchCheck, adjusted_bench
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate, landing_points, placed
from labapp.core.bench_check.suspects import freed_directions
from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes import fit
from labapp.core.surface.measures import measure_surface
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import BoolArray, CannotMeasure, FloatArray

DOT_MM = 0.03
"""Expected standard uncertainty of a dot's position on the plane, mm."""

EXPECTED = Cap(6.7, 0.3)
"""A pool of the usual size (Table of §7.3)."""

CANDIDATES: Mapping[str, tuple[Mirror, ...]] = {
    "plate at 0 mm": (Plate(0.0),),
    "plate at 0 and 2 mm": (Plate(0.0), Plate(2.0)),
    "thumb tack": (Cap(9.75, 0.91),),
    "plate at 0 mm, thumb tack": (Plate(0.0), Cap(9.75, 0.91)),
    "plate at 0 and 2 mm, thumb tack": (Plate(0.0), Plate(2.0), Cap(9.75, 0.91)),
    "plate at 0 mm, level to ± 0.03°, thumb tack": (
        Plate(0.0, tilt_sigma_deg=0.03),
        Cap(9.75, 0.91),
    ),
}
"""Candidate sets of pictures."""


@dataclass(frozen=True)
class Forecast:
    """Standard uncertainty of the expected pool's height, mm.

    Parameters
    ----------
    name
        Description of the pictures.
    setup_sigma_mm, total_sigma_mm
        Contribution of the set-up, and total with noise and level, after a check with these
        pictures.
    """

    name: str
    setup_sigma_mm: float
    total_sigma_mm: float


def forecast(
    rig: Rig, candidates: Mapping[str, Sequence[Mirror]] = CANDIDATES, pool: Cap = EXPECTED
) -> tuple[Forecast, ...]:
    """Predict the ± of a pool's height with the present set-up, and after each set of pictures.

    By linear propagation of the covariance; the first result is without pictures. Sets with a
    mirror none of whose dots would be on the imaging plane are left out.

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
    """Predict the ± of the expected pool's height with the present set-up."""
    return _of_height("as it is", rig, pool)


@dataclass(frozen=True)
class BlindSpot:
    """A mirror's height whose error the pictures hardly contradict, mm.

    Parameters
    ----------
    picture
        Name of its picture.
    noticed_mm
        Smallest detectable error of the height (`MeasuredSize.noticed_mm`).
    pool_mm
        Error of the expected pool's height that results from it.
    """

    picture: str
    noticed_mm: float
    pool_mm: float


def blind_spots(check: BenchCheck, pool: Cap = EXPECTED) -> tuple[BlindSpot, ...]:
    """Mirror heights whose undetected error would exceed the ± of the expected pool's height.

    Empty unless the check's status is ``ok``, as its set-up must not be used otherwise. No
    uncertainty covers a given height that is wrong beyond its ±. The check is therefore repeated
    with a wrong height (external reliability: Baarda 1968, A testing procedure for use in geodetic
    networks).

    Raises
    ------
    CannotMeasure
        If the pool cannot be measured with the adjusted set-up.
    """
    if check.status != "ok":
        return ()
    total, found = height_sigma(check.rig, pool).total_sigma_mm, []
    for k, picture in enumerate(check.pictures):
        noticed = next(one.noticed_mm for one in picture.sizes if one.name == "height")
        off = max(abs(_misled(check, k, error, pool)) for error in (-noticed, noticed))
        if off > total:
            found.append(BlindSpot(picture.picture.name, noticed, off))
    return tuple(found)


def _misled(check: BenchCheck, k: int, error_mm: float, pool: Cap) -> float:
    """Error of a pool's height caused by a wrong height of a mirror, mm.

    0 if the pool could not be measured, as no wrong result would be given.
    """
    mirror = check.sightings[k].mirror
    raised = replace(mirror, height_mm=mirror.height_mm + error_mm)
    freed = freed_directions(check.before, check.free)
    system = System.of(check.before, check.sightings, freed).with_mirror(k, raised)
    made, unknown = check.adjustment, check.adjustment.unknown.copy()
    # The estimated pose is kept; it differs by the error from the pose expected now.
    height = mirror.parameters.index("height_mm")
    unknown[system.parts[k + 1].start + height] -= error_mm / mirror.sigma[height]
    misled = adjusted_bench(check.before, system.refined(unknown, made.scale))
    match = _expected_match(check.rig, pool)
    seen = misled.calibration.to_plane(check.calibration.to_image(match.plane_mm))
    exact = [replace(one, uncertainty=None) for one in (check.rig, misled.rig)]
    try:
        right, found = (
            measure_surface(fit.reconstruct(each, bench, FitSettings()), each, bench).height_mm
            for each, bench in zip((match, replace(match, plane_mm=seen)), exact, strict=True)
        )
    except CannotMeasure:
        return 0.0
    return found - right


def expected_sighting(mirror: Mirror, rig: Rig) -> Sighting | None:
    """Return the dots on the plane of a mirror in its expected pose; None if there are none."""
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
    return plane, shown & ~rig.pattern.is_absent


def _expected_match(rig: Rig, pool: Cap) -> Match:
    """Expected dots of a pool on the plane, with their rays."""
    plane, shown = _shown(pool, rig)
    ray = np.argwhere(shown) + 1
    ground = intersect_level(rig.laser.position_mm, ray_directions(rig.laser, rig.pattern))
    outside = np.hypot(ground[..., 0], ground[..., 1]) > pool.diameter_mm / 2
    ray_states = np.where(shown, 1, np.where(outside, -1, 0))
    ray_states[rig.pattern.is_absent] = 0
    return Match(
        orientation="S/S",
        dot=np.arange(len(ray)),
        ray=ray,
        reflected=ray,
        plane_mm=plane[shown],
        plane_covariance_mm2=np.tile(DOT_MM**2 * np.eye(2), (len(ray), 1, 1)),
        ray_states=ray_states,
    )


def _of_height(name: str, rig: Rig, pool: Cap) -> Forecast:
    made = fit.reconstruct(_expected_match(rig, pool), rig, FitSettings())
    height = 2
    setup, total = float(made.size_sigma_setup[height]), float(made.size_sigma[height])
    if not np.isfinite(total):
        raise CannotMeasure("no-surface", "the pool that is expected could not be measured")
    return Forecast(name, setup, total)
