"""Calibration of camera and imaging plane from pictures of boards, rendered with a known lens."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from labapp.config.setup_keys import SECTIONS
from labapp.core.calibration.board_calibration import BoardCalibration, calibrate_board
from labapp.core.calibration.boards import BOARDS, BoardCorners, parse_board
from labapp.core.calibration.imaging_plane import calibrate_imaging_plane
from labapp.core.calibration.lens_fit import fit_lens, fit_terms
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.values import CannotMeasure
from labapp.simulation.calibration.target import Target, TargetLook, render_target
from labapp.simulation.camera import Lens
from labapp.simulation.forward import trace
from labapp.simulation.pools import spherical_cap
from labapp.simulation.render import Look, render
from tests.core.test_bench_check import EXACT, VIEW
from tests.inked_board import InkedBoard
from tests.posed_view import PosedView

pytestmark = pytest.mark.slow

CHARUCO, CHESS = BOARDS["charuco_4_inch"], BOARDS["chessboard_4_inch"]
WIDTH, HEIGHT = SIZE = 480, 640
FOCAL_PX = 1000.0
CORNER = np.hypot(WIDTH - 1, HEIGHT - 1) / 2 / FOCAL_PX


def lens(percent: float, **terms: float) -> Lens | None:
    """Return a lens with the given distortion in the picture's corner, None for 0 %."""
    return Lens(FOCAL_PX, k1=percent / 100 / CORNER**2, **terms) if percent else None


@cache
def shot(
    board, percent=0.0, turned=(1.0, -2.0, 1.3), center=None, seed=1, px_per_mm=5.0, axis=None
):
    """Return a view of a board, and its picture."""
    middle = board.corners_mm.mean(axis=0) if center is None else center
    view = PosedView.at(
        tuple(middle), px_per_mm, turned_deg=turned, lens=lens(percent), axis_px=axis
    )
    look = TargetLook()
    return view, render_target(InkedBoard(board), view, look, np.random.default_rng(seed))


@cache
def calibrated(board, percent=-1.0):
    """Return the default view of a board, and the calibration from its picture."""
    view, image = shot(board, percent)
    return view, calibrate_board([image])


def off_mm(calibration: BoardCalibration, view: PosedView) -> np.ndarray:
    """Return the calibration's errors on the plane, at points all over the picture, mm."""
    u, v = np.linspace(5, WIDTH - 6, 9), np.linspace(5, HEIGHT - 6, 9)
    image_px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return np.hypot(*(calibration.image_calibration.to_plane(image_px) - view.to_plane(image_px)).T)


@pytest.mark.parametrize("board", [CHARUCO, CHESS], ids=lambda board: board.kind)
@pytest.mark.parametrize("percent", [-1.0, 0.5, 0.0])
def test_lens_and_plane_are_calibrated(board, percent):
    view, calibration = calibrated(board, percent)
    value, sigma = calibration.distortion_percent
    assert calibration.board == board
    assert abs(value - percent) < 3 * sigma < 0.15
    assert calibration.fit.rms_px < 0.1
    assert off_mm(calibration, view).max() < 0.05
    assert (calibration.image_calibration.lens is None) == (percent == 0.0)


def test_corner_noise_matches_its_sigma():
    view, calibration = calibrated(CHARUCO)
    true = view.to_image(calibration.seen[0].plane_mm)
    error = calibration.seen[0].image_px - true
    assert np.sqrt(np.mean(error**2)) == pytest.approx(calibration.fit.sigma_px, rel=0.2)
    assert np.sqrt(np.mean(error**2)) < 0.07


def test_decentred_lens_gets_tangential_terms():
    view, image = shot(CHARUCO, -1.0, axis=(215.0, 345.0), seed=2)
    calibration = calibrate_board([image])
    assert {"k1", "p1", "p2"} <= set(calibration.fit.terms)
    assert off_mm(calibration, view).max() < 0.06


def test_distortion_error_over_sigma_is_standard_normal():
    rng = np.random.default_rng(5)
    pulls = []
    for _ in range(60):
        view = PosedView.at(
            (40.0, 36.0), 5.0, turned_deg=tuple(rng.normal(0, 2, 3)), lens=lens(-0.8)
        )
        image_px = view.to_image(CHARUCO.corners_mm) + rng.normal(0, 0.05, (110, 2))
        fit = fit_terms([BoardCorners(CHARUCO, np.arange(110), image_px)], SIZE, ("k1",))
        value, sigma = fit.distortion_percent()
        pulls.append((value + 0.8) / sigma)
    assert 0.75 < np.std(pulls) < 1.3
    assert abs(np.mean(pulls)) < 0.45


def test_no_lens_is_fitted_to_noise():
    rng = np.random.default_rng(6)
    view = PosedView.at((40.0, 36.0), 5.0, turned_deg=(2.0, -1.0, 1.0))
    image_px = view.to_image(CHARUCO.corners_mm)
    lenses = [
        fit_lens(
            [BoardCorners(CHARUCO, np.arange(110), image_px + rng.normal(0, 0.05, (110, 2)))], SIZE
        ).lens
        for _ in range(100)
    ]
    assert sum(one is not None for one in lenses) <= 1


def test_covariance_matches_spread_over_repeated_noise():
    rng = np.random.default_rng(7)
    view = PosedView.at((40.0, 36.0), 5.0, turned_deg=(2.0, -1.0, 1.0), lens=lens(-1.0))
    image_px, places = view.to_image(CHARUCO.corners_mm), np.array([[0.0, 0.0], [80.0, 0.0]])
    fits = [
        fit_terms(
            [BoardCorners(CHARUCO, np.arange(110), image_px + rng.normal(0, 0.05, (110, 2)))],
            SIZE,
            ("k1",),
        )
        for _ in range(80)
    ]
    spread = np.std([fit.calibration().to_image(places).ravel() for fit in fits], axis=0)
    sigma = np.sqrt(np.diag(fits[0].covariance_px2(places)))
    np.testing.assert_allclose(spread, sigma, rtol=0.3)


def test_more_pictures_reduce_uncertainty_and_agree_with_opencv():
    view, first = shot(CHARUCO, -1.0)
    poses = [((15, 0, 0), (40, 20)), ((0, -15, 3), (30, 60)), ((-10, 12, -4), (50, 50))]
    more = [shot(CHARUCO, -1.0, turned, center, k)[1] for k, (turned, center) in enumerate(poses)]
    single, several = calibrated(CHARUCO)[1], calibrate_board([first, *more])
    assert several.distortion_percent[1] < 0.8 * single.distortion_percent[1]
    assert off_mm(several, view).max() < 0.04
    on_board = [np.column_stack([s.plane_mm, np.zeros(len(s.index))]) for s in several.seen]
    camera = np.array([[1500.0, 0, 239.5], [0, 1500.0, 319.5], [0, 0, 1]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
    rms, camera, distortion, *_ = cv2.calibrateCamera(
        [single.astype(np.float32) for single in on_board],
        [s.image_px.astype(np.float32) for s in several.seen],
        SIZE,
        camera,
        np.zeros(5),
        flags=flags,
    )
    corner = CORNER * FOCAL_PX / camera[0, 0]
    assert 100 * distortion.ravel()[0] * corner**2 == pytest.approx(
        several.distortion_percent[0], abs=0.08
    )
    assert rms == pytest.approx(np.sqrt(2) * several.fit.rms_px, rel=0.1)


@pytest.mark.parametrize("board", [CHARUCO, CHESS], ids=lambda board: board.kind)
def test_slightly_turned_board_is_calibrated(board):
    view, image = shot(board, -1.0, turned=(0.0, 0.0, 5.0))
    assert off_mm(calibrate_board([image]), view).max() < 0.05


def test_partly_visible_charuco_is_calibrated():
    view, image = shot(CHARUCO, -1.0, center=(75.0, 70.0))
    calibration = calibrate_board([image])
    true = view.to_image(calibration.seen[0].plane_mm)
    assert 40 < len(calibration.seen[0].index) < 90
    assert np.abs(calibration.seen[0].image_px - true).max() < 0.4
    assert calibration.covered < 0.3
    assert any("larger board" in words for words in calibration.undetermined())


def test_glare_hides_corners_but_does_not_move_them():
    view, image = shot(CHARUCO, -1.0)
    image = image.copy()
    cv2.circle(image, (300, 400), 60, 255, -1)
    calibration = calibrate_board([image])
    corners = calibration.seen[0]
    assert 40 < len(corners.index) < 105
    assert np.abs(corners.image_px - view.to_image(corners.plane_mm)).max() < 0.4


def mirrored():
    return cv2.flip(shot(CHARUCO)[1], 1)


def glaring_chessboard():
    image = shot(CHESS)[1].copy()
    return cv2.circle(image, (240, 300), 70, 255, -1)


def test_chessboard_in_a_shadow_is_calibrated():
    view, image = shot(CHESS)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    in_shadow = 1 / (1 + np.exp(((u - WIDTH / 2) / 2 + np.sqrt(3) / 2 * (v - HEIGHT / 2)) / 8))
    calibration = calibrate_board([image * (1 - 0.6 * in_shadow)])
    assert calibration.board == CHESS
    assert off_mm(calibration, view).max() < 0.05


@pytest.mark.parametrize(
    ("image", "board", "status"),
    [
        (lambda: shot(BOARDS["charuco_letter_a4"], px_per_mm=2.6)[1], CHARUCO, "wrong-board"),
        (lambda: shot(parse_board("chessboard:9x8:8"))[1], None, "wrong-board"),
        (lambda: shot(parse_board("chessboard:9x8:8"))[1], CHESS, "wrong-board"),
        (lambda: shot(CHESS, center=(75.0, 70.0))[1], CHESS, "wrong-board"),
        (glaring_chessboard, CHESS, "no-board"),
        (mirrored, CHARUCO, "no-board"),
        (lambda: np.full((HEIGHT, WIDTH), 30, np.uint8), None, "no-board"),
        (lambda: shot(CHARUCO, center=(400.0, 40.0))[1], CHARUCO, "no-board"),
    ],
)
def test_picture_without_the_expected_board_is_rejected(image, board, status):
    with pytest.raises(CannotMeasure) as error:
        calibrate_board([image()], board)
    assert error.value.status in (status, "wrong-board")


@pytest.mark.parametrize("board", [None, CHARUCO, CHESS])
def test_picture_too_small_for_a_board_shows_no_board(board):
    with pytest.raises(CannotMeasure, match="50 × 50 px is too small") as error:
        calibrate_board([np.zeros((50, 50), np.uint8)], board)
    assert error.value.status == "no-board"
    with pytest.raises(CannotMeasure, match="no-target"):
        calibrate_imaging_plane([np.zeros((50, 50), np.uint8)])


def test_bent_board_is_rejected():
    _, image = shot(CHARUCO)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    bent = cv2.remap(image, u, v + 8 * np.sin(u / 30), cv2.INTER_LINEAR)
    with pytest.raises(CannotMeasure, match="wrong-board"):
        calibrate_board([bent])


def test_content_of_the_picture_is_recognised():
    rng = np.random.default_rng(2)
    target = Target()
    view = PosedView.at((40.0, 40.0), 5.5)
    picture = render_target(target, view, TargetLook(), rng)
    assert isinstance(calibrate_imaging_plane([picture], target.unit_mm), PlaneCalibration)
    for board in (CHARUCO, CHESS, BOARDS["charuco_letter_a4"]):
        scale = 5.0 if board.square_mm == 8.0 else 2.6
        calibration = calibrate_imaging_plane([shot(board, px_per_mm=scale)[1]], target.unit_mm)
        assert isinstance(calibration, BoardCalibration)
        assert calibration.board == board


@pytest.mark.parametrize("seed", range(4))
def test_laser_dots_are_no_chessboard(seed: int):
    reflections = trace(spherical_cap(6.5, 0.3), EXACT.rig)
    frame = render(reflections, VIEW, Look(), np.random.default_rng(seed))
    with pytest.raises(CannotMeasure) as error:
        calibrate_imaging_plane([frame.image])
    assert error.value.status == "no-target"
    with pytest.raises(CannotMeasure) as error:
        calibrate_board([frame.image])
    assert error.value.status == "no-board"


def test_known_lens_straightens_the_target():
    rng, target = np.random.default_rng(2), Target()
    view = PosedView.at((36.0, 36.0), 6.2, turned_deg=(0, 0, 0.6), lens=lens(-1.0))
    picture = render_target(target, view, TargetLook(), rng)
    known = calibrated(CHARUCO)[1].image_calibration.lens
    with_lens = calibrate_imaging_plane([picture], target.unit_mm, lens=known)
    without = calibrate_imaging_plane([picture], target.unit_mm)
    assert off_mm(with_lens, view).max() < 0.4 * off_mm(without, view).max()


def test_setup_keys_are_those_of_a_setup_file():
    keys = calibrated(CHARUCO)[1].setup_keys
    for section, values in keys.items():
        assert set(values) <= set(SECTIONS[section])
        assert all(SECTIONS[section][k].accepts(v) for k, v in values.items() if v is not None)


def test_square_scales_the_plane():
    _, calibration = calibrated(CHARUCO, 0.0)
    larger = calibration.with_square(8.4)
    assert larger.px_per_mm[0] == pytest.approx(calibration.px_per_mm[0] * 8.0 / 8.4)
    assert larger.distortion_percent == pytest.approx(calibration.distortion_percent)


@pytest.mark.parametrize(
    "text",
    ["", "charuco", "charuco:3x9:8", "charuco:9x9:0", "charuco:60x60:8", "chessboard:9x9:8",
     "charuco:9x9:8:NONE:0", "other:9x8:8", "charuco:9x9:8:4X4_50:40"],
)  # fmt: skip
def test_impossible_boards_are_rejected(text):
    with pytest.raises(ValueError, match=r"."):
        parse_board(text)
