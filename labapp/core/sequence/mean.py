"""Standard uncertainty of the mean of a size over the frames of a recording.

The noise of different frames is independent. The error of the set-up is the same in all frames.
That of the level is partly the same: the level follows from the rays that land inside the boundary,
and while the boundary does not move, the same rays give the same error. In simulated recordings the
errors of two frames' levels are correlated by exp(−D²/2ℓ²), with D the distance of their outlines
in standard uncertainties: 1 for a pool that oscillates within its boundary, and practically 0 if
the boundary has moved by three of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np

from labapp.core.surface.measures import Measures, sigma_name
from labapp.core.values import FloatArray

DISTANCE = 0.6
"""ℓ, from simulated recordings of pools that oscillate or whose boundary wanders by 0.2 to 2 %."""

TINY_MM = 1e-9
"""Lower bound of the uncertainty of an outline."""

MOST = 1000
"""Maximum number of frames, evenly spaced, from which the correlation is computed."""


def series_of(measured: Sequence[Measures]) -> dict[str, FloatArray]:
    """All measures of n frames by name, each of shape (n,)."""
    return {
        field.name: np.array([getattr(each, field.name) for each in measured])
        for field in fields(Measures)
    }


def sigma_of_mean(name: str, series: Mapping[str, FloatArray]) -> float:
    """Standard uncertainty of the mean of a size over n frames with a surface.

    Parameters
    ----------
    name
        Name of the size, as in `Measures`.
    series
        The measures of these frames by name, each of shape (n,). If the level's part of an
        uncertainty is NaN, as in results of earlier versions, it is assumed to be all of it; if the
        set-up's part is NaN, it is assumed to be 0.

    Returns
    -------
    float
        NaN if a frame has no uncertainty, or there are no frames.
    """
    if sigma_name(name) not in series or not len(series[name]):
        return math.nan
    parts = (
        noise_sigma_of_mean(name, series),
        level_sigma_of_mean(name, series),
        setup_sigma_of_mean(name, series),
    )
    return float(np.linalg.norm(parts))


def noise_sigma_of_mean(name: str, series: Mapping[str, FloatArray]) -> float:
    """Contribution of noise to `sigma_of_mean`; it is independent between frames."""
    sigma, level = _without_setup(series, name), _level(series, name)
    return float(np.sqrt(np.sum(np.maximum(sigma**2 - level**2, 0.0))) / len(sigma))


def level_sigma_of_mean(name: str, series: Mapping[str, FloatArray]) -> float:
    """Contribution of the level to `sigma_of_mean`, correlated if boundaries are similar."""
    level = _level(series, name)
    count = len(level)
    variance = np.sum(level**2) / count**2
    if count > 1:
        some = np.unique(np.linspace(0, count - 1, min(count, MOST)).round().astype(int))
        together = level[some] @ level_correlation(series, some) @ level[some]
        pairs = len(some) * (len(some) - 1)
        variance += (together - np.sum(level[some] ** 2)) / pairs * (count - 1) / count
    return float(np.sqrt(variance))


def setup_sigma_of_mean(name: str, series: Mapping[str, FloatArray]) -> float:
    """Contribution of the set-up to `sigma_of_mean`, common to all frames; 0 if unknown."""
    return float(_setup(series, name).mean())


def _setup(series: Mapping[str, FloatArray], name: str) -> FloatArray:
    """Uncertainty of a size due to the set-up, shape (n,); 0 if unknown."""
    return np.nan_to_num(series.get(sigma_name(name, "setup"), np.zeros(len(series[name]))))


def _level(series: Mapping[str, FloatArray], name: str) -> FloatArray:
    """Uncertainty of a size due to the level, shape (n,); all but the set-up's part if unknown."""
    level = series[sigma_name(name, "level")]
    return np.where(np.isfinite(level), level, _without_setup(series, name))


def _without_setup(series: Mapping[str, FloatArray], name: str) -> FloatArray:
    """Uncertainty of a size due to noise and level, shape (n,)."""
    total, setup = series[sigma_name(name)], _setup(series, name)
    return np.asarray(np.sqrt(np.maximum(total**2 - setup**2, 0.0)))


def level_correlation(series: Mapping[str, FloatArray], frames: slice | np.ndarray) -> FloatArray:
    """Correlation of the level errors of m frames, shape (m, m)."""
    moved = [
        series[name][frames] / max(np.median(_without_setup(series, size)[frames]), TINY_MM) * share
        for size, center in (("width_mm", "center_x_mm"), ("length_mm", "center_y_mm"))
        for name, share in ((size, 1.0), (center, 2.0))  # a width has two ends that move
    ]
    place = np.column_stack(moved)
    place -= place.mean(axis=0)
    squared = np.sum(place**2, axis=1)
    distance2 = (squared[:, None] + squared - 2 * place @ place.T) / 2
    return np.asarray(np.exp(-np.maximum(distance2, 0.0) / (2 * DISTANCE**2)))
