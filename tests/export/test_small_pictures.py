from __future__ import annotations

import numpy as np
import pytest

from labapp.core.pipeline import Measurement
from labapp.export.rendering.drawing import Direction
from labapp.export.rendering.scene import scene_of
from labapp.export.rendering.studio import Studio


@pytest.mark.parametrize("size_px", [(367, 226), (285, 170)])
@pytest.mark.parametrize("view", ["top", "side", "front"])
def test_labels_stay_within_a_small_picture(
    measured: Measurement, view: Direction, size_px: tuple[int, int]
) -> None:
    pool = measured.reconstruction
    assert pool is not None
    picture = Studio(size_px, view).draw(scene_of(pool)).astype(int)
    ink = np.abs(picture - picture[-1, 0]).max(axis=2) > 40
    assert not ink[:, -2:].any()  # ink at the edge would be cut off
    assert not ink[-2:].any()
    if view == "top":
        # Below the drawing: the numbers along X and the name of the axis.
        lines = np.flatnonzero(ink[:, size_px[0] // 4 : size_px[0] * 2 // 3].any(axis=1))
        bands = np.split(lines, np.flatnonzero(np.diff(lines) > 2) + 1)
        assert [len(band) < 18 for band in bands[-3:]] == [False, True, True]
