"""Simulated lines obey the law of reflection, and their light is where the rays land."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from labapp.core.geometry.line_pattern import LinePattern, LineRig
from labapp.core.geometry.rig import Electrode, ImagingPlane, Laser
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import egg, spherical_cap
from tests.line_truth.frames import LineLook, render_lines
from tests.line_truth.runs import PHASES, penetration_run

RIG = LineRig(
    Laser(27.0, 90.0),
    LinePattern(3, 0.23, 5.0),
    Electrode(5.0),
    ImagingPlane.vertical(53.6, 32.0, -5.0, 64.0, 84.0),
)
VIEW = CameraView((1.0, 318.0), (226.0, 318.0), 60.0, (1.0, 93.0), 60.0, 240, 320)


def test_middle_ray_of_a_flat_pool_lands_at_its_elevation():
    """It keeps its elevation: Z = 53.6·tan 27° at X = 0."""
    frame = render_lines(spherical_cap(6.0, 1e-6), RIG, VIEW, LineLook(), np.random.default_rng(0))
    middle = next(one for one in frame.lines if one.number == 2)
    k = int(np.argmin(np.abs(middle.fan)))
    place = VIEW.to_image(np.array([32.0, 53.6 * np.tan(np.radians(27.0)) + 5.0]))
    assert np.abs(middle.image_px[k] - place).max() < 0.01
    # i grows towards the head, which is upwards in the image of a flat mirror.
    heights = [-float(np.mean(one.image_px[:, 1])) for one in frame.lines]
    assert heights == sorted(heights)


def test_light_is_on_the_true_lines():
    look = LineLook(fringes=(), beam_fraction=0.0)
    frame = render_lines(spherical_cap(6.0, 0.2), RIG, VIEW, look, np.random.default_rng(0))
    line_px = np.concatenate([one.image_px for one in frame.lines])
    v, u = np.nonzero(frame.light_px > 0.02 * frame.light_px.max())
    distance = np.linalg.norm(np.stack([u, v], axis=-1)[:, None] - line_px, axis=-1).min(axis=1)
    assert distance.max() < 4 * 0.25 * 3.75 + 1.0


def test_light_of_a_widened_line_is_one_ridge():
    """A small steep pool spreads its top line over more than ten times the blur."""
    pool, look = egg(4.6, 1.5, 2.3, 0.22), LineLook(fringes=())
    frame = render_lines(pool, RIG, VIEW, look, np.random.default_rng(0))
    top = max(frame.lines, key=lambda one: one.number)
    u, v = np.rint(top.image_px[np.argmin(top.image_px[:, 1])]).astype(int)
    light = gaussian_filter(frame.light_px[:, u], look.light.blur_px)[max(v - 12, 0) : v + 12]
    rises = np.diff(light) > 0
    assert np.sum(rises[:-1] & ~rises[1:]) <= 1


def test_frame_without_a_pool_is_dark():
    frame = render_lines(None, RIG, VIEW, LineLook(), np.random.default_rng(0))
    assert frame.lines == ()
    assert not frame.light_px.any()


def test_gaps_interrupt_lines_and_fringes_add_light():
    def light(look: LineLook) -> float:
        rng = np.random.default_rng(3)
        frame = render_lines(spherical_cap(6.0, 0.2), RIG, VIEW, look, rng, gain=1.0)
        return float(frame.light_px.sum())

    bare = light(LineLook(fringes=()))
    assert light(LineLook(fringes=(), gaps=6, gap_mm=1.0)) < 0.95 * bare
    assert 1.05 * bare < light(LineLook(fringes=(0.18, 0.08))) < 1.4 * bare


def test_run_has_its_phases_in_order():
    run = penetration_run(80, np.random.default_rng(1))
    states = [one.state for one in run]
    assert [s for k, s in enumerate(states) if k == 0 or states[k - 1] != s] == list(PHASES)
    first, early, last = (run[k].pool for k in (0, 40, -1))
    assert first is None
    assert early is not None
    assert last is not None
    assert last.peak_mm > 0 > early.peak_mm
