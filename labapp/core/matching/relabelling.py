"""Other labels for the same dots: shifted, mirrored, exchanged, or from the lattice."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from labapp.core.match import Orientation, signs_of
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.rows.lattice import Lattice, Site
from labapp.core.values import IntArray, median

SHIFTS = tuple((i, j) for i, j in product(range(-2, 3), repeat=2) if 0 < abs(i) + abs(j) < 3)
"""Rows and columns by which labels are shifted."""

AGREED = 0.8
"""Minimum share of the labelled dots in the lattice that must have the same offset of rays
from sites."""

CLOSE_TOGETHER = 0.45
"""Dots of adjacent rays are close together if they are nearer than this share of the median
distance of such dots in the frame. Elsewhere an exchange bends the surface too much."""


BASES = np.array(
    [
        [[1, 0], [0, 1]],
        [[0, 1], [1, 0]],
        [[0, 1], [-1, 0]],
        [[1, 0], [1, 1]],
        [[1, 0], [-1, 1]],
        [[1, 1], [0, 1]],
        [[1, -1], [0, 1]],
    ]
)
"""Row and column of the rays to which a step along the rows of a lattice, and along its columns,
may lead: a twisted surface turns the rows, or the diagonals of the pattern become the shortest
steps between dots."""


def labels_from_lattice(
    lattice: Lattice,
    hole: Site,
    ray: Site,
    orientation: Orientation,
    shape: tuple[int, int],
    basis: IntArray = BASES[0],
) -> IntArray:
    """Label a complete lattice, given the site (k, t) of the hole and its absent ray (i, j).

    Labels have the pattern's shape (rows, columns); dots at sites beyond it get no ray. ``basis``
    is one of `BASES`.
    """
    dot = np.nonzero(lattice.row > 0)[0]
    site = np.stack([lattice.row[dot], lattice.column[dot]], axis=-1)
    steps = (site - hole) @ basis * signs_of(orientation)
    return _labels_of_pairs(np.array(ray) + steps, dot, shape)


def extended_over_lattice(
    labels: IntArray, lattice: Lattice, orientation: Orientation
) -> IntArray | None:
    """Extend labels over the lattice; None if the two disagree."""
    at = np.argwhere(labels != UNLABELLED)
    dot = labels[at[:, 0], at[:, 1]]
    site = np.stack([lattice.row, lattice.column], axis=-1)
    indexed = site[dot, 0] > 0
    offset = (at + 1 - site[dot] * signs_of(orientation))[indexed]
    if len(offset) == 0:
        return None
    kinds, count = np.unique(offset, axis=0, return_counts=True)
    if count.max() < AGREED * len(offset):
        return None
    on_lattice = np.nonzero(site[:, 0] > 0)[0]
    ray = site[on_lattice] * signs_of(orientation) + kinds[np.argmax(count)]
    sited = _labels_of_pairs(ray, on_lattice, labels.shape)
    others = np.where(np.isin(labels, on_lattice), UNLABELLED, labels)
    return np.where(sited != UNLABELLED, sited, others)


def shifted_labels(observed: Observation, labels: IntArray) -> Iterator[IntArray]:
    """Yield labels shifted by up to two rows or columns.

    A shift changes the surface slightly and hardly affects the residuals. It is what a single frame
    determines least well.
    """
    for step in SHIFTS:
        yield shifted_by(observed, labels, step)


def shifted_by(observed: Observation, labels: IntArray, step: tuple[int, ...]) -> IntArray:
    """Shift labels by rows and columns."""
    at = np.argwhere(labels != UNLABELLED)
    shifted = _labels_of_pairs(at + 1 + step, labels[tuple(at.T)], labels.shape)
    shifted[observed.rays.absent] = UNLABELLED
    return shifted


def reoriented_labels(
    observed: Observation, labels: IntArray, before: Orientation, after: Orientation
) -> IntArray:
    """Label the same dots with another orientation: rays are mirrored about the marker."""
    at = np.argwhere(labels != UNLABELLED)
    center = np.array(observed.rig.pattern.marker or observed.rig.pattern.center_ray)
    ray = center + (at + 1 - center) * signs_of(before) * signs_of(after)
    return _labels_of_pairs(ray, labels[at[:, 0], at[:, 1]], labels.shape)


def exchanged_labels(observed: Observation, labels: IntArray) -> Iterator[IntArray]:
    """Yield labels with the dots of two adjacent rays exchanged, for dots that are close together.

    Where rows cross in a dip, two exchanged labels support each other.
    """
    for one, other in close_pairs(observed, labels):
        exchanged = labels.copy()
        exchanged[one], exchanged[other] = labels[other], labels[one]
        yield exchanged


def close_pairs(observed: Observation, labels: IntArray) -> Iterator[tuple[Site, Site]]:
    """Yield pairs of adjacent rays, counted from 0, whose dots are close together."""
    lit, plane_mm = labels != UNLABELLED, np.full((*labels.shape, 2), np.nan)
    plane_mm[lit] = observed.plane_mm[labels[lit]]
    for axis, step in enumerate(((1, 0), (0, 1))):
        apart_mm = np.linalg.norm(np.diff(plane_mm, axis=axis), axis=-1)
        both = np.isfinite(apart_mm)
        if not both.any():
            continue
        close = both & (apart_mm < CLOSE_TOGETHER * median(apart_mm[both]))
        for i, j in np.argwhere(close).tolist():
            yield (i, j), (i + step[0], j + step[1])


def _labels_of_pairs(ray: IntArray, dot: IntArray, shape: tuple[int, ...]) -> IntArray:
    there = ((ray >= 1) & (ray <= shape)).all(axis=-1)
    labels = np.full(shape, UNLABELLED, np.int64)
    labels[ray[there, 0] - 1, ray[there, 1] - 1] = dot[there]
    return labels
