"""How uncertain the mean of a size over the frames of a recording is.

The noise of one frame says nothing of the next one's. What is not known of the set-up is the same
error in all of them. So is the level's, in part: it comes from which rays land inside the boundary,
and while the boundary stays where it is, the same rays put it at the same wrong place. In simulated
recordings the errors of two frames' levels are correlated by exp(−D²/2ℓ²), with D the distance of
their outlines in standard uncertainties: 1 for a pool that swings within its boundary, and nothing
where that has moved by three of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np

from labapp.core.surface.measures import Measures, sigma_name
from labapp.core.values import FloatArray

DISTANCE = 0.6
"""ℓ: from recordings of the twin, pools that swing or whose boundary wanders by 0.2 to 2 %."""

TINY_MM = 1e-9
"""Lower bound of the uncertainty of an outline."""

MOST = 1000
"""From so many frames at most, evenly spaced, the correlation is worked out."""


def series_of(measured: Sequence[Measures]) -> dict[str, FloatArray]:
    """All measures of n frames by their names, each of shape (n,)."""
    return {
        field.name: np.array([getattr(each, field.name) for each in measured])
        for field in fields(Measures)
    }


def sigma_of_mean(name: str, series: Mapping[str, FloatArray]) -> float:
    """Standard uncertainty of a size's mean over n frames with a surface.

    Parameters
    ----------
    name
        Of the size, as in `Measures`.
    series
        The measures of these frames by their names, each of shape (n,). Where the level's part of
        an uncertainty is NaN, as versions before did not keep it, it is taken for all of it; where
        the set-up's is, for none.

    Returns
    -------
    float
        NaN where a frame has no uncertainty, or there is none.
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
    """The noise's part of `sigma_of_mean`: frames are independent."""
    sigma, level = _without_setup(series, name), _level(series, name)
    return float(np.sqrt(np.sum(np.maximum(sigma**2 - level**2, 0.0))) / len(sigma))


def level_sigma_of_mean(name: str, series: Mapping[str, FloatArray]) -> float:
    """The level's part of `sigma_of_mean`: frames whose boundary is alike have the same error."""
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
    """The set-up's part of `sigma_of_mean`: frames do not average it out. 0 where it is unknown."""
    return float(_setup(series, name).mean())


def _setup(series: Mapping[str, FloatArray], name: str) -> FloatArray:
    """The set-up's part of a size's uncertainty, shape (n,); 0 where it is unknown."""
    return np.nan_to_num(series.get(sigma_name(name, "setup"), np.zeros(len(series[name]))))


def _level(series: Mapping[str, FloatArray], name: str) -> FloatArray:
    """The level's part of a size's uncertainty, shape (n,); all but the set-up's if unknown."""
    level = series[sigma_name(name, "level")]
    return np.where(np.isfinite(level), level, _without_setup(series, name))


def _without_setup(series: Mapping[str, FloatArray], name: str) -> FloatArray:
    """Uncertainty of a size by noise and level, shape (n,)."""
    total, setup = series[sigma_name(name)], _setup(series, name)
    return np.asarray(np.sqrt(np.maximum(total**2 - setup**2, 0.0)))


def level_correlation(series: Mapping[str, FloatArray], frames: slice | np.ndarray) -> FloatArray:
    """Correlation of the errors of some frames' levels, shape (m, m)."""
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
