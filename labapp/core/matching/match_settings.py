"""Settings of the matching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from labapp.core.match import ORIENTATIONS, Orientation
from labapp.core.matching.hypothesis import Hypothesis


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the matching.

    Parameters
    ----------
    correspondence
        The orientation to use; ``auto`` tries every one. `pipeline.measure` sets it from
        `Settings.correspondence`.
    margin
        Two hypotheses whose costs differ by less, in units of χ², cannot be distinguished.
    stray, missed
        How many stray dots and missed rays are accepted: a number, and a share of the dots
        (`most_strays`, `most_missed`) that is added to it.
    """

    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    margin: float = 14.0
    stray: tuple[int, float] = (4, 0.02)
    missed: tuple[int, float] = (2, 0.06)

    @property
    def orientations(self) -> tuple[Orientation, ...]:
        """Orientations to try."""
        return ORIENTATIONS if self.correspondence == "auto" else (self.correspondence,)

    def most_strays(self, dots: int) -> float:
        """Return how many of a number of dots are accepted as stray, wherever they lie."""
        return self.stray[0] + self.stray[1] * dots

    def most_missed(self, labels: int) -> float:
        """Return how many missed rays are accepted for a number of labels, wherever they lie."""
        return self.missed[0] + self.missed[1] * labels

    def leaves_much(self, hypothesis: Hypothesis) -> bool:
        """Whether more dots or rays are unexplained than are accepted wherever they lie."""
        labels, strays = hypothesis.label_count, hypothesis.stray_count
        return strays > self.most_strays(
            labels + strays
        ) or hypothesis.missed_count > self.most_missed(labels)
