from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.simulation.camera import CameraView, Lens
from labapp.simulation.forward import trace
from labapp.simulation.pools import Wave, egg
from labapp.simulation.render import Look, render

RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50.0, 45.0, 3.0))
VIEW = CameraView.rolled(roll_deg=1.2)
SEEN = trace(egg(6.6, 3.0, 4.4, 0.3, (0.0, -0.6)), RIG)
STILL = Look(
    unevenness=0.0, speckle=0.0, glow=0.0, background=20.0, read_noise=0.0, photon_noise=0.0
)


def dots_alone(look, seed=0, view=VIEW):
    frame = render(SEEN, view, look, np.random.default_rng(seed))
    return frame, frame.image.astype(float) - 20.0


def around(image, dot, reach=9):
    """Return the window around a dot, and its pixels' offsets from it."""
    u, v = np.rint(dot).astype(int)
    rows, columns = np.arange(v - reach, v + reach + 1), np.arange(u - reach, u + reach + 1)
    return image[np.ix_(rows, columns)], columns - dot[0], (rows - dot[1])[:, None]


def isolated(frame, least=22.0):
    """Return shown dots well inside the picture and without close neighbours."""
    dots = frame.dot_px[frame.shown]
    distance = np.linalg.norm(dots[:, None] - dots, axis=-1) + 1e9 * np.eye(len(dots))
    inside = (np.abs(dots - (240, 320)) < (225, 305)).all(axis=-1)
    return dots[(distance.min(axis=1) > least) & inside]


def test_view_maps_its_three_points_and_back():
    x = np.array([[0.0, 0.0], [VIEW.x_axis_mm, 0.0], [0.0, VIEW.z_axis_mm]])
    expected = np.array([VIEW.origin_px, VIEW.x_axis_px, VIEW.z_axis_px])
    np.testing.assert_allclose(VIEW.to_image(x), expected, atol=1e-10)
    np.testing.assert_allclose(VIEW.to_plane(expected), x, atol=1e-10)
    assert np.linalg.det(VIEW.px_per_mm) == pytest.approx(-(5.67**2)), "v grows downwards"
    assert VIEW.x_axis_px[1] < VIEW.origin_px[1], "counter-clockwise lifts the right"


def test_dots_are_at_the_stated_positions():
    frame, image = dots_alone(STILL)
    alone = isolated(frame)
    assert len(alone) > 15
    for dot in alone:
        window, du, dv = around(image, dot)
        total = window.sum()
        assert total > 300
        assert abs((window * du).sum() / total) < 0.05
        assert abs((window * dv).sum() / total) < 0.05


def test_frame_is_dark_where_there_is_no_dot():
    frame, image = dots_alone(STILL)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    for dot in frame.dot_px[frame.shown]:
        image[np.hypot(u - dot[0], v - dot[1]) < 16] = 0
    assert (image == 0).all()
    assert not frame.shown[9, 9], "the centre ray is absent"
    assert frame.shown.sum() == SEEN.visible.sum()


def spread(image, dot):
    window, du, dv = around(image, dot)
    total = window.sum()
    return np.sqrt((window * du**2).sum() / total), np.sqrt((window * dv**2).sum() / total)


def test_dot_size_is_limited_and_grows_with_the_dot_spacing():
    look = Look(**{**vars(STILL), "blur_px": 0.3, "dot_peak": 200.0})
    frame, image = dots_alone(look)
    sizes = np.array([spread(image, dot) for dot in isolated(frame)])
    assert (sizes > 0.95 * 5.67 * look.dot_floor_mm).all()
    assert (sizes < 1.05 * np.hypot(5.67 * look.dot_ceiling_mm, 0.3)).all()
    # At the head, rows are four times as far apart as columns, and dots are elongated.
    assert (sizes[:, 1] > 1.3 * sizes[:, 0]).all()


def test_noise_has_the_requested_variance():
    look = Look(dot_peak=0.0, background=30.0, glow=0.0, read_noise=2.0, photon_noise=0.1)
    image = render(SEEN, VIEW, look, np.random.default_rng(1)).image
    assert image.mean() == pytest.approx(30.0, abs=0.05)
    assert image.var() == pytest.approx(4.0 + 3.0 + 1 / 12, rel=0.02)


def test_arc_glow_is_brightest_below():
    look = Look(dot_peak=0.0, read_noise=0.0, photon_noise=0.0)
    image = render(SEEN, VIEW, look, np.random.default_rng(1)).image.astype(float)
    rows = image.mean(axis=1)
    assert (np.diff(rows) >= -1e-9).all()
    assert rows[-1] - rows[0] > 8


def test_speckle_and_unevenness_do_not_move_dots_on_average():
    look = Look(**{**vars(STILL), "speckle": 0.35, "unevenness": 0.3})
    frame, image = dots_alone(look)
    light, offset = [], []
    for dot in isolated(frame):
        window, du, dv = around(image, dot)
        light.append(window.sum())
        offset.append([(window * du).sum() / light[-1], (window * dv).sum() / light[-1]])
    assert 0.15 < np.std(np.log(light)) < 0.6
    assert np.abs(np.mean(offset, axis=0)).max() < 0.1
    assert 0.03 < np.std(offset) < 0.3


def test_missing_dots_are_neither_drawn_nor_marked_as_shown():
    frame, image = dots_alone(Look(**{**vars(STILL), "missing": 0.3}))
    missing = SEEN.visible & ~frame.shown
    assert 10 < missing.sum() < 60
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    near_shown = np.zeros(image.shape, bool)
    for dot in frame.dot_px[frame.shown]:
        near_shown |= np.hypot(u - dot[0], v - dot[1]) < 16
    assert (image[~near_shown] == 0).all()
    assert near_shown.mean() < 0.5


def test_false_dots_and_hot_pixels_are_added():
    _, clean = dots_alone(STILL)
    frame, false = dots_alone(Look(**{**vars(STILL), "false_dots": 4}))
    assert frame.shown.sum() == SEEN.visible.sum()
    assert (false - clean).sum() > 4 * 200
    _, hot = dots_alone(Look(**{**vars(STILL), "hot_pixels": 6}))
    assert ((hot - clean) >= 40).sum() == 6


def test_dots_beyond_the_picture_are_not_shown():
    near = CameraView.rolled(origin_px=(-150.0, 590.0))
    frame, _ = dots_alone(STILL, view=near)
    u = frame.dot_px[..., 0]
    np.testing.assert_array_equal(frame.shown, SEEN.visible & (u >= -0.5))
    assert 0 < frame.shown.sum() < SEEN.visible.sum()


def test_same_seed_gives_the_same_frame():
    look = Look(hot_pixels=3, false_dots=2, missing=0.05)
    first, again, other = (render(SEEN, VIEW, look, np.random.default_rng(n)) for n in (5, 5, 6))
    np.testing.assert_array_equal(first.image, again.image)
    assert (first.image != other.image).mean() > 0.5
    assert first.image.dtype == np.uint8
    assert first.image.shape == (640, 480)


# --- the lens -----------------------------------------------------------------------------------

BARREL = Lens(900.0, k1=-0.21, k2=0.06, p1=0.002, p2=-0.003, k3=-0.01)


def test_lens_distortion_agrees_with_opencv():
    ideal_px = np.random.default_rng(1).uniform(-400, 400, (50, 2))
    points = np.column_stack([ideal_px / BARREL.focal_px, np.ones(50)])
    camera = np.diag([BARREL.focal_px, BARREL.focal_px, 1.0])
    distortion = np.array([BARREL.k1, BARREL.k2, BARREL.p1, BARREL.p2, BARREL.k3])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, distortion)
    np.testing.assert_allclose(BARREL.distort(ideal_px), expected.reshape(-1, 2), atol=1e-9)


def test_distortion_round_trip():
    view = replace(VIEW, lens=BARREL)
    plane_mm = np.random.default_rng(2).uniform(0, 90, (100, 2))
    image_px = view.to_image(plane_mm)
    np.testing.assert_allclose(view.to_plane(image_px), plane_mm, atol=1e-8)
    assert np.abs(image_px - VIEW.to_image(plane_mm)).max() > 5


def test_lens_that_folds_the_picture_is_rejected():
    with pytest.raises(ValueError, match="folds"):
        replace(VIEW, lens=Lens(400.0, k1=-1.5))


def test_points_far_outside_are_not_folded_into_the_picture():
    lens = Lens(600.0, k1=-0.3)
    view = replace(VIEW, lens=lens)
    far = np.array([[2000.0, 40.0], [40.0, -3000.0]])
    assert np.isnan(view.to_image(far)).all()
    # The polynomial alone would map them back among the dots.
    assert lens.distort(np.array([[100.0, 0.0]]))[0, 0] < 100


def test_dots_are_drawn_at_their_distorted_positions():
    frame, image = dots_alone(STILL, view=replace(VIEW, lens=BARREL))
    plain, _ = dots_alone(STILL)
    assert np.nanmax(np.abs(frame.dot_px - plain.dot_px)[frame.shown]) > 2
    for dot in isolated(frame):
        window, du, dv = around(image, dot)
        assert abs((window * du).sum() / window.sum()) < 0.05
        assert abs((window * dv).sum() / window.sum()) < 0.05


# --- the sensor ---------------------------------------------------------------------------------


def test_light_beyond_the_full_scale_is_clipped():
    bright = replace(STILL, dot_peak=200.0)
    _, unclipped = dots_alone(bright)
    _, clipped = dots_alone(replace(bright, full_scale=90.0))
    assert unclipped.max() > 100
    np.testing.assert_array_equal(clipped, np.minimum(unclipped, 70.0))


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_more_bits_quantize_the_same_light_more_finely(bits):
    fine = render(SEEN, VIEW, replace(STILL, bits=bits), np.random.default_rng(0)).image
    coarse = render(SEEN, VIEW, STILL, np.random.default_rng(0)).image
    assert fine.dtype == (np.uint8 if bits == 8 else np.uint16)
    step = 255 / (2**bits - 1)
    np.testing.assert_allclose(fine * step, coarse, rtol=0, atol=0.5 + step / 2)
    assert (len(np.unique(fine)) > 4 * len(np.unique(coarse))) == (bits > 8)


# --- a pool that moves --------------------------------------------------------------------------


def test_dots_of_a_moving_pool_are_smeared():
    pool = egg(6.6, 3.0, 4.4, 0.3, (0.0, -0.6), (Wave((1, 1), 0.02, 30.0, 1 / 120.0),))
    moments = [trace(pool.after(t), RIG) for t in np.linspace(-0.004, 0.004, 9)]
    look = replace(STILL, dot_peak=200.0)
    frame, still = (render(seen, VIEW, look, np.random.default_rng(0)) for seen in (moments, SEEN))
    light, still_light = (
        one.image.astype(float).sum() - 20.0 * one.image.size for one in (frame, still)
    )
    assert light == pytest.approx(still_light, rel=0.05)
    assert frame.image.max() < still.image.max()
    first, last = (VIEW.to_image(seen.plane_mm) for seen in (moments[0], moments[-1]))
    moved = np.linalg.norm(last - first, axis=-1)[frame.shown]
    assert np.median(moved) > 4
    in_between = np.linalg.norm(frame.dot_px - (first + last) / 2, axis=-1)[frame.shown]
    assert np.nanmax(in_between) < 0.2 * moved.max()
