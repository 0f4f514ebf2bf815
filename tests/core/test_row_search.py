"""Rows and columns by the dissertation's two searches, on known patterns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.rows.lattice import Lattice
from labapp.core.rows.row_search import (
    MaskRowsSettings,
    RowSearchSettings,
    mask_rows,
    search_rows,
)
from labapp.core.values import CannotMeasure

SHAPE = (640, 480)
Search = Callable[[Dots], Lattice]


def dots_at(image_px: np.ndarray) -> Dots:
    count = len(image_px)
    return Dots(*image_px.T, *(np.full(count, value) for value in (0.3, 0.3, 2.5, 40.0, 12.0)))


def pattern(
    rows: int = 7,
    half: int = 5,
    missing: tuple[tuple[int, int], ...] = ((4, 6),),
    bow: float = 1.6,
    row_step: float = 55.0,
    seed: int = 0,
) -> tuple[Dots, np.ndarray]:
    """Return dots on convex arcs in shuffled order, and (k, t) of each, counted from 1."""
    rng = np.random.default_rng(seed)
    site = np.array(
        [
            (k, t)
            for k in range(1, rows + 1)
            for t in range(1, 2 * half + 2)
            if (k, t) not in missing
        ]
    )
    site = site[rng.permutation(len(site))]
    across = site[:, 1] - (half + 1)
    u = 260.0 + (22.0 + 0.6 * site[:, 0]) * across + rng.normal(0, 0.4, len(site))
    v = 560.0 - row_step * site[:, 0] + bow * across**2 + rng.normal(0, 0.4, len(site))
    return dots_at(np.stack([u, v], -1)), site


def by_search(dots: Dots) -> Lattice:
    return search_rows(dots, RowSearchSettings())


def by_masks(dots: Dots) -> Lattice:
    return mask_rows(dots, SHAPE, MaskRowsSettings())


both = pytest.mark.parametrize("search", [by_search, by_masks])


@both
@pytest.mark.parametrize("seed", range(3))
def test_every_dot_of_a_convex_pattern_is_indexed(search: Search, seed: int) -> None:
    dots, site = pattern(seed=seed)
    lattice = search(dots)
    assert np.array_equal(np.stack([lattice.row, lattice.column], -1), site)
    assert lattice.reference == (4, 6)
    assert lattice.candidates == ((4, 6),)
    assert lattice.blocked_rows == frozenset()


@both
def test_rows_are_counted_from_the_bottom_and_columns_from_the_left(search: Search) -> None:
    dots, _ = pattern()
    lattice = search(dots)
    assert dots.v_px[lattice.row == 1].min() > dots.v_px[lattice.row == 7].max()
    assert dots.u_px[lattice.column == 1].max() < dots.u_px[lattice.column == 11].min()


@both
def test_two_absent_middle_dots_mark_a_blocked_row(search: Search) -> None:
    dots, site = pattern(rows=6, row_step=85.0, missing=((4, 6), (2, 6), (2, 7)))
    lattice = search(dots)
    assert lattice.blocked_rows == {2}
    assert lattice.reference == (4, 6)
    indexed = lattice.row > 0
    assert indexed.sum() > 0.9 * len(dots)
    assert np.array_equal(np.stack([lattice.row, lattice.column], -1)[indexed], site[indexed])


def test_row_without_its_centre_dot_has_the_reference() -> None:
    """§5.2.2: "If two or more rows are available …"."""
    dots, _ = pattern(missing=((4, 6), (2, 7)))
    lattice = search_rows(dots, RowSearchSettings())
    assert lattice.reference == (4, 6)
    assert lattice.candidates == ((4, 6), (2, 7))


@both
def test_no_reference_is_chosen_among_two_candidates(search: Search) -> None:
    dots, _ = pattern(missing=((4, 6), (2, 6)))
    lattice = search(dots)
    assert lattice.reference is None
    assert set(lattice.candidates) == {(4, 6), (2, 6)}


@both
def test_no_reference_is_found_where_no_dot_is_missing(search: Search) -> None:
    dots, site = pattern(missing=())
    lattice = search(dots)
    assert lattice.reference is None
    assert lattice.candidates == ()
    assert np.array_equal(np.stack([lattice.row, lattice.column], -1), site)


@both
def test_isolated_false_dot_gets_no_row(search: Search) -> None:
    dots, site = pattern()
    lattice = search(dots_at(np.vstack([dots.image_px, [[450.0, 60.0]]])))
    assert lattice.row[-1] == lattice.column[-1] == 0
    assert np.array_equal(lattice.row[:-1], site[:, 0])


@both
@pytest.mark.parametrize("bow", [0.0, 1.0, 2.0, 2.5])
def test_indices_in_a_bowed_pattern_are_right(search: Search, bow: float) -> None:
    dots, site = pattern(bow=bow)
    lattice = search(dots)
    indexed = lattice.row > 0
    assert indexed.mean() > 0.2
    shift = np.stack([lattice.row, lattice.column], -1)[indexed] - site[indexed]
    assert (shift == shift[0]).all()


def test_row_ends_where_it_would_be_too_steep() -> None:
    """The next dot at the right is the nearest, but more than 60° up: it starts a new row."""
    places = np.array([[100.0, 300], [120, 300], [140, 300], [150, 270], [170, 270], [190, 270]])
    lattice = search_rows(dots_at(places), RowSearchSettings())
    first = lattice.row[:3]
    assert len(set(first)) == 1
    assert first[0] not in lattice.row[3:]


def test_rows_whose_masks_merge_are_rejected() -> None:
    dots, _ = pattern(row_step=8.0)
    with pytest.raises(CannotMeasure, match="no-rows"):
        mask_rows(dots, SHAPE, MaskRowsSettings())


@both
@pytest.mark.parametrize("count", [0, 1])
def test_too_few_dots_are_rejected(search: Search, count: int) -> None:
    with pytest.raises(CannotMeasure) as caught:
        search(dots_at(np.full((count, 2), 50.0)))
    assert caught.value.status == "too-few-dots"


@both
def test_vertically_aligned_dots_form_no_rows(search: Search) -> None:
    with pytest.raises(CannotMeasure) as caught:
        search(dots_at(np.array([[50.0, 50], [50, 100], [50, 150]])))
    assert caught.value.status == "no-rows"
