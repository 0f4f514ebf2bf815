"""Analysis of the pool's dynamics over a recording, from its surfaces and sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from labapp.core.dynamics.modes import ModeCourse, SurfaceSeries, bessel_modes, pod_modes
from labapp.core.dynamics.oscillation import FEWEST
from labapp.core.dynamics.spectra import PeakTrack, Spectrogram, spectrogram, track_peak
from labapp.core.dynamics.steps import Event, StepResponse, find_events, step_response
from labapp.core.values import FloatArray

RESPONDING = ("width_mm", "length_mm", "height_mm", "convexity_mm")
"""Series in which events and responses are searched."""

LEVEL_SIGMAS = 2.0
"""Least change of an event, in σ of the level. The errors of two frames' levels are equal if the
boundary is the same, and independent if it has moved (`core.sequence.mean`): the standard
uncertainty of their difference is at most σ√2."""

LONGEST = 10_000_000
"""Longest series, in steps between frames, that fits into memory as evenly spaced samples."""

MOST_SIGNAL_STEPS = 8
"""A signal with more changes is pulsed: responses to its individual steps are not analysed."""


@dataclass(frozen=True)
class DynamicsSettings:
    """Settings of the analysis; see `fit_oscillations` and `spectrogram`.

    Parameters
    ----------
    of
        Name of the series whose spectra and spectral peak are computed.
    """

    of: str = "height_mm"
    band_hz: tuple[float, float] | None = None
    segment_s: float | None = None


@dataclass(frozen=True)
class Response:
    """Response of one series to a step of one signal."""

    signal: str
    series: str
    step: Event
    response: StepResponse


@dataclass(frozen=True)
class Dynamics:
    """Dynamics of the pool over a recording; n frames.

    Parameters
    ----------
    series
        Sizes and shape of each, name → values, shape (n,).
    modes, pod
        Bessel modes and POD modes.
    spectrogram, peak
        Spectrogram and spectral peak of the series ``settings.of``.
    events
        Change points of each series and each signal.
    responses
        Responses to the steps of signals.
    """

    surfaces: SurfaceSeries
    series: Mapping[str, FloatArray]
    settings: DynamicsSettings
    modes: tuple[ModeCourse, ...]
    pod: tuple[ModeCourse, ...]
    spectrogram: Spectrogram
    peak: PeakTrack
    events: Mapping[str, tuple[Event, ...]]
    responses: tuple[Response, ...]

    @property
    def all_modes(self) -> tuple[ModeCourse, ...]:
        """Bessel modes, followed by POD modes."""
        return (*self.modes, *self.pod)


def analyse(
    surfaces: SurfaceSeries,
    series: Mapping[str, FloatArray],
    signals: Mapping[str, tuple[FloatArray, FloatArray]],
    settings: DynamicsSettings,
    scale_sigma: float = 0.0,
    level_sigma: Mapping[str, float] = MappingProxyType({}),
) -> Dynamics:
    """Analyse how the pool changes over a recording.

    Parameters
    ----------
    surfaces, series
        See `Dynamics`.
    signals
        Name → times on the recording's clock, s, and values, e.g. of current, voltage, wire feed.
    settings
        See `DynamicsSettings`.
    scale_sigma
        See `bessel_modes`.
    level_sigma
        The level's contribution to the standard uncertainty of each series, by name: a change of
        less than `LEVEL_SIGMAS` of it may be due to the error of the level, and is not an event.

    Raises
    ------
    ValueError
        If there are fewer than `FEWEST` frames, or fewer in a segment, or a few frames are spread
        over more than `LONGEST` of their steps.
    """
    time = surfaces.time_s
    if len(time) < FEWEST:
        raise ValueError(f"{len(time)} of the frames have a surface; at least {FEWEST} are needed")
    if np.ptp(time) > LONGEST * np.median(np.diff(time)):
        raise ValueError(f"their times range over {np.ptp(time):g} s: too long for their rate")
    modes = bessel_modes(surfaces, scale_sigma=scale_sigma, band_hz=settings.band_hz)
    slowest = [one.oscillations[0].frequency_hz for one in modes if one.oscillations]
    period = 1 / min(slowest) if slowest else 0.0
    events = {
        name: find_events(time, series[name], period, LEVEL_SIGMAS * level_sigma.get(name, 0.0))
        for name in RESPONDING
    }
    steps = {}
    for name, (at, value) in signals.items():
        within = (at >= time[0]) & (at <= time[-1]) & np.isfinite(value)
        found = find_events(at[within], value[within], lags=(1,))
        steps[name] = tuple(_sharpened(one, at[within], value[within]) for one in found)
    return Dynamics(
        surfaces,
        series,
        settings,
        modes,
        pod_modes(surfaces, scale_sigma=scale_sigma, band_hz=settings.band_hz),
        spectrogram(time, series[settings.of], settings.segment_s),
        track_peak(time, series[settings.of], settings.segment_s, settings.band_hz),
        events | steps,
        _responses(time, series, steps),
    )


def _responses(
    time: FloatArray, series: Mapping[str, FloatArray], steps: Mapping[str, tuple[Event, ...]]
) -> tuple[Response, ...]:
    """Fit responses of every series to every step of signals with few steps, until the next one."""
    found = []
    for signal, events in steps.items():
        if len(events) > MOST_SIGNAL_STEPS:
            continue
        ends = [*(one.time_s for one in events), np.inf]
        for k, event in enumerate(events):
            begin = -np.inf if k == 0 else ends[k - 1]
            used = (time > begin) & (time < ends[k + 1])
            for name in RESPONDING:
                one = step_response(time[used], series[name][used], event.time_s)
                found += [Response(signal, name, event, one)] if one else []
    return tuple(found)


def _sharpened(event: Event, at: FloatArray, value: FloatArray) -> Event:
    """Refine an event of a signal to one sample: the best split into two levels within 4 σ."""
    near = np.flatnonzero(np.abs(at - event.time_s) <= 4 * event.sigma_s)
    if len(near) < 4:
        return event
    x = value[near]
    n = np.arange(1, len(x))
    below, total = np.cumsum(x)[:-1], x.sum()
    split = near[int(np.argmax(below**2 / n + (total - below) ** 2 / (len(x) - n)))]
    step = float(at[split + 1] - at[split])
    return replace(event, time_s=float(at[split] + step / 2), sigma_s=step / np.sqrt(12))
