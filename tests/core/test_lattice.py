"""The default search for rows and columns: indices are correct, or the frame is rejected."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.rows.jump_kernels import without_jumps
from labapp.core.rows.lattice import Lattice, number_on_plane
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice, merge_grids
from labapp.core.rows.lattice_kernels import BORDER, grow
from labapp.core.values import CannotMeasure, ComplexArray, FloatArray, IntArray
from labapp.simulation.pools import egg, ellipsoidal_cap, spherical_cap
from tests.scenes import as_dots, see

ROWS, COLUMNS = 9, 14


def sites() -> IntArray:
    """Return (k, t) of a full grid, counted from 1, rows from the bottom up, shape (n, 2)."""
    k, t = np.mgrid[1 : ROWS + 1, 1 : COLUMNS + 1]
    return np.stack([k.ravel(), t.ravel()], axis=-1)


def bowed(site: IntArray, bow: float = 0.0, fan: float = 0.0, roll_deg: float = 0.0) -> FloatArray:
    """Return positions (u, v): rows arched by ``bow``, columns spread upwards by ``fan``."""
    k, t = site.T - np.array([[5.0], [7.5]])
    x = 22.0 * t * (1 + fan * k)
    y = 34.0 * k - bow * t**2
    roll = np.radians(roll_deg)
    u = 240.0 + np.cos(roll) * x - np.sin(roll) * y
    v = 320.0 - np.sin(roll) * x - np.cos(roll) * y
    return np.stack([u, v], axis=-1)


def wrong(lattice: Lattice, true: IntArray) -> int:
    """Return the number of wrong indices, up to the shift and turn that suit most dots."""
    indexed = lattice.row > 0
    site = np.stack([lattice.row, lattice.column], axis=-1)[indexed]
    agreeing = 0
    for way in ((1, 1), (-1, 1), (-1, -1)):
        count = np.unique(site * way - true[indexed], axis=0, return_counts=True)[1]
        agreeing = max(agreeing, int(count.max()))
    return int(indexed.sum()) - agreeing


@pytest.mark.parametrize(
    ("bow", "fan", "roll_deg"),
    [(0, 0, 0), (1.2, 0, 0), (0, 0.06, 0), (1.2, 0.06, 3), (-1.0, 0.04, -3), (0, 0, 20)],
)
def test_full_grid_is_indexed_from_the_lower_left(bow: float, fan: float, roll_deg: float) -> None:
    order = np.random.default_rng(0).permutation(ROWS * COLUMNS)
    site = sites()[order]
    lattice = grow_lattice(as_dots(bowed(site, bow, fan, roll_deg)), GrowSettings())
    np.testing.assert_array_equal(np.stack([lattice.row, lattice.column], axis=-1), site)


def tiles(seed: int, gap: float, missing: float) -> tuple[FloatArray, IntArray]:
    """Draw positions (u, v) and sites of a grid in tiles, turned, sheared, bowed, in perspective.

    Gaps between tiles are wider by ``gap`` steps. In half of the grids rows are staggered; sites
    are then in whole steps along two sides of the triangles that the dots make.
    """
    rng = np.random.default_rng([seed, round(100 * gap), round(100 * missing)])
    across, tile, staggered = rng.integers(16, 26), rng.integers(5, 9), rng.random() < 0.5
    row, column = np.mgrid[0:across, 0:across].reshape(2, -1)
    x = 20.0 * (column + gap * (column // tile) + staggered * (row % 2) / 2)
    y = rng.uniform(14.0, 26.0) * (row + gap * (row // tile))
    x, y = x - x.mean(), y - y.mean()
    x = x + rng.uniform(-0.2, 0.2) * y
    y = y + rng.uniform(-5e-4, 5e-4) * x**2
    turn = np.radians(rng.uniform(-45.0, 45.0))
    place = (x + 1j * y) * np.exp(1j * turn) / (1 + rng.uniform(-5e-4, 5e-4, 2) @ [x, y])
    positions = 400 + np.stack([place.real, place.imag], axis=-1)
    positions = positions + rng.normal(0.0, 0.3, positions.shape)
    shown = rng.random(len(row)) >= missing
    return positions[shown], np.stack([row, column - staggered * (row // 2)], axis=-1)[shown]


def wrong_among(lattice: Lattice, true: IntArray) -> int:
    """Count wrong indices, up to the shift and the choice of the two steps that suit most dots."""
    indexed = lattice.row > 0
    site = np.stack([lattice.row, lattice.column], axis=-1)[indexed]
    turns = np.array(list(product((-1, 0, 1), repeat=4))).reshape(-1, 2, 2)
    agreeing = [
        np.unique(site - true[indexed] @ turn, axis=0, return_counts=True)[1].max()
        for turn in turns
        if abs(round(np.linalg.det(turn))) == 1
    ]
    return int(indexed.sum() - max(agreeing))


@pytest.mark.parametrize("seed", range(4))
def test_tiles_with_gaps_are_joined_to_one_grid(seed: int) -> None:
    """As from an infrared projector: rows staggered and bowed, gaps a quarter step wide."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[0:24, 0:24].reshape(2, -1)
    u = 20.0 * (column + 0.25 * (column // 8) + row % 2 / 2)
    v = 14.5 * (row + 0.25 * (row // 8)) + 6e-4 * (u - 250) ** 2
    positions = np.stack([u, v], axis=-1) + rng.normal(0, 0.2, (len(u), 2))
    lattice = grow_lattice(as_dots(positions), GrowSettings())
    assert np.mean(lattice.row > 0) > 0.95
    assert wrong_among(lattice, np.stack([row, column - row // 2], axis=-1)) == 0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("gap", [0.15, 0.3, 0.45, 0.6])
@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_no_row_is_skipped_at_gaps_between_tiles(seed: int, gap: float, missing: float) -> None:
    positions, true = tiles(seed, gap, missing)
    try:
        lattice = grow_lattice(as_dots(positions), GrowSettings())
    except CannotMeasure:
        assert gap > 0.3
        return
    assert wrong_among(lattice, true) == 0
    assert np.mean(lattice.row > 0) > (0.5 if gap > 0.3 or missing else 0.85)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_grid_without_tiles_is_indexed(seed: int, missing: float) -> None:
    positions, true = tiles(seed, 0.0, missing)
    lattice = grow_lattice(as_dots(positions), GrowSettings())
    assert wrong_among(lattice, true) == 0
    assert np.mean(lattice.row > 0) > (0.9 if missing else 0.99)


def jumping(dots: bool) -> tuple[ComplexArray, ComplexArray]:
    """Return all dots, sorted, and places of 8 × 6 sites, the last row two steps beyond the others.

    With ``dots``, three dots of the row between are not among them.
    """
    u, v = np.meshgrid(10.0 * np.arange(6), 10.0 * np.arange(8))
    places = u - 1j * v
    places[7] -= 10j
    between = places[7, ::2] + 10j if dots else np.empty(0)
    return np.sort(np.append(places, between)), places


def test_row_beyond_a_dark_one_is_kept_but_not_one_beyond_dots() -> None:
    assert without_jumps(*jumping(dots=False)).all()
    kept = without_jumps(*jumping(dots=True))
    assert kept[:7].all()
    assert not kept[7].any()


def test_row_that_is_shifted_by_a_column_is_not_kept() -> None:
    _, places = jumping(dots=False)
    places[7] += 10j
    places[7, :3] += 10.0
    places[7, 3:] = np.nan
    kept = without_jumps(np.sort(places[~np.isnan(places)]), places)
    assert kept[:7].all()
    assert not kept[7].any()


def test_false_dot_between_two_others_is_no_jump() -> None:
    _, places = jumping(dots=False)
    places = places[:7]
    for false in (places[0, 0] - 5j, places[3, 3] + 5.0):
        assert without_jumps(np.sort(np.append(places, false)), places).all()


def test_contradictory_grids_are_not_joined() -> None:
    left, right = (np.arange(64).reshape(8, 8) + first for first in (0, 100))
    right[:, :2] = left[:, -2:]
    merged = merge_grids([left, right.T])
    assert merged.shape == (8, 14)
    np.testing.assert_array_equal(merged[:, 6:], right)
    right[4:, 0] = left[3:7, -2]  # slipped by a row
    np.testing.assert_array_equal(merge_grids([left, right.T]), left)


@pytest.mark.parametrize("seed", range(12))
def test_missing_and_false_dots_never_cause_a_wrong_index(seed: int) -> None:
    rng = np.random.default_rng(seed)
    site = sites()[rng.permutation(ROWS * COLUMNS)[rng.integers(0, 18) :]]
    positions = bowed(site, rng.uniform(-1, 1.3), rng.uniform(-0.05, 0.07), rng.uniform(-3, 3))
    positions = positions + rng.normal(0.0, 0.6, positions.shape)
    false = rng.uniform(0.0, 480.0, (int(rng.integers(0, 7)), 2))
    lattice = grow_lattice(as_dots(np.concatenate([positions, false])), GrowSettings())
    true_part = Lattice(lattice.row[: len(site)], lattice.column[: len(site)])
    assert wrong(true_part, site) == 0
    # Up to a seventh of the dots are missing; a dot without a complete cell remains in doubt.
    assert np.mean(true_part.row > 0) > 0.8


@pytest.mark.parametrize("seed", range(0, ROWS * COLUMNS, 25))
@pytest.mark.parametrize("reach", [3, 20])
def test_grid_grows_from_any_dot_within_reach(seed: int, reach: int) -> None:
    u, v = bowed(sites(), 1.2, 0.06, 3.0).T
    order = np.argsort(u)
    plane, site = (u - 1j * v)[order], sites()[order]
    across = 2 * (reach + BORDER) + 1
    dot_at = np.full((across, across), -1)
    dot_of = {(k, t): dot for dot, (k, t) in enumerate(site.tolist())}
    k, t = site[seed]
    # Steps to its neighbours, from the side where it has one.
    right, up = (t + 1 if t < COLUMNS else t - 1), (k + 1 if k < ROWS else k - 1)
    first = (plane[dot_of[k, right]] - plane[seed]) * (right - t)
    second = (plane[dot_of[up, t]] - plane[seed]) * (up - k)
    row, column, dot, part = grow(plane, dot_at, seed, first, second, 0.36, 1.8).T
    grown = np.stack([row, column], axis=-1) - across // 2
    offset = site - site[seed]
    assert set(dot.tolist()) == set(np.nonzero(np.abs(offset).max(axis=1) <= reach)[0].tolist())
    np.testing.assert_array_equal(grown, offset[dot])
    assert len(set(part.tolist())) == 1  # all are connected
    assert (dot_at == -1).all()


def test_unconnected_dots_are_not_joined() -> None:
    # Five dots in a cross have no cell.
    plane = np.array([-20.0, -20.0j, 0.0, 20.0j, 20.0])
    dot_at = np.full((21, 21), -1)
    grown = grow(plane, dot_at, 2, 20.0 + 0.0j, 20.0j, 0.36, 1.8)
    assert len(grown) == 5
    np.testing.assert_array_equal(grown[:, 2], grown[:, 3])


def test_coincident_dots_cause_no_wrong_index() -> None:
    site = np.concatenate([sites(), sites()[::9]])
    lattice = grow_lattice(as_dots(bowed(site, 1.0, 0.04)), GrowSettings())
    assert wrong(lattice, site) == 0
    assert np.mean(lattice.row > 0) > 0.5  # coincident dots are in doubt


def test_absent_centre_is_the_reference() -> None:
    site = np.array([s for s in sites() if tuple(s) != (5, 7)])
    lattice = grow_lattice(as_dots(bowed(site, 1.0, 0.04)), GrowSettings())
    assert lattice.reference == (5, 7)
    assert lattice.candidates == ((5, 7),)


def test_no_reference_is_chosen_among_two_holes() -> None:
    site = np.array([s for s in sites() if tuple(s) not in {(5, 7), (3, 9)}])
    lattice = grow_lattice(as_dots(bowed(site, 1.0)), GrowSettings())
    assert lattice.reference is None
    assert set(lattice.candidates) == {(5, 7), (3, 9)}


def test_rows_behind_the_torch_are_blocked() -> None:
    hidden = {(8, t) for t in range(6, 10)} | {(9, t) for t in range(6, 10)}
    site = np.array([s for s in sites() if tuple(s) not in hidden])
    lattice = grow_lattice(as_dots(bowed(site, 0.8)), GrowSettings())
    assert lattice.blocked_rows == {8, 9}


@pytest.mark.parametrize("seed", range(8))
def test_dots_of_pools_are_indexed_correctly_or_rejected(seed: int) -> None:
    rng = np.random.default_rng(seed)
    width, peak = rng.uniform(5.5, 7.5), rng.uniform(0.2, 0.4)
    pool = [
        spherical_cap(width, peak),
        ellipsoidal_cap(width, 1.15 * width, peak),
        egg(width, 0.45 * width, 0.6 * width, peak),
        spherical_cap(width, -1.6 * peak),
    ][seed % 4]
    seen = see(pool, rng, missing=2, false=3)
    try:
        lattice = grow_lattice(seen.dots, GrowSettings())
    except CannotMeasure:
        return
    has_ray = seen.ray[:, 0] > 0
    assert wrong(Lattice(lattice.row[has_ray], lattice.column[has_ray]), seen.ray[has_ray]) == 0


def test_scattered_dots_raise_no_rows() -> None:
    scattered = np.random.default_rng(1).uniform(0.0, 480.0, (60, 2))
    with pytest.raises(CannotMeasure) as error:
        grow_lattice(as_dots(scattered), GrowSettings())
    assert error.value.status == "no-rows"


def test_handful_of_dots_raises_too_few_dots() -> None:
    with pytest.raises(CannotMeasure) as error:
        grow_lattice(as_dots(bowed(sites()[:5])), GrowSettings())
    assert error.value.status == "too-few-dots"


@pytest.mark.parametrize(
    "view",
    [
        pytest.param([[1, 0], [0, 1]], id="as usual"),
        pytest.param([[-1, 0], [0, 1]], id="mirrored"),
        pytest.param([[1, 0], [0, -1]], id="mirrored upside down"),
        pytest.param([[-1, 0], [0, -1]], id="upside down"),
        pytest.param([[0, 1], [1, 0]], id="turned and mirrored"),
        pytest.param([[0, -1], [1, 0]], id="turned left"),
        pytest.param([[0, 1], [-1, 0]], id="turned right"),
    ],
)
def test_rows_are_numbered_as_on_the_imaging_plane(view: list[list[int]]) -> None:
    hidden = {(5, 7), (3, 4), (3, 5)}  # a hole, and a row with hidden dots
    site = np.array([s for s in sites().tolist() if tuple(s) not in hidden])
    to_picture = np.eye(3)
    to_picture[:2, :2], to_picture[:2, 2] = np.array(view, float), 700.0
    seen = bowed(site, 0.6, 0.03) @ to_picture[:2, :2].T + to_picture[:2, 2]
    to_plane = np.diag([1.0, -1.0, 1.0]) @ np.linalg.inv(to_picture)
    dots = as_dots(seen)
    lattice = number_on_plane(grow_lattice(dots, GrowSettings()), dots, ImageCalibration(to_plane))
    np.testing.assert_array_equal(np.stack([lattice.row, lattice.column], axis=-1), site)
    assert (5, 7) in lattice.candidates
    assert lattice.blocked_rows == {3}
