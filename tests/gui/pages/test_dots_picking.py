"""Picking dots and lattice sites, on arrays alone."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Lattice
from labapp.gui.pages.dots import picking


def grid(rows: int = 5, columns: int = 6, missing: tuple[int, int] | None = None) -> Correction:
    """A slanted and curved grid: rows are 30 px apart, columns 20 px."""
    sites = [(k, t) for k in range(1, rows + 1) for t in range(1, columns + 1) if (k, t) != missing]
    k, t = np.array(sites).T
    u = 100 + 20.0 * t + 3 * k
    v = 300 - 30.0 * k + 0.7 * (t - 3.5) ** 2
    one = np.ones(len(k))
    return Correction.of(Dots(u, v, one, one, 2 * one, 100 * one, 30 * one), Lattice(k, t))


def test_nearest_dot_within_a_radius() -> None:
    dots = np.array([[10.0, 10.0], [14.0, 10.0]])
    assert picking.nearest(dots, 11.9, 10, 5) == 0
    assert picking.nearest(dots, 12.1, 10, 5) == 1
    assert picking.nearest(dots, 30, 10, 5) is None
    assert picking.nearest(np.zeros((0, 2)), 0, 0, 5) is None


def test_box_can_start_at_any_corner() -> None:
    dots = np.array([[1.0, 1.0], [5.0, 5.0], [9.0, 2.0]])
    assert picking.in_box(dots, (6, 6), (0, 0)).tolist() == [0, 1]
    assert picking.in_box(dots, (5, 6), (9, 2)).tolist() == [1, 2]
    assert picking.in_box(dots, (20, 20), (30, 30)).tolist() == []


def test_dots_are_joined_along_rows_and_columns() -> None:
    row = np.array([1, 1, 1, 2, 2, 0, 3])
    column = np.array([1, 2, 4, 1, 4, 2, 2])
    along_rows, along_columns = picking.joints(row, column)
    assert along_rows.tolist() == [[0, 1], [1, 2], [3, 4]]
    assert along_columns.tolist() == [[0, 3], [2, 4]]
    for none in picking.joints(np.zeros(3, int), np.zeros(3, int)):
        assert none.shape == (0, 2)


def test_row_number_is_at_the_leftmost_dot() -> None:
    correction = grid()
    ends = picking.row_ends(correction.lattice.row, correction.dots.image_px)
    assert [row for row, _ in ends] == [1, 2, 3, 4, 5]
    assert all(correction.lattice.column[dot] == 1 for _, dot in ends)


@pytest.mark.parametrize("site", [(3, 3), (1, 1), (5, 6), (2, 6)])
def test_neighbours_of_a_missing_dot_give_its_site_and_position(site: tuple[int, int]) -> None:
    complete = grid()
    dot = np.flatnonzero((complete.lattice.row == site[0]) & (complete.lattice.column == site[1]))[
        0
    ]
    place = complete.dots.image_px[dot]
    incomplete = grid(missing=site)
    nearest = picking.site_at(incomplete, *place)
    assert nearest is not None
    assert nearest[0] == site
    assert nearest[1] < 0.25
    estimate = picking.site_px(incomplete, site)
    assert estimate is not None
    assert np.hypot(*(estimate - place)) < 6
    existing = picking.site_px(complete, site)
    assert existing is not None
    np.testing.assert_array_equal(existing, place)


def test_dots_without_rows_have_no_sites() -> None:
    dots = grid().dots
    bare = Correction.of(dots, None)
    assert picking.site_at(bare, 150, 200) is None
    assert picking.site_px(bare, (2, 2)) is None
    one_row = grid(rows=1)
    assert picking.site_at(
        Correction.of(
            Dots(*(np.linspace(1, 6, 6) for _ in range(7))), one_row.lattice
        ), 3, 3
    ) is None  # fmt: skip


def test_dots_are_numbered_by_their_neighbours() -> None:
    correction = grid()
    row, column = correction.lattice.row.copy(), correction.lattice.column.copy()
    lost = np.array([8, 9, 20])
    row[lost] = column[lost] = 0
    bare = Correction.of(correction.dots, Lattice(row, column))
    numbered, unnumbered = picking.numbered_by_neighbours(bare, lost)
    assert unnumbered == {}
    np.testing.assert_array_equal(numbered.lattice.row, correction.lattice.row)
    np.testing.assert_array_equal(numbered.lattice.column, correction.lattice.column)
    assert numbered.manual[lost].all()


def test_dot_between_sites_is_not_numbered() -> None:
    correction = grid()
    u = correction.dots.u_px.copy()
    u[8] += 10
    between = Correction.of(
        Dots(u, *(getattr(correction.dots, name) for name in list(correction.dots.__dict__)[1:])),
        correction.lattice,
    )
    with pytest.raises(ValueError, match="do not fix"):
        picking.numbered_by_neighbours(between, np.array([8]))


def test_dots_are_numbered_although_one_of_them_cannot_be() -> None:
    whole = grid()
    u, lattice = whole.dots.u_px.copy(), whole.lattice
    u[8] += 10  # between two sites
    names = list(whole.dots.__dict__)[1:]
    lost = np.array([8, 9, 20])
    row, column = lattice.row.copy(), lattice.column.copy()
    row[lost] = column[lost] = 0
    bare = Correction.of(
        Dots(u, *(getattr(whole.dots, name) for name in names)), Lattice(row, column)
    )
    numbered, unnumbered = picking.numbered_by_neighbours(bare, lost)
    assert list(unnumbered) == [8]
    assert unnumbered[8]
    for now, known in (
        (numbered.lattice.row, lattice.row),
        (numbered.lattice.column, lattice.column),
    ):
        np.testing.assert_array_equal(now[[9, 20]], known[[9, 20]])
        assert now[8] == 0


def test_dot_is_numbered_once_its_neighbours_are() -> None:
    whole = grid()
    lattice = whole.lattice
    lost = np.flatnonzero((lattice.column > 2) | (lattice.row > 2))[::-1]  # the farthest first
    row, column = lattice.row.copy(), lattice.column.copy()
    row[lost] = column[lost] = 0
    numbered, unnumbered = picking.numbered_by_neighbours(
        Correction.of(whole.dots, Lattice(row, column)), lost
    )
    assert unnumbered == {}
    np.testing.assert_array_equal(numbered.lattice.column, lattice.column)
