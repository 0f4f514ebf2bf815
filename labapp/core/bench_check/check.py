"""Check of the bench with pictures of known mirrors: adjusted set-up, uncertainty and verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from labapp.core.bench_check.adjustment import Adjustment, Sighting, System, adjust
from labapp.core.bench_check.known import MeasuredSize, measure_sizes
from labapp.core.bench_check.labelling import (
    LEAST_DOTS,
    Labelled,
    MirrorDots,
    label_picture,
    relabelled,
    sighting_of,
)
from labapp.core.bench_check.mirrors import Plate, placed
from labapp.core.bench_check.slips import slip_cost_fall
from labapp.core.bench_check.suspects import ALIKE, Suspect, find_suspects, freed_directions
from labapp.core.bench_check.verdict import ResidualPattern, ResidualVerdict, judge
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.perturbation import moved_bench, quantity_values
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Status = Literal["ok", "quantity-off", "size-off"] | ResidualVerdict

ROUNDS = 3
"""Largest number of iterations of adjusting to all pictures and relabelling."""

WIDE = 10.0
"""Factor of the standard uncertainties in the last attempt to label a picture."""

FAR_BETTER = 2.0
"""A cause explains the dots far better if it reduces the cost by this factor more."""

NEARLY = 0.6
"""Another cause is also reported if it explains more than this share of the likeliest one's."""

SLIPPED = 10.0
"""The rays are taken to be one row or column off if that reduces the cost by more than this."""

UNDETERMINED = 0.8
"""A quantity is undetermined if its ± after the check exceeds this share of that before."""


@dataclass(frozen=True)
class CheckedPicture(ReadOnlyArrays):
    """A picture and its results by the adjusted bench; n dots with a ray.

    Parameters
    ----------
    dot
        Index of each pair's dot in the picture's dots, shape (n,).
    ray
        Its ray (i, j), counted from 1, shape (n, 2).
    plane_mm
        The dot by the set-up before the check, IPCS, shape (n, 2), mm.
    residual_mm
        Observed minus computed dot, shape (n, 2), mm.
    """

    picture: MirrorDots
    dot: IntArray
    ray: IntArray
    plane_mm: FloatArray
    residual_mm: FloatArray
    sizes: tuple[MeasuredSize, ...]

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals' lengths, mm."""
        return float(np.sqrt(np.mean(np.sum(self.residual_mm**2, axis=-1))))


@dataclass(frozen=True)
class BenchCheck(ReadOnlyArrays):
    """The result of a bench check.

    Parameters
    ----------
    status
        ``ok``; ``quantity-off`` if a quantity is off by far more than its ±; ``size-off`` if a
        mirror's known size is contradicted; or the verdict, if it is not ``noise-like`` or explains
        the dots far better than these. The new set-up may be used only if the status is ``ok``.
    reason
        Explanation of the status in a sentence; empty for ``ok``.
    verdict, patterns
        Classification of the residuals, see `judge`.
    suspects
        Quantities that are off by far more than their ±, the likeliest first. Quantities that
        explain the dots equally well are listed together.
    free
        Keys of suspects whose prior was widened on request.
    before
        The set-up before the check.
    rig, calibration
        The set-up after the check, with its uncertainty, which is marked as checked if ``ok``.
    pictures
        Results of each picture, in the order given.
    sightings, adjustment
        The labelled dots of each mirror, and the adjustment to them.
    """

    status: Status
    reason: str
    verdict: ResidualVerdict
    patterns: tuple[ResidualPattern, ...]
    suspects: tuple[Suspect, ...]
    free: tuple[str, ...]
    before: Rig
    rig: Rig
    calibration: ImageCalibration
    pictures: tuple[CheckedPicture, ...]
    sightings: tuple[Sighting, ...]
    adjustment: Adjustment

    @cached_property
    def changes(self) -> tuple[QuantityChange, ...]:
        """Each of `QUANTITIES` before and after the check."""
        known, knows = self.before.uncertainty, self.rig.uncertainty
        assert known is not None
        assert knows is not None
        columns = quantity_values(self.before), known.sigma, quantity_values(self.rig), knows.sigma
        return tuple(
            QuantityChange(one.key, one.name, one.unit, *map(float, values))
            for one, *values in zip(QUANTITIES, *columns, strict=True)
        )

    @property
    def undetermined(self) -> tuple[QuantityChange, ...]:
        """Quantities that the pictures hardly determine: their ± is about the same as before."""
        return tuple(
            one
            for one in self.changes
            if one.before_sigma > 0 and one.after_sigma > UNDETERMINED * one.before_sigma
        )


@dataclass(frozen=True)
class QuantityChange:
    """A quantity before and after the check, with its standard uncertainty, in its unit."""

    key: str
    name: str
    unit: str
    before: float
    before_sigma: float
    after: float
    after_sigma: float


def check_bench(
    pictures: Sequence[MirrorDots], bench: Bench, free: Sequence[str] = ()
) -> BenchCheck:
    """Adjust the set-up to pictures of known mirrors.

    Parameters
    ----------
    pictures
        One or several pictures of mirrors, each with its own pose.
    bench
        The set-up before the check; its uncertainty is the prior.
    free
        Keys of suspects (`suspects.suspect_keys`) whose prior is widened.

    Raises
    ------
    CannotMeasure
        As `label_picture`.
    """
    rig = bench.rig
    pictures = [replace(one, mirror=placed(one.mirror, rig)) for one in pictures]
    freed = freed_directions(rig, free)
    observed = [Observation.of(p.dots, bench, p.frame_shape) for p in pictures]
    made, sightings, used = _adjusted(pictures, observed, bench, freed)
    system = System.of(rig, sightings, freed)
    suspects = find_suspects(system, made)
    seen = [(o, p.mirror, own) for o, p, own in zip(observed, pictures, used, strict=True)]
    slip = slip_cost_fall(system, seen, made)
    verdict, patterns = judge(system, made)
    sizes = measure_sizes(system, made)
    named = {
        f"{size.name} in {picture.name}": size
        for picture, own in zip(pictures, sizes, strict=True)
        for size in own
    }
    status, reason = _status(suspects, verdict, patterns, slip, named)
    after = adjusted_bench(rig, made, status == "ok")
    checked = tuple(
        CheckedPicture(
            picture=picture,
            dot=found[tuple(sighting.ray.T)],
            ray=sighting.ray + 1,
            plane_mm=sighting.plane_mm,
            residual_mm=made.residual_mm[k],
            sizes=sizes[k],
        )
        for k, (picture, sighting, found) in enumerate(zip(pictures, sightings, used, strict=True))
    )
    return BenchCheck(
        status=status,
        reason=reason,
        verdict=verdict,
        patterns=patterns,
        suspects=suspects,
        free=tuple(free),
        before=rig,
        rig=after.rig,
        calibration=after.calibration,
        pictures=checked,
        sightings=tuple(sightings),
        adjustment=made,
    )


def _adjusted(
    pictures: Sequence[MirrorDots],
    observed: Sequence[Observation],
    bench: Bench,
    freed: FloatArray,
) -> tuple[Adjustment, list[Sighting], list[IntArray]]:
    """Adjust and label again in turn until no label changes.

    Returns the adjusted set-up, the dots of each picture that were used, and their labels.
    """
    labels = _labelled(pictures, bench, freed)
    made: Adjustment | None = None
    for _ in range(ROUNDS):
        sightings = [
            sighting_of(o, p.mirror, found)
            for o, p, found in zip(observed, pictures, labels, strict=True)
        ]
        made = adjust(bench.rig, sightings, freed, None if made is None else made.unknown)
        again = [
            relabelled(o, p.mirror, made.offset, pose)
            for o, p, pose in zip(observed, pictures, made.poses, strict=True)
        ]
        again = [
            np.where(o.rays.absent, UNLABELLED, a) for o, a in zip(observed, again, strict=True)
        ]
        used = labels
        if all((new == old).all() for new, old in zip(again, used, strict=True)):
            break
        if any((new != UNLABELLED).sum() < LEAST_DOTS for new in again):
            raise CannotMeasure("no-match", "no bench explains all pictures together")
        labels = again
    assert made is not None
    return made, sightings, used


def _labelled(pictures: Sequence[MirrorDots], bench: Bench, freed: FloatArray) -> list[IntArray]:
    """Label each picture; plates first, as they determine the bench for the others."""
    order = sorted(range(len(pictures)), key=lambda k: not isinstance(pictures[k].mirror, Plate))
    labels: dict[int, IntArray] = {}
    near, wide = bench, Bench(_wide(bench.rig), bench.calibration)
    for k in order:
        found, seen_by = _first_label(pictures[k], (near, bench, wide), freed)
        labels[k] = found.labels
        near = adjusted_bench(seen_by, found.adjustment)
    return [labels[k] for k in range(len(pictures))]


def _first_label(
    picture: MirrorDots, benches: Sequence[Bench], freed: FloatArray
) -> tuple[Labelled, Rig]:
    """Return the labels from the first bench that succeeds, and its rig.

    The alternatives are needed because a mirror of another kind or size than given, or a quantity
    that is far off, misleads the subsequent adjustments.
    """
    *others, last = benches
    for bench in others:
        with suppress(CannotMeasure):
            return label_picture(picture, bench, freed), bench.rig
    return label_picture(picture, last, freed), last.rig


def _wide(rig: Rig) -> Rig:
    """Return the rig with its uncertainties multiplied by `WIDE`."""
    assert rig.uncertainty is not None
    covariance = WIDE**2 * rig.uncertainty.covariance
    return replace(rig, uncertainty=replace(rig.uncertainty, covariance=covariance))


def adjusted_bench(rig: Rig, made: Adjustment, checked: bool = False) -> Bench:
    """Return the adjusted rig and image calibration, with their uncertainty."""
    after, calibration = moved_bench(rig, made.offset)
    assert after.uncertainty is not None
    assumed = frozenset() if checked else after.uncertainty.assumed
    known = replace(after.uncertainty, covariance=made.covariance, assumed=assumed, checked=checked)
    return Bench(replace(after, uncertainty=known), calibration)


REASONS: dict[ResidualVerdict, str] = {
    "noise-like": "",
    "distortion": "the picture is distorted in another way: calibrate the camera's lens",
    "plate-not-flat": "the plate is not flat: take a better one",
    "wrong-lens": "the rays are not those of the pattern: is the lens that of the set-up?",
    "row-slipped": "the dots fit the rays of the next row or column better: check which ray is "
    "absent, and that the hole in the dots is its own",
    "unexplained": "no bench and no mirror of this kind explain the dots: check that the mirror is "
    "the one entered, and that nothing moved between the pictures",
}


def _status(
    suspects: Sequence[Suspect],
    verdict: ResidualVerdict,
    patterns: Sequence[ResidualPattern],
    slip: float,
    sizes: Mapping[str, MeasuredSize],
) -> tuple[Status, str]:
    """Determine what is off: a quantity or a size, unless an unmodelled cause explains far more.

    The reason also states other causes that explain nearly as much.
    """
    lacks = verdict if verdict != "noise-like" else patterns[0].cause
    explained = max((one.cost_fall for one in patterns if one.cause == lacks), default=0.0)
    suspected = suspects[0].cost_fall if suspects else 0.0
    contradiction, sizes_off = _sizes_off(sizes)
    if slip > max(SLIPPED, suspected - ALIKE, contradiction - ALIKE):
        return "row-slipped", REASONS["row-slipped"]
    causes: dict[Status, tuple[float, str]] = {
        "size-off": (contradiction, sizes_off),
        "quantity-off": (suspected, _suspected(suspects)),
        lacks: (explained, REASONS[lacks]),
    }
    # An unmodelled cause also biases the sizes.
    if verdict != "noise-like" and explained >= max(FAR_BETTER * suspected, contradiction):
        status: Status = verdict
    elif contradiction > suspected:
        status = "size-off"
    elif suspects:
        status = "quantity-off"
    else:
        return "ok", ""
    best, reason = causes.pop(status)
    likely = [text for fall, text in causes.values() if fall > max(NEARLY * best, 0.0)]
    return status, "; or ".join([reason, *likely])


def _sizes_off(sizes: Mapping[str, MeasuredSize]) -> tuple[float, str]:
    """Largest contradiction of the mirrors' sizes by the dots, as a χ², and the sizes in words."""
    off = {name: one for name, one in sizes.items() if one.is_contradicted}
    square = max((one.deviation**2 for one in off.values()), default=0.0)
    named = (
        f"{name}: known to be {one.known_mm:.3f} ± {one.known_sigma_mm:.3f} mm, and measured "
        f"without that {one.independent_mm:.3f} ± {one.independent_sigma_mm:.3f} mm"
        for name, one in sorted(off.items(), key=lambda pair: -abs(pair[1].deviation))
        if one.deviation**2 > NEARLY * square
    )
    return square, "; or ".join(named) + " (check that the mirror is the one entered)"


def _suspected(suspects: Sequence[Suspect]) -> str:
    """Describe the suspects in words."""
    names = " or ".join(one.name for one in suspects)
    sure = np.sqrt(suspects[0].cost_fall) if suspects else 0.0
    return f"{names}: off by far more than the ± in the set-up ({sure:.0f} standard deviations)"
