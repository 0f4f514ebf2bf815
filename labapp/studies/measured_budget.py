"""Uncertainty of a pool's sizes due to the uncertainty of its set-up, for any scheme."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.config.setup import Setup
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.pipeline import Measurement, Settings, reconstruct
from labapp.core.surface.measures import SIZES, measure_surface
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.studies.parameter_deviation import move


@dataclass(frozen=True)
class Contribution(ReadOnlyArrays):
    """Effect of the ± of one quantity on the sizes."""

    name: str
    sigma: float
    unit: str
    assumed: bool
    """Whether the ± is assumed because none was entered."""
    change: FloatArray
    """Change of each of `SIZES` with the quantity, shape (6,); NaN if there is no surface then.
    """


def measured_budget(
    measurement: Measurement, setup: Setup, settings: Settings
) -> tuple[Contribution, ...]:
    """Reconstruct a measured frame with each quantity of the set-up changed by its ± either way.

    The assignment of rays to dots is kept. The change of a size is half the difference, as in
    `core.surface.setup_uncertainty`, which is part of the default scheme's own ±.
    """
    match, known = measurement.match, setup.rig.uncertainty
    if match is None or measurement.measures is None:
        raise ValueError("the frame has no surface")
    if known is None:
        return ()

    exact = replace(setup.rig, uncertainty=None)

    def sizes(offset: FloatArray) -> FloatArray:
        moved, rig = move(match, exact, known.axes, offset)
        try:
            size = measure_surface(reconstruct(moved, rig, settings), moved, rig)
        except CannotMeasure:
            return np.full(len(SIZES), np.nan)
        return np.array([getattr(size, name) for name in SIZES])

    return tuple(
        Contribution(
            quantity.name,
            float(step.sum()),
            quantity.unit,
            quantity.key in known.assumed,
            (sizes(step) - sizes(-step)) / 2,
        )
        for quantity, step in zip(QUANTITIES, np.diag(known.sigma), strict=True)
    )


def total(own: FloatArray, contributions: Sequence[Contribution], rig: Rig) -> FloatArray:
    """± of sizes, shape (6,), from their own ± and that of the set-up; NaN counts as 0."""
    own = np.nan_to_num(own)
    if rig.uncertainty is None or not contributions:
        return own
    changes = np.nan_to_num([one.change for one in contributions])
    return np.hypot(own, rig.uncertainty.combined(changes.T))
