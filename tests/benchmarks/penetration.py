"""Penetration models on simulated welds with a known law: errors, intervals, transitions.

Run as ``python -m tests.benchmarks.penetration [--seeds N] [--welds N] [--fresh N] [KIND …]``.

For each seed the welds are simulated, each is predicted by a model of the others (leave one weld
out), and fresh welds, unknown to any model, by the model of all. Prints a line per seed and kind:

error
    Root mean square of predicted minus scanned, mm.
noise
    The same for the true law with the true pool: scan and scatter of the back side.
informed
    The same for a prediction that knows the law and every ±, from the measured pool.
cover
    Share of sections in the 95 % interval: of welds left out, of the bead only, of fresh welds.
found
    Transitions from partial to full within 0.2 s, and false transitions.
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
    """Return the RMS of scan error and scatter, relative to the true law of the true pool, mm."""
    squares = []
    for one in welds:
        known = np.isfinite(one.series.target)
        scan = one.series.target[known] - one.back_width_mm[known]
        squares.append(scan**2 + SCATTER_MM**2 * (one.back_width_mm[known] > 0))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def informed_mm(welds: Sequence[SimulatedWeld]) -> float:
    """Return the error of the most likely drive of each step, taken through the true law, mm."""
    drive = np.linspace(0.7, 1.5, 801)
    errors = []
    for one in welds:
        steps = in_steps(one.series, STEP_S)
        variance = steps.noise**2 + steps.level**2
        residual = steps.value[:, None, :] - pool_features(drive)
        likeliest = drive[np.argmin((residual**2 / variance[:, None, :]).sum(axis=2), axis=1)]
        predicted = first_order_lag(back_width_mm(likeliest), BACK_S, 1 / STEP_S)
        errors.append((predicted - steps.target)[np.isfinite(steps.target)])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def fresh_cover(model: PenetrationModel, welds: Sequence[SimulatedWeld]) -> tuple[float, float]:
    """Return error and cover of welds unknown to the model."""
    errors, inside = [], []
    for one in welds:
        prediction, steps = model.predict(one.series), in_steps(one.series, STEP_S)
        known = np.isfinite(steps.target)
        error = (prediction.value - steps.target)[known]
        errors.append(error)
        spread = np.hypot(prediction.sigma, steps.target_sigma)[known]
        inside.append(np.abs(error) <= SURE_95 * spread)
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))), float(
        np.mean(np.concatenate(inside))
    )


def false_transitions(left_out: LeftOut) -> int:
    """Return the number of predicted transitions without a true one within 0.5 s."""
    count = 0
    for name in dict.fromkeys(left_out.weld):
        in_weld = np.array([each == name for each in left_out.weld])
        known, predicted = (
            find_transitions(left_out.time_s[in_weld], value[in_weld], FULL_MM)
            for value in (left_out.measured, left_out.predicted)
        )
        count += sum(not len(known) or np.abs(known - time_s).min() > 0.5 for time_s in predicted)
    return count


def examine(seed: int, kind: Kind, count: int, fresh: int) -> tuple[FloatArray, list[str]]:
    """Return known and predicted transitions for a seed, and the cells of its line."""
    welds = simulate_welds(count, seed)
    series: list[WeldSeries] = [one.series for one in welds]
    settings = ModelSettings(FEATURES, TARGET, STEP_S, full_mm=FULL_MM)
    model, left_out = validated_model(series, kind, settings)
    known, predicted = left_out.transitions()
    near = np.abs(known - predicted) <= NEAR_S
    spread = np.hypot(left_out.sigma, left_out.measured_sigma)
    bead = left_out.measured > 0
    inside = np.abs(left_out.predicted - left_out.measured) <= SURE_95 * spread
    error, cover = fresh_cover(model, simulate_welds(fresh, 10_000 + seed))
    cells = [
        *(f"{seed}", kind, f"{len(left_out.measured)}", f"{left_out.rmse_mm:.4f}"),
        *(f"{noise_mm(welds):.4f}", f"{informed_mm(welds):.4f}"),
        *(f"{left_out.bias_mm:+.4f}", f"{left_out.cover:.1%}"),
        *(f"{inside[bead].mean():.1%}", f"{error:.4f}", f"{cover:.1%}"),
        *(f"{near.sum()}/{len(near)}", f"{false_transitions(left_out)}", f"{model.factor:.2f}"),
    ]
    return np.stack([known, predicted]), cells


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kinds", nargs="*", default=["arx", "gp"])
    for name, default in (("seeds", 5), ("welds", 20), ("fresh", 20)):
        parser.add_argument(f"--{name}", type=int, default=default)
    chosen = parser.parse_args()
    head = "seed kind sections error noise informed bias cover bead fresh fresh-cover found false "
    head += "factor"
    print("".join(f"{cell:>12}" for cell in head.split()))
    for kind in chosen.kinds:
        all_times = []
        for seed in range(1, chosen.seeds + 1):
            times, cells = examine(seed, cast(Kind, kind), chosen.welds, chosen.fresh)
            all_times.append(times)
            print("".join(f"{cell:>12}" for cell in cells), flush=True)
        known, predicted = np.hstack(all_times)
        near = np.abs(known - predicted) <= NEAR_S
        print(f"{kind}: {near.sum()} of {len(near)} transitions within {NEAR_S} s "
              f"({near.mean():.1%}), median {np.nanmedian(predicted - known):+.3f} s")  # fmt: skip


if __name__ == "__main__":
    main()
