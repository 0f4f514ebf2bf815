"""Consensus of the frames of a recording on the assignment of rows.

A frame whose rows are shifted relative to the majority is rejected. A frame in which several holes
can be the marker's gets the rows of the previous and the next frame if the costs summed over all
such frames support them: as the set-up is the same for all frames, a wrong assignment must cost
more in the long run.

A pool whose rays are shifted by a row is displaced by the spacing of the rays and tilted: its
surface differs by 50 µm from that of the previous frame, whereas waves and a boundary that wanders
by 2 % cause 5 to 20 µm. With its rays shifted back, it differs by no more than other frames do.
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
from labapp.core.values import CannotMeasure, FloatArray, IntArray, rms

ALIKE = 0.15
"""Surfaces that differ by less than this share of their rms height have the same rows."""

NEARER = 2.0
"""Rows have slipped if shifted labels reduce the difference from the previous surface by this
factor."""

DECIDES = 2.0
"""An open frame is decided if all frames together support its rows against each rival by this
number of margins, which is the support of two unambiguous frames."""

SLIPS = tuple(np.array(by) for by in product((0, 1, -1, 2, -2), repeat=2) if 0 in by and any(by))
"""Rows and columns by which rows may have slipped."""


Placed = tuple[Reconstruction, tuple[int, int]]
"""A surface, and the shift of its rays from those of the first frame, in rows and columns."""


@dataclass
class Ballot:
    """Vote of a frame on the rows of a recording.

    Parameters
    ----------
    shift
        Shift of its rays from those of the first frame, in rows and columns; None without a
        surface.
    after
        The next frame with a surface; None while there is none.
    """

    measured: Measurement
    shift: tuple[int, int] | None = None
    after: Placed | None = None

    @property
    def is_open(self) -> bool:
        """Whether other frames may decide its rows."""
        return isinstance(self.measured, OpenMeasurement)


class RowVote:
    """Count the votes of the frames of a recording on the rows."""

    def __init__(self, rig: Rig, settings: Settings) -> None:
        self._rig, self._settings = rig, settings
        self._places = project_rays(rig.laser, rig.pattern).landing_mm[..., :2].reshape(-1, 2)
        self._votes: Counter[tuple[int, int]] = Counter()
        """Number of frames by the shift of their rays from the first frame, in rows and columns."""
        self._shift = (0, 0)
        """Shift of the frames that are currently tracked."""
        self._usual: Placed | None = None
        """The last frame that agrees with the majority."""
        self._before: Placed | None = None
        """The last frame with an accepted surface."""
        self._undecided: list[Ballot] = []
        """Open frames since the last one with a surface that have not been judged yet."""
        self._decided: Counter[tuple[int, int]] = Counter()
        """Number of open frames with a candidate, by its shift."""
        self._lost: dict[tuple[int, int], dict[tuple[int, int], float]] = {}
        """Margins that these lack compared with unambiguous frames, by shift and rival's step."""

    def add(self, measured: Measurement, tracked: bool = False) -> Ballot:
        """Count the next frame.

        A tracked frame has the rows of the previous one, and no vote of its own. A frame that was
        corrected by hand has a vote, but later frames are not tracked from it.
        """
        surface, shift = measured.reconstruction, self._shift
        if surface is None:
            ballot = Ballot(measured)
            self._undecided += [ballot] if ballot.is_open else []
            return ballot
        if not tracked:
            if self._usual is not None:
                usual, (row, column) = self._usual
                slip = self._slip(measured, usual)
                shift = row + int(slip[0]), column + int(slip[1])
            if measured.correction is None:
                self._shift = shift
            self._votes[shift] += 1
        if self._votes[shift] == max(self._votes.values(), default=0):
            self._usual = surface, shift
        for each in self._undecided:
            each.after = surface, shift
        self._undecided = []
        return Ballot(measured, shift)

    def judged(self, ballot: Ballot) -> Measurement:
        """Return the measurement of an added frame, decided or rejected by the vote.

        Without a majority for its rows it is ``ambiguous-rows``, unless an operator has set them.
        Frames must be judged in order.
        """
        measured, shift = ballot.measured, ballot.shift
        if isinstance(measured, OpenMeasurement):
            self._undecided = [each for each in self._undecided if each is not ballot]
            return self._decide(measured, ballot.after)
        if shift is None:
            return measured
        agree, of = self._votes[shift], self._votes.total()
        if measured.correction is not None or self._has_majority(shift):
            assert measured.reconstruction is not None
            self._before = measured.reconstruction, shift
            return measured
        reason = f"{of - agree} of {of} frames measured by themselves have their rows elsewhere"
        rejected = replace(measured, match=None, reconstruction=None, measures=None)
        return replace(rejected, status="ambiguous-rows", reason=reason)

    @property
    def is_outvoted(self) -> bool:
        """Whether the frames that are currently tracked have no majority for their rows."""
        return bool(self._votes) and not self._has_majority(self._shift)

    def _has_majority(self, shift: tuple[int, int]) -> bool:
        return 2 * self._votes[shift] > self._votes.total()

    def _decide(self, measured: OpenMeasurement, after: Placed | None) -> Measurement:
        """Measure an open frame with the rows of the adjacent frames, or refuse it.

        It is refused if these disagree on the rows, if their surfaces are close to those of no
        candidate or of several, and if all frames together do not support the rows. With an
        adjacent frame on one side only, the candidate must be the likeliest one, as the pool may
        have moved by a row.
        """
        beside = [one for one in (self._before, after) if one is not None]
        shifts = {shift for _, shift in beside}
        if len(shifts) != 1:
            return measured.refused
        index = self._alike(measured.candidates, [surface for surface, _ in beside])
        if index is None:
            return measured.refused
        (shift,) = shifts
        chosen, margin = measured.candidates[index], self._settings.match.margin
        lost = self._lost.setdefault(shift, {})
        self._decided[shift] += 1
        for each in measured.candidates:
            if each is not chosen:
                step = each.step[0] - chosen.step[0], each.step[1] - chosen.step[1]
                less = max(1 - (each.cost - chosen.cost) / margin, 0.0)
                lost[step] = lost.get(step, 0.0) + less
        sure = self._votes[shift] + self._decided[shift] - max(lost.values(), default=0.0)
        is_likeliest = chosen.cost <= min(each.cost for each in measured.candidates)
        if not (
            self._has_majority(shift) and sure >= DECIDES and (is_likeliest or len(beside) > 1)
        ):
            return measured.refused
        assert chosen.match is not None
        made = measured.decided(chosen.match, self._rig, self._settings)
        if made.reconstruction is not None:
            self._before = made.reconstruction, shift
        return made

    def _alike(self, candidates: tuple[Candidate, ...], beside: list[Reconstruction]) -> int | None:
        """Index of the one candidate whose surface is close to all of these; None without one."""
        made = [self._heights_of(each.match) for each in candidates]
        found: set[int | None] = set()
        for one in beside:
            usual = self._heights(one)
            off = [np.inf if own is None else rms(own - usual) for own in made]
            nearest, next_one = np.argsort(off)[:2].tolist()
            is_alike = off[nearest] < min(ALIKE * rms(usual), off[next_one] / NEARER)
            found.add(nearest if is_alike else None)
        return found.pop() if len(found) == 1 else None

    def _heights_of(self, match: Match | None) -> FloatArray | None:
        """Heights of the surface fitted to a match; None if there is none."""
        if match is None:
            return None
        try:
            return self._heights(fit.reconstruct(match, self._rig, self._settings.fit))
        except CannotMeasure:
            return None

    def _slip(self, measured: Measurement, usual: Reconstruction) -> IntArray:
        """Shift of a frame's rays relative to those of another, in rows and columns."""
        assert measured.match is not None
        assert measured.reconstruction is not None
        heights = self._heights(usual)
        slip, off = np.zeros(2, np.int64), rms(self._heights(measured.reconstruction) - heights)
        if off < ALIKE * rms(heights):
            return slip
        nearest = off / NEARER
        for by in SLIPS:
            try:
                moved = fit.reconstruct(_moved(measured.match, by), self._rig, self._settings.fit)
            except CannotMeasure:
                continue
            off = rms(self._heights(moved) - heights)
            if off < nearest:
                nearest, slip = off, -by
        return slip

    def _heights(self, surface: Reconstruction) -> FloatArray:
        """Heights at the landing points of the rays, 0 outside the pool, mm."""
        return np.nan_to_num(surface.surface.height(*self._places.T))


def _moved(match: Match, by: IntArray) -> Match:
    """Shift the rays of a match by rows and columns."""
    size = np.array(match.ray_states.shape)
    ray = match.ray + by
    on = ((ray >= 1) & (ray <= size)).all(axis=-1)
    from_, to = (np.argwhere(match.ray_states != 0) + sign * by for sign in (0, 1))
    inside = ((to >= 0) & (to < size)).all(axis=-1)
    ray_states = np.zeros_like(match.ray_states)
    ray_states[tuple(to[inside].T)] = match.ray_states[tuple(from_[inside].T)]
    return replace(
        match,
        dot=match.dot[on],
        ray=ray[on],
        reflected=match.reflected[on],
        plane_mm=match.plane_mm[on],
        plane_covariance_mm2=match.plane_covariance_mm2[on],
        ray_states=ray_states,
    )
