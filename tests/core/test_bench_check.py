"""The bench check: the errors of a simulated bench are found from pictures of known mirrors."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from labapp.config.bench_check import changed_since_check
from labapp.config.mirror_text import mirror_text, parse_mirror
from labapp.config.setup import checked_setup, parse_setup, unchecked_setup
from labapp.core.bench_check.adjustment import adjust
from labapp.core.bench_check.check import REASONS, BenchCheck, check_bench
from labapp.core.bench_check.forecast import blind_spots, forecast
from labapp.core.bench_check.labelling import MirrorDots, label_picture, sighting_of
from labapp.core.bench_check.mirrors import Ball, Cap, Mirror, Plate, landing_points, placed
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.geometry.rig import DotPattern, Rig
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.core.images.find_dots import DotSettings, find_mirror_dots
from labapp.core.matching.observation import Observation
from labapp.core.schemes import fit
from labapp.core.surface.measures import measure_surface
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import PoolSurface, exact_match, trace
from labapp.simulation.pools import spherical_cap
from labapp.simulation.render import Look, render
from tests.mirrors import BallMirror, FlatMirror
from tests.scenes import as_dots
from tests.simulated_benches import FOCAL_PX, BenchErrors, SimulatedBench, draw_bench

SHAPE = (640, 480)
VIEW = CameraView.rolled((0.74, 558.26), 4.7)
TEXT = f"""
[laser]
projection_angle_deg = 31.14   # by protractor
distance_mm = 31.48
[pattern]
rows = 19
columns = 19
inter_beam_angle_deg = 0.77
[electrode]
height_mm = 500.0
[imaging_plane]
distance_mm = 50.0
s_mm = 45.0
h_mm = 3.0
width_mm = 101.6
height_mm = 101.6
[image_calibration]
origin_px = {list(VIEW.origin_px)}
x_axis_px = {list(VIEW.x_axis_px)}
x_axis_mm = {VIEW.x_axis_mm}
z_axis_px = {list(VIEW.z_axis_px)}
z_axis_mm = {VIEW.z_axis_mm}
"""
SETUP = parse_setup(TEXT, "setup.toml")
BENCH, RIG, CALIBRATION = SETUP.bench, SETUP.rig, SETUP.calibration
EXACT = SimulatedBench(replace(RIG, uncertainty=None), VIEW)


def picture(
    mirror: Mirror,
    surface: PoolSurface,
    bench: SimulatedBench,
    rng: np.random.Generator,
    *,
    missing: float = 0.0,
    false: int = 0,
) -> tuple[MirrorDots, np.ndarray]:
    """Return a mirror's picture, and the ray of each dot, counted from 0 (−1 for false dots)."""
    reflections = trace(surface, bench.rig)
    image_px = bench.view.to_image(reflections.plane_mm)
    shown = reflections.visible & ((image_px > 3) & (image_px < [476, 636])).all(axis=-1)
    shown &= rng.random(shown.shape) >= missing
    dots = image_px[shown] + rng.normal(0, 0.12, (int(shown.sum()), 2))
    dots = np.vstack([dots, rng.uniform(10, [470, 630], (false, 2))])
    ray = np.vstack([np.argwhere(shown), np.full((false, 2), -1)])
    order = rng.permutation(len(dots))
    return MirrorDots(mirror.name, mirror, as_dots(dots[order], 0.12), SHAPE), ray[order]


def check_of(bench: SimulatedBench, free: tuple[str, ...] = ()) -> BenchCheck:
    """Return the check of a bench with a plate and a thumb tack."""
    rng = np.random.default_rng(9)
    tack = Cap(9.75, 0.91), spherical_cap(9.75, 0.91, (0.2, -0.1))
    pairs = [(Plate(), FlatMirror(0.01, 0.001, -0.001)), tack]
    return check_bench([picture(*each, bench, rng)[0] for each in pairs], BENCH, list(free))


@pytest.mark.parametrize(
    ("mirror", "surface"),
    [
        (Plate(2.0), FlatMirror(2.0)),
        (Cap(9.75, 0.91), spherical_cap(9.75, 0.91)),
        (Ball(10.0, 0.9), BallMirror(10.0, 0.9)),
    ],
    ids=["plate", "cap", "ball"],
)
def test_landing_points_agree_with_the_simulation(mirror: Mirror, surface: PoolSurface):
    true = trace(surface, EXACT.rig)
    plane, hit = landing_points(mirror, mirror.pose, RIG)
    assert true.hit.sum() > 50
    np.testing.assert_array_equal(hit & true.hit, true.hit & np.isfinite(true.plane_mm[..., 0]))
    both = hit & true.hit
    np.testing.assert_allclose(plane[both], true.plane_mm[both], atol=1e-5)


@pytest.mark.parametrize("top_mm", [0.9, 10.0])
def test_ball_is_placed_where_the_beam_axis_meets_its_top(top_mm: float):
    laser = replace(RIG.laser, azimuth_deg=5.0, aim_x_mm=0.5)
    rig = replace(RIG, laser=laser)
    ball = placed(Ball(10.0, top_mm), rig)
    way = ball.pose[:3] - laser.position_mm
    np.testing.assert_allclose(way / np.linalg.norm(way), laser.axes[0], atol=1e-12)
    assert placed(Plate(2.0), rig) == Plate(2.0)
    assert len(forecast(rig, {"a ball": (ball,)})) == 2


@pytest.mark.parametrize("seed", range(3))
def test_plate_rays_are_labelled_on_a_misaligned_bench(seed: int):
    rng = np.random.default_rng([5, seed])
    bench = draw_bench(RIG, VIEW, BenchErrors(), rng)
    plate, ray = picture(Plate(), FlatMirror(), bench, rng, missing=0.05, false=8)
    labels = label_picture(plate, BENCH).labels
    labelled = np.argwhere(labels >= 0)
    true_ray = ray[labels[tuple(labelled.T)]]
    assert len(labelled) > 0.97 * (ray[:, 0] >= 0).sum()
    wrong = (true_ray != labelled).any(axis=-1) & (true_ray[:, 0] >= 0)
    assert not wrong.any()


def test_labelling_fails_without_the_reference_hole():
    rng = np.random.default_rng(1)
    full, ray = picture(Cap(9.75, 0.91), spherical_cap(9.75, 0.91), EXACT, rng)
    above_hole = ray[:, 0] > 10  # only rows above the hole
    dots = as_dots(full.dots.image_px[above_hole], 0.12)
    with pytest.raises(CannotMeasure) as error:
        label_picture(replace(full, dots=dots), BENCH)
    assert error.value.status in ("no-reference", "ambiguous-rows", "no-match")


@pytest.mark.slow
def test_errors_of_the_adjusted_bench_match_the_covariance():
    """Over 12 benches, the mean χ² of the offsets' errors equals the degrees of freedom."""
    chi_square = []
    errors = BenchErrors(distortion=0.0, point_px=0.0)
    uncertainty = RIG.uncertainty
    assert uncertainty is not None
    calibration_keys = [k for key, k in INDEX.items() if key.startswith(("image_cal", "camera"))]
    covariance = uncertainty.covariance.copy()
    covariance[calibration_keys] = 0.0
    covariance[:, calibration_keys] = 0.0
    rig = replace(RIG, uncertainty=replace(uncertainty, covariance=covariance))
    for seed in range(12):
        rng = np.random.default_rng([8, seed])
        bench = draw_bench(rig, VIEW, errors, rng)
        plate, ray = picture(Plate(tilt_sigma_deg=1e-3), FlatMirror(), bench, rng)
        observed = Observation.of(plate.dots, Bench(rig, CALIBRATION), SHAPE)
        labels = np.full((19, 19), -1)
        labels[tuple(ray.T)] = np.arange(len(ray))
        adjustment = adjust(rig, [sighting_of(observed, plate.mirror, labels)])
        error = adjustment.offset - true_offsets(bench.rig)
        chi_square.append(error @ np.linalg.pinv(adjustment.covariance, rcond=1e-10) @ error)
    assert 9.0 < np.mean(chi_square) < 17.0  # 13 quantities


def true_offsets(true: Rig) -> np.ndarray:
    """Return the true offsets of a bench from the setup, without those of its picture."""
    offsets = np.zeros(len(QUANTITIES))
    for part in ("laser", "pattern"):
        for key, k in INDEX.items():
            section, _, name = key.partition(".")
            if section == part:
                offsets[k] = getattr(getattr(true, part), name) - getattr(getattr(RIG, part), name)
    first = INDEX["imaging_plane.distance_mm"]
    plane, nominal = true.imaging_plane, RIG.imaging_plane
    offsets[first : first + 3] = (plane.origin_mm - nominal.origin_mm)[[1, 0, 2]] * [-1, -1, 1]
    offsets[first + 3 : first + 6] = np.subtract(plane.angles_deg, nominal.angles_deg)
    return offsets


@pytest.mark.slow
def test_check_in_setup_file_is_valid_until_a_value_changes():
    bench = draw_bench(RIG, VIEW, BenchErrors(), np.random.default_rng(2))
    check = check_of(bench)
    assert check.status == "ok"
    assert check.verdict == "noise-like"
    text = checked_setup(TEXT, "setup.toml", check, "2026-11-24T12:00:00+00:00")
    section = tomllib.loads(text)["bench_check"]
    assert section["free"] == []
    assert section["mirrors"] == ["plate:0+-0.02", "cap:9.75+-0.02:0.91+-0.005"]
    checked = parse_setup(text, "setup.toml")
    uncertainty = checked.rig.uncertainty
    assert uncertainty is not None
    assert uncertainty.status == "checked"
    np.testing.assert_allclose(uncertainty.covariance, check.adjustment.covariance, atol=1e-8)
    places = np.array([[100.0, 120.0], [400.0, 300.0]])
    np.testing.assert_allclose(
        checked.calibration.to_plane(places), check.calibration.to_plane(places), atol=1e-9
    )
    np.testing.assert_allclose(
        checked.calibration.to_image(checked.calibration.to_plane(places)), places, atol=1e-6
    )
    moved = text.replace("width_mm = 101.6", "width_mm = 101.7", 1)
    farther = re.sub("(?m)^x_axis_mm = .*$", "x_axis_mm = 69.95", text)
    for changed in (moved, farther):
        again = parse_setup(changed, "setup.toml").rig.uncertainty
        assert again is not None
        assert again.status == "entered"
        assert changed_since_check(tomllib.loads(changed))
    unchecked = parse_setup(unchecked_setup(text, "setup.toml"), "setup.toml")
    assert unchecked.rig.laser == RIG.laser
    assert unchecked.calibration.lens is None


@pytest.mark.parametrize("view", [[[-1, 0], [0, 1]], [[-1, 0], [0, -1]], [[0, 1], [1, 0]]], ids=str)
def test_plate_is_labelled_if_the_camera_is_mirrored_or_turned(view: list[list[int]]) -> None:
    usual, ray = picture(Plate(), FlatMirror(), EXACT, np.random.default_rng(3))
    to_seen = np.eye(3)
    to_seen[:2, :2], to_seen[:2, 2] = view, np.negative(view).clip(0).sum(axis=1) * 640
    seen = usual.dots.image_px @ to_seen[:2, :2].T + to_seen[:2, 2]
    plate = MirrorDots("plate", Plate(), as_dots(seen, 0.12), (640, 640))
    calibration = ImageCalibration(CALIBRATION.matrix @ np.linalg.inv(to_seen))
    labels = label_picture(plate, Bench(RIG, calibration)).labels
    assert labels[tuple(ray.T)].tolist() == list(range(len(ray)))


@pytest.mark.slow
def test_written_setup_is_the_adjusted_one():
    """The setup has a lens, and the picture is shifted; residuals are those of the adjustment."""
    middle = SHAPE[1] / 2, SHAPE[0] / 2
    keys = {"focal_px": [FOCAL_PX] * 2, "center_px": list(middle), "distortion": [-0.5, 0, 0, 0, 0]}
    written = "".join(f"{key} = {value}\n" for key, value in keys.items())
    text = TEXT + "[camera_lens]\n" + written
    lens_px = Lens((FOCAL_PX, FOCAL_PX), middle, (-0.5, 0.0, 0.0, 0.0, 0.0))
    setup, rng = parse_setup(text, "setup.toml"), np.random.default_rng(3)
    reflections = trace(FlatMirror(), EXACT.rig)
    matrix = np.linalg.inv(np.array([[1, 0, 12], [0, 1, -7], [0, 0, 1]]) @ CALIBRATION.from_plane)
    ideal = ImageCalibration(matrix, lens_px)
    image_px = ideal.to_image(reflections.plane_mm[reflections.visible])
    dots = as_dots(image_px + rng.normal(0, 0.12, image_px.shape), 0.12)
    plate = MirrorDots("plate", Plate(), dots, SHAPE)
    check = check_bench([plate], setup.bench, ["picture.u", "picture.v"])
    assert check.status == "ok"
    read = parse_setup(checked_setup(text, "setup.toml", check, "2026-11-24T12:00:00+00:00"), "")
    (result,) = check.pictures
    computed, _ = landing_points(
        Plate(), check.adjustment.poses[0], read.rig, tuple(result.ray.T - 1)
    )
    residual = read.calibration.to_plane(dots.image_px[result.dot]) - computed
    np.testing.assert_allclose(residual, result.residual_mm, atol=1e-4)


@pytest.mark.slow
def test_quantity_far_off_is_named_and_corrected_when_free():
    laser = replace(RIG.laser, distance_mm=RIG.laser.distance_mm / 0.8)
    check = check_of(SimulatedBench(replace(EXACT.rig, laser=laser), VIEW))
    assert check.status == "quantity-off"
    assert [one.key for one in check.suspects] == ["laser.distance_mm"]
    uncertainty = check.rig.uncertainty
    assert uncertainty is not None
    assert uncertainty.status != "checked"
    again = check_of(SimulatedBench(replace(EXACT.rig, laser=laser), VIEW), ("laser.distance_mm",))
    assert again.status == "ok"
    assert again.rig.laser.distance_mm == pytest.approx(laser.distance_mm, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("truth", [0.91, 1.0])
def test_check_fails_where_a_mirror_contradicts_its_known_size(truth: float):
    rng = np.random.default_rng(9)
    pairs = [(Plate(), FlatMirror()), (Cap(9.75, 0.91), spherical_cap(9.75, truth, (0.2, -0.1)))]
    check = check_bench([picture(*each, EXACT, rng)[0] for each in pairs], BENCH)
    radius, height = check.pictures[1].sizes
    assert check.status == ("ok" if truth == 0.91 else "size-off")
    assert radius.is_contradicted == (truth != 0.91)
    assert height.independent_mm == pytest.approx(truth, abs=3 * height.independent_sigma_mm)
    uncertainty = check.rig.uncertainty
    assert uncertainty is not None
    assert (uncertainty.status == "checked") == (truth == 0.91)


@pytest.mark.slow
@pytest.mark.parametrize("absent", [[9, 10], [10, 11]])
def test_labels_a_row_off_are_reported(absent: list[int]):
    """The adjustment absorbs them, with changes of about half a degree and half a millimetre."""
    angle = "inter_beam_angle_deg = 0.77\n"
    setup = parse_setup(TEXT.replace(angle, f"{angle}absent = [{absent}]\n"), "setup.toml")
    rng = np.random.default_rng(0)
    pictures = [picture(Plate(height), FlatMirror(height), EXACT, rng)[0] for height in (0.0, 2.0)]
    check = check_bench(pictures, setup.bench)
    assert check.status == "row-slipped"
    assert all(abs(one.after - one.before) <= 2.0 * one.before_sigma for one in check.changes)


class BowedPattern(DotPattern):
    """A different lens, whose rows and columns are bowed by 4 % at the edges."""

    @property
    def tangents(self) -> np.ndarray:
        """Tangents of the rays to the beam axis."""
        ideal = super().tangents
        return ideal * (
            1 + 0.04 * (ideal**2).sum(axis=-1, keepdims=True) / np.abs(ideal).max() ** 2
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plate", "pattern", "verdict"),
    [
        (FlatMirror(bend_per_mm=(0.001, -0.0008)), RIG.pattern, "plate-not-flat"),
        (FlatMirror(), BowedPattern(), "wrong-lens"),
    ],
    ids=["plate", "lens"],
)
def test_model_errors_are_named(plate: FlatMirror, pattern: DotPattern, verdict: str):
    rng = np.random.default_rng(4)
    bench = replace(EXACT, rig=replace(EXACT.rig, pattern=pattern))
    pictures = [
        picture(Plate(), plate, bench, rng)[0],
        picture(Plate(2.0), FlatMirror(2.0), bench, rng)[0],
    ]
    check = check_bench(pictures, BENCH)
    assert check.status == check.verdict == verdict
    uncertainty = check.rig.uncertainty
    assert uncertainty is not None
    assert uncertainty.status != "checked"


@pytest.mark.slow
@pytest.mark.parametrize("bend_per_mm", [(0.00044, 0.0), (0.00044, -0.00044)])
def test_plate_0_05_mm_from_flat_is_reported(bend_per_mm: tuple[float, float]):
    """Over 30 mm. It also biases the thumb tack's height, which may be named first."""
    rng = np.random.default_rng(4)
    tack = Cap(9.75, 0.91), spherical_cap(9.75, 0.91, (0.2, -0.1))
    pairs = [(Plate(), FlatMirror(bend_per_mm=bend_per_mm)), tack]
    check = check_bench([picture(*each, EXACT, rng)[0] for each in pairs], BENCH)
    assert check.status in ("plate-not-flat", "size-off")
    assert REASONS["plate-not-flat"] in check.reason


@pytest.mark.slow
@pytest.mark.parametrize("height_mm", [1.5, 2.3])
def test_wrong_plate_height_is_reported(height_mm: float):
    rng = np.random.default_rng(4)
    pairs = [(Plate(), FlatMirror()), (Plate(2.0), FlatMirror(height_mm))]
    check = check_bench([picture(*each, EXACT, rng)[0] for each in pairs], BENCH)
    assert check.status == "size-off"
    assert "height in plate at 2 mm" in check.reason
    size = check.pictures[1].sizes[0]
    assert size.independent_mm == pytest.approx(height_mm, abs=3 * size.independent_sigma_mm)


@pytest.mark.slow
def test_check_fails_with_a_strongly_bent_plate():
    rng = np.random.default_rng(4)
    bent = FlatMirror(bend_per_mm=(0.004, -0.003))
    pictures = [
        picture(Plate(), bent, EXACT, rng)[0],
        picture(Plate(2.0), FlatMirror(2.0), EXACT, rng)[0],
    ]
    assert check_bench(pictures, BENCH).status != "ok"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ball", "sunk ball", "thumb tack"])
@pytest.mark.parametrize("seed", range(2))
def test_single_mirror_in_a_rendered_picture_is_measured(kind: str, seed: int):
    rng = np.random.default_rng([33, seed])
    bench = draw_bench(RIG, VIEW, BenchErrors(), rng)
    x, y = rng.uniform(-0.6, 0.6, 2)
    steep = np.tan(np.radians(RIG.laser.projection_angle_deg))
    mirror, surface = {
        "ball": (Ball(10.0, 10.0), BallMirror(10.0, 10.0, (x, 10.0 / steep + y))),
        "sunk ball": (Ball(10.0, 2.0), BallMirror(10.0, 2.0, (x, 2.0 / steep + y))),
        "thumb tack": (Cap(9.75, 0.91), spherical_cap(9.75, 0.91, (x, y))),
    }[kind]
    image = render(trace(surface, bench.rig), bench.view, Look(glow=0.0), rng).image
    dots = find_mirror_dots(image, DotSettings())
    check = check_bench([MirrorDots(kind, mirror, dots, image.shape)], BENCH)
    assert check.status == "ok"
    for size in check.pictures[0].sizes:
        assert size.measured_mm == pytest.approx(size.known_mm, rel=0.01)
        assert size.independent_sigma_mm > 3 * size.sigma_mm
        assert not size.is_contradicted


@pytest.mark.slow
@pytest.mark.parametrize("level_deg", [0.1, 0.0])
def test_dot_noise_is_not_mistaken_for_a_wrong_scale(level_deg: float):
    """Residuals shrink with the plane's scale, which once favoured smaller scales."""
    plate = Plate(tilt_sigma_deg=level_deg)
    rng = np.random.default_rng(0)
    reflections = trace(FlatMirror(), EXACT.rig)
    image_px = VIEW.to_image(reflections.plane_mm)[reflections.visible]
    dots = as_dots(image_px + rng.normal(0, 0.2, image_px.shape), 0.2)
    check = check_bench([MirrorDots("plate", plate, dots, SHAPE)], BENCH)
    assert (check.status, check.suspects) == ("ok", ())


def test_forecast_uncertainty_falls_with_each_picture():
    sigma_mm = {one.name: one.setup_sigma_mm for one in forecast(RIG)}
    initial, plate = sigma_mm["as it is"], sigma_mm["plate at 0 mm"]
    assert 0.03 < initial / 0.3 < 0.1
    assert plate < 0.7 * initial
    assert sigma_mm["plate at 0 mm, thumb tack"] < 0.6 * plate


@pytest.mark.parametrize(
    ("text", "mirror"),
    [
        ("plate:0", Plate(0.0)),
        ("plate:2+-0.01", Plate(2.0, 0.01)),
        ("plate:2:0.03", Plate(2.0, tilt_sigma_deg=0.03)),
        ("plate:0+-0.01:0.05", Plate(0.0, 0.01, 0.05)),
        ("cap:9.75±0.05:0.91", Cap(9.75, 0.91, 0.05)),
        ("ball:10:1.2", Ball(10.0, 1.2)),
        ("ball:10", Ball(10.0, 10.0)),
    ],
)
def test_mirror_text_round_trip(text: str, mirror: Mirror):
    assert parse_mirror(text) == mirror
    written = parse_mirror(mirror_text(mirror))
    np.testing.assert_allclose(written.pose, mirror.pose)
    np.testing.assert_allclose(written.sigma, mirror.sigma)
    assert type(written) is type(mirror)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "plate",
        "plate:nan",
        "cap:5:4",
        "ball:-1",
        "ball:10:30",
        "tack:1:2",
        "plate:1+-0",
        "plate:0:0",
        "plate:0:0.1+-0.1",
        "plate:0:free",
        "plate:0:20",
    ],
)
def test_impossible_mirrors_are_rejected(text: str):
    with pytest.raises(InputError):
        parse_mirror(text)


@pytest.mark.slow
def test_blind_spot_of_a_single_plate_is_reported():
    """A plate 0.5 mm too high is mistaken for a misaligned bench; with two plates it is not."""
    rng = np.random.default_rng(4)
    correct, too_high = (picture(Plate(), FlatMirror(z), EXACT, rng)[0] for z in (0.0, 0.5))
    second = picture(Plate(2.0), FlatMirror(2.0), EXACT, rng)[0]
    biased = check_bench([too_high], BENCH)
    assert biased.status == "ok"
    pool = spherical_cap(6.7, 0.3)
    match = exact_match(trace(pool, EXACT.rig))
    plane_mm = biased.calibration.to_plane(EXACT.view.to_image(match.plane_mm))
    match = replace(match, plane_mm=plane_mm)
    measures = measure_surface(fit.reconstruct(match, biased.rig, FitSettings()), match, biased.rig)
    error = abs(measures.height_mm - pool.peak_mm)
    assert error > measures.height_sigma_mm
    (of_biased,), (of_correct,) = map(blind_spots, (biased, check_bench([correct], BENCH)))
    assert of_biased.picture == of_correct.picture == correct.name
    assert 0.5 < of_biased.noticed_mm < 2.0
    assert error < of_correct.pool_mm < 3 * error
    assert check_bench([too_high, second], BENCH).status == "size-off"
    assert blind_spots(replace(biased, status="size-off")) == ()
    assert blind_spots(check_bench([correct, second], BENCH)) == ()
