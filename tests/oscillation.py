"""An oscillation of a pool in the sample recordings, in tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.values import FloatArray
from labapp.simulation.pools import Place


@dataclass(frozen=True)
class Oscillation:
    """An oscillation of the pool along and across, zero at the boundary.

    ``amplitude · (1 − ρ²)² · (cos(ωt)·q + ½·sin(ωt)·p)`` has no net volume on an even pool.
    """

    amplitude_mm: float
    """Amplitude of the mode."""
    frequency_hz: float
    time_s: float = 0.0
    """ω/2π, and the time t."""

    def _weights(self) -> tuple[float, float]:
        phase = 2 * np.pi * self.frequency_hz * self.time_s
        return self.amplitude_mm * np.cos(phase), self.amplitude_mm * np.sin(phase) / 2

    def height(self, place: Place) -> FloatArray:
        """Height that it adds, mm."""
        along, across = self._weights()
        return (1 - place.rho2) ** 2 * (along * place.q + across * place.p)

    def gradient(self, place: Place) -> FloatArray:
        """Gradient that it adds, shape (…, 2)."""
        along, across = self._weights()
        damp = 1 - place.rho2
        slope = -4 * damp * (along * place.q + across * place.p)
        return place.gradient(slope * place.p + damp**2 * across, slope * place.q + damp**2 * along)

    def after(self, seconds: float) -> Oscillation:
        """The same oscillation ``seconds`` later."""
        return replace(self, time_s=self.time_s + seconds)
