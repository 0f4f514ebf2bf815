"""Check of an advice by a new simulation and against every set-up of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.simulation.parallel import Progress, in_parallel
from labapp.studies.adviser.bench_limits import LaserPlace, Place
from labapp.studies.adviser.expected_pools import Sample
from labapp.studies.adviser.height_error import simulated_errors, trials_in_blocks
from labapp.studies.adviser.search import Advice, constraint_text, grid_of

TEXT_PLACE = Place(31.14, 31.48, 50.0, 50.8, 0.0)
"""The set-up of §8.3.1, on the 4″ plane."""

FRESH_SEED = 1_000_003
"""Seed of pools that the adviser did not use."""

BLOCK = 10
"""Number of pools per task of a process."""


@dataclass(frozen=True)
class Check(ReadOnlyArrays):
    """Results for new pools; n pools, each at k positions, and m set-ups of a grid.

    The reflected rays depend on the position of a pool under the torch to a fraction of a row. With
    one position per pool, the mean over 50 pools varies by a tenth.
    """

    advice: Advice
    chosen: FloatArray
    text: FloatArray
    """Error of the height (mm), number of blocked rays and of rays that miss the plane, for every
    pool at every position with the recommended set-up and with that of §8.3.1, shape (n, k, 3); the
    error is infinite if there is no surface.
    """
    places: tuple[Place, ...]
    errors: FloatArray
    """The grid's possible set-ups and their mean errors on the same pools, shape (m,), mm."""
    rematch: FloatArray
    """Errors of the recommended set-up and of the best one of the grid on n further pools, shape
    (2, n, k), mm: on the first pools the latter was partly best by chance.
    """

    @property
    def error_mm(self) -> float:
        """Mean error of the recommended set-up over the pools that it can measure."""
        return _mean(self.chosen[..., 0])

    @property
    def text_error_mm(self) -> float:
        """Mean error of the set-up of §8.3.1 over the pools that it can measure."""
        return _mean(self.text[..., 0])

    @property
    def text_breaks(self) -> tuple[str, ...]:
        """Texts of the constraints that the set-up of §8.3.1 violates, such as merging dots."""
        angle, distance = TEXT_PLACE.projection_angle_deg, TEXT_PLACE.distance_mm
        laser = LaserPlace(self.advice.expected, self.advice.limits, angle, distance)
        margins = laser.margins(TEXT_PLACE)
        return tuple(constraint_text(name, much) for name, much in margins.items() if much < 0)

    @property
    def off_prediction(self) -> float:
        """Relative deviation of the error from the predicted one."""
        return self.error_mm / self.advice.error_mm - 1


def check(
    advice: Advice,
    pools: int = 50,
    places: int = 8,
    grid: tuple[int, int, int] = (5, 4, 3),
    progress: Progress | None = None,
    workers: int | None = None,
) -> Check:
    """Measure new pools with the recommended set-up, with that of §8.3.1 and with all of a grid.

    Parameters
    ----------
    pools, places
        Number of pools, and number of positions of each, with newly drawn noise of the dots and
        errors of the calibration.
    grid
        Numbers of angles, distances and plane distances, evenly over the bench's limits.
    """
    expected, limits = advice.expected, advice.limits
    compared = grid_of(expected, limits, grid, workers=1)
    rivals = [one.place for one in compared if one.possible]
    fresh, more = (
        expected.sample(pools, seed, even=False, places=places)
        for seed in (FRESH_SEED, FRESH_SEED + 1)
    )

    def measured(some: Sequence[Place], sample: Sample, what: str) -> FloatArray:
        tasks = trials_in_blocks(limits, some, sample, BLOCK)
        found = np.concatenate(in_parallel(simulated_errors, tasks, what, progress, workers))
        return np.asarray(found.reshape(len(some), pools, places, -1))

    own = measured([advice.best.place, TEXT_PLACE], fresh, "fresh pools")
    errors = np.array([])
    once_more = np.full((2, 0, places, 3), np.nan)
    if rivals:
        errors = measured(rivals, fresh, "every set-up of a grid")[..., 0].mean(axis=(1, 2))
        rival = rivals[int(errors.argmin())]
        once_more = measured([advice.best.place, rival], more, "the best two once more")
    return Check(advice, own[0], own[1], tuple(rivals), errors, once_more[..., 0])


def _mean(errors: FloatArray) -> float:
    """Mean of the finite errors; NaN if there are none."""
    finite = errors[np.isfinite(errors)]
    return float(finite.mean()) if len(finite) else float("nan")


def _micro(error_mm: float, lost: int = 0) -> str:
    """Text of an error, µm, and of the number of measurements without a surface."""
    words = f"{1000 * error_mm:.2f} µm" if np.isfinite(error_mm) else "unknown"
    return words + (f", {lost} times no surface" if lost else "")


def _percent(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.1f} %" if np.isfinite(ratio) else "unknown"


def check_text(found: Check) -> str:
    """Text of the results of a check."""
    hidden, missing = (int(found.chosen[..., k].sum()) for k in (1, 2))
    lost, text_lost = (int(np.isinf(one[..., 0]).sum()) for one in (found.chosen, found.text))
    pools, places = found.chosen.shape[:2]
    lines = [
        f"{pools} fresh pools at {places} places each: {hidden} rays hidden, "
        f"{missing} off the plane",
        f"mean height error {_micro(found.error_mm)}, "
        f"{_percent(found.off_prediction + 1)} off the predicted "
        f"{_micro(found.advice.error_mm, lost)}",
        f"set-up of §8.3.1: {_micro(found.text_error_mm, text_lost)}"
        + "".join(f"; {words}" for words in found.text_breaks),
    ]
    if found.places:
        least = float(found.errors.min())
        own, rival = found.rematch.mean(axis=(1, 2)).tolist()
        lines += [
            f"best of {len(found.places)} possible set-ups of a grid: {_micro(least)} "
            f"({_percent(_ratio(least, found.error_mm))})",
            f"those two on as many pools more: {_micro(own).removesuffix(' µm')} and "
            f"{_micro(rival)} ({_percent(_ratio(rival, own))})",
        ]
    return "\n".join(lines)


def _ratio(error_mm: float, other_mm: float) -> float:
    """Ratio of two errors; NaN if either is infinite."""
    both = np.isfinite([error_mm, other_mm]).all()
    return error_mm / other_mm if both else float("nan")
