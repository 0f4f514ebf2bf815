"""Simulated line patterns: five lines (§3.2.1), penetration runs (Fig. 3-14), GMAW (§3.3).

python -m tests.benchmarks.lines five [--pools N] [--seed S] [--pictures FOLDER]
python -m tests.benchmarks.lines runs [--frames N] [--seed S]
python -m tests.benchmarks.lines gmaw [--frames N] [--seed S]
"""

from __future__ import annotations

import argparse
import pickle
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.line_pattern import LinePattern, LineRig
from labapp.core.geometry.rig import Electrode, ImagingPlane, Laser
from labapp.core.lines.frame import LineFrame, measure_lines
from labapp.core.lines.pulses import pulse_frequency
from labapp.core.lines.states import LineSeries, line_changes, line_states
from labapp.core.lines.track import oscillation_frequency, track_line
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import Pool, egg
from tests.line_truth.frames import LineFrame as TrueFrame
from tests.line_truth.frames import LineLook, render_lines
from tests.line_truth.runs import GmawLook, gmaw_run, penetration_run

RIG = LineRig(
    Laser(27.0, 90.0),
    LinePattern(5, 0.23, 5.0),
    Electrode(5.0),
    ImagingPlane.vertical(53.6, 32.0, -5.0, 64.0, 84.0),
)
VIEW = CameraView((2.0, 638.0), (452.0, 638.0), 60.0, (2.0, 188.0), 60.0)
CALIBRATION = ImageCalibration.from_three_points(
    VIEW.origin_px, VIEW.x_axis_px, VIEW.x_axis_mm, VIEW.z_axis_px, VIEW.z_axis_mm
)
K95 = 1.96


def draw_pool(rng: np.random.Generator, sign: int) -> Pool:
    """Draw a pool of 5-7 mm, 0.1-0.4 mm high or deep; its head is shorter than its tail."""
    width, length = rng.uniform(5.0, 7.0, 2)
    head = length * rng.uniform(0.42, 0.5)
    center = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)
    return egg(width, head, length - head, sign * rng.uniform(0.1, 0.4), center)


def dense(points: np.ndarray) -> np.ndarray:
    """Return a polyline with 30 times as many points."""
    at, steps = np.linspace(0, len(points) - 1, 30 * len(points)), np.arange(len(points))
    return np.stack([np.interp(at, steps, points[:, k]) for k in (0, 1)], axis=-1)


def ridge_errors(result: LineFrame, true: TrueFrame) -> tuple[list[int], np.ndarray]:
    """Return the true number of each line found (0: none), and the distances to it, px."""
    numbers, errors = [], []
    lines = {one.number: dense(one.image_px) for one in true.lines}
    for one in result.seen.lines if lines else ():
        near = {n: cKDTree(line).query(one.image_px) for n, line in lines.items()}
        best = min(near, key=lambda n: np.median(near[n][0]))
        distance, nearest = near[best]
        if np.median(distance) > 3.0:
            numbers.append(0)
            continue
        numbers.append(best)
        if one.folded:  # its two halves have no separate ridges
            continue
        beside = (nearest > 0) & (nearest < len(lines[best]) - 1)
        errors.append(distance[beside])
    return numbers, np.concatenate(errors) if errors else np.zeros(0)


def lines_right(true: TrueFrame, numbers: list[int]) -> bool:
    """Whether each line at least a fifth as long as the longest is found once, in order."""
    longest = max(len(one.fan) for one in true.lines)
    expected = [one.number for one in true.lines if len(one.fan) >= 0.2 * longest]
    found = [n for n in numbers if n in expected or n == 0]
    return 0 not in numbers and found in (sorted(expected), sorted(expected)[::-1])


def draw(image: np.ndarray, result: LineFrame, path: Path) -> None:
    """Overlay lines and ends on a frame."""
    enlarged = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).astype(int)
    enlarged = cv2.cvtColor(np.clip(2 * enlarged - 30, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    colours = [(60, 60, 255), (60, 200, 255), (60, 255, 60), (255, 200, 60), (255, 60, 200)]
    for k, one in enumerate(result.seen.lines):
        for u, v in np.rint(2 * one.image_px + 0.5).astype(int).tolist():
            cv2.circle(enlarged, (u, v), 1, colours[k % 5], -1)
        for u, v in np.rint(2 * one.ends_px + 0.5).astype(int).tolist():
            cv2.circle(enlarged, (u, v), 6, (255, 255, 255), 1)
    cv2.imwrite(str(path), enlarged)


def five(pools: int, seed: int, pictures: Path | None) -> None:
    """Print lines, ridge error and surface of pools, alternately convex and concave."""
    rows, squares, points, total_s = [], 0.0, 0, 0.0
    for n in range(pools):
        rng = np.random.default_rng([seed, n])
        sign = 1 if n % 2 == 0 else -1
        pool = draw_pool(rng, sign)
        true = render_lines(pool, RIG, VIEW, LineLook(gaps=2), rng)
        begin = time.perf_counter()
        result = measure_lines(true.image, RIG, CALIBRATION)
        total_s += time.perf_counter() - begin
        numbers, errors = ridge_errors(result, true)
        right = lines_right(true, numbers)
        rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else np.nan
        squares, points = squares + float(np.sum(errors**2)), points + len(errors)
        height = pool.size.height_mm if sign > 0 else pool.size.depth_mm
        surface = result.surface
        z, sigma = (surface.height_mm, surface.height_sigma_mm) if surface else (np.nan, np.nan)
        rows.append((sign, right, rms, result.status == "ok", (z - height) / height, sigma, height))
        print(
            f"{n:3d} {height:+.3f} mm, width {pool.size.width_mm:.2f}: {result.status:8s}"
            f" lines {numbers} {'right' if right else 'WRONG'}, ridge {rms:.2f} px,"
            f" z {z:+.3f} ± {sigma:.3f} ({100 * (z - height) / height:+.1f} %)"
            + (f" misfit {surface.misfit:.2f} margin {surface.margin:.0f}" if surface else ""),
            flush=True,
        )
        if pictures:
            draw(true.image, result, pictures / f"five{n}.png")
    sign, right, rms, ok, error, sigma, height = map(np.array, zip(*rows, strict=True))
    print(
        f"{total_s / pools:.2f} s a frame; ridge over all points {np.sqrt(squares / points):.3f} px"
    )
    for name, chosen in (("convex", sign > 0), ("concave", sign < 0), ("all", sign != 0)):
        chosen_ok = chosen & ok
        off = np.abs(error[chosen_ok])
        within = off * np.abs(height[chosen_ok]) <= K95 * sigma[chosen_ok]
        print(
            f"{name:8s} lines right {right[chosen].mean():.1%}, ridge median"
            f" {np.nanmedian(rms[chosen]):.3f} px, determined {ok[chosen].mean():.1%}:"
            f" height error median {np.median(off):.1%}, worst {off.max():.1%},"
            f" within 95 % ± {within.mean():.1%}"
        )


def runs(frames: int, seed: int, keep: Path | None) -> None:
    """Print the states of three penetration runs like that of Fig. 3-11 … 3-14."""
    for n in range(3):
        rng = np.random.default_rng([seed, 100 + n])
        run, measured = penetration_run(frames, rng), []
        for one in run:
            image = render_lines(one.pool, RIG, VIEW, LineLook(gaps=1), rng).image
            measured.append(measure_lines(image, RIG, CALIBRATION))
        series = LineSeries.of(measured)
        states = line_states(series)
        truth = [one.state for one in run]
        wrong = [k for k in range(frames) if states[k] != truth[k]]
        if keep:
            with (keep / f"run{n}.pkl").open("wb") as file:
                pickle.dump((series, truth, [one.status for one in measured]), file)
        print(
            f"run {n}: states right in {1 - len(wrong) / frames:.1%} of {frames} frames; wrong:",
            *(f"{k} {truth[k]}>{states[k]}" for k in wrong[:12]),
            f"; lines lost or won: {line_changes(series)}",
            flush=True,
        )


GMAW_RIG = LineRig(
    Laser(70.0, 60.0, aim_y_mm=-2.4),
    LinePattern(1, 0.23, 4.0),
    Electrode(15.0),
    ImagingPlane.vertical(20.0, 32.0, -4.0, 64.0, 48.0),
)
GMAW_VIEW = CameraView((0.0, 239.0), (300.0, 239.0), 60.0, (0.0, 39.0), 40.0, 320, 240)


def gmaw(frames: int, seed: int, pictures: Path | None) -> None:
    """Print pulses, line and oscillation of a recording of pulsed GMAW."""
    rng = np.random.default_rng([seed, 200])
    hertz = float(rng.uniform(25, 45))
    run = list(gmaw_run(frames, GMAW_RIG, GMAW_VIEW, rng, oscillation_hz=hertz))
    look = GmawLook()
    begin = time.perf_counter()
    pulses, lines = track_line((one.image for one in run), look.frame_rate_hz)
    rate = frames / (time.perf_counter() - begin)
    truth = np.array([one.on for one in run])
    off_frames, followed, errors = np.flatnonzero(~truth), 0, []
    for k in off_frames:
        line = lines[k]
        if line is None:
            continue
        u, v = run[k].line_px[np.argsort(run[k].line_px[:, 0])].T
        inside = (line.u_px >= u[0]) & (line.u_px <= u[-1])
        error = float(np.sqrt(np.mean((line.v_px - np.interp(line.u_px, u, v))[inside] ** 2)))
        errors.append(error)
        followed += error < 1.5
        if pictures and k in off_frames[:: max(len(off_frames) // 8, 1)]:
            enlarged = cv2.cvtColor(cv2.resize(run[k].image, None, fx=3, fy=3), cv2.COLOR_GRAY2BGR)
            for point in zip(line.u_px, line.v_px, strict=True):
                place = np.rint(3 * np.array(point) + 1).astype(int).tolist()
                cv2.circle(enlarged, place, 1, (60, 255, 60), -1)
            cv2.imwrite(str(pictures / f"gmaw{k}.png"), enlarged)
    shifts = [
        (k / look.frame_rate_hz, one.shift_px) for k, one in enumerate(lines) if one is not None
    ]
    oscillation, _ = oscillation_frequency(*np.array(shifts).T)
    print(
        f"on/off right in {np.mean(pulses.on == truth):.2%} of {frames} frames, pulses at"
        f" {pulse_frequency(pulses.on, look.frame_rate_hz):.2f} Hz (true {look.pulse_hz:g});"
        f" line followed in {followed / len(off_frames):.1%} of {len(off_frames)} off-frames,"
        f" median error {np.median(errors):.2f} px; oscillation {oscillation:.2f} Hz"
        f" (true {hertz:.2f}); {rate:.0f} frames/s"
    )


def main() -> None:
    """Run a part."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=["five", "runs", "gmaw"])
    parser.add_argument("--pools", type=int, default=60)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pictures", type=Path)
    chosen = parser.parse_args()
    if chosen.part == "five":
        five(chosen.pools, chosen.seed, chosen.pictures)
    elif chosen.part == "runs":
        runs(chosen.frames, chosen.seed, chosen.pictures)
    else:
        gmaw(chosen.frames, chosen.seed, chosen.pictures)


if __name__ == "__main__":
    main()
