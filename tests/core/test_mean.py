"""How uncertain the mean of a size over frames is told to be."""

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


def course(
    width: FloatArray, sigma: float, level: float, setup: float = 0.0
) -> dict[str, FloatArray]:
    """Measures of a pool of these widths, else unchanged; σ of width and length are ``sigma``."""
    series = {field.name: np.full(len(width), 1.0) for field in fields(Measures)}
    series["width_mm"] = width
    for size in ("width", "length", "height"):
        series[f"{size}_sigma_mm"] = np.full(len(width), sigma)
        series[f"{size}_sigma_level_mm"] = np.full(len(width), level)
        series[f"{size}_sigma_setup_mm"] = np.full(len(width), setup)
    return series


def test_noise_averages_out() -> None:
    series = course(np.full(25, 6.0), 0.05, 0.0)
    assert sigma_of_mean("height_mm", series) == pytest.approx(0.05 / 5)


def test_the_level_of_a_boundary_that_stands_still_does_not() -> None:
    series = course(np.full(25, 6.0), 0.05, 0.04)
    expected = np.hypot(0.03 / 5, 0.04)
    assert sigma_of_mean("height_mm", series) == pytest.approx(expected)


def test_the_levels_of_boundaries_far_from_each_other_do() -> None:
    series = course(6.0 + np.arange(25.0), 0.05, 0.05)
    assert sigma_of_mean("height_mm", series) == pytest.approx(0.05 / 5)


def test_what_no_version_kept_is_taken_for_the_levels() -> None:
    series = course(np.full(25, 6.0), 0.05, np.nan)
    assert sigma_of_mean("height_mm", series) == pytest.approx(0.05)


def test_the_setup_errs_alike_in_every_frame() -> None:
    series = course(np.full(25, 6.0), np.hypot(0.05, 0.02), 0.0, 0.02)
    assert sigma_of_mean("height_mm", series) == pytest.approx(np.hypot(0.05 / 5, 0.02))
    assert setup_sigma_of_mean("height_mm", series) == pytest.approx(0.02)
    older = course(np.full(25, 6.0), 0.05, 0.0, np.nan)
    assert sigma_of_mean("height_mm", older) == pytest.approx(0.05 / 5)
    assert setup_sigma_of_mean("height_mm", older) == 0


def test_without_an_uncertainty_the_mean_has_none() -> None:
    series = course(np.full(25, 6.0), 0.05, 0.04)
    series["width_sigma_mm"][3] = np.nan
    assert np.isnan(sigma_of_mean("width_mm", series))
    assert np.isnan(sigma_of_mean("are_mm", series))
    assert np.isnan(sigma_of_mean("width_mm", series_of([])))


@pytest.mark.parametrize("still", [True, False])
def test_of_a_long_recording_some_frames_tell_the_correlation(still: bool) -> None:
    width = np.full(4 * MOST, 6.0) if still else 6.0 + np.arange(4.0 * MOST)
    expected = 0.05 if still else 0.05 / np.sqrt(len(width))
    assert sigma_of_mean("height_mm", course(width, 0.05, 0.05)) == pytest.approx(expected)


@pytest.mark.slow
def test_the_mean_of_a_swinging_pool_is_told_to_be_as_uncertain_as_it_is() -> None:
    """Errors of the mean height over three recordings, in units of the ± that it has."""
    errors, if_apart = [], []
    for seed in (1, 2, 3):
        rng = np.random.default_rng([seed, 5])
        width = rng.uniform(4.8, 6.6)
        wave = Wave((1, 1), 0.015, frequency_hz=30.0, turned_deg=rng.uniform(0.0, 360.0))
        measured, off = [], []
        for k in range(12):
            terms = (replace(wave, time_s=k / 200),)
            pool = egg(width, 0.47 * width, 0.6 * width, 0.05 * width, (0.1, -0.2), terms)
            match = matched(see(pool, rng, sigma_px=0.2), BENCH_RIG)
            measured.append(
                measure_surface(fit.reconstruct(match, BENCH_RIG, FitSettings()), match, BENCH_RIG)
            )
            off.append(measured[-1].height_mm - pool.size.height_mm)
        series = series_of(measured)
        apart = np.mean(series["height_sigma_mm"]) / np.sqrt(len(off))
        errors.append(np.mean(off) / sigma_of_mean("height_mm", series))
        if_apart.append(np.mean(off) / apart)
    assert np.abs(errors).max() < 3.0
    assert np.sqrt(np.mean(np.square(if_apart))) > 2.0
