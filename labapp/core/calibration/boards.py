"""Camera calibration boards (ChArUco and chessboard) and the detection of their inner corners.

A board stands in the imaging plane, upright as printed. O′ is its lower left inner corner as the
camera sees it; X′ runs along its lower row of inner corners, Z′ along its left column. A ChArUco
board has a numbered marker in each white square. The markers identify the visible corners even if
part of the board is hidden or outside the picture. A chessboard must be completely visible. It does
not show which side is up and may therefore be rotated by at most 45°.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.calibration.board_corner import fit_corner
from labapp.core.calibration.target_marks import ColourOrGrey, grey_levels
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Kind = Literal["charuco", "chessboard"]

FEWEST_CORNERS, FEWEST_LINES = 12, 3
"""Least number of inner corners, and of rows and columns that contain them, to accept a board."""

FEWEST_MARKERS = 4
"""Least number of markers that identifies a ChArUco board."""

MARGIN = 0.15
"""White margin between a marker and its square, as a share of the square's edge."""

REACH = 0.19
"""Radius of the window about a corner, as a share of a square's edge: a marker begins at 0.21."""

LEAST_REAL = 0.6
"""Least share of the corners of a chessboard that look like corners."""

GROWN_FROM = (3, 5, 7)
"""Corners each way from which a chessboard is grown. The largest is it: in an uneven light or near
a dark bench some do not grow to its rim."""

SMALLEST_PX = 12.0
"""Smallest square whose corners are found, px."""


@dataclass(frozen=True)
class Board:
    """A board of black and white squares.

    Parameters
    ----------
    kind
        ``charuco``, with markers in the white squares, or ``chessboard``.
    columns, rows
        Number of squares in each direction.
    square_mm
        Edge length of a square as measured on the print, mm.
    dictionary
        Name of the markers' dictionary in OpenCV, without ``DICT_``.
    first_id
        Number of the first marker, at the upper left; the others follow row by row.
    """

    name: str
    kind: Kind
    columns: int
    rows: int
    square_mm: float
    dictionary: str = "4X4_250"
    first_id: int = 0

    @property
    def marker_mm(self) -> float:
        """Edge of a marker."""
        return (1.0 - 2.0 * MARGIN) * self.square_mm

    @property
    def ids(self) -> range:
        """Numbers of the board's markers; empty for a chessboard."""
        count = self.columns * self.rows // 2 if self.kind == "charuco" else 0
        return range(self.first_id, self.first_id + count)

    @cached_property
    def corners_mm(self) -> FloatArray:
        """(X′, Z′) of the inner corners, row by row from the upper left, shape (n, 2), mm."""
        x, z = np.meshgrid(np.arange(self.columns - 1), np.arange(self.rows - 1)[::-1])
        return np.asarray(np.stack([x, z], axis=-1).reshape(-1, 2) * self.square_mm, np.float64)

    @property
    def is_possible(self) -> bool:
        """Whether the size is valid: 4 to 60 squares in each direction, of 0.1 to 1000 mm."""
        sides = (self.columns, self.rows)
        return 4 <= min(sides) <= max(sides) <= 60 and 0.1 <= self.square_mm <= 1000.0

    def with_square(self, square_mm: float) -> Board:
        """The same board with squares of another size."""
        return replace(self, square_mm=square_mm)

    def __str__(self) -> str:
        return f"{self.name}: {self.columns} × {self.rows} squares of {self.square_mm:g} mm"


BOARDS = {
    board.name: board
    for board in (
        Board("charuco_4_inch", "charuco", 12, 11, 8.0),
        Board("chessboard_4_inch", "chessboard", 12, 11, 8.0),
        Board("charuco_letter_a4", "charuco", 12, 15, 15.0, first_id=100),
        Board("chessboard_letter_a4", "chessboard", 12, 15, 15.0),
    )
}
"""The boards that can be printed (`resources/targets`)."""

A_BOARD = (
    f"one of {', '.join(BOARDS)}; or KIND:COLUMNSxROWS:SQUARE_MM, with :DICTIONARY:FIRST_ID after "
    "it for a charuco board of other markers than 4X4_250 from 0"
)

_FORM = re.compile(r"(charuco|chessboard):(\d{1,3})x(\d{1,3}):(\d+(?:\.\d+)?)(?::(\w+):(\d{1,6}))?")


def parse_board(text: str) -> Board:
    """Return a board by its name in `BOARDS` or its kind and size, such as ``chessboard:9x7:10``.

    Raises
    ------
    ValueError
        If the text is neither, or describes an invalid board.
    """
    if text in BOARDS:
        return BOARDS[text]
    form = _FORM.fullmatch(text)
    if form is None:
        raise ValueError("it is the name of no board")
    kind, columns, rows, square, dictionary, first = form.groups()
    board = Board(
        text.rpartition(":")[0] if dictionary is None else text,
        "charuco" if kind == "charuco" else "chessboard",
        int(columns),
        int(rows),
        float(square),
        dictionary or "4X4_250",
        int(first or 0),
    )
    if not board.is_possible:
        raise ValueError("a board has 4 to 60 squares each way, of 0.1 to 1000 mm")
    if kind == "charuco":
        try:
            known = len(_dictionary(board.dictionary).bytesList)
        except AttributeError as error:
            raise ValueError(f"OpenCV has no dictionary DICT_{board.dictionary}") from error
        if board.ids.stop > known:
            raise ValueError(f"the dictionary has markers 0 to {known - 1}")
    elif (board.columns + board.rows) % 2 == 0:
        raise ValueError("a chessboard that is not symmetric has an odd and an even side")
    return board


@dataclass(frozen=True)
class BoardCorners(ReadOnlyArrays):
    """Inner corners of a board that were detected in a picture.

    Parameters
    ----------
    index
        Index of each corner in `Board.corners_mm`, shape (n,).
    image_px
        (u, v) of each, shape (n, 2), px.
    """

    board: Board
    index: IntArray
    image_px: FloatArray

    @cached_property
    def plane_mm(self) -> FloatArray:
        """(X′, Z′) of each, shape (n, 2), mm."""
        return np.asarray(self.board.corners_mm[self.index])

    def keep(self, which: BoolArray) -> BoardCorners:
        """Return the corners selected by a mask, shape (n,)."""
        return BoardCorners(self.board, self.index[which], self.image_px[which])


def find_board(image: ColourOrGrey, board: Board | None = None) -> BoardCorners:
    """Find the inner corners of a board in a picture.

    Parameters
    ----------
    image
        Grey or BGR(A) picture, shape (rows, columns[, channels]), of any integer or float type.
    board
        The board; None: the one of `BOARDS` that the picture shows.

    Raises
    ------
    ValueError
        If the image is not a valid picture.
    CannotMeasure
        ``no-board`` if no board is found, ``wrong-board`` if another one is; the reason states
        which.
    """
    try:
        levels = grey_levels(image)
    except CannotMeasure as too_small:
        raise CannotMeasure("no-board", too_small.reason) from None
    if board is None:
        board = _recognised(levels)
    found = (_charuco if board.kind == "charuco" else _chessboard)(levels, board)
    found = _refined(levels, found)
    lines = [np.unique(found.plane_mm[:, axis]).size for axis in (0, 1)]
    if len(found.index) < FEWEST_CORNERS or min(lines) < FEWEST_LINES:
        raise CannotMeasure(
            "no-board",
            f"{len(found.index)} of the {len(board.corners_mm)} inner corners of {board.name} are "
            f"seen: at least {FEWEST_CORNERS} in {FEWEST_LINES} rows and columns are needed.",
        )
    return found


def is_charuco(image: ColourOrGrey) -> bool:
    """Whether a picture shows markers of one of `BOARDS`."""
    ids = _markers(_stretched(grey_levels(image)), "4X4_250")
    return any(_share(board, ids) for board in BOARDS.values())


def _recognised(levels: FloatArray) -> Board:
    """The board of `BOARDS` that a picture shows."""
    ids = _markers(_stretched(levels), "4X4_250")
    shown = [board for board in BOARDS.values() if _share(board, ids)]
    if shown:
        return max(shown, key=lambda board: _share(board, ids))
    grid = _chessboard_grid(levels)
    size = None if grid is None else (grid.shape[1], grid.shape[0])
    for board in BOARDS.values():
        if board.kind == "chessboard" and size == (board.columns - 1, board.rows - 1):
            # Boards with the same number of squares differ only in size, which the user supplies.
            return board
    if size is not None:
        raise CannotMeasure(
            "wrong-board",
            f"The picture shows a chessboard with {size[0]} × {size[1]} inner corners, which is "
            "none of the boards that labapp prints: name its squares and their size.",
        )
    raise CannotMeasure(
        "no-board",
        "The picture shows neither markers of a ChArUco board nor a chessboard with a white rim.",
    )


def _share(board: Board, ids: IntArray) -> int:
    """Number of detected markers that belong to a board; 0 if below `FEWEST_MARKERS`."""
    own = int(np.isin(ids, board.ids).sum())
    return own if own >= FEWEST_MARKERS else 0


def _charuco(levels: FloatArray, board: Board) -> BoardCorners:
    grey, size = _stretched(levels), (board.columns, board.rows)
    dictionary, ids = _dictionary(board.dictionary), np.array(board.ids, np.int32)
    design = cv2.aruco.CharucoBoard(size, 1.0, 1.0 - 2.0 * MARGIN, dictionary, ids)
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1
    detector = cv2.aruco.CharucoDetector(design, parameters, _marker_parameters())
    answer: tuple[Any, ...] = detector.detectBoard(grey)
    corners, numbers, _, seen = answer
    if numbers is None or not len(numbers):
        raise _no_charuco(grey, board, seen)
    index = np.asarray(numbers, np.int64).ravel()
    places = np.asarray(corners, np.float64).reshape(-1, 2)
    return BoardCorners(board, index, places)


def _no_charuco(grey: npt.NDArray[np.uint8], board: Board, seen: Any) -> CannotMeasure:
    """Return the error that explains why no corner of a board was found."""
    others = np.setdiff1d(_markers(grey, board.dictionary), np.array(board.ids))
    if len(others) >= FEWEST_MARKERS:
        return CannotMeasure(
            "wrong-board",
            f"The markers in the picture ({others.min()} to {others.max()}) are not those of "
            f"{board.name} ({board.ids.start} to {board.ids.stop - 1}): it is another board.",
        )
    return CannotMeasure(
        "no-board",
        f"{0 if seen is None else len(seen)} markers of {board.name} are seen, and no corner "
        "beside them: the board is out of the picture, blurred, hidden by glare, mirrored, or not "
        "this one.",
    )


def _refined(grey: FloatArray, found: BoardCorners) -> BoardCorners:
    """Refine the corners on the grey levels; drop those that do not look like a corner."""
    pitch = _pitch_px(found.image_px)
    if pitch < SMALLEST_PX:
        raise CannotMeasure(
            "no-board",
            f"The squares of {found.board.name} are {pitch:.0f} px wide, which is too small: "
            f"{SMALLEST_PX:.0f} px are needed. Move the camera nearer or use a larger board.",
        )
    places = _fitted(grey, found.image_px)
    seen = [k for k, place in enumerate(places) if place is not None]
    image_px = np.array([places[k] for k in seen], float).reshape(-1, 2)
    return BoardCorners(found.board, found.index[seen], image_px)


def _fitted(grey: FloatArray, image_px: FloatArray) -> list[FloatArray | None]:
    """Position of each corner in the grey levels, shape (2,), px; None where there is none."""
    radius = float(np.clip(REACH * _pitch_px(image_px), 3.0, 12.0))
    return [fit_corner(grey, place, radius) for place in image_px]


def _pitch_px(image_px: FloatArray) -> float:
    """Median distance of neighbouring corners in the picture, px; infinite if there are none."""
    nearest = [np.sort(np.hypot(*(image_px - place).T))[1:2] for place in image_px.tolist()]
    apart = np.concatenate([*nearest, np.empty(0)])
    return float(np.median(apart)) if len(apart) else float("inf")


def _chessboard(levels: FloatArray, board: Board) -> BoardCorners:
    grid = _chessboard_grid(levels)
    rows, columns = board.rows - 1, board.columns - 1
    if grid is None:
        raise CannotMeasure(
            "no-board",
            f"The {columns} × {rows} inner corners of {board.name} are not all seen. A "
            "chessboard must be whole and have a white rim; of a ChArUco board a part is enough.",
        )
    if grid.shape[:2] != (rows, columns):
        raise CannotMeasure(
            "wrong-board",
            f"{grid.shape[1]} × {grid.shape[0]} inner corners are seen where {board.name} has "
            f"{columns} × {rows}: part of it is hidden or out of the picture, it is turned, or it "
            "is another board.",
        )
    return BoardCorners(board, np.arange(rows * columns), grid.reshape(-1, 2))


def _chessboard_grid(levels: FloatArray) -> FloatArray | None:
    """Inner corners of the chessboard, shape (rows, columns, 2), px; None if there is none."""
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    grey = _stretched(levels)
    grids = [cv2.findChessboardCornersSBWithMeta(grey, (n, n), flags) for n in GROWN_FROM]
    done, corners, meta = max(grids, key=lambda grid: np.size(grid[2]) if grid[0] else -1)
    if not done:
        return None
    # OpenCV also takes the dots of the laser pattern for corners.
    places = _fitted(levels, np.asarray(corners, np.float64).reshape(-1, 2))
    if sum(place is not None for place in places) < LEAST_REAL * len(places):
        return None
    grid = np.asarray(corners, np.float64).reshape(*np.shape(meta)[:2], 2)
    along_row, along_column = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if abs(along_row[0]) * abs(along_column[1]) < abs(along_row[1]) * abs(along_column[0]):
        grid = grid.swapaxes(0, 1)
    # The detector does not determine the direction of the rows: the board is assumed upright.
    if grid[:, -1, 0].mean() < grid[:, 0, 0].mean():
        grid = grid[:, ::-1]
    if grid[-1, :, 1].mean() < grid[0, :, 1].mean():
        grid = grid[::-1]
    return grid


def _markers(grey: npt.NDArray[np.uint8], dictionary: str) -> IntArray:
    """Numbers of the markers in a picture."""
    detector = cv2.aruco.ArucoDetector(_dictionary(dictionary), _marker_parameters())
    answer: tuple[Any, ...] = detector.detectMarkers(grey)
    ids = answer[1]
    return np.empty(0, np.int64) if ids is None else np.asarray(ids, np.int64).ravel()


def _marker_parameters() -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 0.02
    return parameters


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


def _stretched(grey: FloatArray) -> npt.NDArray[np.uint8]:
    """Stretch the grey levels to the range 0 to 255."""
    low, high = np.percentile(grey, (0.5, 99.5))
    share = (grey - low) / max(float(high - low), 1e-9)
    return np.asarray(np.rint(255.0 * np.clip(share, 0.0, 1.0)), np.uint8)
