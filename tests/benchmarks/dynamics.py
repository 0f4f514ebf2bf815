"""Modes, chirps and step responses of simulated series, compared with the truth.

Run as ``python -m tests.benchmarks.dynamics [PART …] [--count N] [--seed S]``. Every case
draws its own pool, frequencies, phases and damping.

modes
    Two simultaneous modes over 1 s, noise 0.6 µm in each shape, 5 % of the frames lost, at 200 and
    1000 frames/s: median and largest error of frequency, amplitude and damping, share within the
    limits (0.1 Hz, 5 %, 10 %) and within 1.96 σ. Then the same without noise: the error of the
    method.
chirp
    A linear chirp of 4 s: error of the tracked peak, share within 1.96 σ.
step
    First- and second-order responses, noise 4 % of the change: the same of each quantity.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from labapp.core.dynamics.modes import MODES, bessel_modes
from labapp.core.dynamics.spectra import track_peak
from labapp.core.dynamics.steps import step_response
from labapp.simulation.pools import Footprint, Wave
from tests.core.dynamics_truth import pool_with, series_of

SURE = 1.96


def report(name: str, error: Sequence[float], sigma: Sequence[float], bar: float = np.inf) -> None:
    """Print the errors of one quantity; NaN (not found) counts as outside the limits."""
    off, spread = np.abs(error), np.asarray(sigma)
    print(
        f"  {name:<24} median {np.nanmedian(off):.4g}, largest {np.nanmax(off):.4g}, within "
        f"{bar:g}: {np.mean(off <= bar):.0%}, within ±1.96 σ: {np.mean(off <= SURE * spread):.0%}, "
        f"missed {np.isnan(off).sum()} of {len(off)}",
        flush=True,
    )


def modes(count: int, seed: int, rate_hz: float, noise_mm: float) -> None:
    """Print the errors of two simultaneous modes of a random ellipse."""
    rng = np.random.default_rng(seed)
    errors: dict[str, list[tuple[float, float]]] = {}
    for _ in range(count):
        length = rng.uniform(3.2, 4.2)
        foot = Footprint(rng.uniform(5.8, 7.2), length, length, (0.0, rng.uniform(-0.8, 0.3)))
        chosen = rng.choice(len(MODES), 2, replace=False)
        low, high = np.sort(rng.uniform(15, 85, 2))
        hertz = (low, max(high, low + 8))
        waves = [
            Wave(
                MODES[k],
                size := rng.uniform(0.012, 0.03),
                f,
                phase_deg=rng.uniform(0, 360),
                turned_deg=rng.uniform(0, 90) if MODES[k][0] else 0.0,
                damping_per_s=rng.uniform(3, 6),
            )
            for k, f in zip(chosen, hertz, strict=True)
        ]
        series = series_of(pool_with(foot, *waves), rate_hz, rng=rng, noise_mm=noise_mm, lost=0.05)
        results = bessel_modes(series)
        for k, wave in zip(chosen, waves, strict=True):
            figures = results[k].figures
            size = wave.amplitude_mm * np.exp(-wave.damping_per_s * series.time_s[0])
            for name, true, unit in (
                ("frequency_hz", wave.frequency_hz, 1.0),
                ("amplitude_mm", size, size),
                ("damping_per_s", wave.damping_per_s, wave.damping_per_s),
            ):
                value, sigma = figures.get(name, (np.nan, np.nan))
                errors.setdefault(name, []).append(((value - true) / unit, sigma / unit))
    print(f"modes, {rate_hz:g} frames/s, noise {1e3 * noise_mm:g} µm:")
    for name, bar in (("frequency_hz", 0.1), ("amplitude_mm", 0.05), ("damping_per_s", 0.1)):
        report(name, *zip(*errors[name], strict=True), bar)


def chirps(count: int, seed: int) -> None:
    """Print the errors of tracked chirps between two random frequencies."""
    rng = np.random.default_rng(seed)
    errors, sigmas = [], []
    for _ in range(count):
        rate_hz = rng.choice([200, 1000])
        time = np.flatnonzero(rng.random(4 * rate_hz) > 0.03) / rate_hz
        begin, end = rng.uniform(20, 80, 2)
        phase = begin * time + (end - begin) * time**2 / 8
        value = np.cos(2 * np.pi * phase) + rng.normal(0, 0.1, len(time))
        track = track_peak(time, value, 0.25)
        errors += list(track.frequency_hz - (begin + (end - begin) * track.time_s / 4))
        sigmas += list(track.frequency_sigma_hz)
    print("chirp, segments of 0.25 s:")
    report("frequency_hz", errors, sigmas, 0.5)


def steps(count: int, seed: int, order: int) -> None:
    """Print the errors of step responses of first or second order."""
    rng = np.random.default_rng(seed)
    errors: dict[str, list[tuple[float, float]]] = {}
    chosen = 0
    for _ in range(count):
        rate_hz = rng.choice([60, 200, 1000])
        time = np.arange(3 * rate_hz) / rate_hz
        at, delay, change = rng.uniform(0.6, 1.2), rng.uniform(0.02, 0.1), rng.choice([-0.5, 0.4])
        late = np.maximum(time - at - delay, 0)
        fine = np.linspace(0, 3, 60_001)
        if order == 1:
            tau = rng.uniform(0.08, 0.3)
            course, truth = 1 - np.exp(-fine / tau), {"time_constant_s": tau}
        else:
            zeta, omega = rng.uniform(0.25, 0.6), rng.uniform(12, 25)
            poles = np.roots([1, 2 * zeta * omega, omega**2])
            residues = omega**2 / poles / (poles - poles[::-1])
            course = 1 + np.sum(residues * np.exp(np.outer(fine, poles)), axis=1).real
            truth = {"time_constant_s": 1 / (zeta * omega), "overshoot": course.max() - 1}
        crossed = [fine[np.argmax(course >= share)] for share in (0.1, 0.9)]
        truth |= {"change": change, "delay_s": delay, "rise_time_s": crossed[1] - crossed[0]}
        noise = rng.normal(0, 0.04 * abs(change), len(time))
        response = step_response(time, 6 + change * np.interp(late, fine, course) + noise, at)
        chosen += response is not None and response.order == order
        for name, true in truth.items():
            value = (
                (np.nan, np.nan)
                if response is None
                else (response.value[name], response.sigma[name])
            )
            errors.setdefault(name, []).append((value[0] - true, value[1]))
    print(f"step of order {order}: order found in {chosen} of {count}")
    for name, pairs in errors.items():
        report(name, *zip(*pairs, strict=True))


def main() -> None:
    """Print all parts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", default=["modes", "chirp", "step"])
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    if "modes" in chosen.parts:
        for rate_hz in (200, 1000):
            for noise_mm in (6e-4, 0.0):
                modes(chosen.count, chosen.seed, rate_hz, noise_mm)
    if "chirp" in chosen.parts:
        chirps(chosen.count, chosen.seed)
    if "step" in chosen.parts:
        for order in (1, 2):
            steps(chosen.count, chosen.seed, order)


if __name__ == "__main__":
    main()
