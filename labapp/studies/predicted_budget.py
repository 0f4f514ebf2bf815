"""The error budget of a set-up: contribution of each source to the height by the fit scheme.

Every part is predicted (`predicted_error`) and also simulated with pools like the expected one,
measured from dots with noise and with changed calibrated quantities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES, RigUncertainty
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.parallel import Progress, in_parallel
from labapp.simulation.pools import Pool
from labapp.studies.adviser.predicted_error import DOT_SIGMA_MM, PredictedError, predict_error
from labapp.studies.error_analysis import relative_errors
from labapp.studies.parameter_deviation import KnownPool, moved_errors
from labapp.studies.tables import Table

POOLS, MOVED_POOLS = 24, 6
"""Number of simulated pools, and of those simulated with each quantity changed."""

SHIFT_MM, STRETCH = 0.3, 0.05
"""Largest shift along X and Y, and relative change of size, of `similar_pool`."""


@dataclass(frozen=True)
class SetupBudget(ReadOnlyArrays):
    """Budget of the height for m pools of a kind."""

    pool: Pool
    uncertainty: RigUncertainty
    """The expected pool, and the uncertainty of the bench."""
    predicted: tuple[PredictedError, ...]
    """Predicted error of each of the m pools."""
    random: FloatArray
    """Simulated relative height error of each pool without calibration errors, shape (m,); NaN if
    there was no surface.
    """
    parameters: FloatArray
    """Simulated relative change of the height by the standard uncertainty of each of `QUANTITIES`
    for some of the pools, shape (k, q).
    """

    @property
    def lost(self) -> int:
        """Number of pools without a surface."""
        return int(np.isnan(self.random).sum())

    @property
    def empty(self) -> bool:
        """Whether no pool gives a surface, and none has enough dots to predict its error."""
        predicted = any(np.isfinite(one.total_mm) for one in self.predicted)
        return not predicted and self.lost == len(self.random)


def predicted_budget(rig: Rig, pool: Pool, progress: Progress | None = None) -> SetupBudget:
    """Predict and simulate the error budget of a rig with uncertainty for a kind of pool."""
    known, exact = rig.uncertainty, replace(rig, uncertainty=None)
    assert known is not None
    rng = np.random.default_rng(831)
    pools = [similar_pool(pool, rng) for _ in range(POOLS)]
    tasks = [(exact, known, one, k) for k, one in enumerate(pools)]
    found = in_parallel(_simulated, tasks, "budget", progress)
    moved = np.array([changes for _, _, changes in found[:MOVED_POOLS]])
    return SetupBudget(
        pool=pool,
        uncertainty=known,
        predicted=tuple(predicted for predicted, _, _ in found),
        random=np.array([error for _, error, _ in found]),
        parameters=moved,
    )


def similar_pool(pool: Pool, rng: np.random.Generator) -> Pool:
    """Pool of the same shape with a random small shift and change of size."""
    scale = rng.uniform(1 - STRETCH, 1 + STRETCH)
    x, y = np.array(pool.footprint.center_mm) + rng.uniform(-SHIFT_MM, SHIFT_MM, 2)
    similar = pool.scaled(scale, scale, scale)
    return replace(similar, footprint=replace(similar.footprint, center_mm=(float(x), float(y))))


def _simulated(
    task: tuple[Rig, RigUncertainty, Pool, int],
) -> tuple[PredictedError, float, FloatArray]:
    rig, uncertainty, pool, number = task
    rng = np.random.default_rng([831, number])
    predicted = predict_error(pool, rig, dot_sigma_mm=DOT_SIGMA_MM, uncertainty=uncertainty)
    match = exact_match(trace(pool, rig), sigma_mm=DOT_SIGMA_MM, rng=rng)
    changes = np.full(len(QUANTITIES), np.nan)
    try:
        made = reconstruct(match, rig, Settings())
        error = relative_errors(measure_surface(made, match, rig), pool)[0]
    except CannotMeasure:
        return predicted, float("nan"), changes
    if number < MOVED_POOLS:
        known = KnownPool(pool, match, rig, uncertainty)
        changes[:] = 0.0
        for k in np.flatnonzero(uncertainty.sigma):
            step = np.diag(uncertainty.sigma)[k]
            both = [moved_errors((known, way * step, "fit"))[0] for way in (1, -1)]
            changes[k] = (both[0] - both[1]) / 2
    return predicted, error, changes


def budget_table(budget: SetupBudget) -> Table:
    """Budget in % of the pool's height, predicted and simulated."""
    height = abs(budget.pool.peak_mm)
    # The error of a pool with too few dots is not predicted, and no calibration changes it.
    known = [one for one in budget.predicted if np.isfinite(one.total_mm)]
    rows: list[tuple[str | float | None, ...]] = []
    parts = (
        ("which rays come back", "boundary_mm"),
        ("surface between the dots", "shape_mm"),
        ("dots' places", "dots_mm"),
    )
    for name, part in parts:
        rows.append((name, _rms([getattr(p, part) for p in known]) / height, None))
    random = [one.random_mm for one in known]
    rows.append(("these together", _rms(random) / height, _rms(budget.random)))
    for k in np.flatnonzero(budget.uncertainty.sigma):
        each = [one.parameters_mm[k] for one in known]
        rows.append((QUANTITIES[k].name, _rms(each) / height, _rms(budget.parameters[:, k])))
    total = [one.total_mm for one in known]
    by_setup = budget.uncertainty.combined(budget.parameters)
    simulated = float(np.hypot(_rms(budget.random), _rms(by_setup)))
    rows.append(("everything", _rms(total) / height, simulated))
    percent = [(name, *map(_percent, values)) for name, *values in rows]
    return Table(
        "error_budget",
        f"Error budget of the height, fit, standard uncertainties in % of {height:g} mm: "
        f"{len(budget.random)} pools about {budget.pool.footprint.width_mm:g} mm wide"
        + (f", {budget.lost} without a surface" if budget.lost else ""),
        ("source", "predicted_pct", "simulated_pct"),
        tuple(percent),
    )


def _rms(values: Sequence[float] | FloatArray) -> float:
    """Root mean square of the known values; NaN if there are none."""
    known = np.asarray(values, float)[~np.isnan(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else float("nan")


def _percent(value: str | float | None) -> float | None:
    return 100 * value if isinstance(value, float) and not np.isnan(value) else None
