"""Uncertainty of the mean of a size over frames."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from labapp.core.schemes import fit
from labapp.core.sequence.mean import (
    MOST,
    series_of,
    setup_sigma_of_mean,
    sigma_of_mean,
)
from labapp.core.surface.measures import Measures, measure_surface
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import FloatArray
from labapp.simulation.pools import Wave, egg
from tests.benchmarks.dips import matched
from tests.scenes import BENCH_RIG, see


def measures_of(
    width: FloatArray, sigma: float, level: float, setup: float = 0.0
) -> dict[str, FloatArray]:
    """Return measures which differ only in width; all sizes have the given σ."""
    measures = {field.name: np.full(len(width), 1.0) for field in fields(Measures)}
    measures["width_mm"] = width
    for size in ("width", "length", "height"):
        measures[f"{size}_sigma_mm"] = np.full(len(width), sigma)
        measures[f"{size}_sigma_level_mm"] = np.full(len(width), level)
        measures[f"{size}_sigma_setup_mm"] = np.full(len(width), setup)
    return measures


def test_noise_averages_out() -> None:
    series = measures_of(np.full(25, 6.0), 0.05, 0.0)
    assert sigma_of_mean("height_mm", series) == pytest.approx(0.05 / 5)


def test_level_of_a_steady_boundary_does_not_average_out() -> None:
    series = measures_of(np.full(25, 6.0), 0.05, 0.04)
    expected = np.hypot(0.03 / 5, 0.04)
    assert sigma_of_mean("height_mm", series) == pytest.approx(expected)


def test_levels_of_distant_boundaries_average_out() -> None:
    series = measures_of(6.0 + np.arange(25.0), 0.05, 0.05)
    assert sigma_of_mean("height_mm", series) == pytest.approx(0.05 / 5)


def test_unknown_level_part_is_assumed_to_be_all() -> None:
    series = measures_of(np.full(25, 6.0), 0.05, np.nan)
    assert sigma_of_mean("height_mm", series) == pytest.approx(0.05)


def test_setup_error_is_common_to_all_frames() -> None:
    series = measures_of(np.full(25, 6.0), np.hypot(0.05, 0.02), 0.0, 0.02)
    assert sigma_of_mean("height_mm", series) == pytest.approx(np.hypot(0.05 / 5, 0.02))
    assert setup_sigma_of_mean("height_mm", series) == pytest.approx(0.02)
    older = measures_of(np.full(25, 6.0), 0.05, 0.0, np.nan)
    assert sigma_of_mean("height_mm", older) == pytest.approx(0.05 / 5)
    assert setup_sigma_of_mean("height_mm", older) == 0


def test_mean_has_no_uncertainty_if_a_frame_has_none() -> None:
    series = measures_of(np.full(25, 6.0), 0.05, 0.04)
    series["width_sigma_mm"][3] = np.nan
    assert np.isnan(sigma_of_mean("width_mm", series))
    assert np.isnan(sigma_of_mean("are_mm", series))
    assert np.isnan(sigma_of_mean("width_mm", series_of([])))


@pytest.mark.parametrize("still", [True, False])
def test_correlation_in_a_long_recording_is_sampled(still: bool) -> None:
    width = np.full(4 * MOST, 6.0) if still else 6.0 + np.arange(4.0 * MOST)
    expected = 0.05 if still else 0.05 / np.sqrt(len(width))
    assert sigma_of_mean("height_mm", measures_of(width, 0.05, 0.05)) == pytest.approx(expected)


@pytest.mark.slow
def test_mean_uncertainty_of_an_oscillating_pool() -> None:
    """The mean height's error over its σ, in six recordings."""
    errors, if_independent = [], []
    for seed in range(1, 7):
        rng = np.random.default_rng([seed, 5])
        width = rng.uniform(4.8, 6.6)
        wave = Wave((1, 1), 0.015, frequency_hz=30.0, turned_deg=rng.uniform(0.0, 360.0))
        measured, height_errors = [], []
        for k in range(12):
            terms = (replace(wave, time_s=k / 200),)
            pool = egg(width, 0.47 * width, 0.6 * width, 0.05 * width, (0.1, -0.2), terms)
            match = matched(see(pool, rng, sigma_px=0.2), BENCH_RIG)
            measured.append(
                measure_surface(fit.reconstruct(match, BENCH_RIG, FitSettings()), match, BENCH_RIG)
            )
            height_errors.append(measured[-1].height_mm - pool.size.height_mm)
        series = series_of(measured)
        independent_sigma = np.mean(series["height_sigma_mm"]) / np.sqrt(len(height_errors))
        errors.append(np.mean(height_errors) / sigma_of_mean("height_mm", series))
        if_independent.append(np.mean(height_errors) / independent_sigma)
    assert np.abs(errors).max() < 3.0
    assert np.abs(if_independent).max() > 3.0  # the same criterion rejects independent levels
