"""ChArUco boards and chessboards in the imaging plane: as pictures and for printing.

The layout of squares and marker bits is defined here, independently of the corner detection.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from labapp.core.calibration.boards import Board
from labapp.core.values import BoolArray, FloatArray

MARKER_CELLS = 6
"""Cells along each side of a marker, including its black border of one cell."""

PLATES_MM = {"4_inch": (101.6, 101.6), "letter_a4": (210.0, 279.4)}
"""Width and height of the printed sheet or plate, by the end of the board's name; "letter_a4" fits
both paper sizes."""

CUT_MM, TICK_MM = 0.1, 1.6
"""Thickness of the line around the plate; length of the ticks beside O′."""


@dataclass(frozen=True)
class PrintedBoard:
    """A board on a white background, in the IPCS with origin at its O′."""

    board: Board

    def rectangles_mm(self) -> FloatArray:
        """Black areas as (X′ from, Z′ from, X′ to, Z′ to), shape (m, 4), mm."""
        board, edge = self.board, self.board.square_mm
        cell = board.marker_mm / MARKER_CELLS
        found = []
        for row in range(board.rows):
            for column in range(board.columns):
                left, top = (column - 1) * edge, (board.rows - 1 - row) * edge
                if (row + column) % 2 == 0:
                    found.append((left, top - edge, left + edge, top))
                elif board.kind == "charuco":
                    rim = (edge - board.marker_mm) / 2
                    for at_y, bits in enumerate(self._markers[self._numbers[row, column]]):
                        high = top - rim - at_y * cell
                        found += [
                            (left + rim + a * cell, high - cell, left + rim + b * cell, high)
                            for a, b in _runs(bits)
                        ]
        return np.array(found)

    @cached_property
    def _numbers(self) -> FloatArray:
        """Index of the marker in each square, shape (rows, columns); −1 in a black square."""
        board = self.board
        row, column = np.indices((board.rows, board.columns))
        white = (row + column) % 2 == 1
        return np.where(white, np.cumsum(white).reshape(white.shape) - 1, -1)

    @cached_property
    def _markers(self) -> BoolArray:
        """Whether each cell of each marker is black, shape (markers, 6, 6)."""
        name = f"DICT_{self.board.dictionary.upper()}"
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        drawn = [
            cv2.aruco.generateImageMarker(dictionary, number, MARKER_CELLS) == 0
            for number in self.board.ids
        ]
        return np.array(drawn, bool)

    @property
    def plate_mm(self) -> tuple[float, float]:
        """Width and height of the printed sheet or plate."""
        for end, size in PLATES_MM.items():
            if self.board.name.endswith(end):
                return size
        edge = self.board.square_mm
        return (self.board.columns + 2) * edge, (self.board.rows + 2) * edge

    @property
    def origin_mm(self) -> tuple[float, float]:
        """Distance of O′ from the left and from the lower edge of the plate."""
        board, (width, height) = self.board, self.plate_mm
        left = (width - board.columns * board.square_mm) / 2
        low = (height - board.rows * board.square_mm) / 2
        return left + board.square_mm, low + board.square_mm

    def notes(self) -> tuple[str, str]:
        """Text printed above and below the squares."""
        board, (x, z) = self.board, self.origin_mm
        markers = f"{board.dictionary} {board.ids.start}-{board.ids.stop - 1}"
        of = f" | markers {markers}, {board.marker_mm:g} mm" if board.kind == "charuco" else ""
        ten = f"10 squares = {10 * board.square_mm:g} mm"
        return (
            f"labapp {board.name} | {board.columns} x {board.rows} squares of "
            f"{board.square_mm:g} mm{of}",
            f"O': lower left inner corner, {x:g} mm from the left and {z:g} mm from the lower edge"
            f" | print at 100 %: {ten}",
        )


def _runs(bits: BoolArray) -> list[tuple[int, int]]:
    """Start and end of each run of black cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bits.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def board_svg(board: Board) -> str:
    """Draw a board at true size as an SVG document, to be printed without scaling."""
    printed = PrintedBoard(board)
    width, height = printed.plate_mm
    squares = "\n".join(
        f'    <rect x="{x:.3f}" y="{height - z - tall:.3f}" width="{wide:.3f}" '
        f'height="{tall:.3f}"/>'
        for x, z, wide, tall in _sheet(printed)
    )
    notes = "\n".join(
        f'  <text x="{x:.3f}" y="{height - z:.3f}" font-family="sans-serif" '
        f'font-size="{size:g}">{words}</text>'
        for x, z, size, words in _words(printed)
    )
    return f"""<svg xmlns="http://www.w3.org/2000/svg" version="1.1" \
width="{width:g}mm" height="{height:g}mm" viewBox="0 0 {width:g} {height:g}">
  <title>{board.name}</title>
  <rect x="{CUT_MM / 2:g}" y="{CUT_MM / 2:g}" width="{width - CUT_MM:g}" \
height="{height - CUT_MM:g}" fill="white" stroke="black" stroke-width="{CUT_MM:g}"/>
  <g fill="black" shape-rendering="crispEdges">
{squares}
  </g>
{notes}
</svg>
"""


def board_pdf(board: Board) -> bytes:
    """Draw a board at true size as a PDF of one page, to be printed without scaling."""
    from reportlab.lib.units import mm
    from reportlab.pdfgen.canvas import Canvas

    printed = PrintedBoard(board)
    width, height = printed.plate_mm
    out = io.BytesIO()
    page = Canvas(out, (width * mm, height * mm), invariant=1, initialFontName="Helvetica")
    page.setTitle(board.name)
    page.setLineWidth(CUT_MM * mm)
    half = CUT_MM / 2 * mm
    page.rect(half, half, width * mm - 2 * half, height * mm - 2 * half)
    for x, z, wide, tall in _sheet(printed):
        page.rect(x * mm, z * mm, wide * mm, tall * mm, stroke=0, fill=1)
    for x, z, size, words in _words(printed):
        page.setFont("Helvetica", size * mm)
        page.drawString(x * mm, z * mm, words)
    page.save()
    return out.getvalue()


def _sheet(printed: PrintedBoard) -> list[tuple[float, float, float, float]]:
    """Black rectangles (left, bottom, width, height) from the plate's lower left corner, mm."""
    origin, edge = np.array(printed.origin_mm), printed.board.square_mm
    low, high = np.hsplit(printed.rectangles_mm(), 2)
    rectangles = np.hstack([origin + low, high - low])
    # Ticks in the white margin, to the left of O′ and below it.
    (x, z), out = printed.origin_mm, edge + 0.4
    ticks = [(x - out - TICK_MM, z - 0.1, TICK_MM, 0.2), (x - 0.1, z - out - TICK_MM, 0.2, TICK_MM)]
    return [*(tuple(row) for row in rectangles.tolist()), *ticks]


def _words(printed: PrintedBoard) -> list[tuple[float, float, float, str]]:
    """Texts on the plate: (left, baseline, size, text), mm from the plate's lower left corner."""
    (width, height), (x, z) = printed.plate_mm, printed.origin_mm
    edge = printed.board.square_mm
    size = 2.0 if width < 150 else 3.4
    left, low = x - edge, z - edge
    high = height - low
    above, below = printed.notes()
    return [
        (left, high + size, size, above),
        (left, low - 2.6 * size - TICK_MM, size, below),
        (x + 0.6, low - TICK_MM - 0.4, size, "O'"),
    ]
