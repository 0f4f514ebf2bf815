"""Frames of a recording decide on the rows together.

One that is a row off the others is not answered. One that leaves open which hole is the marker's
gets the rows of the frames before and after it, where the costs of all frames add up to speak for
them: that of a rival must be higher over time, as the set-up is the same for all.

A pool whose rays are a row off lies a ray's spacing aside and is tilted: its surface is 50 µm from
that of the frame before, where waves and a boundary that wanders by 2 % make 5 to 20. With its rays
moved back by that row it is as near again as frames are to each other.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from labapp.core.geometry.optics import project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.match import Candidate, Match
from labapp.core.pipeline import Measurement, OpenMeasurement, Settings
from labapp.core.schemes import fit
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import CannotMeasure, FloatArray, IntArray

ALIKE = 0.15
"""Surfaces that differ by less have the same rows, a share of their root mean square height."""

NEARER = 2.0
"""Rows have slipped if shifted labels bring the surface so many times nearer to the one before."""

DECIDES = 2.0
"""An open frame is decided where all frames together speak for its rows, against each rival, by so
many margins: as two that are sure do."""

SLIPS = tuple(np.array(by) for by in product((0, 1, -1, 2, -2), repeat=2) if 0 in by and any(by))
"""Rows and columns by which they may have."""


Placed = tuple[Reconstruction, tuple[int, int]]
"""A surface, and by how many rows and columns its rays are off those of the first frame."""


@dataclass
class Ballot:
    """What a frame says about the rows of a recording.

    Parameters
    ----------
    measured
        The frame.
    at
        Rows and columns by which its rays are off the first frame's; None without a surface.
    after
        The next frame with a surface; None while there is none.
    """

    measured: Measurement
    at: tuple[int, int] | None = None
    after: Placed | None = None

    @property
    def is_open(self) -> bool:
        """Whether other frames may decide its rows."""
        return isinstance(self.measured, OpenMeasurement)


class RowVote:
    """Counts how many frames of a recording agree on the rows.

    Parameters
    ----------
    rig
        The bench.
    settings
        Of the measurement.
    """

    def __init__(self, rig: Rig, settings: Settings) -> None:
        self._rig, self._settings = rig, settings
        self._places = project_rays(rig.laser, rig.pattern).landing_mm[..., :2].reshape(-1, 2)
        self._votes: Counter[tuple[int, int]] = Counter()
        """How many frames are so many rows and columns off the first."""
        self._at = (0, 0)
        """How far the frames are off the first that follow now."""
        self._usual: Placed | None = None
        """The last frame that agrees with most."""
        self._before: Placed | None = None
        """The last frame that was answered."""
        self._undecided: list[Ballot] = []
        """Open frames since the last one with a surface that are not judged yet."""
        self._decided: Counter[tuple[int, int]] = Counter()
        """How many open frames have candidates with rows so far off the first."""
        self._lost: dict[tuple[int, int], dict[tuple[int, int], float]] = {}
        """How many margins these lack for a sure frame, by rows and by what step a rival is on."""

    def add(self, measured: Measurement, followed: bool = False) -> Ballot:
        """Count the next frame.

        One that was followed from those before has their rows, and no vote of its own. One that was
        corrected by hand has a vote, but those after it were not followed from it.
        """
        surface, at = measured.reconstruction, self._at
        if surface is None:
            ballot = Ballot(measured)
            self._undecided += [ballot] if ballot.is_open else []
            return ballot
        if not followed:
            if self._usual is not None:
                usual, (row, column) = self._usual
                slip = self._slip(measured, usual)
                at = row + int(slip[0]), column + int(slip[1])
            if measured.correction is None:
                self._at = at
            self._votes[at] += 1
        if self._votes[at] == max(self._votes.values(), default=0):
            self._usual = surface, at
        for each in self._undecided:
            each.after = surface, at
        self._undecided = []
        return Ballot(measured, at)

    def judged(self, ballot: Ballot) -> Measurement:
        """Return the measurement of a frame that was added, if it stands or can be decided.

        Without a majority for its rows it is ``ambiguous-rows``; not if an operator gave them.
        Frames are judged in their order.
        """
        measured, at = ballot.measured, ballot.at
        if isinstance(measured, OpenMeasurement):
            self._undecided = [each for each in self._undecided if each is not ballot]
            return self._decide(measured, ballot.after)
        if at is None:
            return measured
        agree, of = self._votes[at], self._votes.total()
        if measured.correction is not None or self._has_majority(at):
            assert measured.reconstruction is not None
            self._before = measured.reconstruction, at
            return measured
        reason = f"{of - agree} of {of} frames measured by themselves have their rows elsewhere"
        kept = replace(measured, match=None, reconstruction=None, measures=None)
        return replace(kept, status="ambiguous-rows", reason=reason)

    def _has_majority(self, at: tuple[int, int]) -> bool:
        return 2 * self._votes[at] > self._votes.total()

    def _decide(self, measured: OpenMeasurement, after: Placed | None) -> Measurement:
        """The measurement of an open frame with the rows of the frames beside it, or refused.

        It is refused where they disagree on the rows, or are near no candidate's surface or several
        ones'; and where all frames together do not speak for it. Where there are frames on one side
        alone the candidate must be the likeliest: the pool may have gone on by a row.
        """
        beside = [one for one in (self._before, after) if one is not None]
        places = {at for _, at in beside}
        if len(places) != 1:
            return measured.refused
        index = self._alike(measured.candidates, [surface for surface, _ in beside])
        if index is None:
            return measured.refused
        (at,) = places
        chosen, margin = measured.candidates[index], self._settings.match.margin
        lost = self._lost.setdefault(at, {})
        self._decided[at] += 1
        for each in measured.candidates:
            if each is not chosen:
                step = each.step[0] - chosen.step[0], each.step[1] - chosen.step[1]
                less = max(1 - (each.cost - chosen.cost) / margin, 0.0)
                lost[step] = lost.get(step, 0.0) + less
        sure = self._votes[at] + self._decided[at] - max(lost.values(), default=0.0)
        is_likeliest = chosen.cost <= min(each.cost for each in measured.candidates)
        if not (self._has_majority(at) and sure >= DECIDES and (is_likeliest or len(beside) > 1)):
            return measured.refused
        assert chosen.match is not None
        made = measured.decided(chosen.match, self._rig, self._settings)
        if made.reconstruction is not None:
            self._before = made.reconstruction, at
        return made

    def _alike(self, candidates: tuple[Candidate, ...], beside: list[Reconstruction]) -> int | None:
        """Index of the candidate whose surface alone is near all of these; None without one."""
        made = [self._heights_of(each.match) for each in candidates]
        found: set[int | None] = set()
        for one in beside:
            usual = self._heights(one)
            off = [np.inf if own is None else _rms(own - usual) for own in made]
            nearest, next_one = np.argsort(off)[:2].tolist()
            is_alike = off[nearest] < min(ALIKE * _rms(usual), off[next_one] / NEARER)
            found.add(nearest if is_alike else None)
        return found.pop() if len(found) == 1 else None

    def _heights_of(self, match: Match | None) -> FloatArray | None:
        """Heights with a match's rays; None where no surface has them."""
        if match is None:
            return None
        try:
            return self._heights(fit.reconstruct(match, self._rig, self._settings.fit))
        except CannotMeasure:
            return None

    def _slip(self, measured: Measurement, usual: Reconstruction) -> IntArray:
        """Rows and columns by which a frame's rays are off those of another."""
        assert measured.match is not None
        assert measured.reconstruction is not None
        heights = self._heights(usual)
        slip, off = np.zeros(2, np.int64), _rms(self._heights(measured.reconstruction) - heights)
        if off < ALIKE * _rms(heights):
            return slip
        nearest = off / NEARER
        for by in SLIPS:
            try:
                moved = fit.reconstruct(_moved(measured.match, by), self._rig, self._settings.fit)
            except CannotMeasure:
                continue
            off = _rms(self._heights(moved) - heights)
            if off < nearest:
                nearest, slip = off, -by
        return slip

    def _heights(self, surface: Reconstruction) -> FloatArray:
        """Height where each ray would land, 0 outside the pool, mm."""
        return np.nan_to_num(surface.surface.height(*self._places.T))


def _moved(match: Match, by: IntArray) -> Match:
    """Match the dots with the rays so many rows and columns on."""
    size = np.array(match.witness.shape)
    ray = match.ray + by
    on = ((ray >= 1) & (ray <= size)).all(axis=-1)
    from_, to = (np.argwhere(match.witness != 0) + sign * by for sign in (0, 1))
    inside = ((to >= 0) & (to < size)).all(axis=-1)
    witness = np.zeros_like(match.witness)
    witness[tuple(to[inside].T)] = match.witness[tuple(from_[inside].T)]
    return replace(
        match,
        dot=match.dot[on],
        ray=ray[on],
        reflected=match.reflected[on],
        plane_mm=match.plane_mm[on],
        plane_covariance_mm2=match.plane_covariance_mm2[on],
        witness=witness,
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
