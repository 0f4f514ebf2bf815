"""Error of the height for a set-up and a kind of pool: simulated and predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, FloatArray
from labapp.simulation.forward import exact_match, trace
from labapp.studies.adviser.bench_limits import BenchLimits, Place
from labapp.studies.adviser.expected_pools import Sample
from labapp.studies.adviser.predicted_error import predict_error
from labapp.studies.error_analysis import relative_errors
from labapp.studies.parameter_deviation import move

MEAN_OF_SIGMA = float(np.sqrt(2 / np.pi))
"""Mean absolute value of a normal deviate of standard deviation 1."""


@dataclass(frozen=True)
class Trial:
    """A set-up, and the pools of a sample on which it is tested."""

    limits: BenchLimits
    place: Place
    sample: Sample
    start: int
    stop: int
    """Pools ``start`` to before ``stop`` of a sample."""
    calibrated: bool = True
    """Whether the calibration has the sample's errors."""


def simulated_errors(trial: Trial) -> FloatArray:
    """Measure pools with a set-up by the fit scheme; one row per pool, shape (n, 3).

    Error of the height, mm, infinite if there is no surface; number of rays blocked by the torch;
    number of rays that miss the plane.

    The measurement uses the assumed set-up, and the rays come from the true one, which differs by
    the sample's errors (`move`).
    """
    limits, sample = trial.limits, trial.sample
    rig, known = limits.rig(trial.place), limits.uncertainty
    root = known.root
    rows = []
    for number in range(trial.start, trial.stop):
        pool = sample.pools[number]
        seen = trace(pool, rig)
        counts = (int((seen.lit & seen.blocked).sum()), int((seen.lit & ~seen.on_plane).sum()))
        rng = np.random.default_rng([sample.seed, number])
        try:
            match = exact_match(seen, sigma_mm=limits.dot_sigma_mm, rng=rng)
            believed = rig
            if trial.calibrated:
                match, believed = move(match, rig, known.axes, root @ sample.deviate[number])
            measures = measure_surface(reconstruct(match, believed, Settings()), match, believed)
            error = abs(relative_errors(measures, pool)[0] * pool.peak_mm)
        except CannotMeasure:
            error = np.inf
        rows.append((error, *counts))
    return np.array(rows)


def predicted_errors(trial: Trial) -> FloatArray:
    """Predicted mean absolute error of the height of each pool, shape (n,), mm.

    About five times as fast as the simulation, and without its scatter; see `predict_error`.
    """
    limits, rig = trial.limits, trial.limits.rig(trial.place)
    found = [
        predict_error(
            pool,
            rig,
            dot_sigma_mm=limits.dot_sigma_mm,
            uncertainty=limits.uncertainty if trial.calibrated else None,
        )
        for pool in trial.sample.pools[trial.start : trial.stop]
    ]
    return np.array([MEAN_OF_SIGMA * one.total_mm for one in found])


def trials_in_blocks(
    limits: BenchLimits,
    places: Sequence[Place],
    sample: Sample,
    size: int,
    calibrated: bool = True,
) -> list[Trial]:
    """Trials of every set-up with all pools of a sample, ``size`` pools each, set-up by set-up."""
    count = len(sample.pools)
    return [
        Trial(limits, place, sample, start, min(start + size, count), calibrated)
        for place in places
        for start in range(0, count, size)
    ]
