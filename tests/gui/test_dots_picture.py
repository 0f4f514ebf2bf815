"""Dots, rows and the reference drawn over a frame, compared with a stored picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtGui import QImage
from PySide6.QtWidgets import QApplication

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Lattice
from labapp.gui.pages.dots.overlay import DotsOverlay
from labapp.gui.theme import palette
from labapp.gui.views.picture import PictureView
from tests.gui.conftest import KEPT, let_draw
from tests.pictures import RENEW, Away, away, check_picture

STORED_PICTURE = Path(__file__).parent / "pictures" / "dots.png"

TOLERANCE = Away(mean=0.5, share=0.001)

ROWS, COLUMNS = 4, 6
STEP_PX, FIRST_PX = 20.0, np.array([34.0, 104.0])
IN_DOUBT, BY_HAND, CHOSEN, MOVED = 23, 3, 9, 15
"""Dots, counted row by row from the lower left."""


def places() -> np.ndarray:
    """Dot positions (u, v), row by row from the bottom up, shape (24, 2), px."""
    row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    return FIRST_PX + STEP_PX * np.column_stack([column, -row - 0.05 * column])


def frame(dots_px: np.ndarray) -> np.ndarray:
    """Draw a dot at each position; frame of shape (120, 160)."""
    v, u = np.mgrid[:120, :160]
    grey = np.full(u.shape, 30.0)
    for place in dots_px:
        grey += 180 * np.exp(-((u - place[0]) ** 2 + (v - place[1]) ** 2) / (2 * 1.8**2))
    return grey.clip(0, 255).astype(np.uint8)


def correction(dots_px: np.ndarray) -> Correction:
    count = len(dots_px)
    row, column = np.divmod(np.arange(count), COLUMNS)
    row, column = row + 1, column + 1
    row[IN_DOUBT] = column[IN_DOUBT] = 0
    fixed = [np.full(count, value) for value in (0.05, 0.05, 1.8, 180.0, 60.0)]
    lattice = Lattice(row, column, (2, 4), ((2, 4),), frozenset({3}))
    return Correction(Dots(*dots_px.T, *fixed), lattice, np.arange(count) == BY_HAND)


@pytest.fixture
def view(qapp: QApplication) -> PictureView:
    picture_view = PictureView("Frame")
    KEPT.append(picture_view)
    picture_view.setPalette(palette(dark=True))
    picture_view.resize(400, 340)
    picture_view.show()
    picture_view.show_picture(frame(places()))
    let_draw()
    return picture_view


def drawn(view: PictureView, overlay: DotsOverlay, marks_px: np.ndarray) -> np.ndarray:
    """The picture right of the row numbers, whose font differs by machine."""
    computed = places() + np.array([2.0, 0.0])
    overlay.show(correction(marks_px), marks_px, np.array([CHOSEN]), computed)
    QApplication.processEvents()
    image = view.grab_picture().convertToFormat(QImage.Format.Format_RGB888)
    lines = np.frombuffer(image.constBits(), np.uint8).reshape(image.height(), -1)
    pixels = lines[:, : 3 * image.width()].reshape(image.height(), image.width(), 3)
    return pixels[:, 80:].copy()


def test_dots_match_the_stored_picture_within_3_px(
    view: PictureView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    overlay = DotsOverlay(view)
    picture = drawn(view, overlay, places())
    check_picture(picture, STORED_PICTURE, TOLERANCE, tmp_path)
    moved = places()
    moved[MOVED] += [3.0, 0.0]
    changed = away(drawn(view, overlay, moved), picture)
    assert changed.share > 2 * TOLERANCE.share
    monkeypatch.delenv(RENEW, raising=False)
    with pytest.raises(pytest.fail.Exception, match=r"dots-difference\.png"):
        check_picture(drawn(view, overlay, moved), STORED_PICTURE, TOLERANCE, tmp_path)
    assert (tmp_path / "dots-difference.png").is_file()


@pytest.mark.parametrize("what", ["rows", "reference", "marks", "zoom"])
def test_missing_or_moved_overlays_change_the_picture(view: PictureView, what: str):
    overlay = DotsOverlay(view)
    picture = drawn(view, overlay, places())
    if what == "rows":
        overlay._rows.hide()
    elif what == "reference":
        overlay._reference.hide()
    elif what == "marks":
        overlay.toggle()
    else:
        view.zoom(1.02)
    assert not away(drawn(view, overlay, places()), picture).within(TOLERANCE)
