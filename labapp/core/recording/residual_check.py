"""Check of a set-up by the residuals of a recording.

Most of the error of a set-up is absorbed by the surface and does not appear in the residuals. The
part that no surface can absorb (`dot_response`) is the same in every frame, or changes over the
recording if a part moves, while noise averages out. The mean residual of each ray, and its change
over the recording, are compared with the response to each quantity (score test): a quantity is
wrong if the cost falls by more than `LIMIT` when it is freed. The cost of the mean includes the
covariance of the set-up, so that errors within its ± are not a contradiction; the cost of the
change does not, as nothing should move during a recording. The part that fits no quantity (speckle,
a surface finer than that of the fit) is the noise with which both are compared.

With a grossly wrong set-up few residuals exist, as hardly any frame can be measured.
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
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays, rms

MOST = 64
"""Maximum number of frames whose residuals are kept, evenly spaced over the recording."""

PARTS = 3
"""A recording is divided into this number of parts; changes are those from the first to the
last."""

FEWEST, FREEDOM = 6, 20
"""Minimum numbers of frames, and of degrees of freedom that no surface absorbs, for a verdict."""

OFTEN = 0.5
"""A ray is used if it has a dot in at least this share of the frames."""

LIMIT = 11.0
"""A quantity is wrong if the cost falls by more when it is freed: 3.3 standard deviations."""

ALIKE = 6.0
"""Quantities whose reductions of the cost differ by less explain the residuals equally well."""

MODEL_MM = 1e-3
"""Standard uncertainty of the response due to overlapping dots and to shapes that the splines
cannot represent, rms over the dots on the plane."""

NONLINEAR = 0.05
"""Standard uncertainty of the response due to nonlinearity, as a share of the unabsorbed
residual."""

LENS_CENTER = 0.25
"""Standard uncertainty of the centre of the distortion along either axis, relative to half of the
shorter side of the plane. The centre is assumed to be that of the plane."""

VISIBLE_MM = 1e-3
"""A quantity with a smaller effect for its assumed uncertainty raises no doubt. It is named if
others raise a doubt and it explains the residuals as well, since gross errors of it are visible."""

IMPLAUSIBLE = 30.0
"""Such a quantity is not named if its error would exceed this multiple of its assumed
uncertainty."""

UNANSWERED, FEWEST_TRIED = 0.8, 10
"""A set-up is doubtful if a larger share of at least this number of frames matches no pool."""

AGAIN, AT_LEAST = 1.25, 1000
"""During a recording the set-up is judged again when the number of frames has grown by this factor,
or by this number."""

NO_MATCH = frozenset({"no-match", "no-surface"})
"""Statuses of frames that contradict a set-up. ``no-reference`` and ``ambiguous-rows`` do not: they
also occur with a correct set-up, if the pool lies beside the absent ray or a dot next to it is
missing."""

DOUBTFUL = "doubtful"
"""`Measurement.setup_status` of a set-up that its recording contradicts."""

FIXED = (
    "image_calibration.",
    "imaging_plane.glass_",
    "pattern.inter_beam_angle_deg",
    "camera_lens.",
)
"""Prefixes of the keys of quantities that cannot change during a recording."""


@dataclass(frozen=True)
class ResidualSuspect:
    """A quantity whose response is found in the residuals.

    Parameters
    ----------
    name, unit
        Name of the quantity (`perturbation.directions`), and its unit.
    off, sigma
        Its error as estimated from the residuals if only this quantity is wrong, and the standard
        uncertainty of the estimate, including the ± of the other quantities; for a drift, the
        change from the first to the last part.
    rms_mm
        Rms of the residuals that it explains, mm.
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
    """Verdict of a recording on its set-up.

    Parameters
    ----------
    reason
        Why, or why no verdict is possible, in a clause.
    suspects
        Quantities that would explain it, the likeliest first.
    """

    is_doubtful: bool
    reason: str
    suspects: tuple[ResidualSuspect, ...] = ()


@dataclass(frozen=True)
class Residuals(ReadOnlyArrays):
    """Residuals of the n dots of a frame, and the fitted surface.

    Parameters
    ----------
    ray
        Ray (i, j) of each, counted from 1, shape (n, 2).
    residual_mm
        Computed minus captured dot, shape (n, 2), mm.
    surface
        The surface of the scheme fit.
    """

    ray: IntArray
    residual_mm: FloatArray
    surface: SplineSurface

    @classmethod
    def of(cls, measurement: Measurement) -> Self | None:
        """Residuals of a frame; None if it was not measured by the scheme fit."""
        match, made = measurement.match, measurement.reconstruction
        if match is None or made is None or not isinstance(made.unbounded, SplineSurface):
            return None
        return cls(match.ray, made.residual_mm, made.unbounded)


@dataclass
class ResidualRecord:
    """Residuals of a sample of a recording's frames, for the verdict on its set-up."""

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
        """Add the next frame; frames must be added in order.

        Parameters
        ----------
        measurement
            The measurement of the frame.
        residuals
            Its residuals, if the measurement no longer contains them.
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

    def add_and_judge(
        self, measurement: Measurement, residuals: Residuals | None = None
    ) -> Measurement:
        """Add the next frame, and return its measurement with the current status of the set-up.

        The newest frames are weighted as much as all earlier ones, so that a movement is detected
        early.
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
        """Reason for which the set-up is currently doubtful; empty if it is not."""
        last = self._judged[1]
        return last.reason if last.is_doubtful else ""

    def verdict(self) -> SetupVerdict:
        """Judge whether the frames contradict the set-up, and which quantity would explain it."""
        return judge_setup(self.rig, self._statuses, self._samples)


def doubt_of_values(rig: Rig) -> SetupVerdict | None:
    """Verdict on a set-up with implausible values (`implausible_values`); None if it has none."""
    unusual = implausible_values(rig)
    return SetupVerdict(True, "; ".join(unusual)) if unusual else None


def judged_status(rig: Rig, verdict: SetupVerdict | None) -> str:
    """Status of a set-up (`pipeline.setup_status`), including the verdict of its recording."""
    is_doubtful = verdict is not None and verdict.is_doubtful
    return setup_status(rig) and (DOUBTFUL if is_doubtful else setup_status(rig))


def judge_setup(
    rig: Rig, statuses: Mapping[str, int], samples: Sequence[Residuals]
) -> SetupVerdict:
    """Judge whether a recording contradicts its set-up, and which quantity would explain it.

    A set-up with implausible values is doubtful whatever the recording shows.

    Parameters
    ----------
    samples
        Residuals of frames, evenly spaced over the recording, in order.
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
        few = f"too few frames have a surface: {len(samples)}, and at least {FEWEST} are needed"
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
    bent = NONLINEAR * rms(left)
    mean = _Unabsorbed(left.mean(axis=0), pattern, uncertain.mean(axis=0), freedom, bent)
    # With a wrong set-up, the unabsorbed residuals also change if the pool changes.
    drift = _Unabsorbed(left[-1] - left[0], pattern, uncertain[-1] - uncertain[0], freedom, bent)
    every = directions(rig)
    moved = drift.suspects([one for one in every if not one.key.startswith(FIXED)], is_drift=True)
    off = mean.suspects(every, is_drift=False)
    if not moved and not off:
        said = f"the residuals of {len(samples)} frames do not contradict it"
        return SetupVerdict(False, said)
    return SetupVerdict(True, _reason(moved or off, len(samples)), (*moved, *off))


def _lens_center_sigma(rig: Rig) -> float:
    """Standard uncertainty of the centre of the distortion times the distortion, mm·percent."""
    uncertainty, plane = rig.uncertainty, rig.imaging_plane
    assert uncertainty is not None
    sigma = float(uncertainty.sigma[INDEX["camera_lens.distortion_percent"]])
    reach = min(plane.width_mm, plane.height_mm) / 2
    return (
        LENS_CENTER
        * reach
        * float(np.hypot(uncertainty.axes.calibration.distortion_percent, sigma))
    )


def _by_ray(samples: Sequence[Residuals], shape: tuple[int, int]) -> tuple[IntArray, FloatArray]:
    """Rays (i, j) that often have a dot, shape (n, 2), and their residuals, shape (frames, n, 2).

    Missing residuals are replaced by the mean of those of the other frames.
    """
    every = np.full((len(samples), *shape, 2), np.nan)
    for place, one in zip(every, samples, strict=True):
        place[tuple(one.ray.T - 1)] = one.residual_mm
    often = np.isfinite(every[..., 0]).mean(axis=0) >= OFTEN
    residual = every[:, often]
    mean = np.nanmean(residual, axis=0)
    return np.argwhere(often) + 1, np.where(np.isfinite(residual), residual, mean)


@dataclass(frozen=True)
class _Unabsorbed(ReadOnlyArrays):
    """Unabsorbed residuals of m rays, X′ and Z′ interleaved.

    Parameters
    ----------
    residual_mm
        Their mean, or its change, shape (2m,), mm.
    by_quantity
        Response to each of `QUANTITIES`, shape (2m, q).
    uncertain
        Root of their covariance due to the uncertainties of the set-up and of the centre of the
        distortion, shape (2m, q + 2).
    freedom
        Degrees of freedom.
    bent_mm
        Standard uncertainty of the response due to its nonlinearity, rms, mm.
    """

    residual_mm: FloatArray
    by_quantity: FloatArray
    uncertain: FloatArray
    freedom: int
    bent_mm: float

    def suspects(
        self, tested: Sequence[Direction], *, is_drift: bool
    ) -> tuple[ResidualSuspect, ...]:
        """Find the perturbations of the bench that explain the residuals, likeliest first."""
        left, weight = self.residual_mm, np.linalg.inv(self._covariance())
        found: list[tuple[float, ResidualSuspect]] = []
        seen = 0.0
        for one in tested:
            pattern = self.by_quantity @ one.vector
            usual = QUANTITIES[INDEX[one.key]].assumed if one.key in INDEX else 1.0
            weighted = weight @ pattern
            information = float(pattern @ weighted)
            if information <= 0.0:
                continue
            # Residuals of a set-up with an error δ have the sign of a response to −δ.
            off, sigma = -float(left @ weighted) / information, information**-0.5
            drop, size = (off / sigma) ** 2, rms(pattern)
            is_visible = usual * size >= VISIBLE_MM
            seen = max(seen, drop) if is_visible else seen
            if is_visible or abs(off) <= IMPLAUSIBLE * usual:
                suspect = ResidualSuspect(one.name, one.unit, off, sigma, abs(off) * size, is_drift)
                found.append((drop, suspect))
        if seen < LIMIT:
            return ()
        found.sort(key=lambda pair: -pair[0])
        return tuple(suspect for drop, suspect in found if drop > found[0][0] - ALIKE)

    def _covariance(self) -> FloatArray:
        """Covariance of the residuals if the set-up is correct within its ±, (2m, 2m), mm²."""
        left, count = self.residual_mm, len(self.residual_mm)
        assumed = np.array([one.assumed for one in QUANTITIES])
        explained = np.column_stack([self.by_quantity * assumed, self.uncertain[:, -2:]])
        modes, size, _ = np.linalg.svd(explained, full_matrices=False)
        modes = modes[:, size > VISIBLE_MM * np.sqrt(count)]
        unexplained = left - modes @ (modes.T @ left)
        noise = float(np.sum(unexplained**2)) / (self.freedom - modes.shape[1])
        floor = count * (MODEL_MM**2 + self.bent_mm**2)
        return np.asarray(self.uncertain @ self.uncertain.T + (noise + floor) * np.eye(count))


def _reason(suspects: Sequence[ResidualSuspect], frames: int) -> str:
    """Name in a clause the quantities that explain the residuals equally well."""
    first = suspects[0]
    alike = [one for one in suspects if one.is_drift == first.is_drift]
    when = "appeared during the recording" if first.is_drift else f"recur in {frames} frames"
    found = f"residuals of {1e3 * first.rms_mm:.0f} µm {when}"
    off = f"{first.name}, by {first.off:+.2g} ± {first.sigma:.1g} {first.unit}"
    if len(alike) == 1:
        return f"{found}; likeliest cause: {off}"
    others = "; ".join(f"{one.name}, by {one.off:+.2g} {one.unit}".rstrip() for one in alike[1:])
    one_of = f"the likeliest cause is one of these {len(alike)}, which residuals cannot distinguish"
    return f"{found}; {one_of}: {off}; {others}"
