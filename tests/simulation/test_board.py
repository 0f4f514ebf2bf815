"""Printable boards: the drawings agree with the simulated board."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from labapp.core.calibration.boards import BOARDS
from labapp.simulation.calibration.board import PrintedBoard, board_pdf, board_svg
from tests.inked_board import InkedBoard

TARGETS = Path(__file__).parents[2] / "resources" / "targets"
SVG = "{http://www.w3.org/2000/svg}"

every_board = pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)


@every_board
def test_rectangles_are_the_inked_areas(board):
    printed = InkedBoard(board)
    rectangles = printed.rectangles_mm()
    rng = np.random.default_rng(4)
    points = rng.uniform(-20, 200, (4000, 2))
    low, high = rectangles[:, :2], rectangles[:, 2:]
    within = ((points[:, None] > low) & (points[:, None] < high)).all(axis=-1).any(axis=-1)
    np.testing.assert_array_equal(printed.inked(points), within)


@every_board
def test_svg_has_the_board_at_true_size(board):
    root = ET.fromstring(board_svg(board))
    width, height = PrintedBoard(board).plate_mm
    assert (root.get("width"), root.get("height")) == (f"{width:g}mm", f"{height:g}mm")
    squares = [
        (float(rect.get("width")), float(rect.get("x")), float(rect.get("y")))
        for rect in root.iter(f"{SVG}rect")
        if float(rect.get("width")) == float(rect.get("height")) == board.square_mm
    ]
    assert len(squares) == -(-board.columns * board.rows // 2)
    x, z = PrintedBoard(board).origin_mm
    # The square to the lower left of O′ is black if columns and rows are both even, or both odd.
    lower_left = (board.square_mm, x - board.square_mm, height - z)
    upper_left = (board.square_mm, x - board.square_mm, height - z - board.square_mm)
    assert any(np.allclose(one, lower_left) or np.allclose(one, upper_left) for one in squares)


@every_board
def test_committed_boards_are_up_to_date(board):
    assert (TARGETS / f"{board.name}.svg").read_text("utf-8") == board_svg(board)
    pdf, width = (TARGETS / f"{board.name}.pdf").read_bytes(), PrintedBoard(board).plate_mm[0]
    assert f"/MediaBox [ 0 0 {width * 72 / 25.4:.6g}"[:20].encode() in pdf
    assert board_pdf(board)[:5] == pdf[:5] == b"%PDF-"
