"""Judge whether a frame is suitable for measurement (§9.2).

Used before and during capture: exposure, blur, rows, reference and expected ± of the height.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.images.dots import Dots, Image
from labapp.core.images.exposure import Exposure, judge_exposure
from labapp.core.pipeline import Measurement
from labapp.core.rows.lattice import Lattice
from labapp.core.surface.measures import Measures

Grade = Literal["good", "doubtful", "bad"]
"""Good; measurable, but with reduced quality; not measurable."""

GRADES: tuple[Grade, ...] = ("good", "doubtful", "bad")

BLURRED = 0.6
"""If the valley between a tenth of the dots and their neighbours is flatter, dots are about to
merge: in the sample runs, a further blur of 2 px loses dots."""

FEW = 0.1
"""Smallest acceptable share of rays with dots; the sample runs have 0.18 to 0.27."""

HOLE = 0.5
"""No dot is closer to the reference than this fraction of the dot spacing."""

UNMEASURED = "not-measured"
"""Status of a frame without a set-up."""

FATAL = frozenset({"blank", "no dots", "dots merge"})
"""Exposure verdicts with which a frame cannot be measured."""


@dataclass(frozen=True)
class Remark:
    """Assessment of one property of a frame: description and remedy, one or two sentences."""

    about: Literal["exposure", "blur", "rows", "reference", "measurement", "height ±"]
    grade: Grade
    words: str


@dataclass(frozen=True)
class Quality:
    """Quality of a frame for measurement, with remarks on it, the worst first."""

    exposure: Exposure
    remarks: tuple[Remark, ...]

    @property
    def grade(self) -> Grade:
        """Grade of the worst remark."""
        return self.remarks[0].grade

    @property
    def words(self) -> str:
        """Description of all problems, or of the first remark if there are none."""
        wrong = [remark.words for remark in self.remarks if remark.grade != "good"]
        return " ".join(wrong) or self.remarks[0].words


def judge_quality(
    image: Image,
    measurement: Measurement,
    bit_depth: int | None,
    rays: int | None = None,
) -> Quality:
    """Judge a frame by its grey levels and its measurement.

    Parameters
    ----------
    image
        Grey levels, shape (rows, columns).
    measurement
        Its measurement by the live chain.
    bit_depth
        Significant bits of a grey level; None if unknown.
    rays
        Number of rays of the lens; None if unknown.
    """
    dots = measurement.dots
    # Without a match, a hole in the rows or at their ends is only a candidate.
    lattice = measurement.lattice if measurement.match is not None else None
    exposure = judge_exposure(image, dots, bit_depth)
    blocked = 0 if lattice is None else len(lattice.blocked_rows)
    remarks = [_of_exposure(exposure)]
    if dots is not None and len(dots):
        remarks.append(_of_blur(exposure))
        remarks.append(_of_rows(dots, blocked, rays))
        if lattice is not None:
            remarks.append(_of_reference(_hole_seen(dots, lattice)))
        remarks += _of_measurement(measurement)
    remarks.sort(key=lambda remark: -GRADES.index(remark.grade))  # stable: order of assessment
    return Quality(exposure, tuple(remarks))


def _of_exposure(exposure: Exposure) -> Remark:
    grade: Grade = "good" if exposure.verdict == "good" else "doubtful"
    if exposure.verdict in FATAL or exposure.snr == 0:
        grade = "bad"
    return Remark("exposure", grade, exposure.advice)


def _of_blur(exposure: Exposure) -> Remark:
    if exposure.valley < BLURRED and exposure.verdict != "dots merge":
        full = f"{1 - exposure.valley:.0%}"
        words = (
            f"Dots are blurred: the gaps between them have {full} of their light. Focus the lens."
        )
        return Remark("blur", "doubtful", words)
    return Remark("blur", "good", "The dots are sharp.")


def _of_rows(dots: Dots, blocked: int, rays: int | None) -> Remark:
    seen = f"{len(dots)} dots" if rays is None else f"{len(dots)} of {rays} dots"
    if rays is not None and len(dots) < FEW * rays:
        words = f"Only {seen} are seen: is the pool in the dot matrix, the plane in the picture?"
        return Remark("rows", "doubtful", words)
    if blocked:
        rows = "a row" if blocked == 1 else f"{blocked} rows"
        words = f"The torch hides dots in {rows}: raise it; Set-up shows which rays it blocks."
        return Remark("rows", "doubtful", words)
    return Remark("rows", "good", f"{seen} are seen.")


def _of_reference(reference: bool) -> Remark:
    if reference:
        return Remark("reference", "good", "The reference is seen.")
    words = "The reference, the hole of the absent ray, is not visible: rows may be misidentified."
    return Remark("reference", "doubtful", words)


def _hole_seen(dots: Dots, lattice: Lattice) -> bool:
    """Whether the reference has dots on two opposite sides and none at its position."""
    if lattice.reference is None:
        return False
    k, t = lattice.reference
    place = dots.image_px
    for down, along in ((0, 1), (1, 0)):
        pair = [
            place[(lattice.row == k + side * down) & (lattice.column == t + side * along)]
            for side in (-1, 1)
        ]
        if all(len(end) == 1 for end in pair):
            one, other = pair[0][0], pair[1][0]
            apart = float(np.linalg.norm(other - one)) / 2
            nearest = np.linalg.norm(place - (one + other) / 2, axis=1).min()
            return bool(nearest > HOLE * apart)
    return False


def _of_measurement(measurement: Measurement) -> list[Remark]:
    if measurement.status == UNMEASURED:
        return []
    if measurement.status != "ok":
        reason = measurement.reason[:1].upper() + measurement.reason[1:]
        return [Remark("measurement", "bad", f"{reason} ({measurement.status}).")]
    found = [Remark("measurement", "good", "The frame can be measured.")]
    sigma_mm = float("nan") if measurement.measures is None else _peak_sigma(measurement.measures)
    if not np.isfinite(sigma_mm):
        return found
    words = f"The height will be known to ± {sigma_mm:.3f} mm."
    return [*found, Remark("height ±", "good", words)]


def _peak_sigma(sizes: Measures) -> float:
    """Uncertainty of the height or the depth, whichever is larger."""
    hollow = -sizes.depth_mm > sizes.height_mm
    return sizes.depth_sigma_mm if hollow else sizes.height_sigma_mm
