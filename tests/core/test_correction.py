"""Manual corrections: every edit, the invariants of all edits, and dots added to an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import (
    PLACED_PX,
    Correction,
    add_dot,
    assign,
    block_row,
    clear_rows,
    delete_dots,
    merge_rows,
    move_dots,
    set_reference,
    shift_row,
    split_row,
)
from labapp.core.rows.lattice import Lattice
from labapp.core.values import FloatArray, IntArray
from tests.scenes import as_dots

ROWS, COLUMNS = 4, 5
HOLE = (3, 3)


def place_of(sites: IntArray) -> FloatArray:
    """Return the positions of the dots of sites (k, t), shape (n, 2), px."""
    return np.stack([40.0 + 20.0 * sites[:, 1], 200.0 - 30.0 * sites[:, 0]], axis=-1)


def grid() -> Correction:
    """Return a grid with one hole, numbered from the lower left, and one dot in doubt."""
    k, t = np.mgrid[1 : ROWS + 1, 1 : COLUMNS + 1]
    sites = np.stack([k.ravel(), t.ravel()], axis=-1)
    sites = sites[(sites != HOLE).any(axis=-1)]
    dots = as_dots(np.vstack([place_of(sites), [300.0, 20.0]]))
    row, column = np.append(sites[:, 0], 0), np.append(sites[:, 1], 0)
    return Correction.of(dots, Lattice(row, column, None, (HOLE,)))


def dot_at(correction: Correction, row: int, column: int) -> int:
    """Return the index of the dot at a site."""
    lattice = correction.lattice
    (dot,) = np.flatnonzero((lattice.row == row) & (lattice.column == column))
    return int(dot)


def sites(correction: Correction) -> IntArray:
    return np.stack([correction.lattice.row, correction.lattice.column], axis=-1)


LAST = ROWS * COLUMNS - 1  # the dot in doubt


def test_delete_dots_leaves_the_others_unchanged() -> None:
    before = grid()
    after = delete_dots(before, [3, 0, 3])
    keep = np.delete(np.arange(LAST + 1), [0, 3])
    np.testing.assert_array_equal(after.dots.image_px, before.dots.image_px[keep])
    np.testing.assert_array_equal(sites(after), sites(before)[keep])
    assert not after.manual.any()
    assert len(before.dots) == LAST + 1


def test_deleted_dot_leaves_a_candidate_for_the_reference() -> None:
    before = grid()
    after = delete_dots(before, [dot_at(before, 2, 2)])
    assert set(after.lattice.candidates) == {HOLE, (2, 2)}


def test_moved_dots_get_the_uncertainty_of_manual_placement() -> None:
    before = grid()
    after = move_dots(before, [2, 4], 0.5, -1.25)
    step = after.dots.image_px - before.dots.image_px
    np.testing.assert_array_equal(np.flatnonzero(step.any(axis=-1)), [2, 4])
    np.testing.assert_allclose(step[[2, 4]], [[0.5, -1.25]] * 2)
    np.testing.assert_array_equal(np.flatnonzero(after.manual), [2, 4])
    assert (after.dots.u_sigma_px[[2, 4]] == PLACED_PX).all()
    assert after.dots.u_sigma_px[0] == before.dots.u_sigma_px[0]
    np.testing.assert_array_equal(sites(after), sites(before))


def test_row_and_column_can_be_assigned_one_after_the_other() -> None:
    with_row = assign(grid(), [LAST], row=3)
    assert sites(with_row)[LAST].tolist() == [3, 0]
    assert not with_row.sited[LAST]
    with_site = assign(with_row, [LAST], column=3)
    assert sites(with_site)[LAST].tolist() == list(HOLE)
    assert with_site.sited[LAST]
    assert np.flatnonzero(with_site.manual).tolist() == [LAST]
    # The dot is too far from the hole to fill it, but has its site.
    assert with_site.lattice.candidates == ()


def test_assigning_an_occupied_site_is_rejected() -> None:
    before = grid()
    owner = dot_at(before, 2, 2)
    u, v = before.dots.image_px[owner]
    with pytest.raises(ValueError, match=rf"dot {owner} at \({u:.1f}, {v:.1f}\) px"):
        assign(before, [LAST], row=2, column=2)
    with pytest.raises(ValueError, match="cannot be assigned to"):
        assign(before, [0, LAST], row=9, column=9)


def test_cleared_dots_have_no_site() -> None:
    after = clear_rows(grid(), [0, 1])
    assert sites(after)[:3].tolist() == [[0, 0], [0, 0], [1, 3]]


def test_shifting_a_row_shifts_the_reference_in_it() -> None:
    before = set_reference(grid(), HOLE)
    after = shift_row(before, 3, 2)
    in_row = before.lattice.row == 3
    np.testing.assert_array_equal(after.lattice.column - before.lattice.column, 2 * in_row)
    assert after.lattice.reference == (3, 5)
    np.testing.assert_array_equal(after.manual, in_row)
    assert shift_row(before, 2, 1).lattice.reference == HOLE


def test_shift_below_the_first_column_renumbers_all_columns() -> None:
    before = set_reference(grid(), HOLE)
    after = shift_row(before, 1, -2)
    step = after.lattice.column - before.lattice.column
    np.testing.assert_array_equal(step[:-1], np.where(before.lattice.row[:-1] == 1, 0, 2))
    assert sites(after)[LAST].tolist() == [0, 0]
    assert after.lattice.reference == (3, 5)


def test_row_below_the_lowest_renumbers_all_rows() -> None:
    before = block_row(set_reference(grid(), HOLE), 4)
    after = assign(before, [LAST], row=0, column=2)
    assert sites(after)[LAST].tolist() == [1, 2]
    np.testing.assert_array_equal(after.lattice.row[:-1], before.lattice.row[:-1] + 1)
    assert after.lattice.reference == (4, 3)
    assert after.lattice.blocked_rows == {5}


@pytest.mark.parametrize("above", [True, False])
def test_split_and_merge_are_inverse(above: bool) -> None:
    before = block_row(set_reference(grid(), HOLE), 3)
    after = split_row(before, 3, 3, above=above)
    row, column = before.lattice.row, before.lattice.column
    goes_up = (row > 3) | ((row == 3) & ((column >= 3) == above))
    np.testing.assert_array_equal(after.lattice.row, row + goes_up)
    np.testing.assert_array_equal(after.lattice.column, column)
    assert after.lattice.reference == (4 if above else 3, 3)
    assert after.lattice.blocked_rows == {3, 4}
    np.testing.assert_array_equal(after.manual, row == 3)
    for one, other in ((3, 4), (4, 3)):
        again = merge_rows(after, one, other)
        np.testing.assert_array_equal(sites(again), sites(before))
        assert again.lattice.reference == HOLE
        assert again.lattice.blocked_rows == {3}


def test_merging_rows_with_common_columns_is_rejected() -> None:
    with pytest.raises(ValueError, match="row 1, column 1 is already assigned to dot 0"):
        merge_rows(grid(), 2, 1)


def test_rows_are_blocked_and_unblocked() -> None:
    blocked = block_row(block_row(grid(), 2), 4)
    assert blocked.lattice.blocked_rows == {2, 4}
    assert block_row(blocked, 2, blocked=False).lattice.blocked_rows == {4}
    assert not blocked.manual.any()


def test_the_reference_is_set_and_cleared() -> None:
    after = set_reference(grid(), (9, 1))
    assert after.lattice.reference == (9, 1)
    assert after.lattice.candidates == ((9, 1),)
    cleared = set_reference(after, None)
    assert cleared.lattice.reference is None
    assert cleared.lattice.candidates == (HOLE,)


IMAGE = np.random.default_rng(0).normal(10.0, 1.0, (220, 340))

REFUSED: list[tuple[Callable[[Correction], Correction], str]] = [
    (lambda c: delete_dots(c, []), "no dot is selected"),
    (lambda c: delete_dots(c, [LAST + 1]), f"no dot {LAST + 1}; there are {LAST + 1}"),
    (lambda c: move_dots(c, [-1], 0.0, 0.0), "no dot -1"),
    (lambda c: move_dots(c, [0], float("nan"), 0.0), "cannot be moved"),
    (lambda c: clear_rows(c, np.array([0.5])), "by their integer indices"),
    (lambda c: assign(c, [0]), "a row or a column is needed"),
    (lambda c: assign(c, [0], row=100000), "100000 is not a valid row"),
    (lambda c: shift_row(c, 7, 1), "row 7 has no dots"),
    (lambda c: shift_row(c, 0, 1), "row 0 has no dots"),
    (lambda c: split_row(c, 2, 1), "row 2 has no dots on both sides of column 1"),
    (lambda c: split_row(c, 2, 6), "row 2 has no dots on both sides of column 6"),
    (lambda c: merge_rows(c, 2, 2), "with itself"),
    (lambda c: merge_rows(c, 2, 8), "row 8 has no dots"),
    (lambda c: block_row(c, 2, blocked=False), "row 2 is not marked"),
    (lambda c: add_dot(c, IMAGE, 500.0, 10.0), "not in the frame"),
    (lambda c: add_dot(c, IMAGE, float("nan"), 10.0), "not in the frame"),
    (lambda c: add_dot(c, IMAGE, *(c.dots.image_px[4] + 0.3)), "dot 4 at .* is there already"),
]


@pytest.mark.parametrize(("edit", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_wrong_edits_are_rejected(edit: Callable[[Correction], Correction], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        edit(grid())


def test_inconsistent_corrections_are_rejected() -> None:
    good = grid()
    n = len(good.dots)
    with pytest.raises(ValueError, match="is already assigned to dot 0"):
        replace(good, lattice=Lattice(np.ones(n, np.int64), np.ones(n, np.int64)))
    with pytest.raises(ValueError, match="counted from 1"):
        replace(good, lattice=Lattice(np.full(n, -1), np.zeros(n, np.int64)))
    with pytest.raises(ValueError, match="same length"):
        replace(good, manual=good.manual[1:])


def test_second_dot_found_on_a_site_loses_it() -> None:
    dots = as_dots(place_of(np.array([[1, 1], [1, 2], [1, 3]])))
    correction = Correction.of(dots, Lattice(np.array([1, 1, 1]), np.array([1, 2, 2])))
    assert sites(correction).tolist() == [[1, 1], [0, 0], [0, 0]]
    assert len(Correction.of(None, None).dots) == 0


NUMBER = st.integers(-3, 8)
EDITS = st.lists(
    st.tuples(st.sampled_from(range(11)), st.lists(NUMBER, min_size=4, max_size=4)), max_size=25
)


def edited(correction: Correction, kind: int, numbers: list[int]) -> Correction:
    a, b, c, d = numbers
    edits: list[Callable[[], Correction]] = [
        lambda: add_dot(correction, IMAGE, 40.0 + 9 * a, 90.0 + 7 * b),
        lambda: delete_dots(correction, [abs(a)]),
        lambda: move_dots(correction, [abs(a), abs(b)], c / 10, d),
        lambda: assign(correction, [abs(a)], row=b, column=c),
        lambda: assign(correction, [abs(a), abs(d)], row=b),
        lambda: clear_rows(correction, [abs(a), abs(b)]),
        lambda: shift_row(correction, a, b),
        lambda: split_row(correction, a, b, above=c > 2),
        lambda: merge_rows(correction, a, b),
        lambda: block_row(correction, a, blocked=b > 0),
        lambda: set_reference(correction, (a, b) if c > 0 else None),
    ]
    return edits[kind]()


@given(EDITS)
@pytest.mark.slow
def test_any_sequence_of_edits_keeps_the_correction_consistent(
    edits: list[tuple[int, list[int]]],
) -> None:
    correction = grid()
    for kind, numbers in edits:
        before = (len(correction.dots), correction.manual.sum(), sites(correction).copy())
        try:
            after = edited(correction, kind, numbers)
        except ValueError:
            np.testing.assert_array_equal(sites(correction), before[2])
            continue
        assert len(after.dots) == before[0] + {0: 1, 1: -1}.get(kind, 0)
        lattice, sited = after.lattice, after.sited
        assigned = sites(after)[sited]
        assert len(np.unique(assigned, axis=0)) == len(assigned)
        assert sites(after).min() >= 0
        if kind == 1:
            assert after.manual.sum() <= before[1]
        else:
            assert (after.manual[: before[0]] >= correction.manual).all()
        assert lattice.reference is None or min(lattice.reference) >= 1
        assert all(k >= 1 for k in lattice.blocked_rows)
        assert not {*lattice.candidates} & {tuple(site) for site in assigned.tolist()} or (
            lattice.reference is not None
        )
        arrays = [getattr(after.dots, field.name) for field in fields(Dots)]
        for array in (*arrays, lattice.row, lattice.column, after.manual):
            assert not array.flags.writeable
        correction = after


def picture(positions: FloatArray, peak: float) -> FloatArray:
    """Return an image of round dots of σ = 2 px on a noisy background."""
    v, u = np.mgrid[:220, :340]
    image: FloatArray = np.random.default_rng(3).normal(20.0, 1.5, u.shape)
    for x, y in positions:
        image += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8.0)
    return image


@pytest.mark.parametrize("peak", [8.0, 40.0])
def test_added_dot_snaps_to_the_peak_under_the_pointer(peak: float) -> None:
    before = grid()
    true = np.array([150.3, 151.7])
    image = picture(np.vstack([before.dots.image_px, true]), peak)
    after = add_dot(before, image, true[0] + 1.8, true[1] - 2.1)
    assert len(after.dots) == LAST + 2
    error = after.dots.image_px[-1] - true
    assert np.linalg.norm(error) < (0.3 if peak > 20 else 0.6)
    assert 0.05 < after.dots.u_sigma_px[-1] < 0.5
    assert np.flatnonzero(after.manual).tolist() == [LAST + 1]
    assert sites(after)[-1].tolist() == [0, 0]
    np.testing.assert_array_equal(after.dots.image_px[:-1], before.dots.image_px)


def test_dot_added_beside_another_does_not_snap_to_it() -> None:
    before = grid()
    true = before.dots.image_px[LAST] + [9.0, 3.0]
    image = picture(np.vstack([before.dots.image_px, true]), 40.0)
    after = add_dot(before, image, *(true - [3.0, 1.0]))
    assert np.linalg.norm(after.dots.image_px[-1] - true) < 0.3


@pytest.mark.parametrize("image", [picture(np.zeros((0, 2)), 0.0), np.zeros((220, 340), np.uint8)])
def test_dot_added_without_a_peak_stays_and_is_uncertain(image: FloatArray) -> None:
    after = add_dot(grid(), image, 152.25, 151.5)
    assert after.dots.image_px[-1].tolist() == [152.25, 151.5]
    assert min(after.dots.u_sigma_px[-1], after.dots.v_sigma_px[-1]) >= 1.0
    assert after.dots.snr[-1] < 3


@pytest.mark.parametrize("true", [(335.0, 5.0), (3.5, 216.0)])
def test_dot_near_the_frame_edge_can_be_added_first(true: tuple[float, float]) -> None:
    image = picture(np.array([true]), 40.0)
    after = add_dot(Correction.of(None, None), image, true[0] + 1.0, true[1] - 1.0)
    assert np.linalg.norm(after.dots.image_px[0] - true) < 0.5
    assert len(add_dot(after, image, 0.0, 0.0).dots) == 2
