"""The drawing of a pool in 3-D equals a stored picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.export.rendering.drawing import build_scene
from labapp.export.rendering.scene import Scene
from tests.pictures import RENEW, Away, away, check_picture

REFERENCE = Path(__file__).parent / "pictures" / "pool.png"

TOLERANCE = Away(mean=1.0, share=0.008)

RINGS, SPOKES, RADIUS_MM = 12, 48, 3.0


def pool(*, mirrored: bool = False, hollow: bool = False) -> Scene:
    """An asymmetric cap over a circle, highest towards +X, with points and boundary."""
    ring, spoke = (index.ravel() for index in np.mgrid[1 : RINGS + 1, :SPOKES])
    radius, angle = RADIUS_MM * ring / RINGS, 2 * np.pi * spoke / SPOKES
    flat = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    flat = np.vstack([[0.0, 0.0], flat])
    height = 0.4 * (1 - (flat**2).sum(axis=1) / RADIUS_MM**2) * (1 + 0.25 * flat[:, 0])
    flat = flat * [-1, 1] if mirrored else flat
    height = -height if hollow else height
    around = np.arange(SPOKES)
    following = (around + 1) % SPOKES
    fan = np.column_stack([np.zeros(SPOKES, int), 1 + around, 1 + following])
    quads = []
    for inner in range(RINGS - 1):
        low, high = 1 + inner * SPOKES, 1 + (inner + 1) * SPOKES
        quads.append(np.column_stack([low + around, high + around, high + following]))
        quads.append(np.column_stack([low + around, high + following, low + following]))
    vertices = np.column_stack([flat, height])
    return Scene(
        vertices,
        np.vstack([fan, *quads]),
        height,
        "height (mm)",
        (-0.5, 0.5) if hollow else (0.0, 0.5),
        points_mm=vertices[1::6],
        lines_mm={"boundary": vertices[[*range(-SPOKES, 0), -SPOKES]]},
    )


def drawn(scene: Scene) -> np.ndarray:
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=[400, 300])
    build_scene(plotter, scene)
    plotter.render()
    picture = np.array(plotter.screenshot(return_img=True))
    plotter.close()
    return picture


@pytest.fixture(scope="module")
def picture(opengl: None) -> np.ndarray:
    return drawn(pool())


def test_pool_equals_the_stored_picture(
    picture: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_picture(picture, REFERENCE, TOLERANCE, tmp_path)
    monkeypatch.delenv(RENEW, raising=False)
    with pytest.raises(pytest.fail.Exception, match=r"pool-difference\.png"):
        check_picture(drawn(pool(mirrored=True)), REFERENCE, TOLERANCE, tmp_path)
    assert (tmp_path / "pool-difference.png").is_file()


@pytest.mark.parametrize(
    "change", ["mirrored", "hollow", "colour map", "limits", "points", "height"]
)
def test_changed_drawing_is_detected(picture: np.ndarray, change: str) -> None:
    other = {
        "mirrored": pool(mirrored=True),
        "hollow": pool(hollow=True),
        "colour map": replace(pool(), colour_map="coolwarm"),
        "limits": replace(pool(), limits=(0.0, 0.9)),
        "points": replace(pool(), points_mm=np.empty((0, 3))),
        "height": replace(pool(), exaggeration=pool().exaggeration * 1.5),
    }[change]
    assert not away(drawn(other), picture).within(TOLERANCE)
