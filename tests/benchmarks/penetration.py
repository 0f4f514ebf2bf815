"""Penetration models on simulated welds with a known law: errors, intervals, transitions.

Run as ``python -m tests.benchmarks.penetration [--seeds N] [--welds N] [--fresh N] [KIND …]``.

For each seed the welds are simulated, each is predicted by a model of the others (leave one weld
out), and fresh welds, which no model has seen, by the model of all. A line a seed and kind:

error
    Root mean square of predicted less scanned, mm.
noise
    The same of the law itself, given the true pool: scan and scatter of the back side.
informed
    That of a prediction that knows the law and every ±, from the pool as it was measured.
cover
    Share of sections in the 95 % interval; of welds left out, of the bead alone, of fresh welds.
found
    Transitions from partial to full within 0.2 s, and those that are predicted where there is none.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import cast

import numpy as np

from labapp.core.dynamics.penetration import (
    SURE_95,
    Kind,
    LeftOut,
    ModelSettings,
    PenetrationModel,
    validated_model,
)
from labapp.core.dynamics.weld_series import WeldSeries, find_transitions, in_steps
from labapp.core.values import FloatArray
from labapp.simulation.penetration import (
    BACK_S,
    FEATURES,
    FULL_MM,
    SCATTER_MM,
    TARGET,
    SimulatedWeld,
    back_width_mm,
    first_order_lag,
    pool_features,
    simulate_welds,
)

STEP_S, NEAR_S = 0.1, 0.2


def noise_mm(welds: Sequence[SimulatedWeld]) -> float:
    """Scan and scatter: what is left between scans and the true law of the true pool."""
    square = []
    for one in welds:
        there = np.isfinite(one.series.target)
        scan = one.series.target[there] - one.back_width_mm[there]
        square.append(scan**2 + SCATTER_MM**2 * (one.back_width_mm[there] > 0))
    return float(np.sqrt(np.mean(np.concatenate(square))))


def informed_mm(welds: Sequence[SimulatedWeld]) -> float:
    """Error of the likeliest drive of the step and those before it, taken through the true law."""
    drive = np.linspace(0.7, 1.5, 801)
    errors = []
    for one in welds:
        steps = in_steps(one.series, STEP_S)
        variance = steps.noise**2 + steps.level**2
        away = steps.value[:, None, :] - pool_features(drive)
        likeliest = drive[np.argmin((away**2 / variance[:, None, :]).sum(axis=2), axis=1)]
        found = first_order_lag(back_width_mm(likeliest), BACK_S, 1 / STEP_S)
        errors.append((found - steps.target)[np.isfinite(steps.target)])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def fresh_cover(model: PenetrationModel, welds: Sequence[SimulatedWeld]) -> tuple[float, float]:
    """Error and cover of welds that the model has not seen."""
    errors, inside = [], []
    for one in welds:
        found, steps = model.predict(one.series), in_steps(one.series, STEP_S)
        there = np.isfinite(steps.target)
        error = (found.value - steps.target)[there]
        errors.append(error)
        spread = np.hypot(found.sigma, steps.target_sigma)[there]
        inside.append(np.abs(error) <= SURE_95 * spread)
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))), float(
        np.mean(np.concatenate(inside))
    )


def false_transitions(left: LeftOut) -> int:
    """Predicted transitions without one of the sections within half a second."""
    count = 0
    for name in dict.fromkeys(left.weld):
        of = np.array([each == name for each in left.weld])
        known, found = (
            find_transitions(left.time_s[of], value[of], FULL_MM)
            for value in (left.measured, left.predicted)
        )
        count += sum(not len(known) or np.abs(known - at).min() > 0.5 for at in found)
    return count


def examine(seed: int, kind: Kind, count: int, fresh: int) -> tuple[FloatArray, list[str]]:
    """Known and found transitions of a seed, and the cells of its line."""
    welds = simulate_welds(count, seed)
    series: list[WeldSeries] = [one.series for one in welds]
    settings = ModelSettings(FEATURES, TARGET, STEP_S, full_mm=FULL_MM)
    model, left = validated_model(series, kind, settings)
    known, found = left.transitions()
    near = np.abs(known - found) <= NEAR_S
    spread = np.hypot(left.sigma, left.measured_sigma)
    bead = left.measured > 0
    inside = np.abs(left.predicted - left.measured) <= SURE_95 * spread
    error, cover = fresh_cover(model, simulate_welds(fresh, 10_000 + seed))
    cells = [
        *(f"{seed}", kind, f"{len(left.measured)}", f"{left.rmse_mm:.4f}"),
        *(f"{noise_mm(welds):.4f}", f"{informed_mm(welds):.4f}"),
        *(f"{left.bias_mm:+.4f}", f"{left.cover:.1%}"),
        *(f"{inside[bead].mean():.1%}", f"{error:.4f}", f"{cover:.1%}"),
        *(f"{near.sum()}/{len(near)}", f"{false_transitions(left)}", f"{model.factor:.2f}"),
    ]
    return np.stack([known, found]), cells


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kinds", nargs="*", default=["arx", "gp"])
    for name, default in (("seeds", 5), ("welds", 20), ("fresh", 20)):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    head = "seed kind sections error noise informed bias cover bead fresh fresh-cover found false "
    head += "factor"
    print("".join(f"{cell:>12}" for cell in head.split()))
    for kind in given.kinds:
        every = []
        for seed in range(1, given.seeds + 1):
            times, cells = examine(seed, cast(Kind, kind), given.welds, given.fresh)
            every.append(times)
            print("".join(f"{cell:>12}" for cell in cells), flush=True)
        known, found = np.hstack(every)
        near = np.abs(known - found) <= NEAR_S
        print(f"{kind}: {near.sum()} of {len(near)} transitions within {NEAR_S} s "
              f"({near.mean():.1%}), median {np.nanmedian(found - known):+.3f} s")  # fmt: skip


if __name__ == "__main__":
    main()
