"""What the residuals of a recording say of its set-up.

Most of what is wrong with a set-up goes into the surface: residuals do not show it. What no surface
can absorb (`dot_response`) is the same in every frame, or changes over the recording where a part
moves, while noise averages out. The mean residual of each ray, and its change over the recording,
are compared with the response to each quantity (score test): one is off where the cost falls by
more than `LIMIT` once it is free. The cost of the mean has the set-up's own covariance, so that
what its ± covers is no contradiction; nothing should move during a recording. What fits no quantity
(speckle, a surface finer than the fit's) is the noise that both are compared with.

A set-up that is far off leaves few residuals to look at: hardly a frame is measured at all.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from labapp.core.geometry.perturbation import Direction, directions
from labapp.core.geometry.plausibility import implausible_values
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.core.pipeline import Measurement, setup_status
from labapp.core.recording.dot_response import dot_responses
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

MOST = 64
"""So many frames are kept, evenly over the recording …"""

PARTS = 3
"""The first and the last of so many parts of a recording tell what has changed."""

FEWEST, FREEDOM = 6, 20
"""… and so many, with so many degrees of freedom that no surface absorbs, make a verdict."""

OFTEN = 0.5
"""A ray counts if it has a dot in this share of the frames."""

LIMIT = 11.0
"""A quantity is off where the cost falls by more with it free: 3.3 standard deviations."""

ALIKE = 6.0
"""Quantities that the cost falls by nearly as much with explain the residuals alike."""

MODEL_MM = 1e-3
"""Standard uncertainty, root mean square over the dots on the plane, of what a set-up's pattern may
have of spots that overlap and of shapes that no spline has."""

NONLINEAR = 0.05
"""And as a share of all that no surface absorbs: the response is linear to that share."""

LENS_CENTER = 0.25
"""Standard uncertainty of the centre of the distortion on the plane, which is taken for the plane's
middle, along either axis, over half of the plane's shorter side."""

VISIBLE_MM = 1e-3
"""A quantity that leaves less for its assumed uncertainty raises no doubt. It is named where others
do, and it explains the residuals as well: gross errors of it are visible, too …"""

IMPLAUSIBLE = 30.0
"""… unless it would be off by more times its assumed uncertainty."""

UNANSWERED, FEWEST_TRIED = 0.8, 10
"""A set-up is in doubt where a larger share of so many frames has rays that match no pool."""

AGAIN, AT_LEAST = 1.25, 1000
"""While frames come, they are judged again at so many times as many, or at so many more."""

NO_MATCH = frozenset({"no-match", "no-surface"})
"""Statuses of frames that contradict a set-up. ``no-reference`` and ``ambiguous-rows`` do not: the
right one gives them, too, where the pool lies beside the absent ray or a dot next to it is missing.
"""

DOUBTFUL = "doubtful"
"""`Measurement.setup_status` of a set-up that its recording contradicts."""

FIXED = (
    "image_calibration.",
    "imaging_plane.glass_",
    "pattern.inter_beam_angle_deg",
    "camera_lens.",
)
"""Keys of what cannot change during a recording begin so."""


@dataclass(frozen=True)
class Suspect:
    """A quantity whose pattern the residuals have.

    Parameters
    ----------
    name, unit
        What it is called (`perturbation.directions`), and what it is measured in.
    off, sigma
        By how much the residuals have it off if it alone is, and the standard uncertainty of that,
        the other quantities' ± included; of a drift, from the first to the last part.
    rms_mm
        What of the residuals it explains, root mean square, mm.
    is_drift
        Whether it has changed during the recording.
    """

    name: str
    unit: str
    off: float
    sigma: float
    rms_mm: float
    is_drift: bool = False


@dataclass(frozen=True)
class SetupVerdict:
    """What a recording says of its set-up.

    Parameters
    ----------
    is_doubtful
        Whether it contradicts the set-up.
    reason
        Why, or why nothing can be said, in a clause.
    suspects
        Quantities that would explain it, the likeliest first.
    """

    is_doubtful: bool
    reason: str
    suspects: tuple[Suspect, ...] = ()


@dataclass(frozen=True)
class Residuals(ReadOnlyArrays):
    """Residuals of the n dots of a frame, and the surface that left them.

    Parameters
    ----------
    ray
        Ray (i, j) of each, counted from 1, shape (n, 2).
    residual_mm
        Computed minus captured dot, shape (n, 2), mm.
    surface
        The fit's surface.
    """

    ray: IntArray
    residual_mm: FloatArray
    surface: SplineSurface

    @classmethod
    def of(cls, measurement: Measurement) -> Self | None:
        """Those of a frame; None where the fit did not measure it."""
        match, made = measurement.match, measurement.reconstruction
        if match is None or made is None or not isinstance(made.unbounded, SplineSurface):
            return None
        if len(made.residual_mm) != len(match.ray):
            return None
        return cls(match.ray, made.residual_mm, made.unbounded)


@dataclass
class ResidualRecord:
    """Residuals of a recording's frames, as many as a verdict needs.

    Parameters
    ----------
    rig
        The bench that the frames are measured with.
    """

    rig: Rig
    _samples: list[Residuals] = field(default_factory=list)
    _newest: deque[Residuals] = field(default_factory=lambda: deque(maxlen=MOST // PARTS))
    _statuses: Counter[str] = field(default_factory=Counter)
    _every: int = 1
    _seen: int = 0
    _judged: tuple[int, SetupVerdict] = (0, SetupVerdict(False, "no frame was measured"))

    def __post_init__(self) -> None:
        if doubt := doubt_of_values(self.rig):
            self._judged = 0, doubt

    def add(self, measurement: Measurement, residuals: Residuals | None = None) -> None:
        """Add the next frame, in their order.

        Parameters
        ----------
        measurement
            What was measured.
        residuals
            Its residuals, where the measurement no longer has them.
        """
        self._statuses[measurement.status] += 1
        found = residuals or Residuals.of(measurement)
        if found is None:
            return
        self._newest.append(found)
        if self._seen % self._every == 0:
            self._samples.append(found)
        self._seen += 1
        if len(self._samples) > MOST:
            self._samples = self._samples[::2]
            self._every *= 2

    def judged(self, measurement: Measurement, residuals: Residuals | None = None) -> Measurement:
        """Add the next frame; returns it with what is known of the set-up by now.

        The newest frames weigh as much as all before: what has moved is soon seen.
        """
        self.add(measurement, residuals)
        count, last = sum(self._statuses.values()), self._judged[0]
        if count >= max(FEWEST_TRIED, min(AGAIN * last, last + AT_LEAST)):
            newest = {id(one): one for one in self._newest}
            before = [one for one in self._samples if id(one) not in newest]
            samples = [*before, *newest.values()]
            self._judged = count, judge_setup(self.rig, self._statuses, samples)
        status = measurement.setup_status and judged_status(self.rig, self._judged[1])
        return replace(measurement, setup_status=status)

    @property
    def doubt(self) -> str:
        """Why the set-up is doubtful, as far as it is known by now; empty if it is not."""
        last = self._judged[1]
        return last.reason if last.is_doubtful else ""

    def verdict(self) -> SetupVerdict:
        """Whether the frames contradict the set-up, and which quantity would explain it."""
        return judge_setup(self.rig, self._statuses, self._samples)


def doubt_of_values(rig: Rig) -> SetupVerdict | None:
    """Doubt of a set-up with values that no usual bench has (`implausible_values`); or None."""
    unusual = implausible_values(rig)
    return SetupVerdict(True, "; ".join(unusual)) if unusual else None


def judged_status(rig: Rig, verdict: SetupVerdict | None) -> str:
    """How far a rig can be relied on (`pipeline.setup_status`), with what its recording says."""
    is_doubtful = verdict is not None and verdict.is_doubtful
    return setup_status(rig) and (DOUBTFUL if is_doubtful else setup_status(rig))


def judge_setup(
    rig: Rig, statuses: Mapping[str, int], samples: Sequence[Residuals]
) -> SetupVerdict:
    """Judge whether a recording contradicts its set-up, and which quantity would explain it.

    Values that no usual bench has are a doubt whatever the recording says.

    Parameters
    ----------
    rig
        The bench that the frames were measured with.
    statuses
        How many frames have each status.
    samples
        Residuals of frames, evenly over the recording, in their order.
    """
    if doubt := doubt_of_values(rig):
        return doubt
    tried = sum(statuses.get(one, 0) for one in (*NO_MATCH, "ok"))
    lost = tried - statuses.get("ok", 0)
    if tried >= FEWEST_TRIED and lost > UNANSWERED * tried:
        return SetupVerdict(
            True,
            f"the dots of {lost} of {tried} frames match no pool on this set-up: look at the "
            "pattern's rotation and inter-beam angle, the laser and the image calibration",
        )
    if rig.uncertainty is None:
        return SetupVerdict(False, "the set-up is taken as exact")
    if len(samples) < FEWEST:
        few = f"{len(samples)} frames with a surface are too few: {FEWEST} are needed"
        return SetupVerdict(False, few)
    ray, residual = _by_ray(samples, (rig.pattern.rows, rig.pattern.columns))
    parts = np.array_split(np.arange(len(samples)), PARTS)
    surfaces = [samples[part[len(part) // 2]].surface for part in parts]
    known, responses = dot_responses(rig, surfaces, ray)
    if min(one.freedom for one in responses) < FREEDOM:
        return SetupVerdict(False, f"{np.sum(known)} dots are too few to contradict it")
    left = np.array(
        [
            one.unabsorbed(residual[part][:, known].mean(axis=0))
            for one, part in zip(responses, parts, strict=True)
        ]
    )
    patterns = np.array([one.by_quantity for one in responses])
    centers = _lens_center_sigma(rig) * np.array([one.by_lens_center for one in responses])
    freedom, root = responses[PARTS // 2].freedom, rig.uncertainty.root
    pattern, uncertain = patterns.mean(axis=0), np.concatenate([patterns @ root, centers], axis=-1)
    bent = NONLINEAR * _rms(left)
    mean = _Left(left.mean(axis=0), pattern, uncertain.mean(axis=0), freedom, bent)
    # A set-up that is off leaves something else where the pool has become another.
    drift = _Left(left[-1] - left[0], pattern, uncertain[-1] - uncertain[0], freedom, bent)
    every = directions(rig)
    moved = drift.suspects([one for one in every if not one.key.startswith(FIXED)], is_drift=True)
    off = mean.suspects(every, is_drift=False)
    if not moved and not off:
        said = f"the residuals of {len(samples)} frames do not contradict it"
        return SetupVerdict(False, said)
    return SetupVerdict(True, _reason(moved or off, len(samples)), (*moved, *off))


def _lens_center_sigma(rig: Rig) -> float:
    """Standard uncertainty of the distortion's centre times the distortion, mm·percent."""
    known, plane = rig.uncertainty, rig.imaging_plane
    assert known is not None
    sigma = float(known.sigma[INDEX["camera_lens.distortion_percent"]])
    reach = min(plane.width_mm, plane.height_mm) / 2
    return LENS_CENTER * reach * float(np.hypot(known.axes.calibration.distortion_percent, sigma))


def _by_ray(samples: Sequence[Residuals], shape: tuple[int, int]) -> tuple[IntArray, FloatArray]:
    """Rays (i, j) that often have a dot, shape (n, 2); their residuals, shape (frames, n, 2).

    Where a frame lacks one, it is the mean of the others.
    """
    every = np.full((len(samples), *shape, 2), np.nan)
    for place, one in zip(every, samples, strict=True):
        place[tuple(one.ray.T - 1)] = one.residual_mm
    often = np.isfinite(every[..., 0]).mean(axis=0) >= OFTEN
    residual = every[:, often]
    mean = np.nanmean(residual, axis=0)
    return np.argwhere(often) + 1, np.where(np.isfinite(residual), residual, mean)


@dataclass(frozen=True)
class _Left(ReadOnlyArrays):
    """What no surface could explain of m rays' residuals, X′ and Z′ in turn.

    Parameters
    ----------
    residual_mm
        Their mean, or how it has changed, shape (2m,), mm.
    by_quantity
        Response to each of `QUANTITIES`, shape (2m, q).
    uncertain
        Root of the covariance that the uncertainties of the set-up and of the centre of the lens's
        distortion give it, shape (2m, q + 2).
    freedom
        Degrees of freedom.
    bent_mm
        Standard uncertainty of the response, as it is not quite linear, root mean square, mm.
    """

    residual_mm: FloatArray
    by_quantity: FloatArray
    uncertain: FloatArray
    freedom: int
    bent_mm: float

    def suspects(self, tested: Sequence[Direction], *, is_drift: bool) -> tuple[Suspect, ...]:
        """Which of the ways that a bench may be off contradict it, the likeliest first."""
        left, weight = self.residual_mm, np.linalg.inv(self._covariance())
        found: list[tuple[float, Suspect]] = []
        seen = 0.0
        for one in tested:
            pattern = self.by_quantity @ one.vector
            usual = QUANTITIES[INDEX[one.key]].assumed if one.key in INDEX else 1.0
            weighed = weight @ pattern
            known = float(pattern @ weighed)
            if known <= 0.0:
                continue
            # Computed with a set-up that is off by δ, residuals are as with the dots off by −δ.
            off, sigma = -float(left @ weighed) / known, known**-0.5
            drop, size = (off / sigma) ** 2, _rms(pattern)
            is_visible = usual * size >= VISIBLE_MM
            seen = max(seen, drop) if is_visible else seen
            if is_visible or abs(off) <= IMPLAUSIBLE * usual:
                suspect = Suspect(one.name, one.unit, off, sigma, abs(off) * size, is_drift)
                found.append((drop, suspect))
        if seen < LIMIT:
            return ()
        found.sort(key=lambda pair: -pair[0])
        return tuple(suspect for drop, suspect in found if drop > found[0][0] - ALIKE)

    def _covariance(self) -> FloatArray:
        """Covariance of the residuals where the set-up is as it says, shape (2m, 2m), mm²."""
        left, count = self.residual_mm, len(self.residual_mm)
        assumed = np.array([one.assumed for one in QUANTITIES])
        explained = np.column_stack([self.by_quantity * assumed, self.uncertain[:, -2:]])
        modes, size, _ = np.linalg.svd(explained, full_matrices=False)
        modes = modes[:, size > VISIBLE_MM * np.sqrt(count)]
        unexplained = left - modes @ (modes.T @ left)
        noise = float(np.sum(unexplained**2)) / (self.freedom - modes.shape[1])
        floor = count * (MODEL_MM**2 + self.bent_mm**2)
        return np.asarray(self.uncertain @ self.uncertain.T + (noise + floor) * np.eye(count))


def _reason(suspects: Sequence[Suspect], frames: int) -> str:
    """Which quantities explain the residuals, in a clause: all that residuals cannot tell apart."""
    first = suspects[0]
    alike = [one for one in suspects if one.is_drift == first.is_drift]
    when = "have come up during the recording" if first.is_drift else f"recur in {frames} frames"
    found = f"residuals of {1e3 * first.rms_mm:.0f} µm {when}"
    off = f"{first.name}, by {first.off:+.2g} ± {first.sigma:.1g} {first.unit}"
    if len(alike) == 1:
        return f"{found}; likeliest cause: {off}"
    others = "; ".join(f"{one.name}, by {one.off:+.2g} {one.unit}".rstrip() for one in alike[1:])
    one_of = f"one of these {len(alike)} is the likeliest cause, residuals cannot tell which"
    return f"{found}; {one_of}: {off}; {others}"


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
