"""Manual correction of lines: the edits, and the measurement after them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.lines.correction import (
    LineCorrection,
    cut_line,
    delete_line,
    join_lines,
    nearest_line,
    number_line,
)
from labapp.core.lines.detection.find_lines import LightLine, find_lines
from labapp.core.lines.detection.numbering import LinesSeen, number_lines
from labapp.core.lines.frame import measure_lines
from labapp.simulation.pools import egg
from tests.benchmarks.lines import CALIBRATION, RIG, VIEW
from tests.line_truth.frames import LineLook, render_lines


def straight(v_px: float, u_px: tuple[int, int] = (100, 300)) -> LightLine:
    """Return a line along u."""
    u = np.arange(*u_px, dtype=float)
    image_px = np.stack([u, np.full_like(u, v_px)], axis=-1)
    return LightLine(
        image_px=image_px,
        tangent=np.tile([1.0, 0.0], (len(u), 1)),
        sigma_px=np.full(len(u), 0.1),
        curvature=np.zeros(len(u)),
        ends_px=image_px[[0, -1]],
        cut=np.zeros(2, bool),
        width_px=3.0,
        light=100.0,
        gap_px=0.0,
        smoothed_px=9.0,
    )


def five() -> LineCorrection:
    """Return five lines, 40 px apart, from the lowest up."""
    lines = tuple(straight(500.0 - 40.0 * k) for k in range(5))
    return LineCorrection.of(LinesSeen(lines, True, True, 2))


def same(one: LightLine, other: LightLine) -> bool:
    return bool(np.array_equal(one.image_px, other.image_px) and (one.cut == other.cut).all())


def test_cut_and_join_are_inverse():
    cut = cut_line(five(), 2, 80)
    assert len(cut.seen.lines) == 6
    left, right = sorted(cut.seen.lines[2:4], key=lambda one: one.ends_px[0, 0])
    assert [left.cut.tolist(), right.cut.tolist()] == [[False, True], [True, False]]
    assert left.ends_px[1].tolist() == right.ends_px[0].tolist() == [180.0, 420.0]
    joined = join_lines(cut, 3, 2)
    assert len(joined.seen.lines) == 5
    assert same(joined.seen.lines[2], five().seen.lines[2])


def test_pieces_are_joined_at_their_nearest_ends():
    one, other = straight(420.0, (100, 180)), straight(420.0, (220, 300))
    turned = LineCorrection.of(LinesSeen((other, one), False, False, 0))
    joined = join_lines(turned, 0, 1).seen.lines[0]
    assert joined.image_px[0, 0] == 100
    assert (np.diff(joined.image_px[:, 0]) > 0).all()
    assert joined.gap_px == pytest.approx(40.0, abs=1.0)
    assert joined.ends_px[:, 0].tolist() == [100.0, 299.0]


def test_cutting_a_line_at_its_end_is_rejected():
    with pytest.raises(ValueError, match="end"):
        cut_line(five(), 0, 3)


def test_deleting_the_edge_line_clears_its_fringe():
    assert delete_line(five(), 2).seen.fringe_below
    changed = delete_line(five(), 0).seen
    assert (changed.fringe_below, changed.fringe_above) == (False, True)
    assert changed.left_out == 3
    assert [one.image_px[0, 1] for one in changed.lines] == [460.0, 420.0, 380.0, 340.0]


def test_impossible_line_numbers_are_rejected():
    with pytest.raises(ValueError, match="1 to 5"):
        number_line(five(), 0, 6, 5)
    two = number_line(number_line(five(), 0, 2, 5), 1, 3, 5)
    with pytest.raises(ValueError, match="different numbers"):
        join_lines(two, 0, 1)


def test_nearest_line():
    line, point, distance = nearest_line(five().seen.lines, 150.0, 463.0)
    assert (line, point, distance) == (1, 50, 3.0)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    pool = egg(6.0, 2.8, 3.2, 0.3)
    return render_lines(pool, RIG, VIEW, LineLook(), np.random.default_rng(3)).image


@pytest.fixture(scope="module")
def found(picture: np.ndarray) -> LineCorrection:
    seen = number_lines(find_lines(picture), 5)
    assert len(seen.lines) == 5
    return LineCorrection.of(seen)


def measured(picture: np.ndarray, correction: LineCorrection):
    assert isinstance(CALIBRATION, ImageCalibration)
    return measure_lines(picture, RIG, CALIBRATION, correction)


@pytest.mark.slow
def test_two_pieces_of_a_line_give_the_same_surface(picture: np.ndarray, found: LineCorrection):
    whole = measured(picture, found).surface
    cut = cut_line(found, 2, len(found.seen.lines[2].image_px) // 2)
    assert measured(picture, cut).status == "line-numbers"  # six lines of five
    for k in (2, 3):
        cut = number_line(cut, k, 3, 5)
    result = measured(picture, cut)
    assert result.status == "ok"
    assert result.surface is not None
    assert whole is not None
    assert result.surface.numbers.tolist() == [1, 2, 3, 3, 4, 5]
    assert result.surface.height_mm == pytest.approx(whole.height_mm, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [1, 2])
def test_a_hidden_line_leaves_its_number_free(
    picture: np.ndarray, found: LineCorrection, hidden: int
):
    result = measured(picture, delete_line(found, hidden))
    assert result.status == "ok"
    assert result.surface is not None
    assert result.surface.numbers.tolist() == [n for n in range(1, 6) if n != hidden + 1]
    assert result.surface.height_mm == pytest.approx(0.3, rel=0.05)


def test_a_line_may_be_missing_only_where_two_are_far_apart():
    seen = five().seen
    assert [each.tolist() for each in seen.steps(5)] == [[0, 1, 2, 3, 4]]
    fewer = delete_line(five(), 2).seen
    assert [each.tolist() for each in fewer.steps(5)] == [[0, 1, 2, 3], [0, 1, 3, 4]]
    wider = tuple(straight(500.0 - v) for v in (0, 40, 91, 176))  # a steep pool spreads them
    assert [each.tolist() for each in LinesSeen(wider, True, False, 0).steps(5)] == [[0, 1, 2, 3]]


def test_a_fringe_on_one_side_gives_the_numbers():
    lines = five().seen.lines[:4]

    def firsts(below: bool, above: bool) -> list[int]:
        return list(LinesSeen(lines, below, above, 0).first_numbers(5, 4, same_order=True))

    assert firsts(True, False) == [1]
    assert firsts(False, True) == [2]
    assert firsts(False, False) == firsts(True, True) == [1, 2]  # one of them is no fringe


@pytest.mark.parametrize(("u_px", "fringe"), [((100, 300), True), ((150, 190), False)])
def test_a_piece_of_a_line_is_no_fringe(u_px: tuple[int, int], fringe: bool):
    lines = five().seen.lines[:4]
    faint = replace(straight(340.0, u_px), light=15.0)
    seen = number_lines((*lines, faint), 5)
    assert len(seen.lines) == 4
    assert (seen.fringe_below, seen.fringe_above) == (False, fringe)


@pytest.mark.slow
def test_manual_numbers_override_those_from_fringes(picture: np.ndarray, found: LineCorrection):
    three = delete_line(delete_line(found, 4), 3)
    three = number_line(number_line(three, 0, 1, 5), 1, 2, 5)
    surface = measured(picture, three).surface
    assert surface is not None
    assert surface.numbers.tolist() == [1, 2, 3]
    assert measured(picture, number_line(three, 1, 4, 5)).status == "line-numbers"
