"""Settings for the choice of the correspondence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from labapp.core.match import ORIENTATIONS, Orientation
from labapp.core.matching.hypothesis import Hypothesis


@dataclass(frozen=True)
class MatchSettings:
    """Settings for the choice of the correspondence.

    Parameters
    ----------
    correspondence
        ``auto`` tries every orientation; otherwise the one to use. `pipeline.measure` sets it from
        `Settings.correspondence`.
    margin
        Two hypotheses whose costs differ by less, in units of χ², cannot be distinguished.
    stray, missed
        How many stray dots and missed rays are accepted: a number, and a share of the dots
        (`most_strays`, `leaves_much`) that is added to it.
    """

    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    margin: float = 14.0
    stray: tuple[int, float] = (4, 0.02)
    missed: tuple[int, float] = (2, 0.06)

    @property
    def orientations(self) -> tuple[Orientation, ...]:
        """Orientations to try."""
        return ORIENTATIONS if self.correspondence == "auto" else (self.correspondence,)

    def most_strays(self, hypothesis: Hypothesis) -> float:
        """Return how many stray dots are accepted, wherever they lie."""
        return self.stray[0] + self.stray[1] * (hypothesis.label_count + hypothesis.stray_count)

    def leaves_much(self, hypothesis: Hypothesis) -> bool:
        """Whether more dots or rays are unexplained than are accepted wherever they lie."""
        most_missed = self.missed[0] + self.missed[1] * hypothesis.label_count
        return (
            hypothesis.stray_count > self.most_strays(hypothesis)
            or hypothesis.missed_count > most_missed
        )
