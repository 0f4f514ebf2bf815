"""Directions of a lens's individual rays, from pictures of the pattern on flat mirrors.

A level mirror at height z reflects a ray as if it came straight from the laser's mirror image, as
far below the mirror as the laser is above it. The direction from there to the dot, mirrored back,
is the ray's. Two heights give different directions if a mirror is not level or not at its height,
or if the imaging plane is tilted. A wrong laser position is hardly detected: it changes the
directions of all rays instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.bench_check.labelling import MirrorDots, label_picture, sighting_of
from labapp.core.bench_check.mirrors import Plate
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.optics import direction_to_dots
from labapp.core.geometry.patterns import FEWEST_RAYS
from labapp.core.matching.observation import Observation
from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

LEAST_PICTURES = 2
"""With one height, a wrong mirror height is indistinguishable from other ray directions."""


@dataclass(frozen=True)
class PatternCalibration(ReadOnlyArrays):
    """Individually measured rays, n of them.

    Parameters
    ----------
    ray
        Ray (i, j), counted from 1, shape (n, 2).
    tangents
        Its tangents to the beam axis, sideways and upwards, shape (n, 2).
    sigma
        Their standard uncertainty from the dots' noise, the set-up taken as exact, shape (n, 2).
    off_deg
        Root mean square angle between these rays and those of the set-up, degrees.
    disagreement
        Root mean square difference between the pictures, relative to the dots' noise: about 1 if
        the mirrors' heights and the imaging plane are correct.
    """

    ray: IntArray
    tangents: FloatArray
    sigma: FloatArray
    off_deg: float
    disagreement: float


def calibrate_pattern(pictures: Sequence[MirrorDots], bench: Bench) -> PatternCalibration:
    """Measure the rays of a pattern from pictures of plates at different heights.

    Parameters
    ----------
    pictures
        Two or more pictures of `Plate` mirrors.
    bench
        The set-up, taken as exact; its pattern must be good enough to identify the rays.

    Raises
    ------
    CannotMeasure
        As `label_picture`; ``too-few-dots`` if fewer than `FEWEST_RAYS` rays are in two or more
        pictures.
    """
    rig, shape = bench.rig, (bench.rig.pattern.rows, bench.rig.pattern.columns)
    weight, weighted, squares = (np.zeros((*shape, 2)) for _ in range(3))
    seen = np.zeros(shape, np.int64)
    for picture in pictures:
        labels = label_picture(picture, bench).labels
        observed = Observation.of(picture.dots, bench, picture.frame_shape)
        sighting = sighting_of(observed, picture.mirror, labels)
        tangents, sigma = _unfolded(bench, picture, sighting.plane_mm, sighting.covariance_mm2)
        at = tuple(sighting.ray.T)
        seen[at] += 1
        weight[at] += sigma**-2
        weighted[at] += sigma**-2 * tangents
        squares[at] += sigma**-2 * tangents**2
    twice = seen >= LEAST_PICTURES
    if twice.sum() < FEWEST_RAYS:
        count = int(twice.sum())
        raise CannotMeasure(
            "too-few-dots", f"{count} rays are in two pictures or more, {FEWEST_RAYS} are needed"
        )
    mean = weighted[twice] / weight[twice]
    freedom = 2 * int((seen[twice] - 1).sum())
    chi2 = float((squares[twice] - weight[twice] * mean**2).sum())
    off = np.degrees(np.arctan(np.linalg.norm(mean - rig.pattern.tangents[twice], axis=-1)))
    return PatternCalibration(
        ray=np.argwhere(twice) + 1,
        tangents=mean,
        sigma=1.0 / np.sqrt(weight[twice]),
        off_deg=float(np.sqrt(np.mean(off**2))),
        disagreement=float(np.sqrt(max(chi2, 0.0) / freedom)),
    )


def _unfolded(
    bench: Bench, picture: MirrorDots, plane_mm: FloatArray, covariance_mm2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Tangents of the rays of n dots to the beam axis, and their σ, shapes (n, 2)."""
    laser, plane = bench.rig.laser, bench.rig.imaging_plane
    assert isinstance(picture.mirror, Plate)
    image = laser.position_mm * [1, 1, -1] + [0, 0, 2 * picture.mirror.height_mm]
    axis, *across = laser.axes * [1, 1, -1]  # mirrored, as are the rays

    def tangents(dots_mm: FloatArray) -> FloatArray:
        direction = direction_to_dots(image, dots_mm, plane)
        return np.asarray(direction @ np.array(across).T / (direction @ axis)[:, None])

    made, step = tangents(plane_mm), 1e-3
    slopes = [(tangents(plane_mm + step * np.eye(2)[k]) - made) / step for k in range(2)]
    by_dot = np.stack(slopes, axis=-1)
    variance = np.einsum("nij,njk,nik->ni", by_dot, covariance_mm2, by_dot)
    return made, np.sqrt(variance)
