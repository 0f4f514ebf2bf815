"""Search for the optimal positions of laser and imaging plane for expected pools.

It finds the set-up within a bench's limits with the least expected error of the height: every
position of a grid is checked against the constraints (`LaserPlace`), the feasible ones are compared
by the predicted error on an increasing number of pools, the best are refined by Nelder–Mead, and
the finalists are compared by simulated measurements of the pools.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import minimize

from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.simulation.parallel import Progress, in_parallel, shared_processes
from labapp.studies.adviser.bench_limits import (
    CONSTRAINTS,
    BenchLimits,
    Constraint,
    LaserPlace,
    Place,
    broken,
)
from labapp.studies.adviser.expected_pools import ExpectedPools, Sample
from labapp.studies.adviser.height_error import (
    Trial,
    predicted_errors,
    simulated_errors,
    trials_in_blocks,
)

MOVED: dict[str, str] = {
    "projection_angle_deg": "angle_deg",
    "distance_mm": "distance_mm",
    "plane_mm": "plane_mm",
    "s_mm": "s_mm",
    "h_mm": "h_mm",
}
"""Quantities of a `Place`, and their ranges in `BenchLimits`."""

SEED = 4


@dataclass(frozen=True)
class Effort:
    """Effort of the search; the defaults take some minutes on two cores."""

    grid: tuple[int, int, int] = (6, 6, 4)
    """Numbers of angles, distances and plane distances of the grid."""
    pools: tuple[int, int, int] = (8, 32, 128)
    """Number of pools for comparing all feasible positions, the best ten, and the finalists.
    """
    steps: int = 24
    """Function evaluations of a refinement."""
    finalists: int = 6
    """Number of set-ups that are simulated."""
    sweep: int = 9
    """Points of each sensitivity curve."""


QUICK = Effort(grid=(5, 4, 3), pools=(2, 4, 12), steps=6, finalists=2, sweep=3)
"""Takes a tenth of the time; the expected error is accurate to a fifth."""


@dataclass(frozen=True)
class Candidate:
    """An evaluated set-up."""

    place: Place
    margins: dict[Constraint, float]
    """Margin of each of `CONSTRAINTS`; negative where it is violated."""
    error_mm: float = np.inf
    """Predicted mean error of the height; infinite if a constraint is violated."""

    @property
    def possible(self) -> bool:
        """Whether all constraints hold."""
        return broken(self.margins) == 0


@dataclass(frozen=True)
class Sweep(ReadOnlyArrays):
    """Sensitivity to one quantity, with the others as recommended; n values."""

    name: str
    """Name of the quantity in `Place`."""
    value: FloatArray
    """Values of the quantity, mm or degrees, shape (n,)."""
    error_mm: FloatArray
    """Predicted mean error at each value, ignoring the constraints, shape (n,)."""
    margins: tuple[dict[Constraint, float], ...]
    """Margins at each of the n values."""

    def breaks(self, number: int) -> tuple[Constraint, ...]:
        """Constraints that are violated at a value."""
        return tuple(name for name, margin in self.margins[number].items() if margin < 0)


@dataclass(frozen=True)
class Advice:
    """The recommended set-up, its expected error, and the set-ups compared with it."""

    expected: ExpectedPools
    limits: BenchLimits
    best: Candidate
    """The recommended set-up; if none is feasible, the one with the least violation."""
    error_mm: float
    sigma_mm: float
    """Expected mean error of its height, and the standard uncertainty of that mean; NaN if no
    set-up is feasible. The latter is NaN, too, if a simulated pool gave no surface with each of
    the finalists: the error is then only predicted.
    """
    random_mm: float
    """The same mean with the calibration known exactly; NaN if a simulated pool gave no surface."""
    grid: tuple[Candidate, ...]
    """The positions of the grid, one laser position after the other."""
    sweeps: tuple[Sweep, ...]
    """Sensitivity to each quantity."""
    pools: int = 0
    """Number of pools simulated with the recommended set-up."""
    lost: int = 0
    """Number of those that gave no surface, with the calibration's errors or without them."""

    @property
    def possible(self) -> bool:
        """Whether any set-up within the limits meets all constraints."""
        return self.best.possible


def advise(
    expected: ExpectedPools,
    limits: BenchLimits,
    effort: Effort | None = None,
    seed: int = SEED,
    progress: Progress | None = None,
    workers: int | None = None,
) -> Advice:
    """Find the set-up with the least predicted error of the height.

    Parameters
    ----------
    expected, limits
        The pools, and the bench's limits.
    seed
        Seed of the pools and errors for the comparison: the same seed gives the same advice.
    progress, workers
        See `in_parallel`. An exception of ``progress`` ends the search.
    """
    search = _Search(expected, limits, effort or Effort(), seed, progress, workers)
    with shared_processes(workers):
        return _found(search)


def _found(search: _Search) -> Advice:
    expected, limits = search.expected, search.limits
    grid = search.grid()
    possible = [one for one in grid if one.possible]
    if not possible:
        nearest = search.nearest(min(grid, key=lambda one: broken(one.margins)))
        if not nearest.possible:
            unknown = float("nan")
            return Advice(expected, limits, nearest, unknown, unknown, unknown, grid, ())
        possible = [nearest]
    scored = search.scored(possible, 0)
    by_place = {one.place: one for one in scored}
    grid = tuple(by_place.get(one.place, one) for one in grid)
    finalists = search.refined(search.scored(_best(scored, 10), 1))
    best, errors, *counts = search.decided(finalists)
    sweeps = search.sweeps(best, errors[0] / best.error_mm)
    return Advice(expected, limits, best, *errors, grid, sweeps, *counts)


def _best(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    return sorted(candidates, key=lambda one: one.error_mm)[:count]


class _Search:
    """The steps of `advise`."""

    def __init__(
        self,
        expected: ExpectedPools,
        limits: BenchLimits,
        effort: Effort,
        seed: int,
        progress: Progress | None,
        workers: int | None,
    ) -> None:
        self.expected, self.limits, self.effort = expected, limits, effort
        self.progress, self.workers = progress, workers
        few, some, many = effort.pools
        self.samples = (
            expected.sample(few, seed),
            expected.sample(some, seed),
            expected.sample(many, seed + 1),
        )

    def grid(self) -> tuple[Candidate, ...]:
        return grid_of(self.expected, self.limits, self.effort.grid, self.progress, self.workers)

    def scored(self, candidates: Sequence[Candidate], stage: int) -> list[Candidate]:
        """Predict the candidates' errors on the pools of a stage."""
        sample = self.samples[stage]
        tasks = trials_in_blocks(
            self.limits, [one.place for one in candidates], sample, len(sample.pools)
        )
        what = ("predicted errors", "the best")[stage]
        found = in_parallel(predicted_errors, tasks, what, self.progress, self.workers)
        return [
            replace(one, error_mm=float(errors.mean()))
            for one, errors in zip(candidates, found, strict=True)
        ]

    def refined(self, candidates: list[Candidate]) -> list[Candidate]:
        """The best candidates, and the refinements of the best two of them."""
        best = _best(candidates, max(self.effort.finalists - 2, 1))
        tasks = [
            (self.expected, self.limits, one, self.samples[1], self.effort.steps)
            for one in best[:2]
        ]
        found = in_parallel(_refined_locally, tasks, "local search", self.progress, self.workers)
        return list({one.place: one for one in [*found, *best]}.values())

    def nearest(self, start: Candidate) -> Candidate:
        """The set-up with the least violation, starting from the grid's."""
        return _refined_locally((self.expected, self.limits, start, None, 3 * self.effort.steps))

    def decided(
        self, finalists: list[Candidate]
    ) -> tuple[Candidate, tuple[float, float, float], int, int]:
        """Simulate the finalists; see `Advice` for what is returned of the best.

        Returns the best, its (mean error, σ of that, random part), and the numbers of its pools
        and of those without a surface.

        Each simulated mean still varies by a tenth with the drawn pools. The prediction, corrected
        by one factor for all finalists, does not, but does not cover everything. Therefore the
        finalists are compared by the mean of both on a logarithmic scale.
        """
        sample, count = self.samples[2], len(finalists)
        tasks = trials_in_blocks(self.limits, [one.place for one in finalists], sample, 8)
        tell = (self.progress, self.workers)
        found = in_parallel(simulated_errors, tasks, "measuring pools", *tell)
        errors = np.concatenate(found)[:, 0].reshape(count, -1)
        predicted = np.array([one.error_mm for one in finalists])
        simulated = errors.mean(axis=1)
        kept = np.isfinite(simulated)
        if not kept.any():
            # Some pool has no surface with any set-up: only the prediction is left.
            best, unknown = int(predicted.argmin()), float("nan")
            lost = int(np.isinf(errors[best]).sum())
            only = (float(predicted[best]), unknown, unknown)
            return finalists[best], only, errors.shape[1], lost
        factor = np.exp(np.log(simulated[kept] / predicted[kept]).mean())
        both = np.where(kept, np.sqrt(simulated * factor * predicted), np.inf)
        best = int(both.argmin())
        sigma = errors[best].std(ddof=1) / np.sqrt(errors.shape[1])
        exact = trials_in_blocks(self.limits, [finalists[best].place], sample, 8, calibrated=False)
        random = np.concatenate(in_parallel(simulated_errors, exact, "exact calibration", *tell))
        lost = int(np.isinf(random[:, 0]).sum())
        mean = float("nan") if lost else float(random[:, 0].mean())
        return finalists[best], (float(both[best]), float(sigma), mean), errors.shape[1], lost

    def sweeps(self, best: Candidate, scale: float) -> tuple[Sweep, ...]:
        tasks = [
            (self.expected, self.limits, best, name, self.samples[1], self.effort.sweep)
            for name in MOVED
        ]
        found = in_parallel(_swept, tasks, "a mm or a degree away", self.progress, self.workers)
        return tuple(replace(one, error_mm=scale * one.error_mm) for one in found)


def grid_of(
    expected: ExpectedPools,
    limits: BenchLimits,
    counts: tuple[int, int, int],
    progress: Progress | None = None,
    workers: int | None = None,
) -> tuple[Candidate, ...]:
    """Set-ups evenly over the limits, one laser position after the other.

    ``counts``: of angles, distances and plane distances; the rest as in `in_parallel`.
    """
    ranges = (limits.angle_deg, limits.distance_mm, limits.plane_mm)
    angles, distances, planes = (
        np.unique(np.linspace(*span, count)) for span, count in zip(ranges, counts, strict=True)
    )
    tasks = [
        (expected, limits, float(angle), float(distance), planes)
        for angle, distance in product(angles, distances)
    ]
    found = in_parallel(_at_planes, tasks, "finding possible set-ups", progress, workers)
    return tuple(one for some in found for one in some)


def _at_planes(
    task: tuple[ExpectedPools, BenchLimits, float, float, FloatArray],
) -> list[Candidate]:
    expected, limits, angle, distance, planes = task
    laser = LaserPlace(expected, limits, angle, distance)
    places = [laser.best_plate(float(plane)) for plane in planes]
    return [Candidate(place, laser.margins(place)) for place in places]


def _refined_locally(
    task: tuple[ExpectedPools, BenchLimits, Candidate, Sample | None, int],
) -> Candidate:
    """Minimise the predicted error or, without a sample, the violation (Nelder–Mead)."""
    expected, limits, start, sample, steps = task
    ranges = np.array([limits.angle_deg, limits.distance_mm, limits.plane_mm])
    span = np.maximum(ranges[:, 1] - ranges[:, 0], 1e-9)
    best = start

    def cost(share: FloatArray) -> float:
        nonlocal best
        at = ranges[:, 0] + np.clip(share, 0, 1) * span
        laser = LaserPlace(expected, limits, float(at[0]), float(at[1]))
        place = laser.best_plate(float(at[2]))
        one = Candidate(place, laser.margins(place))
        if sample is None:
            best = min(best, one, key=lambda each: broken(each.margins))
            return broken(one.margins)
        if not one.possible:
            return 1.0 + broken(one.margins)
        trial = Trial(limits, place, sample, 0, len(sample.pools))
        one = replace(one, error_mm=float(predicted_errors(trial).mean()))
        best = min(best, one, key=lambda each: each.error_mm)
        return one.error_mm

    place = start.place
    at = np.array([place.projection_angle_deg, place.distance_mm, place.plane_mm])
    first = (at - ranges[:, 0]) / span
    simplex = first + np.vstack([np.zeros(3), np.diag(np.where(first > 0.5, -0.12, 0.12))])
    minimize(
        cost, first, method="Nelder-Mead",
        options={"maxfev": steps, "initial_simplex": simplex, "xatol": 2e-3, "fatol": 1e-6},
    )  # fmt: skip
    return best


def _swept(task: tuple[ExpectedPools, BenchLimits, Candidate, str, Sample, int]) -> Sweep:
    expected, limits, best, name, sample, count = task
    low, high = getattr(limits, MOVED[name])
    values = np.unique(np.append(np.linspace(low, high, count), getattr(best.place, name)))
    margins, errors = [], []
    trial = Trial(limits, best.place, sample, 0, len(sample.pools))
    for value in values:
        place = replace(best.place, **{name: float(value)})
        laser = LaserPlace(expected, limits, place.projection_angle_deg, place.distance_mm)
        margins.append(laser.margins(place))
        # Shifting the plate in its plane changes what is seen, but not the accuracy.
        moved = best.error_mm
        if name not in ("s_mm", "h_mm"):
            wide = replace(limits, plate_mm=(4 * limits.plate_mm[0], 4 * limits.plate_mm[1]))
            free = replace(place, s_mm=2 * limits.plate_mm[0], h_mm=-2 * limits.plate_mm[1])
            open_bench = replace(trial, limits=wide, place=free)
            moved = float(predicted_errors(open_bench).mean())
        errors.append(moved)
    # The open bench's wider plate has its axis points farther out: only ratios are taken from it.
    ratio = np.array(errors) / errors[int(np.argmin(np.abs(values - getattr(best.place, name))))]
    return Sweep(name, values, best.error_mm * ratio, tuple(margins))


def constraint_text(name: Constraint, margin: float) -> str:
    """Text of a margin: the amount by which a constraint is met or violated."""
    label, unit = CONSTRAINTS[name]
    much = f"{abs(margin):.3g} {unit}"
    if name == "once":
        return f"{label}: {much} do" if margin < 0 else label
    return f"{label}: {much} {'too little' if margin < 0 else 'to spare'}"
