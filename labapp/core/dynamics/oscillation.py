"""Damped sinusoids in a series, with uncertainties, by nonlinear least squares on the samples.

The samples need not be evenly spaced; missing frames are not interpolated. For given frequency and
damping the model is linear (variable projection, Golub & Pereyra 1973). The noise need not be
white: its variance is taken from the residual's periodogram near the frequency.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, stdtrit

from labapp.core.values import ComplexArray, FloatArray, ReadOnlyArrays

FALSE_ALARM = 1e-3
"""Probability that pure noise gives an oscillation."""

TREND = 2
"""Degree of the polynomial trend."""

FEWEST = 16
"""Least number of samples per oscillation."""

BESIDE = np.concatenate([np.arange(-12, -1), np.arange(2, 13)])
"""Distances from the frequency at which the noise is estimated, in 1/duration; closer in, the fit
has removed it."""

DAMPING_STARTS = (0.5, 6.0)
"""Initial decay rates, in 1/duration."""

SINGULAR = 1e-3
"""A frequency whose cosine and sine the other columns explain almost entirely is not tried: the
least determinant of their normal matrix, in squared numbers of samples."""


@dataclass(frozen=True)
class Oscillation(ReadOnlyArrays):
    """A damped sinusoid common to c channels: Re(A · exp((iω − γ)·τ)), τ from the first sample.

    Parameters
    ----------
    frequency_hz, damping_per_s
        ω/2π, and the decay rate γ of the amplitude; negative if it grows.
    amplitude
        A of each channel, shape (c,), in the unit of the series.
    covariance
        Covariance of frequency, damping, and the real and imaginary part of each A, shape
        (2 + 2c, 2 + 2c).
    """

    frequency_hz: float
    damping_per_s: float
    amplitude: ComplexArray
    covariance: FloatArray

    @property
    def frequency_sigma_hz(self) -> float:
        """Standard uncertainty of the frequency, Hz."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def damping_sigma_per_s(self) -> float:
        """Standard uncertainty of the damping, 1/s."""
        return float(np.sqrt(self.covariance[1, 1]))

    def quantities(self, of: Callable[[ComplexArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return quantities of the amplitudes and their standard uncertainties, to first order.

        Parameters
        ----------
        of
            Function of the complex amplitudes, shape (c,), that returns k quantities, shape (k,).
        """
        step = 1e-6 * max(float(np.abs(self.amplitude).max()), 1e-12)
        slopes = [
            (of(self.amplitude + d) - of(self.amplitude - d)) / (2 * step)
            for unit in np.eye(len(self.amplitude))
            for d in (step * unit, 1j * step * unit)
        ]
        slope = np.stack(slopes)
        variance = np.einsum("ik,ij,jk->k", slope, self.covariance[2:, 2:], slope)
        return of(self.amplitude), np.sqrt(variance)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Value of each channel at times since the first sample, shape (n, c)."""
        rate = 2j * np.pi * self.frequency_hz - self.damping_per_s
        return np.asarray((np.exp(rate * time_s)[:, None] * self.amplitude).real)


def fit_oscillations(
    time_s: FloatArray,
    values: FloatArray,
    most: int = 3,
    band_hz: tuple[float, float] | None = None,
) -> tuple[Oscillation, ...]:
    """Fit damped sinusoids to a series; the strongest is returned first.

    Sinusoids are added one by one at the frequency that reduces the cost most, and all are
    refitted jointly. This stops if the probability that noise gives the same reduction is not less
    than `FALSE_ALARM`, or if a frequency lies at an end of the band.

    Parameters
    ----------
    time_s
        Times of n samples, ascending, shape (n,), s; they need not be evenly spaced.
    values
        Values, shape (n,), or (n, c) for c channels with common frequencies.
    most
        Largest number of oscillations; at most one for every `FEWEST` samples.
    band_hz
        Lowest and highest frequency, at most half the frame rate. None: from two periods in the
        series to half the frame rate.
    """
    time = np.asarray(time_s, float) - time_s[0]
    value = np.asarray(values, float).reshape(len(time), -1)
    if len(time) < FEWEST:
        return ()
    step = float(np.median(np.diff(time)))
    low, high = band_hz or (2 / (time[-1] + step), np.inf)
    band = low, min(high, 0.5 / step)  # beyond, every frequency fits as well as its alias
    edge = 0.05 / (time[-1] + step)  # a maximum at an end of the band lies outside it
    if band[1] - low < 2 * edge:
        return ()
    fitted = _Fit(time, value, np.empty((0, 2)))
    while len(fitted.rates) < min(most, len(time) // FEWEST):
        start = 2 * np.pi * _strongest(fitted, step, band)
        starts = (np.vstack([fitted.rates, (start, k / time[-1])]) for k in DAMPING_STARTS)
        wider = min((_refine(time, value, s, band) for s in starts), key=lambda f: f.cost)
        hertz = wider.rates[:, 0] / (2 * np.pi)
        if hertz.min() < band[0] + edge or hertz.max() > band[1] - edge:
            break
        if not _stands_out(fitted, wider, step):
            break
        fitted = wider
    every = [fitted.oscillation(k, step) for k in range(len(fitted.rates))]
    return tuple(sorted(every, key=lambda one: -_energy(one, time)))


class _Fit:
    """Linear least-squares fit of the model for given rates (ω, γ), shape (k, 2)."""

    def __init__(self, time: FloatArray, value: FloatArray, rates: FloatArray) -> None:
        self.time, self.value, self.rates = time, value, rates
        span = max(float(time[-1]), 1e-12)
        self._trend = np.polynomial.legendre.legvander(2 * time / span - 1, TREND)
        waves = [np.exp((1j * w - g) * time) for w, g in rates]
        parts = [part for wave in waves for part in (wave.real, -wave.imag)]
        self.columns = np.column_stack([*parts, self._trend])
        self.weights = np.linalg.lstsq(self.columns, value, rcond=None)[0]
        self.residual = value - self.columns @ self.weights
        self.cost = float(np.sum(self.residual**2))

    def amplitude(self, k: int) -> ComplexArray:
        """A of component k, shape (c,)."""
        return np.asarray(self.weights[2 * k] + 1j * self.weights[2 * k + 1])

    def noise(self, k: int, step: float) -> FloatArray:
        """Variance of white noise with the spectral density near component k, shape (c,)."""
        span = float(self.time[-1]) + step
        near = self.rates[k, 0] / (2 * np.pi) + BESIDE / span
        near = near[(near > 1 / span) & (near < 0.5 / step)]
        turned = np.exp(-2j * np.pi * near[:, None] * self.time)
        power = np.mean(np.abs(turned @ self.residual) ** 2, axis=0) / len(self.time)
        # Student's factor (JCGM 100, G.3): two degrees of freedom per frequency.
        student = stdtrit(2 * len(near), 0.975) / stdtrit(np.inf, 0.975)
        return np.asarray(np.maximum(power * student**2, 1e-30))

    def oscillation(self, k: int, step: float) -> Oscillation:
        """Return component k with its covariance."""
        channels, count = self.value.shape[1], len(self.rates)
        linear = self.columns.shape[1]
        size = 2 * count + linear * channels
        normal = np.zeros((size, size))
        for c, variance in enumerate(self.noise(k, step)):
            jacobian = np.zeros((len(self.time), size))
            for j, (w, g) in enumerate(self.rates):
                moved = self.time * np.exp((1j * w - g) * self.time) * self.amplitude(j)[c]
                jacobian[:, 2 * j], jacobian[:, 2 * j + 1] = -moved.imag, -moved.real
            begin = 2 * count + c * linear
            jacobian[:, begin : begin + linear] = self.columns
            normal += jacobian.T @ jacobian / variance
        scale = 1 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        covariance = np.linalg.pinv(normal * scale * scale[:, None], hermitian=True)
        covariance *= scale * scale[:, None]
        own = [2 * k, 2 * k + 1]
        for c in range(channels):
            begin = 2 * count + c * linear + 2 * k
            own += [begin, begin + 1]
        block = covariance[np.ix_(own, own)]
        block[0] /= 2 * np.pi
        block[:, 0] /= 2 * np.pi
        frequency, damping = self.rates[k, 0] / (2 * np.pi), self.rates[k, 1]
        return Oscillation(float(frequency), float(damping), self.amplitude(k), np.asarray(block))


def _strongest(fitted: _Fit, step: float, band: tuple[float, float]) -> float:
    """Frequency of the sinusoid that reduces the cost most in the band, all else refitted, Hz.

    The trend must be refitted too: where crests are missing, the largest power of the residual is
    at twice the frequency. The sums over samples are computed by FFT, for times rounded to steps.
    """
    place = np.round(fitted.time / step).astype(int)
    others = np.linalg.qr(fitted.columns)[0]
    parts = np.zeros((place[-1] + 1, 1 + others.shape[1] + fitted.residual.shape[1]))
    parts[place] = np.column_stack([np.ones(len(place)), others, fitted.residual])
    size = 4 * len(parts)
    turned = np.fft.fft(parts, size, axis=0)
    frequency = np.fft.rfftfreq(size, step)
    at = np.arange(len(frequency))
    real, imag = turned[at].real, -turned[at].imag  # sums with the cosine and the sine
    double, count = turned[2 * at % size, 0], len(place)
    own, last = slice(1, 1 + others.shape[1]), slice(1 + others.shape[1], None)
    cosine = (count + double.real) / 2 - np.sum(real[:, own] ** 2, axis=1)
    sine = (count - double.real) / 2 - np.sum(imag[:, own] ** 2, axis=1)
    both = -double.imag / 2 - np.sum(real[:, own] * imag[:, own], axis=1)
    determinant = cosine * sine - both**2
    known = (frequency >= band[0]) & (frequency <= band[1]) & (determinant > SINGULAR * count**2)
    gain = np.zeros(len(frequency))
    b, c = real[known][:, last], imag[known][:, last]
    squares = sine[known, None] * b**2 - 2 * both[known, None] * b * c + cosine[known, None] * c**2
    gain[known] = np.sum(squares, axis=1) / determinant[known]
    return float(np.clip(frequency[np.argmax(gain)], *band))  # a narrow band has no frequency


def _refine(
    time: FloatArray, value: FloatArray, rates: FloatArray, band: tuple[float, float]
) -> _Fit:
    """Optimise the rates, starting from those given."""
    from scipy.optimize import least_squares

    span, scale = float(time[-1]), np.tile([1.0, 1.0], len(rates)) / float(time[-1])
    low = np.tile([2 * np.pi * band[0], -3 / span], len(rates))
    high = np.tile([2 * np.pi * band[1], 2 * np.pi * band[1]], len(rates))

    def residual(flat: FloatArray) -> FloatArray:
        return np.ravel(_Fit(time, value, flat.reshape(-1, 2)).residual)

    start = np.clip(rates.ravel(), low + 1e-9 * high, high * (1 - 1e-9))
    best = least_squares(residual, start, bounds=(low, high), x_scale=scale, xtol=1e-10)
    return _Fit(time, value, best.x.reshape(-1, 2))


def _stands_out(without: _Fit, with_it: _Fit, step: float) -> bool:
    """Whether the last component is significant, given the number of frequencies tried."""
    last, channels = len(with_it.rates) - 1, with_it.value.shape[1]
    gain = np.sum(without.residual**2 - with_it.residual**2, axis=0)
    chance = chdtrc(2 * channels + 2, np.sum(gain / with_it.noise(last, step)))
    return bool(chance * 2 * len(without.time) < FALSE_ALARM)


def _energy(one: Oscillation, time: FloatArray) -> float:
    return float(np.sum(one.at(time) ** 2))
