"""Rendered frames of pools of every kind on benches of every kind.

Run as ``python tests/benchmarks/benches.py [--pools N] [--seed S] [--off TIMES] [--refused]
[KIND …]``. Pools are those of ``clutter.py``. Each frame has its own bench: laser (angle, distance,
aim), pattern (9 to 25 rows, 0.3 to 0.5 mm apart on the work piece), pose of the imaging plane,
direction of travel, and camera (size of the picture, view upright, mirrored, rolled or oblique).
The setup has the default uncertainties of a setup file, and TIMES the errors of ``clutter.py``. The
look is that of ``rendered.py``. At least `FEWEST` dots are in the picture. Prints a line for each
frame with wrong labels, or with a size off by more than 4 of its σ; then, for every kind, how many
were measured, and the root mean square of error over σ of each size. Fails if any frame was
measured wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import LowRear, Pool
from labapp.simulation.render import GreyImage, RenderedFrame, render
from tests.benchmarks.clutter import KINDS, as_entered, displaced
from tests.benchmarks.dips import height_error
from tests.benchmarks.rendered import ON_ITS_DOT_PX, PX_PER_MM, draw_look

FEWEST, MOST_SIGMAS = 25, 4.0

ON_ITS_DOT_MM = ON_ITS_DOT_PX / PX_PER_MM

SIZES = ("width_mm", "length_mm", "height_mm", "depth_mm")

PICTURES = ((480, 640), (640, 480), (800, 600), (1280, 1024), (1600, 1200))


@dataclass(frozen=True)
class Scene:
    """A frame, its bench as entered, its pool, and the true rig and view."""

    frame: RenderedFrame
    bench: Bench
    pool: Pool
    rig: Rig
    view: CameraView

    @property
    def px_per_mm(self) -> float:
        """Scale along X′."""
        return float(np.linalg.norm(self.view.px_per_mm[:, 0]))


@dataclass(frozen=True)
class SceneResult:
    """Result for one frame: status and reason, wrong and right labels, and errors.

    The error of the height (or depth) is a share of it, those of all sizes are in units of their σ.
    """

    status: str
    reason: str = ""
    wrong: int = 0
    right: int = 0
    height: float = float("nan")
    sigmas: dict[str, float] = field(default_factory=dict)

    @property
    def is_wrong(self) -> bool:
        """A wrong surface was shown as right."""
        return self.wrong > 0 or any(abs(one) > MOST_SIGMAS for one in self.sigmas.values())


def draw_rig(rng: np.random.Generator) -> Rig:
    """Draw a bench whose imaging plane, 200 mm wide, catches the reflection of a flat plate.

    The lower edge of the plane is at most 5 mm above the work piece.
    """
    angle_deg, distance_mm = rng.uniform(22.0, 42.0), rng.uniform(25.0, 60.0)
    step_deg = float(np.degrees(np.arctan(rng.uniform(0.30, 0.50) / distance_mm)))
    count, away_mm = int(rng.choice([9, 13, 15, 17, 19, 21, 25])), rng.uniform(35.0, 80.0)
    tilt_deg = (rng.uniform(-10.0, 25.0), rng.uniform(-6.0, 6.0), rng.uniform(-2.0, 2.0))
    middle_mm = np.array([0.0, -away_mm, away_mm * np.tan(np.radians(angle_deg))])
    plane = ImagingPlane.of_angles(middle_mm, tilt_deg, 200.0, 200.0)
    above_mm = (middle_mm[2] - rng.uniform(0.0, 5.0)) / plane.z_axis[2]
    corner_mm = plane.to_universal(np.array([-100.0, -above_mm]))
    return Rig(
        laser=Laser(angle_deg, distance_mm, rng.normal(0.0, 0.5), *rng.normal(0.0, 0.2, 2)),
        pattern=DotPattern(count, count, step_deg),
        electrode=Electrode(5.0),
        imaging_plane=ImagingPlane.of_angles(corner_mm, tilt_deg, 200.0, 200.0),
        travel="+y" if rng.random() < 0.6 else "-y",
    )


def draw_view(rays: Reflections, rng: np.random.Generator) -> CameraView:
    """Draw a camera in whose picture the dots fill half to nine tenths of one side."""
    width, height = PICTURES[rng.integers(len(PICTURES))]
    dots = rays.plane_mm[rays.visible]
    low, high = dots.min(axis=0), dots.max(axis=0)
    px_per_mm = rng.uniform(0.5, 0.9) * float(np.min(np.array([width, height]) / (high - low)))
    px_per_mm = min(px_per_mm, 20.0)
    roll, shear = np.radians(rng.normal(0.0, [1.5, 1.5]))
    side = -1.0 if rng.random() < 0.15 else 1.0
    along = px_per_mm * side * np.array([np.cos(roll), -np.sin(roll)])
    up = px_per_mm * rng.uniform(0.9, 1.1) * np.array([-np.sin(roll + shear), -np.cos(roll)])
    middle = (low + high) / 2
    origin = np.array([width, height]) / 2 - middle[0] * along - middle[1] * up
    x_axis, z_axis = origin + 60.0 * along, origin + 60.0 * up
    return CameraView(tuple(origin), tuple(x_axis), 60.0, tuple(z_axis), 60.0, width, height)


def facing(pool: Pool, rig: Rig) -> Pool:
    """Return the pool with its head on the side towards which the torch travels."""
    if rig.head_sign > 0:
        return pool
    foot = pool.footprint
    terms = tuple(
        replace(term, towards=1) if isinstance(term, LowRear) else term for term in pool.terms
    )
    turned = replace(foot, head_mm=foot.tail_mm, tail_mm=foot.head_mm)
    return replace(pool, footprint=turned, terms=terms)


def draw_scene(kind: str, seed: int, off: float = 0.0) -> Scene:
    """Draw benches and pools until enough dots are in the picture; enter the bench with errors."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), 7])
    while True:
        rig = draw_rig(rng)
        middle = tuple(rng.uniform(-0.5, 0.5, 2))
        pool = facing(KINDS[kind](rng, rng.uniform(4.0, 7.0), middle), rig)
        rays = trace(pool, rig)
        if rays.visible.sum() < FEWEST:
            continue
        view = draw_view(rays, rng)
        frame = render(rays, view, draw_look(rng), rng)
        if frame.shown.sum() < FEWEST:
            continue
        axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
        calibration = ImageCalibration.from_three_points(*axes)
        entered = as_entered(displaced(rig, rng, off), calibration)
        return Scene(frame, Bench(entered, calibration), pool, rig, view)


def image_of(scene: Scene) -> GreyImage:
    """Return the frame's image."""
    return np.asarray(scene.frame.image, np.uint8)


def compared(scene: Scene, result: Measurement) -> SceneResult:
    """Compare the measurement of a frame with the truth."""
    if result.match is None or result.measures is None or result.dots is None:
        return SceneResult(result.status, result.reason)
    true_px = np.where(scene.frame.shown[..., None], scene.frame.dot_px, np.nan)
    dots = np.column_stack([result.dots.u_px, result.dots.v_px])[result.match.dot]
    distance = np.linalg.norm(dots - true_px[tuple(result.match.ray.T - 1)], axis=-1)
    near_px = max(ON_ITS_DOT_PX, ON_ITS_DOT_MM * scene.px_per_mm)
    wrong = int((~(distance < near_px)).sum())
    sigmas = {}
    for name in SIZES:
        sigma = getattr(result.measures, name.replace("_mm", "_sigma_mm"))
        error = getattr(result.measures, name) - getattr(scene.pool.size, name)
        sigmas[name] = error / sigma if sigma > 0 else np.nan
    height = height_error(scene.pool, result.measures)
    return SceneResult("ok", "", wrong, len(dots) - wrong, height, sigmas)


def summary(kind: str, results: list[SceneResult]) -> str:
    """Return statuses, error of the height, and error over σ of each size of frames of a kind."""
    counts = Counter(one.status for one in results).most_common()
    statuses = ", ".join(f"{count} {status}" for status, count in counts)
    errors = [[one.sigmas[name] for one in results if one.sigmas] for name in SIZES]
    rms = ", ".join(
        f"{name[:-3]} {np.sqrt(np.nanmean(np.square(of_size))):.2f}"
        for name, of_size in zip(SIZES, errors, strict=True)
        if np.isfinite(of_size).any()
    )
    off_pct = [100 * abs(one.height) for one in results if one.sigmas] or [np.nan]
    return (
        f"{kind}: {statuses}; height off by {np.median(off_pct):.2f} % in the median, "
        f"{max(off_pct):.2f} % at worst; error/σ {rms}"
    )


def main() -> int:
    """Print the results; return the number of frames with a wrong surface."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--pools", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--off", type=float, default=0.0)
    parser.add_argument("--refused", action="store_true", help="print a line for these as well")
    chosen = parser.parse_args()
    wrong = 0
    for kind in chosen.kinds:
        results = []
        for seed in range(chosen.seed, chosen.seed + chosen.pools):
            scene = draw_scene(kind, seed, chosen.off)
            result = measure(image_of(scene), scene.bench, Settings())[0]
            results.append(one := compared(scene, result))
            if one.is_wrong or (chosen.refused and one.status != "ok"):
                print(f"{kind} {seed}: {one}", flush=True)
        wrong += sum(one.is_wrong for one in results)
        print(summary(kind, results), flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
