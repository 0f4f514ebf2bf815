"""§5.1: O′ and both axes in calibration pictures of known truth; wrong pictures are rejected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from labapp.core.calibration import plane_calibration
from labapp.core.calibration.plane_calibration import (
    PlaneCalibration,
    calibrate_plane,
)
from labapp.core.calibration.target_marks import thinned
from labapp.core.values import CannotMeasure


@dataclass(frozen=True)
class Scene:
    """A picture of a target, drawn independently of the package from distances to its edges."""

    roll_deg: float = 3.0
    unit_px: float = 34.0
    origin: tuple[float, float] = (60.3, 560.7)
    shape: tuple[int, int] = (640, 480)
    light: float = 32.0
    dark: float = 14.0
    noise: float = 1.3
    vignetting: float = 0.35
    slope: float = 0.2
    x_units: tuple[float, float] = (1.0, 10.0)
    z_units: tuple[float, float] = (1.0, 4.0)
    squeeze: float = 1.0
    shear_deg: float = 0.0
    has_dot: bool = True
    has_x: bool = True
    has_z: bool = True
    bench: float | None = None
    """Grey level around the plane, 1.1 units from O′, as on the printed target; None: no bench."""
    seed: int = 0

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of one unit along O′X′ and O′Z′."""
        x, z = np.radians(self.roll_deg), np.radians(self.roll_deg + self.shear_deg)
        along_x = self.unit_px * np.array([np.cos(x), -np.sin(x)])
        return along_x, self.squeeze * self.unit_px * np.array([-np.sin(z), -np.cos(z)])

    @property
    def truth(self) -> np.ndarray:
        """(u, v) of O′, (5.5, 0) and (0, 2.5), shape (3, 2)."""
        origin = np.array(self.origin)
        return np.array([origin, origin + 5.5 * self.axes[0], origin + 2.5 * self.axes[1]])

    def render(self) -> np.ndarray:
        v, u = np.mgrid[: self.shape[0], : self.shape[1]].astype(float)
        place = np.stack([u, v], -1) - self.origin
        x, z = np.moveaxis(place @ np.linalg.inv(np.stack(self.axes)), -1, 0)
        bar, dot, flag_out = 0.13, 0.32, 0.19

        def box(x0: float, x1: float, z0: float, z1: float) -> np.ndarray:
            return np.maximum.reduce([x0 - x, x - x1, z0 - z, z - z1])

        outside = [np.full(self.shape, np.inf)]
        if self.has_dot:
            outside.append(np.hypot(x, z) - dot)
        if self.has_x:
            outside.append(box(*self.x_units, -bar, bar))
            # Flags on one side only: they would bias a plain centroid.
            outside += [box(n - 0.03, n + 0.03, 0, bar + flag_out) for n in range(2, 10)]
        if self.has_z:
            outside.append(box(-bar, bar, *self.z_units))
            outside += [box(0, bar + flag_out, n - 0.03, n + 0.03) for n in range(2, 4)]
        distance_px = np.minimum.reduce(outside) * self.unit_px
        ink = np.clip(0.5 - distance_px / 2.0, 0.0, 1.0)
        light = np.full(self.shape, self.light)
        if self.bench is not None:
            light[np.minimum(x, z) < -1.1] = self.bench
        across, down = (np.linspace(-1, 1, n) for n in self.shape[::-1])
        fall = 1 - self.vignetting * (across**2 + down[:, None] ** 2) / 2
        fall = fall + self.slope * across / 2
        rng = np.random.default_rng(self.seed)
        grey = (light + (self.dark - light) * ink) * fall
        grey += rng.normal(0, self.noise, grey.shape)
        grey.flat[rng.integers(0, grey.size, 60)] = rng.choice([0.0, 255.0], 60)
        return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def points(calibration: PlaneCalibration) -> np.ndarray:
    return np.array([calibration.origin_px, calibration.x_axis_px, calibration.z_axis_px])


def random_scene(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    light = rng.uniform(25, 220)
    contrast = rng.uniform(0.35, 0.9)
    roll = float(rng.uniform(-10, 10))
    return Scene(
        roll_deg=roll,
        unit_px=rng.uniform(26, 33),
        origin=(rng.uniform(60, 80) + max(roll, 0) * 3, rng.uniform(500, 530)),
        light=light,
        dark=light * (1 - contrast),
        noise=rng.uniform(0.02, 0.12) * light * contrast,
        vignetting=rng.uniform(0, 0.6),
        slope=rng.uniform(-0.4, 0.4),
        seed=seed,
    )


def test_points_of_eq_5_6_in_a_dim_picture() -> None:
    scene = Scene()
    calibration = calibrate_plane(scene.render())
    assert np.abs(points(calibration) - scene.truth).max() < 0.3
    assert calibration.x_axis_mm == pytest.approx(34.925)
    assert calibration.z_axis_mm == pytest.approx(15.875)
    assert calibration.px_per_mm == pytest.approx((34 / 6.35, 34 / 6.35), rel=5e-3)
    assert calibration.angle_deg == pytest.approx(90.0, abs=0.3)
    assert 12 < calibration.threshold < 32
    assert (len(calibration.marks), calibration.model) == (15, "affine")
    plane = calibration.image_calibration.to_plane(scene.truth)
    assert plane == pytest.approx(np.array([[0, 0], [34.925, 0], [0, 15.875]]), abs=0.075)


@pytest.mark.slow
def test_random_pictures_are_calibrated_within_half_a_pixel() -> None:
    errors, ratios = [], []
    for seed in range(15):
        scene = random_scene(seed)
        calibration = calibrate_plane(scene.render())
        errors.append(points(calibration) - scene.truth)
        ratios.append(errors[-1] / np.array(calibration.sigma_px)[:, None])
    assert np.hypot(*np.moveaxis(errors, -1, 0)).max() < 0.5
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 1.3


@pytest.mark.parametrize("kind", ["uint16", "colour", "alpha", "float"])
@pytest.mark.slow
def test_any_kind_of_picture_gives_the_same_points(kind: str) -> None:
    grey = Scene().render()
    image = {
        "uint16": grey.astype(np.uint16) * 180,
        "colour": cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR),
        "alpha": cv2.cvtColor(grey, cv2.COLOR_GRAY2BGRA),
        "float": grey / 255.0,
    }[kind]
    assert points(calibrate_plane(image)) == pytest.approx(points(calibrate_plane(grey)), abs=0.02)


def test_unit_scales_the_axes() -> None:
    calibration = calibrate_plane(Scene().render(), unit_mm=6.35)
    assert calibration.x_axis_mm == pytest.approx(5.5 * 6.35)
    assert calibration.px_per_mm[0] == pytest.approx(34 / 6.35, rel=5e-3)


def test_hidden_flag_is_not_a_mark() -> None:
    scene = Scene(noise=0.5)
    image = scene.render().astype(float)
    along_x, along_z = scene.axes
    for begin, end in ((0.16, 0.5), (-0.16, -0.5)):
        ends = [scene.truth[0] + 6 * along_x + at * along_z for at in (begin, end)]
        places = [tuple(round(c) for c in place) for place in ends]
        cv2.line(image, *places, float(np.median(image)), 5)
    calibration = calibrate_plane(image)
    assert len(calibration.marks) == 14
    assert 6 * 6.35 not in [mark[0] for mark in calibration.marks]
    assert np.abs(points(calibration) - scene.truth).max() < 0.3


@pytest.mark.parametrize("unit_px", [12.0, 16.0, 20.0])
@pytest.mark.slow
def test_target_beside_a_dark_bench_is_found(unit_px: float) -> None:
    scene = Scene(3.0, unit_px, (160.0, 400.0), light=90.0, dark=20.0, slope=0.1, bench=2.0)
    assert np.abs(points(calibrate_plane(scene.render())) - scene.truth).max() < 0.3


@pytest.mark.slow
def test_bench_beside_the_plane_does_not_move_the_marks() -> None:
    scene = Scene(3.0, 16.0, (160.0, 400.0), light=150.0, dark=25.0, slope=0.6, bench=25.0)
    assert np.abs(points(calibrate_plane(scene.render())) - scene.truth).max() < 0.12


@pytest.mark.slow
def test_small_picture_is_calibrated() -> None:
    scene = Scene(2.0, 10.0, (30.3, 180.7), (220, 200), light=90.0, noise=2.0)
    assert np.abs(points(calibrate_plane(scene.render())) - scene.truth).max() < 0.5


@pytest.mark.slow
def test_marks_reduce_the_error_of_the_points() -> None:
    scenes = [random_scene(seed) for seed in range(20, 32)]
    errors, sigma = [], []
    for scene in scenes:
        calibration = calibrate_plane(scene.render())
        errors.append(calibration.points_px - scene.truth)
        sigma.append(np.sqrt(np.diag(calibration.points_covariance_px2)).reshape(3, 2))
    assert np.sqrt(np.mean(np.square(errors))) < 0.12
    assert 0.4 < np.sqrt(np.mean(np.square(np.array(errors) / sigma))) < 2.0


def test_uncertainty_of_points_is_propagated_to_scales_and_angle() -> None:
    square = PlaneCalibration(
        (50.0, 400.0), (380.0, 400.0), 55.0, (50.0, 250.0), 25.0, (0.1, 0.2, 0.3), 14.0
    )
    assert square.px_per_mm == pytest.approx((6.0, 6.0))
    at_origin = np.hypot(0.1 / 330, 0.1 / 150)
    angle = np.degrees(np.sqrt((0.2 / 330) ** 2 + (0.3 / 150) ** 2 + at_origin**2))
    expected = [np.hypot(0.1, 0.2) / 55, np.hypot(0.1, 0.3) / 25, angle]
    np.testing.assert_allclose(square.scales_and_angle_sigma, expected, rtol=1e-3)


def test_another_unit_also_scales_the_marks() -> None:
    calibration = calibrate_plane(Scene().render())
    scaled = calibration.with_scale(0.5)
    assert scaled.px_per_mm == pytest.approx([2 * scale for scale in calibration.px_per_mm])
    assert scaled.points_px == pytest.approx(calibration.points_px)
    assert scaled.model == calibration.model


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"has_dot": False}, "Three marks are expected"),
        ({"has_x": False}, "Three marks are expected"),
        ({"has_z": False}, "Three marks are expected"),
        ({"has_dot": False, "has_x": False, "has_z": False}, "Three marks are expected|no dark"),
        ({"unit_px": 45.0}, "runs out of the picture"),
        ({"x_units": (1.0, 9.0)}, "bar on O′X′ is .* px long"),
        ({"x_units": (1.5, 10.0)}, "bar on O′X′ is .* px long"),
        ({"z_units": (1.0, 3.6)}, "bar on O′Z′ is .* px long"),
        ({"squeeze": 0.7}, "scales disagree"),
        ({"roll_deg": 10.0, "shear_deg": -20.0}, "apart, which should be about 90"),
        ({"light": 14.0}, "Three marks are expected|no dark"),
    ],
)
@pytest.mark.slow
def test_picture_of_a_wrong_target_is_rejected(
    change: dict[str, object], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plane_calibration, "ANGLE_TOLERANCE_DEG", 15.0)
    scene = replace(Scene(), **change)
    with pytest.raises(CannotMeasure, match=words) as caught:
        calibrate_plane(scene.render())
    assert caught.value.status == "no-target"


@pytest.mark.parametrize("turn", ["mirrored", "upside down", "on its side"])
def test_turned_picture_is_rejected(turn: str) -> None:
    image = Scene().render()
    turned = {
        "mirrored": image[:, ::-1],
        "upside down": image[::-1],
        "on its side": np.rot90(image),
    }[turn]
    with pytest.raises(CannotMeasure, match="lower left of its bars"):
        calibrate_plane(turned)


@pytest.mark.slow
def test_partly_covered_bar_is_never_measured_wrong() -> None:
    scene = Scene(noise=0.5)
    along = scene.axes[0] / scene.unit_px
    for begin in (3.0, 7.0, 8.5, 9.4, 9.7):
        image = scene.render().astype(float)
        near, far = (
            np.round(scene.truth[0] + along * scene.unit_px * units) for units in (begin, 11)
        )
        ends = (tuple(int(c) for c in near), tuple(int(c) for c in far))
        cv2.line(image, *ends, float(np.median(image)), 24)
        try:
            calibration = calibrate_plane(image)
        except CannotMeasure:
            continue
        assert np.hypot(*(points(calibration) - scene.truth).T).max() < 3.0


@pytest.mark.parametrize("end", [4.12, 4.15])
@pytest.mark.slow
def test_tape_that_looks_like_the_end_of_a_bar_is_rejected(end: float) -> None:
    scene = Scene(roll_deg=0.0, light=90.0, dark=20.0, noise=0.5, vignetting=0.0, slope=0.0)
    image, (u, v) = scene.render(), scene.origin
    top, bottom = (round(v - units * scene.unit_px) for units in (end, 3.35))
    image[top:bottom, round(u) - 25 : round(u) + 25] = 45
    with pytest.raises(CannotMeasure, match="no-target"):
        calibrate_plane(image)


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_rejected(seed: int) -> None:
    noise = np.random.default_rng(seed).integers(0, 255, (640, 480)).astype(np.uint8)
    with pytest.raises(CannotMeasure, match="no-target"):
        calibrate_plane(noise)


def test_invalid_pictures_are_rejected() -> None:
    with pytest.raises(ValueError, match="a picture has shape"):
        calibrate_plane(np.zeros((4, 5, 6, 7)))
    with pytest.raises(ValueError, match="finite"):
        calibrate_plane(np.full((100, 100), np.nan))
    with pytest.raises(CannotMeasure, match="too small"):
        calibrate_plane(np.zeros((1, 1), np.uint8))
    with pytest.raises(CannotMeasure, match="no dark marks"):
        calibrate_plane(np.full((200, 200), 90, np.uint8))


def test_thinning_gives_a_centre_line_one_pixel_wide() -> None:
    mask = np.zeros((15, 60), bool)
    mask[4:11, 5:55] = True
    line = thinned(mask)
    assert not (line & ~mask).any()
    assert line.sum(axis=0).max() == 1
    v, u = np.nonzero(line)
    assert (v == 7).all()
    assert np.ptp(u) > 40
    assert u.mean() == pytest.approx(29.5, abs=1.0)


def test_thinning_never_removes_an_object() -> None:
    assert thinned(np.ones((2, 2), bool)).any()
    assert thinned(np.ones((1, 1), bool)).sum() == 1
