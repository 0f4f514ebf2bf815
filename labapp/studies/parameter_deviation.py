"""Parameter deviation error: effect of the uncertainty of a bench on the sizes (§8.1).

The quantities of the bench are changed by their standard uncertainties and the same dots are
reconstructed again: one quantity at a time (the law of propagation, JCGM 100:2008, 5.1), and all
together, drawn from normal distributions (Monte Carlo, JCGM 101:2008, 5 to 7). The assignment of
rays to dots is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import (
    QUANTITIES,
    AxisPoints,
    RigUncertainty,
    covariance_of,
)
from labapp.core.match import Match
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.simulation.parallel import Progress, in_parallel
from labapp.simulation.pools import Pool
from labapp.studies.error_analysis import scheme_errors
from labapp.studies.tables import Table

_CALIBRATED_IN_THE_TEXT = (
    "laser.projection_angle_deg",
    "laser.distance_mm",
    "imaging_plane.distance_mm",
    "imaging_plane.s_mm",
    "imaging_plane.h_mm",
    "image_calibration.origin_px",
    "image_calibration.x_axis_px",
    "image_calibration.z_axis_px",
)

NOMINAL = {
    one.sigma_key: 0.1 if one.sigma_key.removesuffix("_sigma") in _CALIBRATED_IN_THE_TEXT else 0.0
    for one in QUANTITIES
}
"""Standard uncertainties by `Quantity.sigma_key`: 0.1 mm, 0.1° and 0.1 px for the quantities
calibrated in the text (§5, Appendix I), and 0 for all others."""

COVERAGE = 0.95

DRAWS, SEED = 400, 2008
"""Number of Monte Carlo draws, and their seed."""


def nominal(axes: AxisPoints) -> RigUncertainty:
    """The uncertainty of a bench with the standard uncertainties `NOMINAL`."""
    return RigUncertainty(axes, *covariance_of(NOMINAL))


def move(match: Match, rig: Rig, axes: AxisPoints, offset: FloatArray) -> tuple[Match, Rig]:
    """The match and the rig with the bench's quantities changed by an offset, shape (q,).

    The assignment of rays to dots is kept.
    """
    dots = moved_dots(match.plane_mm, rig, axes, offset)
    return replace(match, plane_mm=dots), moved_rig(rig, offset)


@dataclass(frozen=True)
class ParameterDeviation(ReadOnlyArrays):
    """Effect of a bench's uncertainties on height (or depth) and diameter of a pool."""

    uncertainty: RigUncertainty
    contribution: FloatArray
    """Relative change of height and diameter by the standard uncertainty of each of `QUANTITIES`,
    shape (q, 2).
    """
    draws: FloatArray
    """Relative errors of height and diameter of every draw minus those of the undisturbed bench,
    shape (m, 2); NaN if there was no surface.
    """

    @property
    def linear(self) -> FloatArray:
        """Standard uncertainty by linear propagation, shape (2,)."""
        return self.uncertainty.combined(np.nan_to_num(self.contribution).T)

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
    """A known pool, its measured dots, and the bench."""

    cap: Pool
    match: Match
    rig: Rig
    uncertainty: RigUncertainty
    """The pool's dots, the bench, and the bench's uncertainty."""


def parameter_deviation(
    known: KnownPool,
    scheme: str,
    draws: int = DRAWS,
    progress: Progress | None = None,
    workers: int | None = None,
) -> ParameterDeviation:
    """Propagate the uncertainties of a bench's calibration to the size of a known pool.

    Parameters
    ----------
    draws
        Number of Monte Carlo draws. The standard deviation of m draws has a relative uncertainty of
        about 1/√(2m): 3.5 % for 400 draws.
    """
    uncertainty, count = known.uncertainty, len(QUANTITIES)
    uncertain = np.flatnonzero(uncertainty.sigma)
    single = np.diag(uncertainty.sigma)[uncertain]
    deviates = np.random.default_rng(SEED).normal(size=(draws, len(uncertain)))
    drawn = deviates @ uncertainty.root[:, uncertain].T
    offsets = np.vstack([np.zeros((1, count)), single, -single, drawn])
    tasks = [(known, offset, scheme) for offset in offsets]
    found = np.array(in_parallel(moved_errors, tasks, f"parameters, {scheme}", progress, workers))
    plus, minus, others = np.split(found[1:], [len(single), 2 * len(single)])
    contribution = np.zeros((count, 2))
    contribution[uncertain] = (plus - minus) / 2
    return ParameterDeviation(uncertainty, contribution, others - found[0])


def moved_errors(task: tuple[KnownPool, FloatArray, str]) -> FloatArray:
    """Relative errors of height and diameter, shape (2,), with the bench changed by an offset."""
    known, offset, scheme = task
    match, rig = move(known.match, known.rig, known.uncertainty.axes, offset)
    try:
        return np.array(scheme_errors(match, rig, known.cap, scheme)[:2])
    except CannotMeasure:
        return np.full(2, np.nan)


def deviation_table(found: dict[tuple[str, str], ParameterDeviation]) -> Table:
    """Contribution of each quantity, their sum and the Monte Carlo result by (surface, scheme)."""
    rows = []
    for (surface, scheme), one in found.items():
        for quantity, sigma, (height, diameter) in zip(
            QUANTITIES, one.uncertainty.sigma, 100 * np.abs(one.contribution), strict=True
        ):
            if not sigma:
                continue
            which = (quantity.name, float(sigma), quantity.unit)
            rows.append((surface, scheme, *which, float(height), float(diameter), None, None))
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
