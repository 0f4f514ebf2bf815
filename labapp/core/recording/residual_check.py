"""What the residuals of a recording say of its set-up.

Most of what is wrong with a set-up goes into the surface: the residuals do not show it. What is
left is the same in every frame, where noise is not. For each quantity of the set-up the fit is
done anew with that quantity off, which gives the pattern of residuals that it would leave. The
amplitude of each pattern in the residuals of each frame is a series, whose mean is tested with the
correlation of its values in time allowed for.

A set-up that is far off leaves few residuals to look at: hardly a frame is answered at all.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.match import Match
from labapp.core.pipeline import Measurement
from labapp.core.surface.pool_fit import FitSettings, fit_pool
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, ReadOnlyArrays

MOST = 64
"""So many frames are kept, evenly over the recording; so many at least make a verdict: …"""

FEWEST = 6

LEAST_MM = 0.015
"""A pattern is in doubt from this root mean square on the imaging plane on: spots that overlap and
waves that the surface is too stiff for leave up to half as much, frame after frame, …"""

LEAST_T = 6.0
"""… from so many standard uncertainties of its mean amplitude, …"""

LEAST_SIGMAS = 1.5
"""… and where the quantity is off by so many times what it is known to."""

VISIBLE_MM = 1e-3
"""A quantity that leaves less for its standard uncertainty cannot be seen."""

ALIKE = 0.9
"""Quantities that explain such a share of what the best does cannot be told apart by it."""

UNANSWERED, FEWEST_TRIED = 0.8, 10
"""A set-up is in doubt where a larger share of so many frames has rays that match no pool."""

NO_MATCH = frozenset({"no-match", "no-reference", "ambiguous-rows", "no-rows", "no-surface"})


@dataclass(frozen=True)
class Suspect:
    """A quantity whose pattern the residuals have.

    Parameters
    ----------
    name, unit
        What it is called (`uncertainty.QUANTITIES`), and what it is measured in.
    off, sigma
        By how much the residuals have it off if it alone is, and the standard uncertainty of that.
    rms_mm
        What of the residuals it explains, root mean square, mm.
    """

    name: str
    unit: str
    off: float
    sigma: float
    rms_mm: float


@dataclass(frozen=True)
class SetupVerdict:
    """What a recording says of its set-up.

    Parameters
    ----------
    is_doubtful
        Whether it contradicts the set-up.
    reason
        Why, or why nothing can be said, in a sentence.
    suspects
        Quantities that would explain it, the likeliest first.
    """

    is_doubtful: bool
    reason: str
    suspects: tuple[Suspect, ...] = ()


@dataclass(frozen=True)
class _Sample(ReadOnlyArrays):
    match: Match
    surface: SplineSurface
    residual_mm: FloatArray


@dataclass
class ResidualRecord:
    """Residuals of a recording's frames, as many as a verdict needs.

    Parameters
    ----------
    rig
        The bench that the frames are measured with.
    settings
        Of the fit.
    """

    rig: Rig
    settings: FitSettings = field(default_factory=FitSettings)
    _samples: list[_Sample] = field(default_factory=list)
    _statuses: Counter[str] = field(default_factory=Counter)
    _every: int = 1
    _seen: int = 0

    def add(self, measured: Measurement) -> None:
        """Take note of the next frame. Only what the fit measured has residuals that are used."""
        self._statuses[measured.status] += 1
        match, made = measured.match, measured.reconstruction
        if match is None or made is None or not isinstance(made.unbounded, SplineSurface):
            return
        if len(made.residual_mm) != len(match.ray):
            return
        if self._seen % self._every == 0:
            self._samples.append(_Sample(match, made.unbounded, made.residual_mm))
        self._seen += 1
        if len(self._samples) > MOST:
            self._samples = self._samples[::2]
            self._every *= 2

    def verdict(self) -> SetupVerdict:
        """Whether the frames contradict the set-up, and which quantity would explain it."""
        tried = sum(self._statuses[one] for one in (*NO_MATCH, "ok"))
        lost = tried - self._statuses["ok"]
        if tried >= FEWEST_TRIED and lost > UNANSWERED * tried:
            return SetupVerdict(
                True,
                f"the dots of {lost} of {tried} frames match no pool on this set-up: look at the "
                "pattern's rotation and inter-beam angle, the laser and the image calibration",
            )
        if self.rig.uncertainty is None or len(self._samples) < FEWEST:
            few = f"{len(self._samples)} frames with a surface are too few: {FEWEST} are needed"
            return SetupVerdict(False, few)
        suspects = self._suspects()
        if not suspects:
            return SetupVerdict(
                False, f"the residuals of {len(self._samples)} frames do not contradict it"
            )
        first = suspects[0]
        off = f"{first.off:+.2g} ± {first.sigma:.1g} {first.unit}"
        return SetupVerdict(
            True,
            f"residuals of {1e3 * first.rms_mm:.0f} µm are the same in {len(self._samples)} "
            f"frames, as if {first.name} were off by {off}",
            suspects,
        )

    def _suspects(self) -> tuple[Suspect, ...]:
        assert self.rig.uncertainty is not None
        middle = self._samples[len(self._samples) // 2]
        place = np.full(middle.match.witness.shape, -1)
        place[tuple(middle.match.ray.T - 1)] = np.arange(len(middle.match.ray))
        found = []
        for k, (quantity, sigma) in enumerate(
            zip(QUANTITIES, self.rig.uncertainty.sigma.tolist(), strict=True)
        ):
            pattern = self._pattern(middle, k, sigma) if sigma else None
            if pattern is None or _rms(pattern) < VISIBLE_MM:
                continue
            amplitude = np.array([_amplitude(one, place, pattern) for one in self._samples])
            mean, spread = float(np.mean(amplitude)), _sigma_of_mean(amplitude)
            explained = abs(mean) * _rms(pattern)
            certain = abs(mean) > LEAST_T * spread and abs(mean) > LEAST_SIGMAS
            if certain and explained > LEAST_MM:
                # Computed with a set-up that is off by δ, residuals are as with the dots off by −δ.
                off = -mean * sigma
                one = Suspect(quantity.name, quantity.unit, off, spread * sigma, explained)
                found.append((abs(mean), one))
        # Of those that explain about as much, the likeliest is off by the least it is known to.
        most = max((one.rms_mm for _, one in found), default=0.0)
        found.sort(key=lambda pair: (pair[1].rms_mm < ALIKE * most, pair[0]))
        return tuple(one for _, one in found)

    def _pattern(self, sample: _Sample, quantity: int, sigma: float) -> FloatArray | None:
        """Residuals by a quantity off by its σ, once the surface has followed, shape (n, 2), mm."""
        offset = np.zeros(len(QUANTITIES))
        offset[quantity] = sigma
        try:
            return (self._refitted(sample, offset) - self._refitted(sample, -offset)) / 2.0
        except CannotMeasure:
            return None

    def _refitted(self, sample: _Sample, offset: FloatArray) -> FloatArray:
        match, known = sample.match, self.rig.uncertainty
        assert known is not None
        dots = moved_dots(match.plane_mm, self.rig, known.axes, offset)
        bench = replace(moved_rig(self.rig, offset), uncertainty=None)
        pool = fit_pool(
            *(match.ray, dots, match.plane_covariance_mm2, match.witness, bench, self.settings),
            *(sample.surface, match.missing),
        )
        return pool.residual_mm


def _amplitude(sample: _Sample, place: np.ndarray, pattern: FloatArray) -> float:
    """Least-squares amplitude of a pattern in the residuals of the rays that have one."""
    at = place[tuple(sample.match.ray.T - 1)]
    known: BoolArray = at >= 0
    expected, residual = pattern[at[known]], sample.residual_mm[known]
    return float(np.sum(expected * residual) / max(float(np.sum(expected**2)), 1e-18))


def _sigma_of_mean(values: FloatArray) -> float:
    """Standard uncertainty of the mean of values that follow on each other.

    Neighbours that are alike are as good as fewer values: autocorrelations are summed up to the
    first that is not above 0, and to a third of the series at most.
    """
    count = len(values)
    apart = values - values.mean()
    variance = float(np.mean(apart**2))
    if not variance:
        return 0.0
    alike = 0.0
    for lag in range(1, count // 3 + 1):
        correlation = float(np.mean(apart[lag:] * apart[:-lag])) / variance
        if correlation <= 0.0:
            break
        alike += (1.0 - lag / count) * correlation
    return float(np.sqrt(variance * (1.0 + 2.0 * alike) / (count - 1)))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
