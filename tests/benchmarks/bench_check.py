"""Bench checks on simulated benches: coverage of the height's ±, and errors of the height.

Run as ``python -m tests.benchmarks.bench_check [--benches N] [--full M] [--seed S]``. Benches are
drawn around one setup, with errors in all quantities that have a ±, including those of the glass.
Pools of two kinds are measured on each before and after the check, and with the true setup, where
only noise and level contribute errors. For the first M benches dots are matched as in the app; for
the others each dot's ray is given, which is about ten times as fast. Each set of pictures is taken
with plates levelled to each of `LEVELS_DEG`, on the same benches with the same draws.
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
from labapp.core.bench_check.labelling import MirrorDots
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from labapp.core.images.dots import Dots
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import PoolSurface, exact_match, trace
from labapp.simulation.pools import Pool, egg, spherical_cap
from tests.mirrors import FlatMirror
from tests.simulated_benches import BenchErrors, SimulatedBench, draw_bench

PX_PER_MM, SIGMA_PX, SHAPE = 4.7, 0.12, (640, 480)
MIDDLE = np.array([SHAPE[1] - 1, SHAPE[0] - 1]) / 2
# The camera is aimed at the plane's middle.
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
"""Standard deviations of the plates' tilt, also assumed by the check: the default, a ground plate
on a surface plate, and exactly level."""


def levelled(mirror: Plate | Cap, level_deg: float) -> Plate | Cap:
    """Return the mirror; a plate gets the given tilt uncertainty."""
    return replace(mirror, tilt_sigma_deg=level_deg) if isinstance(mirror, Plate) else mirror


CANDIDATES: dict[str, tuple[Mirror, ...]] = {
    f"{name}, {level:g} deg": tuple(levelled(one, level) for one in mirrors)
    for level in LEVELS_DEG
    for name, mirrors in PICTURES.items()
}


def surface_like(mirror: Mirror, rng: np.random.Generator) -> PoolSurface:
    """Return a true surface of a mirror, with errors drawn from its uncertainties."""
    if isinstance(mirror, Plate):
        rise = np.tan(np.radians(rng.normal(0, mirror.tilt_sigma_deg, 2)))
        height = mirror.height_mm + rng.normal(0, mirror.height_sigma_mm)
        return FlatMirror(float(height), *map(float, rise))
    assert isinstance(mirror, Cap)
    diameter = mirror.diameter_mm + rng.normal(0, mirror.diameter_sigma_mm)
    height = mirror.height_mm + rng.normal(0, mirror.height_sigma_mm)
    x, y = rng.normal(0, 0.4, 2)
    return spherical_cap(float(diameter), float(height), (float(x), float(y)))


def seen_dots(
    surface: PoolSurface, bench: SimulatedBench, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return positions of dots in the picture, px, and their rays, counted from 0."""
    reflections = trace(surface, bench.rig)
    image_px = bench.view.to_image(reflections.plane_mm)
    shown = reflections.visible & ((image_px > 3) & (image_px < [SHAPE[1] - 4, SHAPE[0] - 4])).all(
        axis=-1
    )
    return image_px[shown] + rng.normal(0, SIGMA_PX, (int(shown.sum()), 2)), np.argwhere(shown)


def dots_at(image_px: FloatArray) -> Dots:
    """Return dots at positions in the picture."""
    n = len(image_px)
    sigma_px = np.full(n, SIGMA_PX)
    shape = np.full(n, 2.0), np.full(n, 50.0), np.full(n, 20.0)
    return Dots(image_px[:, 0], image_px[:, 1], sigma_px, sigma_px, *shape)


def sighting(mirror: Mirror, image_px: FloatArray, ray: FloatArray) -> Sighting:
    """Return the sighting from a perfect match."""
    covariance = np.tile((SIGMA_PX / PX_PER_MM) ** 2 * np.eye(2), (len(image_px), 1, 1))
    return Sighting(mirror, ray, CALIBRATION.to_plane(image_px), covariance)


ToPlane = Callable[[FloatArray], FloatArray]
"""From positions in the picture, px, to the imaging plane, mm."""


def measured(
    pool: Pool, bench: SimulatedBench, rig: Rig, to_plane: ToPlane, seed: list[int]
) -> tuple[float, float]:
    """Return a pool's height with a setup, and its ±, mm; NaN without a surface."""
    rng = np.random.default_rng(seed)
    image_px, ray = seen_dots(pool, bench, rng)
    match = exact_match(trace(pool, bench.rig))
    keep = (match.ray[:, None] == ray + 1).all(-1).any(1)
    covariance = np.tile((SIGMA_PX / PX_PER_MM) ** 2 * np.eye(2), (len(image_px), 1, 1))
    match = replace(
        match, dot=match.dot[: keep.sum()], ray=ray + 1, reflected=match.reflected[keep],
        plane_mm=to_plane(image_px), plane_covariance_mm2=covariance,
    )  # fmt: skip
    try:
        measures = measure_surface(reconstruct(match, rig, Settings()), match, rig)
    except CannotMeasure:
        return np.nan, np.nan
    return measures.height_mm, measures.height_sigma_mm


def main() -> None:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--benches", type=int, default=200)
    parser.add_argument("--full", type=int, default=10)
    parser.add_argument("--seed", type=int, default=18)
    chosen = parser.parse_args()
    errors: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    statuses: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for n in range(chosen.benches):
        rng = np.random.default_rng([chosen.seed, n])
        bench = draw_bench(BEHIND_GLASS, VIEW, ERRORS, rng)
        width, height = float(rng.uniform(5.5, 7.5)), float(rng.uniform(0.15, 0.35))
        pool = spherical_cap(width, height) if n % 2 else egg(width, width / 2, 0.6 * width, height)
        predicted = {
            one.name: (one.total_sigma_mm, one.setup_sigma_mm)
            for one in forecast(BEHIND_GLASS, CANDIDATES, Cap(width, height))
        }
        seed = [chosen.seed, n, 1]
        exact = replace(BEHIND_GLASS, uncertainty=None)
        predicted["true"] = height_sigma(exact, Cap(width, height)).total_sigma_mm, 0.0
        results: dict[str, tuple[Rig, ToPlane]] = {
            "true": (bench.rig, bench.view.to_plane),
            "as it is": (BEHIND_GLASS, CALIBRATION.to_plane),
        }
        for k, (name, mirrors) in enumerate(CANDIDATES.items()):
            rng_pictures = np.random.default_rng([chosen.seed, n, 2, k % len(PICTURES)])
            sightings = [
                (m, *seen_dots(surface_like(m, rng_pictures), bench, rng_pictures)) for m in mirrors
            ]
            if n < chosen.full:
                pictures = [
                    MirrorDots(m.name, m, dots_at(place), SHAPE) for m, place, _ in sightings
                ]
                try:
                    check = check_bench(pictures, Bench(BEHIND_GLASS, CALIBRATION))
                except CannotMeasure as error:
                    statuses[name][error.status] += 1
                    continue
                statuses[name][check.status] += 1
                results[name] = check.rig, check.calibration.to_plane
            else:
                adjustment = adjust(BEHIND_GLASS, [sighting(*one) for one in sightings])
                after = adjusted_bench(BEHIND_GLASS, adjustment, checked=True)
                results[name] = after.rig, after.calibration.to_plane
        by_truth = np.nan
        for name, (rig, to_plane) in results.items():
            height_mm, sigma = measured(pool, bench, rig, to_plane, seed)
            by_truth = height_mm if name == "true" else by_truth
            row = height_mm - height, sigma, *predicted[name], height_mm - by_truth, height
            errors[name].append(row)
        if n % 10 == 9 or n == chosen.benches - 1:
            report(errors, statuses)


def report(errors: dict[str, list[tuple[float, ...]]], statuses: dict[str, dict[str, int]]) -> None:
    """Print the results so far."""
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
