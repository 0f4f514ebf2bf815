"""What recordings can tell of their set-up: false alarms, and the size that can be seen.

Run as ``python tests/benchmarks/setup_doubt.py [--recordings N] [--frames M] [--sizes K]``. Dots of
pools of seven kinds that swing, grow and wander are simulated, on benches that are exactly as set
up, on such as are off by the assumed uncertainties, and on the latter once they are checked against
a plate and a cap. Before that the size of each quantity is searched
for at which a recording of K frames is in doubt: what that size leaves in the residuals, by its
linear response, is added to those of a right bench; a bench that is truly off by twice of it is
simulated, too.
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
from labapp.core.recording import residual_check
from labapp.core.recording.dot_response import DotResponse, dot_responses
from labapp.core.recording.residual_check import FIXED, MOST, Residuals, judge_setup
from labapp.core.surface.pool_fit import FitSettings, fit_pool
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray
from labapp.simulation.benches import BenchErrors, SimulatedBench, draw_bench
from labapp.simulation.forward import trace
from labapp.simulation.pools import Oscillation, Pool, egg
from tests.benchmarks.bench_check import (
    CALIBRATION,
    PX_PER_MM,
    SHAPE,
    VIEW,
    seen,
    sighting,
    surface_like,
)
from tests.benchmarks.clutter import KINDS, draw_pool
from tests.scenes import BENCH_RIG

RATE_HZ, MISSING, SEED, TRIED = 60.0, 0.02, 18, 16
MIRRORS = (Plate(0.0), Cap(9.75, 0.91))
ASSUMED = RigUncertainty(
    AxisPoints(CALIBRATION, VIEW.x_axis_mm, VIEW.z_axis_mm), *covariance_of({})
)


def grown(pool: Pool, by: float, aside: FloatArray) -> Pool:
    """A pool that has grown by a share, higher by half more, and wandered."""
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
    """Statuses and residuals of pools' frames, their dots labelled without a fault."""
    statuses: Counter[str] = Counter()
    found: list[Residuals] = []
    near: SplineSurface | None = None
    exact, known = replace(rig, uncertainty=None), rig.uncertainty
    assert known is not None
    for pool in pools:
        made_dots = trace(pool, true)
        place = to_image(made_dots.plane_mm)
        inside = ((place > 3) & (place < np.array(SHAPE[::-1]) - 4)).all(axis=-1)
        shown = made_dots.visible & inside & (rng.random(inside.shape) > MISSING)
        ray, noise = np.argwhere(shown) + 1, rng.normal(0, sigma_px, (int(shown.sum()), 2))
        dots = known.axes.calibration.to_plane(place[shown] + noise)
        covariance = np.broadcast_to((sigma_px / PX_PER_MM) ** 2 * np.eye(2), (len(ray), 2, 2))
        witness = np.where(shown, 1, np.where(made_dots.lit | made_dots.absent, 0, -1))
        given = ray, dots, covariance, witness, exact, FitSettings(), near, MISSING
        try:
            made = fit_pool(*given)
        except CannotMeasure as why:
            statuses[why.status] += 1
            near = None
            continue
        statuses["ok"] += 1
        near = made.surface
        found.append(Residuals(ray, made.residual_mm, made.surface))
    return statuses, found


def checked(rig: Rig, bench: SimulatedBench, rng: np.random.Generator) -> Rig:
    """The set-up once it is checked against a plate and a cap, without the torch."""
    free, sightings = replace(rig, electrode=Electrode(500.0)), []
    bench = replace(bench, rig=replace(bench.rig, electrode=free.electrode))
    for mirror in MIRRORS:
        sightings.append(sighting(mirror, *seen(surface_like(mirror, rng), bench, rng)))
    adjusted, _ = adjusted_bench(free, adjust(free, sightings), checked=True)
    return replace(adjusted, electrode=rig.electrode)


def false_alarms(
    recordings: int, frames: int, errors: BenchErrors | None, *, is_checked: bool = False
) -> None:
    """Judge recordings of benches that are right, or off by no more than is known."""
    doubted = judged = 0
    for n in range(recordings):
        rng = np.random.default_rng([SEED, n])
        rig, pool = draw_pool(list(KINDS)[n % len(KINDS)], rng)
        rig = replace(rig, uncertainty=ASSUMED)
        swing = Oscillation(rng.uniform(0, 0.015), rng.uniform(10, 40))
        pool, growth = replace(pool, terms=(*pool.terms, swing)), rng.uniform(-0.05, 0.1)
        way, sigma_px = rng.uniform(-0.2, 0.2, 2), rng.uniform(0.1, 0.3)
        bench = SimulatedBench(rig, VIEW)
        if errors is not None:
            bench = draw_bench(rig, VIEW, errors, rng)
        if is_checked:
            rig = checked(rig, bench, rng)
        share = np.linspace(0, 1, frames)
        pools = [
            grown(pool.after(k / RATE_HZ), growth * s, way * s)
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
    """`dot_responses`, worked out once for the same surfaces, whatever the ± of the rig."""
    key = (*map(id, surfaces), ray.tobytes())
    if key not in _KEPT:
        _KEPT[key] = dot_responses(rig, surfaces, ray)
    return _KEPT[key]


def smallest(
    rig: Rig, samples: Sequence[Residuals], one: Direction, share: Callable[[int], float]
) -> float:
    """Smallest size of a quantity that brings samples into doubt, in its unit; inf: none."""
    middle = samples[len(samples) // 2]
    ray = middle.ray
    known, (response,) = kept_responses(rig, [middle.surface], ray)
    pattern = np.full((rig.pattern.rows, rig.pattern.columns, 2), np.nan)
    pattern[tuple(ray[known].T - 1)] = (response.by_quantity @ one.vector).reshape(-1, 2)

    def is_doubted(size: float) -> bool:
        moved = []
        for k, sample in enumerate(samples):
            by = np.nan_to_num(pattern[tuple(sample.ray.T - 1)])
            residual = sample.residual_mm - size * share(k) * by
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
    """What a recording says on a bench that is truly off: not by its linear response."""
    exact, offset = replace(rig, uncertainty=None), size * one.vector
    try:
        true = moved_rig(exact, offset)
        camera = moved_calibration(ASSUMED.axes, rig.imaging_plane, offset)
        rng = np.random.default_rng([SEED, 1])
        verdict = judge_setup(rig, *recorded(pools, rig, true, camera.to_image, 0.16, rng))
    except ValueError as why:
        return f"impossible: {why}"
    if not verdict.is_doubtful:
        return "no doubt"
    alike = [suspect for suspect in verdict.suspects if not suspect.is_drift]
    own = [suspect for suspect in alike if suspect.name == one.name]
    if not own:
        return f"doubt, not named among {len(alike)}: {verdict.reason}"
    place = alike.index(own[0]) + 1
    return f"doubt, named {place} of {len(alike)}, off {own[0].off:.3g} ± {own[0].sigma:.2g}"


def sizes(frames: int) -> None:
    """Print the size that can be seen of each quantity, and what twice of it does in earnest."""
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
    after = replace(ASSUMED, covariance=system.adjustment(np.zeros(system.size), 1.0).covariance)
    _, (response,) = kept_responses(rig, [samples[0].surface], samples[0].ray)
    last = len(samples) - 1
    print(f"{len(samples)} frames kept of {frames}, {len(samples[0].ray)} dots")
    print(f"{'':42} {'unit':4} µm a unit  entered  checked    moves  checked × 2, {TRIED} frames")
    for one in directions(rig):
        left = 1e3 * float(np.sqrt(np.mean((response.by_quantity @ one.vector) ** 2)))
        with mock.patch.object(residual_check, "dot_responses", kept_responses):
            found = [
                smallest(replace(rig, uncertainty=known), samples, one, lambda _: 1.0)
                for known in (ASSUMED, after)
            ]
            moves = np.nan
            if not one.key.startswith(FIXED):
                moves = smallest(rig, samples, one, lambda k: k / last)
        said = ""
        if np.isfinite(found[1]):
            said = simulated(replace(rig, uncertainty=after), one, 2 * found[1], pools[:TRIED])
        figures = " ".join(f"{each:8.3g}" for each in (left, *found, moves))
        print(f"{one.name:42} {one.unit:4} {figures}  {said}", flush=True)


def main() -> None:
    """Run the study and print its figures."""
    ask = argparse.ArgumentParser()
    ask.add_argument("--recordings", type=int, default=150)
    ask.add_argument("--frames", type=int, default=16)
    ask.add_argument("--sizes", type=int, default=100)
    given = ask.parse_args()
    sizes(given.sizes)
    print("benches as set up:")
    false_alarms(given.recordings, given.frames, None)
    print("benches off by the assumed uncertainties:")
    false_alarms(given.recordings, given.frames, BenchErrors())
    print("the same, once they are checked:")
    false_alarms(given.recordings, given.frames, BenchErrors(), is_checked=True)


if __name__ == "__main__":
    main()
