"""Tracking of a correction from frame to frame: correct rows, or none."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.rows.carry_on import carry_on
from labapp.core.rows.correction import Correction, block_row, clear_rows
from labapp.core.rows.lattice import Lattice
from labapp.core.values import BoolArray, IntArray
from labapp.simulation.pools import egg
from tests.oscillation import Oscillation
from tests.scenes import SeenDots, as_dots, see

FRAMES = 12


@cache
def frames() -> tuple[SeenDots, ...]:
    """Return frames of a moving, oscillating pool: dots move by up to half a row per frame."""
    scenes = []
    for n in range(FRAMES):
        wave = np.sin(2 * np.pi * n / FRAMES)
        pool = egg(
            width_mm=6.6 + 0.1 * wave,
            head_mm=3.0,
            tail_mm=4.3 - 0.2 * wave,
            peak_mm=0.3 + 0.015 * wave,
            center_mm=(0.04 * wave, -0.6 + 0.03 * n),
            terms=(Oscillation(0.01, 22.0, n / 60.0),),
        )
        scenes.append(see(pool, np.random.default_rng(n), missing=1, false=2))
    return tuple(scenes)


@dataclass(frozen=True)
class Known:
    """A correction with true rows, and the offset from its sites to the rays (S/S)."""

    correction: Correction
    offset: IntArray


def known(seen: SeenDots) -> Known:
    """Return a correction with every dot in its true row."""
    real = seen.ray[:, 0] > 0
    offset = seen.ray[real].min(axis=0) - 1
    site = np.where(real[:, None], seen.ray - offset, 0)
    reference = tuple((np.array([10, 10]) - offset).tolist())
    lattice = Lattice(site[:, 0], site[:, 1], (reference[0], reference[1]))
    return Known(Correction.of(seen.dots, lattice), offset)


def right_rows(carried: Correction, seen: SeenDots, offset: IntArray) -> BoolArray:
    """Return whether each dot with a site has the right one."""
    site = np.stack([carried.lattice.row, carried.lattice.column], axis=-1)
    return np.asarray((site + offset == seen.ray).all(axis=-1)[carried.sited])


def subset(dots: Dots, keep: IntArray | BoolArray) -> Dots:
    return Dots(*(getattr(dots, field.name)[keep] for field in fields(Dots)))


@pytest.mark.slow
def test_rows_are_tracked_through_a_moving_pool() -> None:
    start = known(frames()[0])
    correction: Correction | None = block_row(start.correction, 2)
    for seen in frames()[1:7]:
        assert correction is not None
        correction = carry_on(correction, seen.dots)
        assert correction is not None
        assert right_rows(correction, seen, start.offset).all()
        # New dots have no row until they are measured.
        assert correction.sited.sum() >= 0.75 * (seen.ray[:, 0] > 0).sum()
        assert correction.lattice.reference == start.correction.lattice.reference
        assert correction.lattice.blocked_rows == {2}
        np.testing.assert_array_equal(correction.dots.image_px, seen.dots.image_px)


@pytest.mark.parametrize("frame", range(FRAMES - 1))
@pytest.mark.slow
def test_nearly_all_dots_are_tracked_to_the_next_frame(frame: int) -> None:
    before, after = frames()[frame : frame + 2]
    start = known(before)
    carried = carry_on(start.correction, after.dots)
    assert carried is not None
    assert right_rows(carried, after, start.offset).all()
    both = {tuple(ray) for ray in before.ray.tolist()} & {tuple(ray) for ray in after.ray.tolist()}
    assert carried.sited.sum() >= 0.95 * (len(both) - 1)


def test_manual_marks_and_partial_sites_are_tracked() -> None:
    before, after = frames()[2:4]
    start = known(before)
    correction = clear_rows(start.correction, [3])
    column = correction.lattice.column.copy()
    column[5] = 0
    marks = np.isin(np.arange(len(column)), [5, 6])
    correction = replace(
        correction, lattice=replace(correction.lattice, column=column), manual=marks
    )
    carried = carry_on(correction, after.dots)
    assert carried is not None
    index = {tuple(ray): n for n, ray in enumerate(after.ray.tolist()) if ray != [0, 0]}
    third, fifth, sixth = (index[tuple(before.ray[n].tolist())] for n in (3, 5, 6))
    assert (carried.lattice.row[third], carried.lattice.column[third]) == (0, 0)
    assert carried.lattice.row[fifth] == correction.lattice.row[5]
    assert carried.lattice.column[fifth] == 0
    assert np.flatnonzero(carried.manual).tolist() == sorted([fifth, sixth])


def test_manual_dots_missed_by_the_detector_are_dropped() -> None:
    before, after = frames()[4:6]
    start = known(before)
    # A quarter of the dots were added manually and are not detected in the next frame.
    manual_dots = np.flatnonzero((before.ray % 2 == 0).all(axis=-1) & (before.ray[:, 0] > 0))
    manual_rays = {tuple(ray) for ray in before.ray[manual_dots].tolist()}
    keep = np.array([tuple(ray) not in manual_rays for ray in after.ray.tolist()])
    seen = SeenDots(subset(after.dots, keep), after.ray[keep])
    assert carry_on(start.correction, seen.dots) is None
    by_hand = replace(start.correction, manual=np.isin(np.arange(len(before.ray)), manual_dots))
    carried = carry_on(by_hand, seen.dots)
    assert carried is not None
    assert len(carried.dots) == keep.sum()
    assert right_rows(carried, seen, start.offset).all()
    assert not carried.manual.any()


def row_step_px(correction: Correction) -> float:
    """Return the typical distance between rows, px."""
    lattice, v = correction.lattice, correction.dots.v_px
    middle = [
        float(np.median(v[lattice.row == k])) for k in np.unique(lattice.row[lattice.row > 0])
    ]
    return float(np.median(-np.diff(middle)))


@pytest.mark.parametrize("rows", np.linspace(-2.0, 2.0, 17))
@pytest.mark.slow
def test_jolt_never_assigns_a_wrong_row(rows: float) -> None:
    # Shifted by a row, a picture looks the same except for its rim and the reference.
    seen = frames()[7]
    start = known(seen)
    jolt = np.array([0.0, rows * row_step_px(start.correction)])
    carried = carry_on(start.correction, as_dots(seen.dots.image_px + jolt))
    if carried is None:
        assert abs(rows) > 0.3
    else:
        assert right_rows(carried, seen, start.offset).all()


def test_tracking_stops_at_a_different_picture() -> None:
    start = known(frames()[0])
    rng = np.random.default_rng(5)
    assert carry_on(start.correction, as_dots(rng.uniform(20.0, 460.0, (90, 2)))) is None
    third = subset(frames()[1].dots, np.arange(len(frames()[1].dots)) % 3 > 0)
    assert carry_on(start.correction, third) is None
    assert carry_on(start.correction, subset(third, np.zeros(0, np.int64))) is None


def test_tracking_stops_at_a_dot_on_the_reference() -> None:
    seen = frames()[0]
    start = known(seen)
    beside = [np.flatnonzero((seen.ray == ray).all(axis=-1)) for ray in ([10, 9], [10, 11])]
    middle = seen.dots.image_px[np.concatenate(beside)].mean(axis=0)
    assert carry_on(start.correction, seen.dots) is not None
    assert carry_on(start.correction, as_dots(np.vstack([seen.dots.image_px, middle]))) is None


def test_correction_without_rows_is_not_tracked() -> None:
    assert carry_on(Correction.of(frames()[0].dots, None), frames()[1].dots) is None
    assert carry_on(Correction.of(None, None), frames()[1].dots) is None
