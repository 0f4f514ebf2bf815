from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.session.file.schema import MEASURES
from labapp.session.results.measured import Overview
from labapp.session.results.trends import FEWEST, outlying_frames, spectrum, statistics_of, trend

RATE_HZ = 60.0


def overview(height: np.ndarray, time_s: np.ndarray | None = None, **sizes) -> Overview:
    count = len(height)
    measures = {name: np.full(count, 1.0) for name in MEASURES}
    measures |= {name: np.zeros(count) for name in MEASURES if "_setup_" in name}
    measures["height_mm"] = np.asarray(height, float)
    measures.update(sizes)
    return Overview(
        frame=np.arange(count),
        time_s=np.arange(count) / RATE_HZ if time_s is None else time_s,
        status=tuple("ok" if np.isfinite(h) else "no-match" for h in height),
        corrected=np.zeros(count, bool),
        stale=np.zeros(count, bool),
        measures=measures,
    )


def noisy(count: int = 40) -> np.ndarray:
    return 0.3 + np.random.default_rng(3).normal(0, 0.003, count)


def test_spread_is_defined_as_in_eq_7_4() -> None:
    """Eq. 7-4 divides by n: 15 heights, here 1 … 15."""
    result = statistics_of(trend(overview(np.arange(1.0, 16.0)), "height_mm"))
    assert (result.count, result.mean, result.lowest, result.highest) == (15, 8.0, 1.0, 15.0)
    assert result.deviation == pytest.approx(np.sqrt(224 / 12))


def test_spread_excludes_stale_frames_and_those_without_a_surface() -> None:
    height = noisy()
    height[[3, 7]] = np.nan
    measured = overview(height)
    measured = replace(measured, stale=np.arange(40) < 10)
    course = trend(measured, "height_mm")
    assert course.frame.tolist() == [k for k in range(40) if k not in (3, 7)]
    assert statistics_of(course).mean == pytest.approx(height[10:].mean())
    assert statistics_of(trend(replace(measured, stale=np.ones(40, bool)), "height_mm")).count == 0


def test_trend_has_sigma_corrections_and_time_axis() -> None:
    measured = replace(overview(noisy()), corrected=np.arange(40) == 5)
    course = trend(measured, "height_mm")
    assert course.timed
    assert course.at[6] == pytest.approx(0.1)
    assert course.corrected.tolist() == measured.corrected.tolist()
    assert (course.sigma == 1).all()
    assert np.isnan(trend(measured, "are_mm").sigma).all()
    untimed = trend(overview(noisy(), np.full(40, np.nan)), "height_mm")
    assert not untimed.timed
    assert untimed.at.tolist() == list(range(40))


@pytest.mark.parametrize("odd", [0, 1, 20, 39])
def test_outlying_frame_is_doubtful(odd: int) -> None:
    height = noisy()
    height[odd] *= 1.16  # a row shifted by one
    assert np.flatnonzero(outlying_frames(overview(height))).tolist() == [odd]
    course = trend(overview(height), "height_mm", without_outlying=True)
    assert statistics_of(course).count == 39
    assert statistics_of(trend(overview(height), "height_mm")).count == 40
    are = np.full(40, 0.02)
    are[odd] = 0.1  # a wrong column
    assert np.flatnonzero(outlying_frames(overview(noisy(), are_mm=are))).tolist() == [odd]


def test_growing_oscillating_or_noisy_pool_is_not_doubtful() -> None:
    growing = noisy(200) + np.linspace(0, 0.3, 200)
    assert not outlying_frames(overview(growing)).any()
    assert not outlying_frames(overview(noisy(2000))).any()
    oscillating = 0.3 + 0.02 * np.sin(np.arange(200))
    assert not outlying_frames(overview(oscillating)).any()
    assert not outlying_frames(overview(noisy(FEWEST - 1) * np.array([9, *[1] * 6]))).any()


def test_spectrum_gives_frequency_and_amplitude_of_an_oscillation() -> None:
    count = 240
    time_s = np.arange(count) / RATE_HZ
    height = 0.3 + 0.05 * time_s + 0.02 * np.sin(2 * np.pi * 12.5 * time_s)
    course = trend(overview(height), "height_mm")
    assert course.timed
    result = spectrum(course)
    frequency, amplitude = result.peak
    assert frequency == pytest.approx(12.5, abs=0.01)
    assert amplitude == pytest.approx(0.02, rel=0.02)
    assert result.frequency[-1] == pytest.approx(RATE_HZ / 2)
    assert result.resolution == pytest.approx(2 * RATE_HZ / count)
    course = trend(overview(height, np.full(count, np.nan)), "height_mm")
    assert not course.timed
    assert spectrum(course).peak[0] == pytest.approx(12.5 / RATE_HZ)


def test_spectrum_uses_the_longest_uninterrupted_part() -> None:
    height = noisy(100)
    height[30] = np.nan
    result = spectrum(trend(overview(height), "height_mm"))
    assert (result.first, result.last, result.count) == (31, 99, 69)
    gap = np.arange(100) / RATE_HZ
    gap[80:] += 0.5
    result = spectrum(trend(overview(height, gap), "height_mm"))
    assert (result.first, result.last) == (31, 79)


def test_short_series_has_no_spectrum() -> None:
    for count in (0, 1, FEWEST - 1):
        with pytest.raises(ValueError, match="in a row"):
            spectrum(trend(overview(noisy(count)), "height_mm"))
