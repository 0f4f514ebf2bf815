"""Pictures at paper size, and the first intersection of a ray with a surface."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.export.rendering.paper import Paper, paper_picture
from labapp.export.rendering.pick import first_hit
from tests.export.test_scene_picture import pool


@pytest.mark.parametrize(("width_mm", "dpi"), [(90.0, 150), (60.0, 300)])
def test_picture_has_the_given_width_without_empty_margins(
    opengl: None, width_mm: float, dpi: int
) -> None:
    dark = pool()
    picture = paper_picture(dark, "free", Paper(width_mm, dpi))
    assert picture.shape[1] == round(width_mm / 25.4 * dpi)
    assert picture.shape[0] < picture.shape[1]
    ink = picture.min(axis=2) < 250
    margin_px = 3 * dpi / 25.4
    for axis in (0, 1):
        inked = np.flatnonzero(ink.any(axis=axis))
        assert inked[0] <= margin_px
        assert inked[-1] >= ink.shape[1 - axis] - 1 - margin_px
    assert (picture[0] > 250).all()  # white, whatever the colours of the window


def test_ray_hits_the_first_of_two_surfaces() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    triangles = np.array([[0, 1, 2], [3, 5, 4]])
    down = np.array([0.0, 0.0, -1.0])
    hit = first_hit(corners, triangles, np.array([0.2, 0.3, 5.0]), down)
    assert hit == pytest.approx([0.2, 0.3, 1.0])
    hit = first_hit(corners, triangles, np.array([0.2, 0.3, 0.5]), down)
    assert hit == pytest.approx([0.2, 0.3, 0.0])
    assert first_hit(corners, triangles, np.array([0.8, 0.3, 5.0]), down) is None
    assert first_hit(corners, triangles, np.array([0.2, 0.3, -1.0]), down) is None
    assert first_hit(corners, triangles[:0], np.array([0.2, 0.3, 5.0]), down) is None
