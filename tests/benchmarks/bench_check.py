"""How well bench checks do on simulated benches: coverage of the height's ±, and its errors.

Run as ``python -m tests.benchmarks.bench_check [--benches N] [--full M] [--seed S]``. Benches are
drawn about one set-up, with all quantities off that have a ±, those of a glass on the plane too.
Pools of two kinds are measured on each before and after the check, and with the true set-up, whose
errors are those of noise and level alone. Of the first M benches dots are matched as in the app; of
the others each dot's ray is given, which is some ten times as quick. Each set of pictures is taken
with plates that lie level to each of `LEVELS_DEG`, on the same benches with the same draws.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labapp.core.bench_check.adjustment import Sighting, adjust
from labapp.core.bench_check.check import adjusted_bench, check_bench
from labapp.core.bench_check.forecast import forecast, height_sigma
from labapp.core.bench_check.labelling import Picture
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from labapp.core.images.dots import Dots
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, FloatArray
from labapp.simulation.benches import BenchErrors, SimulatedBench, draw_bench
from labapp.simulation.calibration.mirrors import FlatMirror
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import PoolSurface, exact_match, trace
from labapp.simulation.pools import Pool, egg, spherical_cap

PX_PER_MM, SIGMA_PX, SHAPE = 4.7, 0.12, (640, 480)
MIDDLE = np.array([SHAPE[1] - 1, SHAPE[0] - 1]) / 2
# The camera looks at the plane's middle.
VIEW = CameraView.rolled(
    (float(MIDDLE[0] - 50.8 * PX_PER_MM), float(MIDDLE[1] + 50.8 * PX_PER_MM)), PX_PER_MM
)
CALIBRATION = ImageCalibration.from_three_points(
    VIEW.origin_px, VIEW.x_axis_px, VIEW.x_axis_mm, VIEW.z_axis_px, VIEW.z_axis_mm
)
RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(500.0),  # the torch is out of the way
    ImagingPlane.vertical(50.0, 45.0, 3.0),
    RigUncertainty(AxisPoints(CALIBRATION, VIEW.x_axis_mm, VIEW.z_axis_mm), *covariance_of({})),
)
BEHIND_GLASS = replace(
    RIG,
    imaging_plane=replace(RIG.imaging_plane, glass_mm=3.0),
    uncertainty=RigUncertainty(
        AxisPoints(CALIBRATION, VIEW.x_axis_mm, VIEW.z_axis_mm),
        *covariance_of({}, has_glass=True),
    ),
)
ERRORS = BenchErrors(axis_mm=0.1, glass_mm=0.1, glass_index=0.02)
PICTURES: dict[str, tuple[Plate | Cap, ...]] = {
    "plate": (Plate(0.0),),
    "two heights": (Plate(0.0), Plate(2.0)),
    "plate and cap": (Plate(0.0), Cap(9.75, 0.91)),
}
LEVELS_DEG = (0.1, 0.02, 0.0)
"""Standard deviations of how level plates lie, and what the check takes them for: what is assumed
where nothing is entered, a ground plate on a surface plate, and exactly level."""


def levelled(mirror: Plate | Cap, level_deg: float) -> Plate | Cap:
    """A mirror; if it is a plate, level to so much."""
    return replace(mirror, tilt_sigma_deg=level_deg) if isinstance(mirror, Plate) else mirror


CANDIDATES: dict[str, tuple[Mirror, ...]] = {
    f"{name}, {level:g} deg": tuple(levelled(one, level) for one in mirrors)
    for level in LEVELS_DEG
    for name, mirrors in PICTURES.items()
}


def surface_like(mirror: Mirror, rng: np.random.Generator) -> PoolSurface:
    """A mirror as it truly is: off by its uncertainties."""
    if isinstance(mirror, Plate):
        rise = np.tan(np.radians(rng.normal(0, mirror.tilt_sigma_deg, 2)))
        height = mirror.height_mm + rng.normal(0, mirror.height_sigma_mm)
        return FlatMirror(float(height), *map(float, rise))
    assert isinstance(mirror, Cap)
    diameter = mirror.diameter_mm + rng.normal(0, mirror.diameter_sigma_mm)
    height = mirror.height_mm + rng.normal(0, mirror.height_sigma_mm)
    x, y = rng.normal(0, 0.4, 2)
    return spherical_cap(float(diameter), float(height), (float(x), float(y)))


def seen(
    surface: PoolSurface, bench: SimulatedBench, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Places of dots in the picture, px, and their rays, counted from 0."""
    made = trace(surface, bench.rig)
    place = bench.view.to_image(made.plane_mm)
    shown = made.visible & ((place > 3) & (place < [SHAPE[1] - 4, SHAPE[0] - 4])).all(axis=-1)
    return place[shown] + rng.normal(0, SIGMA_PX, (int(shown.sum()), 2)), np.argwhere(shown)


def dots_at(place: FloatArray) -> Dots:
    """Dots at places in the picture."""
    n = len(place)
    same = np.full(n, SIGMA_PX)
    shape = np.full(n, 2.0), np.full(n, 50.0), np.full(n, 20.0)
    return Dots(place[:, 0], place[:, 1], same, same, *shape)


def sighting(mirror: Mirror, place: FloatArray, ray: FloatArray) -> Sighting:
    """What a perfect matching would give."""
    covariance = np.tile((SIGMA_PX / PX_PER_MM) ** 2 * np.eye(2), (len(place), 1, 1))
    return Sighting(mirror, ray, CALIBRATION.to_plane(place), covariance)


ToPlane = Callable[[FloatArray], FloatArray]
"""From places in the picture, px, to the imaging plane, mm."""


def measured(
    pool: Pool, bench: SimulatedBench, rig: Rig, to_plane: ToPlane, seed: list[int]
) -> tuple[float, float]:
    """A pool's height by a set-up, and its ±, mm; NaN without a surface."""
    rng = np.random.default_rng(seed)
    place, ray = seen(pool, bench, rng)
    match = exact_match(trace(pool, bench.rig), rig)
    keep = (match.ray[:, None] == ray + 1).all(-1).any(1)
    covariance = np.tile((SIGMA_PX / PX_PER_MM) ** 2 * np.eye(2), (len(place), 1, 1))
    match = replace(
        match, dot=match.dot[: keep.sum()], ray=ray + 1, reflected=match.reflected[keep],
        plane_mm=to_plane(place), plane_covariance_mm2=covariance,
    )  # fmt: skip
    try:
        made = measure_surface(reconstruct(match, rig, Settings()), match, rig)
    except CannotMeasure:
        return np.nan, np.nan
    return made.height_mm, made.height_sigma_mm


def main() -> None:
    """Run the study and print its tables."""
    ask = argparse.ArgumentParser()
    ask.add_argument("--benches", type=int, default=200)
    ask.add_argument("--full", type=int, default=10)
    ask.add_argument("--seed", type=int, default=18)
    given = ask.parse_args()
    errors: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    statuses: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for n in range(given.benches):
        rng = np.random.default_rng([given.seed, n])
        bench = draw_bench(BEHIND_GLASS, VIEW, ERRORS, rng)
        width, height = float(rng.uniform(5.5, 7.5)), float(rng.uniform(0.15, 0.35))
        pool = spherical_cap(width, height) if n % 2 else egg(width, width / 2, 0.6 * width, height)
        predicted = {
            one.name: (one.total_sigma_mm, one.setup_sigma_mm)
            for one in forecast(BEHIND_GLASS, CANDIDATES, Cap(width, height))
        }
        seed = [given.seed, n, 1]
        exact = replace(BEHIND_GLASS, uncertainty=None)
        predicted["true"] = height_sigma(exact, Cap(width, height)).total_sigma_mm, 0.0
        results: dict[str, tuple[Rig, ToPlane]] = {
            "true": (bench.rig, bench.view.to_plane),
            "as it is": (BEHIND_GLASS, CALIBRATION.to_plane),
        }
        for k, (name, mirrors) in enumerate(CANDIDATES.items()):
            own = np.random.default_rng([given.seed, n, 2, k % len(PICTURES)])
            shots = [(m, *seen(surface_like(m, own), bench, own)) for m in mirrors]
            if n < given.full:
                pictures = [Picture(m.name, m, dots_at(place), SHAPE) for m, place, _ in shots]
                try:
                    check = check_bench(pictures, BEHIND_GLASS, CALIBRATION)
                except CannotMeasure as why:
                    statuses[name][why.status] += 1
                    continue
                statuses[name][check.status] += 1
                results[name] = check.rig, check.calibration.to_plane
            else:
                made = adjust(BEHIND_GLASS, [sighting(*one) for one in shots])
                rig, calibration = adjusted_bench(BEHIND_GLASS, made, checked=True)
                results[name] = rig, calibration.to_plane
        by_truth = np.nan
        for name, (rig, to_plane) in results.items():
            found, sigma = measured(pool, bench, rig, to_plane, seed)
            by_truth = found if name == "true" else by_truth
            row = found - height, sigma, *predicted[name], found - by_truth, height
            errors[name].append(row)
        if n % 10 == 9 or n == given.benches - 1:
            report(errors, statuses)


def report(errors: dict[str, list[tuple[float, ...]]], statuses: dict[str, dict[str, int]]) -> None:
    """Print what has come out so far."""
    print(
        f"{'':23} {'n':>4} lost covered     error         ± predicted  | by the set-up, predicted "
        "| error's fall  (RMS, % of the height)"
    )
    before = np.nan
    for name, rows in errors.items():
        error, sigma, predicted, predicted_setup, by_setup, height = np.array(rows).T
        known = np.isfinite(error)
        covered = np.mean(np.abs(error[known]) < 1.96 * sigma[known])
        percent = [
            100 * float(np.sqrt(np.nanmean((part[known] / height[known]) ** 2)))
            for part in (error, sigma, predicted, by_setup, predicted_setup)
        ]
        lost = int((~known).sum())
        line = " ".join(f"{value:9.2f}" for value in percent)
        before = percent[0] if name == "as it is" else before
        fall = before / percent[0]
        print(f"{name:23} {len(rows):4} {lost:4} {100 * covered:6.1f}% {line} {fall:9.2f}")
    print({name: dict(each) for name, each in statuses.items()}, flush=True)


if __name__ == "__main__":
    main()
