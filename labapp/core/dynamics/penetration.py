"""Penetration models from measured features of the pool's surface: fit, uncertainty, validation.

Width, length and convexity of the pool correlate with the back-side bead (W. J. Zhang et al., Weld.
J. 91 (2012) 195-s). The back side is not visible during welding. The model is therefore simulated
from the pool alone: y(t) = g(x(t)), where x are the features after a filter 1/A(q) of unit gain.
For ARX, g is linear: A(q)·y = B(q)·u + c, fitted to the simulated output; A is found by search and
B by linear least squares. For a Gaussian process, g has the covariance σ²·exp(−½ Σ (Δx_d/ℓ_d)²);
the ± of features is included as in A. McHutchon & C. E. Rasmussen, "Gaussian Process Training with
Input Noise" (NIPS 2011): Σ (∂g/∂x_d · σ_d)² is added to the variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import optimize

from labapp.core.dynamics.static_maps import (
    GaussianMap,
    LinearMap,
    Sections,
    fit_gaussian,
    fit_linear,
)
from labapp.core.dynamics.weld_series import (
    Orders,
    WeldSeries,
    find_transitions,
    impulse_response,
    in_steps,
    regressors,
)
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays

Kind = Literal["arx", "gp"]

SURE_95 = 1.959964
"""Half width of a 95 % interval in standard deviations."""

LONGEST_S = 5.0
"""Longest time constant, s."""


@dataclass(frozen=True)
class ModelSettings:
    """Settings of a model.

    Parameters
    ----------
    features, target
        Names of the features and of the predicted quantity.
    step_s
        Time step over which features are averaged, s.
    full_mm
        Threshold of full penetration; None: unknown.
    """

    features: tuple[str, ...]
    target: str
    step_s: float = 0.1
    orders: Orders = Orders()  # noqa: RUF009 - frozen
    full_mm: float | None = None


@dataclass(frozen=True)
class Prediction(ReadOnlyArrays):
    """Predicted penetration over time.

    Parameters
    ----------
    time_s
        Middle of each step, shape (n,), s. The prediction is available at the step's end.
    value, sigma
        Penetration and its standard uncertainty, mm; NaN where features are missing.
    is_outside
        Whether a regressor is outside the range to which the model was fitted.
    """

    time_s: FloatArray
    value: FloatArray
    sigma: FloatArray
    is_outside: BoolArray

    @property
    def low_95(self) -> FloatArray:
        """Lower end of the 95 % interval, never below 0, mm."""
        return np.asarray(np.maximum(self.value - SURE_95 * self.sigma, 0.0))

    @property
    def high_95(self) -> FloatArray:
        """Upper end of the 95 % interval, mm."""
        return np.asarray(self.value + SURE_95 * self.sigma)


@dataclass(frozen=True)
class PenetrationModel(ReadOnlyArrays):
    """A fitted model.

    Parameters
    ----------
    time_constants_s
        Time constants of A(q).
    center, scale
        Offset and scale that standardise the regressors, shape (d,).
    low, high
        Range of the regressors to which it was fitted, shape (d,).
    static
        Map from standardised regressors to penetration.
    scatter_mm
        Standard deviation not explained by the features.
    factor
        Factor applied to ±, from cross-validation (leave one weld out).
    rmse_mm
        Root-mean-square error of the cross-validation; NaN without it.
    """

    kind: Kind
    settings: ModelSettings
    time_constants_s: tuple[float, ...]
    center: FloatArray
    scale: FloatArray
    low: FloatArray
    high: FloatArray
    mean_mm: float
    static: LinearMap | GaussianMap
    scatter_mm: float
    factor: float = 1.0
    rmse_mm: float = float("nan")

    @cached_property
    def response(self) -> FloatArray:
        """See `impulse_response`."""
        return impulse_response(self.time_constants_s, self.settings.step_s)

    @property
    def memory(self) -> int:
        """Number of previous steps on which a prediction depends."""
        orders = self.settings.orders
        return len(self.response) + orders.delay + orders.lags

    def predict(self, weld: WeldSeries) -> Prediction:
        """Predict penetration, never below 0, from the features of a weld.

        Raises
        ------
        ValueError
            As `in_steps` does.
        """
        return self.predict_steps(in_steps(weld, self.settings.step_s))

    def predict_steps(self, steps: WeldSeries) -> Prediction:
        """As `predict`, from features that `in_steps` averaged."""
        x, noise, level = regressors(steps, self.response, self.settings.orders)
        there = np.isfinite(x).all(axis=1)
        given = x[there]
        mean, variance, gradient = self.static.evaluate((given - self.center) / self.scale)
        slope = gradient / self.scale
        by_features = ((slope * noise[there]) ** 2 + (slope * level[there]) ** 2).sum(axis=1)
        value, sigma = np.full((2, len(x)), np.nan)
        value[there] = np.maximum(self.mean_mm + mean, 0.0)
        sigma[there] = self.factor * np.sqrt(variance + self.scatter_mm**2 + by_features)
        margin = 0.05 * (self.high - self.low)
        outside = (x < self.low - margin) | (x > self.high + margin)
        return Prediction(steps.time_s, value, sigma, np.asarray(outside.any(axis=1)))


def _rows(steps: Sequence[WeldSeries], response: FloatArray, orders: Orders) -> Sections:
    parts = []
    for one in steps:
        x, noise, level = regressors(one, response, orders)
        used = np.isfinite(one.target) & np.isfinite(x).all(axis=1)
        parts.append((x[used], noise[used], level[used], one.target[used], one.target_sigma[used]))
    return Sections(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def fit_model(
    steps: Sequence[WeldSeries],
    kind: Kind,
    settings: ModelSettings,
    like: PenetrationModel | None = None,
) -> PenetrationModel:
    """Fit a model; its ± is estimated from the same welds (`validated_model` cross-validates it).

    Parameters
    ----------
    steps
        Welds as averaged by `in_steps`, with the features of the settings, in their order.
    kind
        ``arx``, or ``gp``, which needs scikit-learn.
    settings
        See `ModelSettings`.
    like
        A model of nearly the same welds, whose parameters are the initial values of the search.

    Raises
    ------
    ValueError
        If there are too few sections, or all have the same penetration.
    ImportError
        If scikit-learn is missing.
    """
    constants = _find_time_constants(steps, settings, like)
    rows = _rows(steps, impulse_response(constants, settings.step_s), settings.orders)
    width = rows.x.shape[1]
    if len(rows.y) < 2 * width + 4 or np.ptp(rows.y) == 0:
        few = f"{len(rows.y)} sections of different penetration"
        raise ValueError(f"{few}; {2 * width + 4} are needed for {width} regressors")
    center, scale = rows.x.mean(axis=0), np.maximum(rows.x.std(axis=0), 1e-12)
    mean = float(rows.y.mean())
    standard = Sections(
        (rows.x - center) / scale, rows.noise / scale, rows.level / scale, rows.y - mean,
        rows.y_sigma,
    )  # fmt: skip
    static: LinearMap | GaussianMap
    if kind == "arx":
        static, scatter = fit_linear(standard)
    else:
        static, scatter = fit_gaussian(standard, like.static if like else None)
    return PenetrationModel(
        kind=kind,
        settings=settings,
        time_constants_s=constants,
        center=center,
        scale=scale,
        low=rows.x.min(axis=0),
        high=rows.x.max(axis=0),
        mean_mm=mean,
        static=static,
        scatter_mm=float(np.sqrt(scatter)),
    )


def _find_time_constants(
    steps: Sequence[WeldSeries], settings: ModelSettings, like: PenetrationModel | None
) -> tuple[float, ...]:
    """Find the time constants whose linear model fits best."""
    orders, least = settings.orders, 0.2 * settings.step_s
    if not orders.poles:
        return ()

    def cost(logs: FloatArray) -> float:
        response = impulse_response(np.exp(logs).tolist(), settings.step_s)
        rows = _rows(steps, response, orders)
        columns = np.column_stack([rows.x, np.ones(len(rows.y))])
        residual = rows.y - columns @ np.linalg.lstsq(columns, rows.y, rcond=None)[0]
        return float(np.log(max(float(residual @ residual), 1e-30)))

    start = np.log(like.time_constants_s if like else (5 * settings.step_s,) * orders.poles)
    bounds = [(np.log(least), np.log(LONGEST_S))] * orders.poles
    options = {"xatol": 0.02, "fatol": 1e-5}
    found = optimize.minimize(cost, start, method="Nelder-Mead", bounds=bounds, options=options)
    return tuple(np.exp(found.x).tolist())


# --- errors of welds left out -------------------------------------------------------------------


@dataclass(frozen=True)
class LeftOut(ReadOnlyArrays):
    """Leave-one-weld-out predictions at the sections, each by a model of the other welds.

    Parameters
    ----------
    weld
        Name of each section's weld, shape (n,).
    time_s, measured, measured_sigma
        Time and measured penetration of each section with its standard uncertainty, s, mm.
    predicted, sigma
        Predicted penetration and its standard uncertainty, mm.
    full_mm
        See `ModelSettings`.
    """

    weld: tuple[str, ...]
    time_s: FloatArray
    measured: FloatArray
    measured_sigma: FloatArray
    predicted: FloatArray
    sigma: FloatArray
    full_mm: float | None

    @property
    def rmse_mm(self) -> float:
        """Root mean square of predicted minus measured, mm."""
        return float(np.sqrt(np.mean((self.predicted - self.measured) ** 2)))

    @property
    def bias_mm(self) -> float:
        """Mean of predicted minus measured, mm."""
        return float(np.mean(self.predicted - self.measured))

    @property
    def cover(self) -> float:
        """Share of sections within their 95 % interval."""
        spread = np.hypot(self.sigma, self.measured_sigma)
        return float(np.mean(np.abs(self.predicted - self.measured) <= SURE_95 * spread))

    def transitions(self) -> tuple[FloatArray, FloatArray]:
        """Times of measured transitions to full penetration, and the nearest predicted ones, s.

        NaN if none is predicted. Both are empty if ``full_mm`` is unknown.
        """
        known: list[float] = []
        found: list[float] = []
        for name in dict.fromkeys(self.weld):
            of = np.array([each == name for each in self.weld])
            if self.full_mm is None:
                break
            there = find_transitions(self.time_s[of], self.predicted[of], self.full_mm)
            for at in find_transitions(self.time_s[of], self.measured[of], self.full_mm):
                known.append(at)
                found.append(float(there[np.argmin(np.abs(there - at))]) if len(there) else np.nan)
        return np.array(known), np.array(found)


def validated_model(
    welds: Sequence[WeldSeries],
    kind: Kind,
    settings: ModelSettings,
    progress: Callable[[int, int], object] = lambda _done, _of: None,
) -> tuple[PenetrationModel, LeftOut]:
    """Fit a model and cross-validate it by leaving out one weld at a time.

    If the mean square of the prediction errors exceeds that expected from ±, the ± is scaled up
    accordingly: sections of one weld are not independent.

    Parameters
    ----------
    welds
        Welds with the features of the settings, in their order.
    kind, settings
        As in `fit_model`.
    progress
        Called with the number of completed fits and their total; may raise to stop.

    Raises
    ------
    ValueError
        As `in_steps` and `fit_model` do, or if there are fewer than three welds with sections.
    ImportError
        If scikit-learn is missing.
    """
    steps = [in_steps(one, settings.step_s) for one in welds]
    used = [one for one in steps if np.isfinite(one.target).any()]
    if len(used) < 3:
        raise ValueError(f"{len(used)} welds have sections; 3 are needed")
    model = fit_model(used, kind, settings)
    names: list[str] = []
    parts = []
    for done, one in enumerate(used, 1):
        progress(done, len(used) + 1)
        others = [each for each in used if each is not one]
        found = fit_model(others, kind, settings, like=model).predict_steps(one)
        cut = np.isfinite(one.target) & np.isfinite(found.value)
        names += [one.name] * int(cut.sum())
        columns = one.time_s, one.target, one.target_sigma, found.value, found.sigma
        parts.append([column[cut] for column in columns])
    joined = (np.concatenate(column) for column in zip(*parts, strict=True))
    time_s, measured, measured_sigma, predicted, sigma = joined
    left = LeftOut(
        tuple(names), time_s, measured, measured_sigma, predicted, sigma, settings.full_mm
    )
    square = (left.predicted - left.measured) ** 2 - left.measured_sigma**2
    factor = float(np.sqrt(max(square.sum() / (left.sigma**2).sum(), 1.0)))
    model = replace(model, factor=factor, rmse_mm=left.rmse_mm)
    return model, replace(left, sigma=factor * left.sigma)
