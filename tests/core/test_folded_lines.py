"""Lines that a concave pool folds or focuses to spots, and short ends of lines."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.config.line_setup import read_line_setup
from labapp.core.lines.detection import ridges as ridges_module
from labapp.core.lines.detection.find_lines import find_lines
from labapp.core.lines.detection.numbering import number_lines
from labapp.core.lines.detection.ridges import find_ridges, sampled
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import egg
from tests.line_truth.frames import LineLook, render_lines
from tests.setups import FIVE_LINES

VIEW = CameraView((2.0, 638.0), (452.0, 638.0), 60.0, (2.0, 188.0), 60.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "sign"),
    [
        pytest.param(49, -1, id="spots"),
        pytest.param(193, -1, id="short-arcs-near-each-other"),
        pytest.param(185, -1, id="legs-of-a-folded-line"),
        pytest.param(215, -1, id="a-leg-below-an-arch"),
        pytest.param(158, 1, id="a-short-end-beyond-a-gap"),
    ],
)
def test_each_line_is_found_once(tmp_path, number: int, sign: int):
    (tmp_path / "setup.toml").write_text(FIVE_LINES, "utf-8")
    rig = read_line_setup(tmp_path / "setup.toml").line_rig
    assert rig is not None
    rng = np.random.default_rng([77, number])
    width, length = rng.uniform(5.0, 7.0, 2)
    head = length * rng.uniform(0.42, 0.5)
    center = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)
    pool = egg(width, head, length - head, sign * rng.uniform(0.1, 0.4), center)
    true = render_lines(pool, rig, VIEW, LineLook(gaps=2), rng)
    numbered = number_lines(find_lines(true.image), 5)
    nearest = []
    for one in numbered.lines:
        distance = {
            line.number: np.median(
                np.linalg.norm(one.image_px[:, None] - line.image_px, axis=-1).min(axis=1)
            )
            for line in true.lines
        }
        best = min(distance, key=lambda k: distance[k])
        assert distance[best] < 4.0
        nearest.append(best)
    assert nearest == ([1, 2, 3, 4, 5] if sign > 0 else [5, 4, 3, 2, 1])


def test_ridges_of_a_very_noisy_frame(monkeypatch):
    monkeypatch.setattr(ridges_module, "SEED", 1.0)
    monkeypatch.setattr(ridges_module, "FLOOR", 0.5)
    noise = np.random.default_rng(1).normal(100, 30, (900, 900)).astype(np.float32)
    ridges = find_ridges(noise, 1.0)
    assert len(ridges.image_px) > 2**15
    assert len(ridges.height) == len(ridges.image_px)


def test_sampling_more_points_than_one_call_accepts():
    rng = np.random.default_rng(2)
    picture = rng.normal(size=(40, 50)).astype(np.float32)
    u, v = rng.integers(0, 50, 40000), rng.integers(0, 40, 40000)
    assert (sampled(picture, np.stack([u, v], axis=-1)) == picture[v, u]).all()
