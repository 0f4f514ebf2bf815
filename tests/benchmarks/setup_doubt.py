"""The check of the setup by recordings: false alarms, and the smallest detectable errors.

Run as ``python -m tests.benchmarks.setup_doubt [--recordings N] [--frames M] [--sizes K]``. Dots of
seven kinds of oscillating, growing and drifting pools are simulated on exact benches, on benches
with errors of the assumed uncertainties, and on the latter after a check with a plate and a cap.
Before that, the smallest error of each quantity is searched at which a recording of K frames is in
doubt: its linear response is added to the residuals of an exact bench. A bench with twice that
error is simulated as well.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest import mock

import numpy as np

from labapp.core.bench_check.adjustment import System, adjust
from labapp.core.bench_check.check import adjusted_bench
from labapp.core.bench_check.forecast import expected_sighting
from labapp.core.bench_check.mirrors import Cap, Plate
from labapp.core.geometry.perturbation import (
    Direction,
    directions,
    moved_calibration,
    moved_rig,
)
from labapp.core.geometry.rig import Electrode, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from labapp.core.match import MatchedDots
from labapp.core.recording import residual_check
from labapp.core.recording.dot_response import DotResponse, dot_responses
from labapp.core.recording.residual_check import FIXED, MOST, Residuals, judge_setup
from labapp.core.surface.pool_fit import FitSettings, fit_pool
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import Pool, egg
from tests.benchmarks.bench_check import (
    CALIBRATION,
    PX_PER_MM,
    SHAPE,
    VIEW,
    seen_dots,
    sighting,
    surface_like,
)
from tests.benchmarks.clutter import KINDS, draw_pool
from tests.oscillation import Oscillation
from tests.scenes import BENCH_RIG
from tests.simulated_benches import BenchErrors, SimulatedBench, draw_bench

RATE_HZ, MISSING, SEED, TRIED = 60.0, 0.02, 18, 16
MIRRORS = (Plate(0.0), Cap(9.75, 0.91))
ASSUMED = RigUncertainty(
    AxisPoints(CALIBRATION, VIEW.x_axis_mm, VIEW.z_axis_mm), *covariance_of({})
)


def grown(pool: Pool, by: float, aside: FloatArray) -> Pool:
    """Return a pool grown by a share (its height by 1.5 times that) and moved aside."""
    foot = pool.footprint
    sizes = {name: getattr(foot, name) * (1 + by) for name in ("width_mm", "head_mm", "tail_mm")}
    x, y = np.add(foot.center_mm, aside).tolist()
    peak = pool.peak_mm * (1 + 1.5 * by)
    return replace(pool, peak_mm=peak, footprint=replace(foot, **sizes, center_mm=(x, y)))


def recorded(
    pools: Sequence[Pool],
    rig: Rig,
    true: Rig,
    to_image: Callable[[FloatArray], FloatArray],
    sigma_px: float,
    rng: np.random.Generator,
) -> tuple[Counter[str], list[Residuals]]:
    """Return statuses and residuals of frames of pools with perfectly labelled dots."""
    statuses: Counter[str] = Counter()
    residuals: list[Residuals] = []
    near: SplineSurface | None = None
    exact, known = replace(rig, uncertainty=None), rig.uncertainty
    assert known is not None
    for pool in pools:
        reflections = trace(pool, true)
        image_px = to_image(reflections.plane_mm)
        inside = ((image_px > 3) & (image_px < np.array(SHAPE[::-1]) - 4)).all(axis=-1)
        shown = reflections.visible & inside & (rng.random(inside.shape) > MISSING)
        ray, noise = np.argwhere(shown) + 1, rng.normal(0, sigma_px, (int(shown.sum()), 2))
        dots = known.axes.calibration.to_plane(image_px[shown] + noise)
        covariance = np.broadcast_to((sigma_px / PX_PER_MM) ** 2 * np.eye(2), (len(ray), 2, 2))
        ray_states = np.where(shown, 1, np.where(reflections.lit | reflections.absent, 0, -1))
        match = MatchedDots(ray, dots, covariance, ray_states, MISSING)
        try:
            pool_fit = fit_pool(match, exact, FitSettings(), near, weigh_by_height_sigma=True)
        except CannotMeasure as error:
            statuses[error.status] += 1
            near = None
            continue
        statuses["ok"] += 1
        near = pool_fit.surface
        residuals.append(Residuals(ray, pool_fit.residual_mm, pool_fit.surface))
    return statuses, residuals


def checked(rig: Rig, bench: SimulatedBench, rng: np.random.Generator) -> Rig:
    """Return the setup after a check with a plate and a cap, without the torch."""
    without_torch, sightings = replace(rig, electrode=Electrode(500.0)), []
    bench = replace(bench, rig=replace(bench.rig, electrode=without_torch.electrode))
    for mirror in MIRRORS:
        sightings.append(sighting(mirror, *seen_dots(surface_like(mirror, rng), bench, rng)))
    found = adjust(without_torch, sightings)
    adjusted = adjusted_bench(without_torch, found, checked=True).rig
    return replace(adjusted, electrode=rig.electrode)


def false_alarms(
    recordings: int, frames: int, errors: BenchErrors | None, *, is_checked: bool = False
) -> None:
    """Judge recordings of benches that are exact, or whose errors are within their uncertainty."""
    doubted = judged = 0
    for n in range(recordings):
        rng = np.random.default_rng([SEED, n])
        rig, pool = draw_pool(list(KINDS)[n % len(KINDS)], rng)
        rig = replace(rig, uncertainty=ASSUMED)
        swing = Oscillation(rng.uniform(0, 0.015), rng.uniform(10, 40))
        pool, growth = replace(pool, terms=(*pool.terms, swing)), rng.uniform(-0.05, 0.1)
        drift, sigma_px = rng.uniform(-0.2, 0.2, 2), rng.uniform(0.1, 0.3)
        bench = SimulatedBench(rig, VIEW)
        if errors is not None:
            bench = draw_bench(rig, VIEW, errors, rng)
        if is_checked:
            rig = checked(rig, bench, rng)
        share = np.linspace(0, 1, frames)
        pools = [
            grown(pool.after(k / RATE_HZ), growth * s, drift * s)
            for k, s in enumerate(share.tolist())
        ]
        verdict = judge_setup(
            rig, *recorded(pools, rig, bench.rig, bench.view.to_image, sigma_px, rng)
        )
        judged += "too few" not in verdict.reason
        doubted += verdict.is_doubtful
        if verdict.is_doubtful:
            print(f"  {n}: {verdict.reason}", flush=True)
    print(f"{doubted} of {recordings} recordings in doubt, {judged} of them with enough dots")


Responses = tuple[BoolArray, list[DotResponse]]
_KEPT: dict[tuple[object, ...], Responses] = {}


def kept_responses(rig: Rig, surfaces: Sequence[SplineSurface], ray: IntArray) -> Responses:
    """Return cached `dot_responses`, which do not depend on the ± of the rig."""
    key = (*map(id, surfaces), ray.tobytes())
    if key not in _KEPT:
        _KEPT[key] = dot_responses(rig, surfaces, ray)
    return _KEPT[key]


def smallest(
    rig: Rig, samples: Sequence[Residuals], one: Direction, share: Callable[[int], float]
) -> float:
    """Return the smallest error of a quantity that causes doubt, in its unit; inf if none."""
    middle = samples[len(samples) // 2]
    ray = middle.ray
    known, (response,) = kept_responses(rig, [middle.surface], ray)
    pattern = np.full((rig.pattern.rows, rig.pattern.columns, 2), np.nan)
    pattern[tuple(ray[known].T - 1)] = (response.by_quantity @ one.vector).reshape(-1, 2)

    def is_doubted(size: float) -> bool:
        moved = []
        for k, sample in enumerate(samples):
            effect = np.nan_to_num(pattern[tuple(sample.ray.T - 1)])
            residual = sample.residual_mm - size * share(k) * effect
            moved.append(replace(sample, residual_mm=residual))
        return judge_setup(rig, {"ok": len(samples)}, moved).is_doubtful

    low, high = 1e-4, 200.0
    if not is_doubted(high):
        return np.inf
    while high > 1.03 * low:
        middle_size = (low * high) ** 0.5
        low, high = (low, middle_size) if is_doubted(middle_size) else (middle_size, high)
    return high


def simulated(rig: Rig, one: Direction, size: float, pools: Sequence[Pool]) -> str:
    """Return the verdict on a recording simulated with the error, without linearization."""
    exact, offset = replace(rig, uncertainty=None), size * one.vector
    try:
        true = moved_rig(exact, offset)
        camera = moved_calibration(ASSUMED.axes, rig.imaging_plane, offset)
        rng = np.random.default_rng([SEED, 1])
        verdict = judge_setup(rig, *recorded(pools, rig, true, camera.to_image, 0.16, rng))
    except ValueError as error:
        return f"impossible: {error}"
    if not verdict.is_doubtful:
        return "no doubt"
    constant = [suspect for suspect in verdict.suspects if not suspect.is_drift]
    named = [suspect for suspect in constant if suspect.name == one.name]
    if not named:
        return f"doubt, not named among {len(constant)}: {verdict.reason}"
    rank = constant.index(named[0]) + 1
    return f"doubt, named {rank} of {len(constant)}, off {named[0].off:.3g} ± {named[0].sigma:.2g}"


def sizes(frames: int) -> None:
    """Print the smallest detectable error of each quantity, and the verdict at twice that."""
    rng = np.random.default_rng([SEED, frames])
    rig = replace(BENCH_RIG, uncertainty=ASSUMED)
    pools = [
        egg(6.66, 3.0, 4.4, 0.29, (0.0, -0.6), (Oscillation(0.012, 22.0, k / RATE_HZ),))
        for k in range(frames)
    ]
    _, samples = recorded(pools, rig, rig, VIEW.to_image, 0.16, rng)
    samples = samples[:: -(-len(samples) // MOST)] if frames > MOST else samples
    sightings = [expected_sighting(mirror, rig) for mirror in MIRRORS]
    system = System.of(rig, [one for one in sightings if one], None)
    checked_uncertainty = replace(
        ASSUMED, covariance=system.adjustment(np.zeros(system.size), 1.0).covariance
    )
    _, (response,) = kept_responses(rig, [samples[0].surface], samples[0].ray)
    last = len(samples) - 1
    print(f"{len(samples)} frames kept of {frames}, {len(samples[0].ray)} dots")
    print(f"{'':42} {'unit':4} µm a unit  entered  checked    moves  checked × 2, {TRIED} frames")
    for one in directions(rig):
        effect_um = 1e3 * float(np.sqrt(np.mean((response.by_quantity @ one.vector) ** 2)))
        with mock.patch.object(residual_check, "dot_responses", kept_responses):
            smallest_sizes = [
                smallest(replace(rig, uncertainty=known), samples, one, lambda _: 1.0)
                for known in (ASSUMED, checked_uncertainty)
            ]
            moves = np.nan
            if not one.key.startswith(FIXED):
                moves = smallest(rig, samples, one, lambda k: k / last)
        outcome = ""
        if np.isfinite(smallest_sizes[1]):
            outcome = simulated(
                replace(rig, uncertainty=checked_uncertainty),
                one,
                2 * smallest_sizes[1],
                pools[:TRIED],
            )
        figures = " ".join(f"{each:8.3g}" for each in (effect_um, *smallest_sizes, moves))
        print(f"{one.name:42} {one.unit:4} {figures}  {outcome}", flush=True)


def main() -> None:
    """Run the study and print its figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--recordings", type=int, default=150)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--sizes", type=int, default=100)
    chosen = parser.parse_args()
    sizes(chosen.sizes)
    print("benches as set up:")
    false_alarms(chosen.recordings, chosen.frames, None)
    print("benches off by the assumed uncertainties:")
    false_alarms(chosen.recordings, chosen.frames, BenchErrors())
    print("the same, once they are checked:")
    false_alarms(chosen.recordings, chosen.frames, BenchErrors(), is_checked=True)


if __name__ == "__main__":
    main()
