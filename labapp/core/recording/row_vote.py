"""Frames of a recording vote on the rows: one that is a row off the others is not answered.

A pool whose rays are a row off lies a ray's spacing aside and is tilted: its surface is 50 µm from
that of the frame before, where waves and a boundary that wanders by 2 % make 5 to 20. With its rays
moved back by that row it is as near again as frames are to each other.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np

from labapp.core.geometry.optics import project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.pipeline import Measurement
from labapp.core.schemes import fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import CannotMeasure, FloatArray, IntArray

ALIKE = 0.15
"""Surfaces that differ by less have the same rows, a share of their root mean square height."""

NEARER = 2.0
"""Rows have slipped if shifted labels bring the surface so many times nearer to the one before."""

SLIPS = tuple(np.array(by) for by in product((0, 1, -1, 2, -2), repeat=2) if 0 in by and any(by))
"""Rows and columns by which they may have."""


class RowVote:
    """Counts how many frames of a recording agree on the rows.

    Parameters
    ----------
    rig
        The bench.
    settings
        Of the fit with which other rows are tried.
    """

    def __init__(self, rig: Rig, settings: FitSettings) -> None:
        self._rig, self._settings = rig, settings
        self._places = project_rays(rig.laser, rig.pattern).landing_mm[..., :2].reshape(-1, 2)
        self._votes: Counter[tuple[int, int]] = Counter()
        """How many frames are so many rows and columns off the first."""
        self._at = (0, 0)
        """How far the frames are off the first that follow now."""
        self._usual: tuple[Reconstruction, tuple[int, int]] | None = None
        """The last frame that agrees with most, and how far it is off the first."""

    def add(self, measured: Measurement, followed: bool = False) -> tuple[int, int]:
        """Count the next frame that has a surface; returns how far it is off the first's rows.

        One that was followed from those before has their rows, and no vote of its own. One that was
        corrected by hand has a vote, but those after it were not followed from it.
        """
        surface, at = measured.reconstruction, self._at
        assert surface is not None
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
        return at

    def judged(self, measured: Measurement, at: tuple[int, int]) -> Measurement:
        """Return the measurement of a frame that `add` found so far off the first, if it stands.

        Without a majority for its rows it is ``ambiguous-rows``; not if an operator gave them.
        """
        agree, of = self._votes[at], self._votes.total()
        if measured.correction is not None or 2 * agree > of:
            return measured
        reason = f"{of - agree} of {of} frames measured by themselves have their rows elsewhere"
        kept = replace(measured, match=None, reconstruction=None, measures=None)
        return replace(kept, status="ambiguous-rows", reason=reason)

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
                moved = fit.reconstruct(_moved(measured.match, by), self._rig, self._settings)
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
