"""Rendered frames of pools of every kind with a fault each: hidden dots, light, optics, coding.

Run as ``python tests/benchmarks/faults.py [--pools N] [--seed S] [--kinds KIND …] [FAULT …]``.
Frames are those of ``rendered.py`` without missing and false dots, each spoiled by one fault. A
frame need not be measured, but what is measured must be right. Prints a line for each frame with
wrong labels, or with a height off by more than 3 of its σ; then, for every fault, how many were
measured and why the others were not. Fails if any label is wrong or any height is off by so much.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Settings, measure
from labapp.core.values import FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.render import GreyImage, Look, render
from tests.benchmarks.clutter import KINDS, as_entered, draw_pool
from tests.benchmarks.rendered import ON_ITS_DOT_PX, draw_look, draw_view

MOST_SIGMAS = 3.0

Hide = Callable[[Reflections, np.random.Generator], Reflections]
Spoil = Callable[[GreyImage, np.random.Generator], GreyImage]


def hidden_lines(axis: int, line: int, count: int = 1) -> Hide:
    """Hide rows (axis 0) or columns: those from the n-th with dots on."""

    def hide(rays: Reflections, rng: np.random.Generator) -> Reflections:
        lit = np.flatnonzero(rays.visible.any(axis=1 - axis))
        chosen = lit[line : line + count] if line >= 0 else lit[line - count + 1 : line + 1 or None]
        hidden = np.isin(np.indices(rays.hit.shape)[axis], chosen)
        return replace(rays, on_plane=rays.on_plane & ~hidden)

    return hide


def beyond_a_line(rays: Reflections, rng: np.random.Generator) -> Reflections:
    """Hide all dots beyond a straight line on the plane, 10 to 35 % of them."""
    angle = rng.uniform(0.0, 2 * np.pi)
    along = rays.plane_mm @ np.array([np.cos(angle), np.sin(angle)])
    limit = np.quantile(along[rays.visible], rng.uniform(0.65, 0.9))
    return replace(rays, on_plane=rays.on_plane & (along < limit))


def behind_a_strip(rays: Reflections, rng: np.random.Generator) -> Reflections:
    """Hide all dots in a straight strip, as a wire does: 2 to 6 mm wide, near the middle."""
    angle = rng.uniform(0.0, 2 * np.pi)
    along = rays.plane_mm @ np.array([np.cos(angle), np.sin(angle)])
    middle = np.quantile(along[rays.visible], rng.uniform(0.2, 0.8))
    return replace(rays, on_plane=rays.on_plane & (np.abs(along - middle) > rng.uniform(1.0, 3.0)))


def blotted(rays: Reflections, rng: np.random.Generator) -> Reflections:
    """Hide all dots in a round spot of 4 to 10 mm."""
    spot = rng.choice(rays.plane_mm[rays.visible])
    distance = np.linalg.norm(rays.plane_mm - spot, axis=-1)
    return replace(rays, on_plane=rays.on_plane & ~(distance < rng.uniform(2.0, 5.0)))


def second_hole(rays: Reflections, rng: np.random.Generator) -> Reflections:
    """Hide one dot within three rows and columns of the marker's."""
    place = 9 + rng.integers(-3, 4, 2)
    hidden = np.zeros(rays.hit.shape, bool)
    hidden[tuple(place)] = True
    return replace(rays, on_plane=rays.on_plane & ~hidden)


def filled_hole(rays: Reflections, rng: np.random.Generator) -> Reflections:
    """Let the absent ray shine."""
    return replace(rays, absent=np.zeros_like(rays.absent))


def half_dark(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Darken half of the picture to 30 %."""
    angle = rng.uniform(0.0, 2 * np.pi)
    v, u = np.indices(image.shape) - np.array(image.shape)[:, None, None] / 2
    dark = np.tanh((u * np.cos(angle) + v * np.sin(angle)) / 30.0)
    return _grey(image * (0.65 + 0.35 * dark))


def arc_light(height: float, longer: float = 1.0) -> Spoil:
    """Add three reflections of the arc, 10 to 40 px wide, that are longer by a factor."""

    def spoil(image: GreyImage, rng: np.random.Generator) -> GreyImage:
        light = image.astype(float)
        v, u = np.indices(image.shape)
        for _ in range(3):
            place, size = rng.random(2) * image.shape, rng.uniform(10.0, 40.0)
            angle = rng.uniform(0.0, np.pi)
            along = (v - place[0]) * np.sin(angle) + (u - place[1]) * np.cos(angle)
            across = (v - place[0]) * np.cos(angle) - (u - place[1]) * np.sin(angle)
            light += height * np.exp(-((along / longer) ** 2 + across**2) / (2 * size**2))
        return _grey(light)

    return spoil


def gratings(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Add a second grid of dots, 20 to 40 px apart, half as bright."""
    step, angle = rng.uniform(20.0, 40.0), rng.uniform(0.0, np.pi / 2)
    v, u = np.indices(image.shape)
    a, b = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    grid = (np.cos(2 * np.pi * a / step) + np.cos(2 * np.pi * b / step)) / 2
    return _grey(image + 20 * np.clip(grid, 0, None) ** 8)


def ghost(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Add the picture again, shifted by up to 40 px, with 40 % of the light."""
    shift = rng.integers(-40, 41, 2)
    return _grey(image + 0.4 * np.roll(image, tuple(shift), (0, 1)).astype(float))


def wide_blur(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    return _grey(gaussian_filter(image.astype(float), rng.uniform(1.5, 3.5)))


def strong_jpeg(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(10, 40))])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)


def interlaced(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Shift every second line by 2 to 6 px."""
    spoiled = image.copy()
    spoiled[::2] = np.roll(image[::2], int(rng.integers(2, 7)), axis=1)
    return spoiled


def saturated(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    return _grey(image * rng.uniform(3.0, 6.0))


def flipped(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    return np.ascontiguousarray(image[:, ::-1] if rng.random() < 0.5 else image[::-1])


def stretched(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Turn by up to 3° and scale by up to 3 %, as if the camera was moved after calibration."""
    height, width = image.shape
    turn = cv2.getRotationMatrix2D(
        (width / 2, height / 2), rng.uniform(-3.0, 3.0), rng.uniform(0.97, 1.03)
    )
    return np.asarray(cv2.warpAffine(image, turn, (width, height)), np.uint8)


def _grey(light: FloatArray) -> GreyImage:
    return np.rint(np.clip(light, 0, 255)).astype(np.uint8)


HIDING: dict[str, Hide] = {
    "first-row-but-1": hidden_lines(0, 1),
    "first-row-but-2": hidden_lines(0, 2),
    "last-row-but-1": hidden_lines(0, -2),
    "last-row-but-2": hidden_lines(0, -3),
    "two-rows": hidden_lines(0, 1, 2),
    "first-column-but-1": hidden_lines(1, 1),
    "last-column-but-1": hidden_lines(1, -2),
    "last-column-but-2": hidden_lines(1, -3),
    "beyond-a-line": beyond_a_line,
    "behind-a-strip": behind_a_strip,
    "blotted": blotted,
    "second-hole": second_hole,
    "filled-hole": filled_hole,
}
SPOILING: dict[str, Spoil] = {
    "none": lambda image, rng: image,
    "half-dark": half_dark,
    "bright-spots": arc_light(150.0),
    "second-grid": gratings,
    "ghost": ghost,
    "wide-blur": wide_blur,
    "strong-jpeg": strong_jpeg,
    "saturated": saturated,
}
MOVED: dict[str, Spoil] = {"interlaced": interlaced, "flipped": flipped, "stretched": stretched}
"""Their dots are not where the truth has them: only what is measured of the height is judged."""

FAULTS = [*SPOILING, *HIDING, *MOVED]
SPOILING |= {"saturated-spots": arc_light(500.0), "streaks": arc_light(200.0, longer=3.0)}
FAULTS += ["saturated-spots", "streaks"]  # at the end: each fault's random numbers follow its place


@dataclass(frozen=True)
class FaultResult:
    """Result for one frame: status and reason, wrong and right labels, and errors of the size.

    `sigmas` is the error of the height (or depth) in units of its σ, `error` as a share.
    """

    status: str
    reason: str = ""
    wrong: int = 0
    right: int = 0
    sigmas: float = 0.0
    error: float = 0.0

    @property
    def is_wrong(self) -> bool:
        """A wrong surface was shown as right."""
        return self.wrong > 0 or abs(self.sigmas) > MOST_SIGMAS


def spoiled_frame(fault: str, kind: str, seed: int) -> tuple[GreyImage, FloatArray, Bench, object]:
    """Image, true dots (rows, columns, 2), px, NaN where none is shown, bench, and the pool."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), FAULTS.index(fault)])
    rig, pool = draw_pool(kind, rng)
    view: CameraView = draw_view(rng)
    look: Look = replace(draw_look(rng), missing=0.0, false_dots=0)
    rays = trace(pool, rig)
    rays = HIDING[fault](rays, rng) if fault in HIDING else rays
    frame = render(rays, view, look, rng)
    image = np.asarray(frame.image, np.uint8)
    image = (SPOILING | MOVED)[fault](image, rng) if fault not in HIDING else image
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    calibration = ImageCalibration.from_three_points(*axes)
    dots = np.where(frame.shown[..., None], frame.dot_px, np.nan)
    return image, dots, Bench(as_entered(rig, calibration), calibration), pool


def measured(fault: str, kind: str, seed: int) -> FaultResult:
    """Measure a frame with a fault as ``labapp reconstruct`` does, and compare with the truth."""
    image, true_px, bench, pool = spoiled_frame(fault, kind, seed)
    result = measure(image, bench, Settings())[0]
    if result.match is None or result.measures is None or result.dots is None:
        return FaultResult(result.status, result.reason)
    wrong = 0
    if fault not in MOVED:
        dots = np.column_stack([result.dots.u_px, result.dots.v_px])[result.match.dot]
        distance = np.linalg.norm(dots - true_px[tuple(result.match.ray.T - 1)], axis=-1)
        wrong = int((~(distance < ON_ITS_DOT_PX)).sum())
    name = "height" if pool.size.height_mm > -pool.size.depth_mm else "depth"
    size, sigma = (getattr(result.measures, f"{name}{end}_mm") for end in ("", "_sigma"))
    error = size - getattr(pool.size, f"{name}_mm")
    right = len(result.match.dot) - wrong
    return FaultResult("ok", "", wrong, right, error / sigma, error / (size - error))


def main() -> int:
    """Print the results; return the number of frames with a wrong surface."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("faults", nargs="*", default=FAULTS)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--pools", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--refused", action="store_true", help="print a line for these as well")
    chosen = parser.parse_args()
    wrong = 0
    for fault in chosen.faults:
        results = []
        for kind in chosen.kinds:
            for seed in range(chosen.seed, chosen.seed + chosen.pools):
                results.append(one := measured(fault, kind, seed))
                if one.is_wrong or (chosen.refused and one.status != "ok"):
                    print(f"{fault} {kind} {seed}: {one}", flush=True)
        of_fault = sum(one.is_wrong for one in results)
        counts = Counter(one.status for one in results).most_common()
        statuses = ", ".join(f"{count} {status}" for status, count in counts)
        print(f"{fault}: {of_fault} wrong of {len(results)} ({statuses})", flush=True)
        wrong += of_fault
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
