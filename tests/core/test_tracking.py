"""A correction carried on from frame to frame: right rows, or none."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction, block_row, clear_rows
from labapp.core.rows.lattice import Lattice
from labapp.core.rows.tracking import carry_on
from labapp.core.values import BoolArray, IntArray
from labapp.simulation.pools import Oscillation, egg
from tests.scenes import SeenDots, as_dots, see

FRAMES = 12


@cache
def frames() -> tuple[SeenDots, ...]:
    """A pool that swells, wanders and swings: dots move by up to half a row from frame to frame."""
    made = []
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
        made.append(see(pool, np.random.default_rng(n), missing=1, false=2))
    return tuple(made)


@dataclass(frozen=True)
class Known:
    """A correction with true rows, and what to add to its sites for the rays (S/S)."""

    correction: Correction
    offset: IntArray


def known(seen: SeenDots) -> Known:
    """Every dot in its true row, as an operator leaves them."""
    real = seen.ray[:, 0] > 0
    offset = seen.ray[real].min(axis=0) - 1
    site = np.where(real[:, None], seen.ray - offset, 0)
    reference = tuple((np.array([10, 10]) - offset).tolist())
    lattice = Lattice(site[:, 0], site[:, 1], (reference[0], reference[1]))
    return Known(Correction.of(seen.dots, lattice), offset)


def right(carried: Correction, seen: SeenDots, offset: IntArray) -> BoolArray:
    """Which dots with a row have the right one."""
    site = np.stack([carried.lattice.row, carried.lattice.column], axis=-1)
    return np.asarray((site + offset == seen.ray).all(axis=-1)[carried.sited])


def subset(dots: Dots, keep: IntArray | BoolArray) -> Dots:
    return Dots(*(getattr(dots, field.name)[keep] for field in fields(Dots)))


@pytest.mark.slow
def test_rows_are_carried_through_a_moving_pool() -> None:
    start = known(frames()[0])
    correction: Correction | None = block_row(start.correction, 2)
    for seen in frames()[1:7]:
        assert correction is not None
        correction = carry_on(correction, seen.dots)
        assert correction is not None
        assert right(correction, seen, start.offset).all()
        # Dots that come new have no row until they are measured.
        assert correction.sited.sum() >= 0.75 * (seen.ray[:, 0] > 0).sum()
        assert correction.lattice.reference == start.correction.lattice.reference
        assert correction.lattice.blocked_rows == {2}
        np.testing.assert_array_equal(correction.dots.image_px, seen.dots.image_px)


@pytest.mark.parametrize("frame", range(FRAMES - 1))
@pytest.mark.slow
def test_nearly_all_dots_are_found_in_the_next_frame(frame: int) -> None:
    before, after = frames()[frame : frame + 2]
    start = known(before)
    carried = carry_on(start.correction, after.dots)
    assert carried is not None
    assert right(carried, after, start.offset).all()
    both = {tuple(ray) for ray in before.ray.tolist()} & {tuple(ray) for ray in after.ray.tolist()}
    assert carried.sited.sum() >= 0.95 * (len(both) - 1)


def test_marks_and_half_sites_go_along_and_doubt_stays_doubt() -> None:
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
    of = {tuple(ray): n for n, ray in enumerate(after.ray.tolist()) if ray != [0, 0]}
    third, fifth, sixth = (of[tuple(before.ray[n].tolist())] for n in (3, 5, 6))
    assert (carried.lattice.row[third], carried.lattice.column[third]) == (0, 0)
    assert carried.lattice.row[fifth] == correction.lattice.row[5]
    assert carried.lattice.column[fifth] == 0
    assert np.flatnonzero(carried.manual).tolist() == sorted([fifth, sixth])


def test_dots_placed_by_hand_that_no_detector_sees_are_left_behind() -> None:
    before, after = frames()[4:6]
    start = known(before)
    # A quarter of the dots are the operator's own and not among those of the next frame.
    own = np.flatnonzero((before.ray % 2 == 0).all(axis=-1) & (before.ray[:, 0] > 0))
    taken = {tuple(ray) for ray in before.ray[own].tolist()}
    keep = np.array([tuple(ray) not in taken for ray in after.ray.tolist()])
    seen = SeenDots(subset(after.dots, keep), after.ray[keep])
    assert carry_on(start.correction, seen.dots) is None
    by_hand = replace(start.correction, manual=np.isin(np.arange(len(before.ray)), own))
    carried = carry_on(by_hand, seen.dots)
    assert carried is not None
    assert len(carried.dots) == keep.sum()
    assert right(carried, seen, start.offset).all()
    assert not carried.manual.any()


def row_step_px(correction: Correction) -> float:
    """Typical distance from a row to the next, px."""
    lattice, v = correction.lattice, correction.dots.v_px
    middle = [
        float(np.median(v[lattice.row == k])) for k in np.unique(lattice.row[lattice.row > 0])
    ]
    return float(np.median(-np.diff(middle)))


@pytest.mark.parametrize("rows", np.linspace(-2.0, 2.0, 17))
@pytest.mark.slow
def test_a_jolt_never_puts_dots_into_a_wrong_row(rows: float) -> None:
    # Shifted by a whole row, a picture looks like itself but for its rim and the reference.
    seen = frames()[7]
    start = known(seen)
    jolt = np.array([0.0, rows * row_step_px(start.correction)])
    carried = carry_on(start.correction, as_dots(seen.dots.image_px + jolt))
    if carried is None:
        assert abs(rows) > 0.3
    else:
        assert right(carried, seen, start.offset).all()


def test_another_picture_stops_it() -> None:
    start = known(frames()[0])
    rng = np.random.default_rng(5)
    assert carry_on(start.correction, as_dots(rng.uniform(20.0, 460.0, (90, 2)))) is None
    third = subset(frames()[1].dots, np.arange(len(frames()[1].dots)) % 3 > 0)
    assert carry_on(start.correction, third) is None
    assert carry_on(start.correction, subset(third, np.zeros(0, np.int64))) is None


def test_a_dot_where_the_reference_was_stops_it() -> None:
    seen = frames()[0]
    start = known(seen)
    beside = [np.flatnonzero((seen.ray == ray).all(axis=-1)) for ray in ([10, 9], [10, 11])]
    middle = seen.dots.image_px[np.concatenate(beside)].mean(axis=0)
    assert carry_on(start.correction, seen.dots) is not None
    assert carry_on(start.correction, as_dots(np.vstack([seen.dots.image_px, middle]))) is None


def test_without_rows_there_is_nothing_to_carry() -> None:
    assert carry_on(Correction.of(frames()[0].dots, None), frames()[1].dots) is None
    assert carry_on(Correction.of(None, None), frames()[1].dots) is None
