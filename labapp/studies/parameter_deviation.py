"""Parameter deviation error: what a bench is not exactly known to be, in the sizes (§8.1).

The calibrated quantities are moved by their standard uncertainties and the same dots are
reconstructed anew: one at a time (the law of propagation, JCGM 100:2008, 5.1), and all at once,
drawn from normal distributions (Monte Carlo, JCGM 101:2008, 5 to 7). Which ray made which dot
stays as it was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.pipeline import reconstruct
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.simulation.parallel import Progress, in_parallel
from labapp.simulation.pools import Pool
from labapp.studies.error_analysis import circle_settings, relative_errors
from labapp.studies.tables import Table

NOMINAL_MM, NOMINAL_DEG, NOMINAL_PX = 0.1, 0.1, 0.1
"""Standard uncertainty of what nobody told one of."""

COVERAGE = 0.95

DRAWS, SEED = 400, 2008
"""How many Monte Carlo draws, and where they begin."""


@dataclass(frozen=True)
class Quantity:
    """A calibrated quantity.

    Parameters
    ----------
    name, unit
        What it is called and measured in.
    parts
        Its places among the offsets that `move` takes: two for a point in the picture.
    """

    name: str
    unit: str
    parts: tuple[int, ...]


QUANTITIES = (
    Quantity("laser, projection angle", "°", (0,)),
    Quantity("laser, distance", "mm", (1,)),
    Quantity("imaging plane, distance", "mm", (2,)),
    Quantity("imaging plane, s", "mm", (3,)),
    Quantity("imaging plane, h", "mm", (4,)),
    Quantity("image calibration, O′", "px", (5, 6)),
    Quantity("image calibration, point on O′X′", "px", (7, 8)),
    Quantity("image calibration, point on O′Z′", "px", (9, 10)),
)

NOMINAL = (NOMINAL_DEG, NOMINAL_MM, *[NOMINAL_MM] * 3, *[NOMINAL_PX] * 3)
"""Standard uncertainty of each of them, where nothing better is known."""

OFFSETS = 11
"""How many numbers they are in all."""


@dataclass(frozen=True)
class AxisPoints:
    """Image calibration, and where on the axes the points lie that it was made from (§5.1).

    Parameters
    ----------
    calibration
        Pixel ↔ imaging plane.
    x_mm, z_mm
        X′ of the point on O′X′, Z′ of that on O′Z′.
    """

    calibration: ImageCalibration
    x_mm: float
    z_mm: float


def move(match: Match, rig: Rig, axes: AxisPoints, offset: FloatArray) -> tuple[Match, Rig]:
    """The match and the rig if the calibrated quantities were off by ``offset``; see `dots_moved`.

    Which ray made which dot stays as it is.
    """
    plane_mm, moved = dots_moved(match.plane_mm, rig, axes, offset)
    return replace(match, plane_mm=plane_mm), moved


def dots_moved(
    plane_mm: FloatArray, rig: Rig, axes: AxisPoints | None, offset: FloatArray
) -> tuple[FloatArray, Rig]:
    """Dots on the plane, shape (n, 2), and the rig if calibrated quantities were off.

    The dots stay where they are in the picture: their places on the plane follow the axis points.

    Parameters
    ----------
    plane_mm, rig, axes
        As they are taken to be; the axis points are needed where these are off.
    offset
        Shape (11,): projection angle in degrees; distance of laser and of plane, s and h in mm;
        (u, v) of O′, of the point on O′X′ and of that on O′Z′ in px.
    """
    angle, distance = offset[:2]
    laser = replace(
        rig.laser,
        projection_angle_deg=rig.laser.projection_angle_deg + angle,
        distance_mm=rig.laser.distance_mm + distance,
    )
    away, s, h = offset[2:5]
    origin = rig.imaging_plane.origin_mm + np.array([-s, -away, h])
    moved = replace(rig, laser=laser, imaging_plane=replace(rig.imaging_plane, origin_mm=origin))
    if axes is None or not offset[5:].any():
        return plane_mm, moved
    calibration = axes.calibration
    points = calibration.to_image(np.array([[0.0, 0.0], [axes.x_mm, 0.0], [0.0, axes.z_mm]]))
    dots = _with_ones(calibration.to_image(plane_mm))
    # What was taken for the moved points is where the true ones are.
    share = np.linalg.solve(_with_ones(points + offset[5:].reshape(3, 2)).T, dots.T)
    return calibration.to_plane(share.T @ points), moved


def _with_ones(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])


def spread(sigma: Sequence[float]) -> FloatArray:
    """Standard uncertainty of each offset of `move`, shape (11,), from those of `QUANTITIES`."""
    each = np.zeros(OFFSETS)
    for quantity, value in zip(QUANTITIES, sigma, strict=True):
        each[list(quantity.parts)] = value
    return each


def by_quantity(change: FloatArray) -> FloatArray:
    """Root of the sum of squares of each of `QUANTITIES`, shape (8, …), from offsets, (11, …)."""
    return np.array([np.linalg.norm(change[list(q.parts)], axis=0) for q in QUANTITIES])


@dataclass(frozen=True)
class ParameterDeviation(ReadOnlyArrays):
    """What a bench's uncertainties do to height (or depth) and diameter of a pool.

    Parameters
    ----------
    sigma
        Standard uncertainty of each of `QUANTITIES`, in its unit, shape (8,).
    contribution
        What each of them alone gives, over the true size: height, diameter; shape (8, 2).
    draws
        Relative errors of height and diameter of every draw, less those of the undisturbed
        bench, shape (m, 2); NaN where there was no surface.
    """

    sigma: FloatArray
    contribution: FloatArray
    draws: FloatArray

    @property
    def linear(self) -> FloatArray:
        """Root of the sum of squares of the contributions, shape (2,)."""
        return np.asarray(np.sqrt(np.nansum(self.contribution**2, axis=0)))

    @property
    def standard(self) -> FloatArray:
        """Standard deviation of the draws, shape (2,) (JCGM 101, 7.6)."""
        return np.asarray(np.nanstd(self.draws, axis=0, ddof=1))

    @property
    def interval(self) -> FloatArray:
        """Probabilistically symmetric 95 % interval of the draws, shape (2, 2) (JCGM 101, 7.7)."""
        tail = 50 * (1 - COVERAGE)
        return np.asarray(np.nanpercentile(self.draws, [tail, 100 - tail], axis=0).T)


@dataclass(frozen=True)
class KnownPool:
    """A known pool, and what is measured of it with what.

    Parameters
    ----------
    cap
        The pool.
    match, rig, axes
        Its dots, the bench and the image calibration.
    """

    cap: Pool
    match: Match
    rig: Rig
    axes: AxisPoints


def parameter_deviation(
    known: KnownPool,
    scheme: str,
    sigma: Sequence[float] = NOMINAL,
    draws: int = DRAWS,
    progress: Progress | None = None,
    workers: int | None = None,
) -> ParameterDeviation:
    """Propagate the uncertainties of a bench's calibration to the size of a known pool.

    Parameters
    ----------
    known
        The pool.
    scheme
        How it is reconstructed.
    sigma
        Standard uncertainty of each of `QUANTITIES`, in its unit.
    draws
        How many Monte Carlo draws. The standard deviation of m draws is itself known to about
        1/√(2m): 400 give 3.5 %.
    progress, workers
        See `in_parallel`.
    """
    each = spread(sigma)
    single = np.vstack([np.diag(each), -np.diag(each)])
    drawn = np.random.default_rng(SEED).normal(size=(draws, OFFSETS)) * each
    offsets = np.vstack([np.zeros((1, OFFSETS)), single, drawn])
    tasks = [(known, offset, scheme) for offset in offsets]
    found = np.array(in_parallel(moved_errors, tasks, f"parameters, {scheme}", progress, workers))
    plus, minus = found[1 : OFFSETS + 1], found[OFFSETS + 1 : 2 * OFFSETS + 1]
    half = (plus - minus) / 2
    draws_apart = found[2 * OFFSETS + 1 :] - found[0]
    return ParameterDeviation(np.array(sigma), by_quantity(half), draws_apart)


def moved_errors(task: tuple[KnownPool, FloatArray, str]) -> FloatArray:
    """Relative errors of height and diameter, shape (2,), with the bench off by an offset."""
    known, offset, scheme = task
    match, rig = move(known.match, known.rig, known.axes, offset)
    try:
        measures = measure_surface(reconstruct(match, rig, circle_settings(scheme)), match, rig)
    except CannotMeasure:
        return np.full(2, np.nan)
    return np.array(relative_errors(measures, known.cap))


def deviation_table(found: dict[tuple[str, str], ParameterDeviation]) -> Table:
    """Contribution of each quantity, their sum and the Monte Carlo's; by (surface, scheme)."""
    rows = []
    for (surface, scheme), one in found.items():
        for quantity, sigma, (height, diameter) in zip(
            QUANTITIES, one.sigma, 100 * one.contribution, strict=True
        ):
            told = (quantity.name, float(sigma), quantity.unit)
            rows.append((surface, scheme, *told, float(height), float(diameter), None, None))
        drawn = f"all, Monte Carlo ({len(one.draws)} draws)"
        for name, sizes, limits in (
            ("all, linear", one.linear, (None, None)),
            (drawn, one.standard, map(float, 100 * one.interval[0])),
        ):
            rows.append((surface, scheme, name, None, "", *map(float, 100 * sizes), *limits))
    return Table(
        "parameter_deviation",
        "Parameter deviation error: standard uncertainties, % of height and diameter",
        (
            "surface",
            "scheme",
            "quantity",
            "u",
            "unit",
            "height_pct",
            "diameter_pct",
            "height_low_95_pct",
            "height_high_95_pct",
        ),
        tuple(rows),
    )
