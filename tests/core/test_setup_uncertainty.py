"""Sensitivity of sizes to the bench: linear response compared with fits on perturbed benches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.config.setup import parse_setup, read_setup, updated_setup
from labapp.core.calibration.mark_fit import MarkFits
from labapp.core.calibration.plane_calibration import calibrate_plane
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.core.match import Match
from labapp.core.schemes import fit
from labapp.core.surface.boundary_trace import trace_boundary
from labapp.core.surface.measures import SIZES, measure_surface
from labapp.core.surface.pool_fit import FitSettings, FittedPool, normal_equations
from labapp.core.surface.setup_uncertainty import fit_changes, setup_changes
from labapp.core.surface.sizes import sizes_and_gradients
from labapp.core.surface.solver import REUSE_MM, normal_factor
from labapp.core.values import FloatArray
from labapp.simulation.calibration.target import Target, TargetLook, render_target
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg

SIZED = [0, 1, 2, 4, 5]
"""All sizes of a convex pool except its depth."""

SETUP = read_setup(Path(__file__).parents[2] / "sample_sessions" / "gtaw" / "setup.toml")
RIG, SETTINGS = SETUP.rig, FitSettings()
MATCH = exact_match(trace(egg(6.6, 3.0, 3.9, 0.33), RIG))


def changes(pool: FittedPool | None = None, match: Match = MATCH) -> FloatArray:
    pool = pool or fit.fit_surface(match, RIG, SETTINGS)
    basis, coefficients, points = pool.surface.basis, pool.surface.coefficients, pool.points_mm
    center = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    boundary, slope = trace_boundary(basis, coefficients, pool.level, center)
    gradient = sizes_and_gradients(basis, coefficients, pool.level, boundary, slope).gradient
    return setup_changes(match, RIG, pool, gradient)


def sizes_on(offset: FloatArray, seen: Match = MATCH) -> FloatArray:
    """Return the sizes from the same dots on a perturbed bench."""
    assert RIG.uncertainty is not None
    dots = moved_dots(seen.plane_mm, RIG, RIG.uncertainty.axes, offset)
    rig, match = moved_rig(RIG, offset), replace(seen, plane_mm=dots)
    size = measure_surface(fit.reconstruct(match, rig, SETTINGS), match, rig)
    return np.array([getattr(size, name) for name in SIZES])


@pytest.mark.parametrize(
    "key",
    [
        "laser.projection_angle_deg",
        "laser.distance_mm",
        "laser.azimuth_deg",
        "pattern.inter_beam_angle_deg",
        "pattern.rotation_deg",
        "imaging_plane.h_mm",
        "imaging_plane.roll_deg",
        "camera_lens.distortion_percent",
    ],
)
def test_changes_agree_with_fits_on_perturbed_benches(key: str) -> None:
    assert_changes_agree(key, MATCH)


@pytest.mark.parametrize("key", ["laser.projection_angle_deg", "imaging_plane.h_mm"])
def test_changes_include_a_rear_that_seems_lower(key: str) -> None:
    """On one of the perturbed benches the rear seems to lie 0.1 mm below the work piece."""
    assert_changes_agree(key, exact_match(trace(egg(7.0, 3.3, 4.0, 0.35), RIG)))


def assert_changes_agree(key: str, match: Match) -> None:
    """Compare the changes with fits on benches on which a quantity is off by ±σ."""
    assert RIG.uncertainty is not None
    offset = np.zeros(len(RIG.uncertainty.sigma))
    offset[INDEX[key]] = RIG.uncertainty.sigma[INDEX[key]]
    expected = (sizes_on(offset, match) - sizes_on(-offset, match)) / 2
    computed = changes(match=match)
    total = np.sqrt(np.sum(computed**2, axis=1))
    error = np.abs(computed[:, INDEX[key]] - expected)
    # A level estimated from scratch may respond differently to such a step.
    assert (error[SIZED] <= 0.35 * total[SIZED]).all()


def test_changes_do_not_depend_on_a_reused_factor() -> None:
    """Here the points have moved by the largest distance for which a factor is reused."""
    pool = fit.fit_surface(MATCH, RIG, SETTINGS)
    moved = pool.points_mm + REUSE_MM * np.sin(np.arange(pool.points_mm.size)).reshape(-1, 3)
    dots = MATCH.plane_mm, MATCH.plane_covariance_mm2
    basis = pool.surface.basis
    old = normal_equations(basis, RIG, moved, *dots, SETTINGS)
    factor = normal_factor(basis, old.stiffness, moved, old.weights)
    total = np.sqrt(np.sum(changes(pool) ** 2, axis=1))[SIZED]
    reused = replace(pool, factor=factor, inverse=None)
    outdated = np.sqrt(np.sum(changes(reused) ** 2, axis=1))[SIZED]
    assert outdated == pytest.approx(total, rel=1e-6)


def test_exact_bench_has_no_changes() -> None:
    rig, pool = replace(RIG, uncertainty=None), fit.fit_surface(MATCH, RIG, SETTINGS)
    gradient = np.ones((6, len(pool.surface.coefficients)))
    assert setup_changes(MATCH, rig, pool, gradient).shape == (6, 0)


@pytest.mark.parametrize("key", ["laser.azimuth_deg", "pattern.rotation_deg", "imaging_plane.s_mm"])
def test_fit_changes_agree_with_fits_on_perturbed_benches(key: str) -> None:
    """These quantities leave the largest residuals, which no surface absorbs."""
    assert RIG.uncertainty is not None
    offset = 0.1 * RIG.uncertainty.root[:, INDEX[key]]
    dots = MATCH.plane_mm, MATCH.plane_covariance_mm2
    pool = fit.fit_surface(MATCH, RIG, SETTINGS)
    residuals, coefficients = fit_changes(MATCH, RIG, pool)
    more, less = (
        fit.fit_surface(
            replace(MATCH, plane_mm=moved_dots(dots[0], RIG, RIG.uncertainty.axes, vector)),
            moved_rig(RIG, vector),
            SETTINGS,
        )
        for vector in (offset, -offset)
    )
    x, y = pool.points_mm[:, :2].T
    shape = pool.surface.basis.matrix(x, y) @ coefficients[:, INDEX[key]]  # the level is left out
    heights = more.surface.height(x, y) - less.surface.height(x, y)
    for change, difference in (
        (residuals[..., INDEX[key]], more.residual_mm - less.residual_mm),
        (shape - shape.mean(), heights - heights.mean()),
    ):
        assert np.linalg.norm(change - difference / 0.2) <= 0.1 * np.linalg.norm(difference / 0.2)


@pytest.mark.slow
@pytest.mark.parametrize("is_square", [True, False], ids=["camera square", "perspective open"])
def test_height_is_covered_with_a_plane_from_a_noisy_picture(
    is_square: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else is uncertain: the ± follows from the calibration's full covariance.

    That includes the perspective which the marks leave open, although this camera has none. If it
    is known to have none, the covariance is that of the chosen map, and the ± is neither too small
    nor too large.
    """
    if is_square:
        monkeypatch.setattr(MarkFits, "covariance_px2", covariance_of_chosen_map)
    view, pool, draws = CameraView.rolled(roll_deg=1.5), egg(6.6, 3.0, 3.9, 0.33), 50
    sections = {one.sigma_key.partition(".")[::2]: 0.0 for one in QUANTITIES}
    exact: dict[str, dict[str, object]] = {}
    for (section, key), sigma in sections.items():
        exact.setdefault(section, {})[key] = sigma
    exact = {name: keys for name, keys in exact.items() if name != "image_calibration"}
    axes = {"x_axis_mm_sigma": 0.0, "z_axis_mm_sigma": 0.0}
    clean = render_target(
        Target(), view, TargetLook(noise=0.0, specks=0), np.random.default_rng(0)
    ).astype(float)
    seen_px = view.to_image(MATCH.plane_mm)

    def height(text: str) -> FloatArray:
        """Return the height with a setup, and the setup's part of its ±."""
        setup = parse_setup(text, "setup.toml")
        match = exact_match(trace(pool, setup.rig))
        match = replace(match, plane_mm=setup.calibration.to_plane(seen_px))
        reconstruction = fit.reconstruct(match, setup.rig, SETTINGS)
        size = measure_surface(reconstruction, match, setup.rig)
        return np.array([size.height_mm, reconstruction.size_sigma_setup[2]])

    text = updated_setup(SETUP.text, "setup.toml", exact)
    truth = {
        name: getattr(view, name)
        for name in ("origin_px", "x_axis_px", "x_axis_mm", "z_axis_px", "z_axis_mm")
    }
    true, _ = height(updated_setup(text, "setup.toml", {"image_calibration": truth}))
    errors = []
    for n in range(draws):
        noise = np.random.default_rng([18, n]).normal(0.0, 2.5, clean.shape)
        calibration = calibrate_plane(np.clip(np.rint(clean + noise), 0, 255).astype(np.uint8))
        calibrated = calibration.setup_keys["image_calibration"] | axes
        height_mm, sigma = height(
            updated_setup(text, "setup.toml", {"image_calibration": calibrated})
        )
        errors.append((height_mm - true) / sigma)
    covered = np.mean(np.abs(errors) < 1.96)
    assert covered >= 0.92
    if is_square:
        assert covered <= 0.98
    else:
        assert np.sqrt(np.mean(np.square(errors))) > 0.2


def covariance_of_chosen_map(
    fits: MarkFits, used: ImageCalibration, plane_mm: FloatArray
) -> FloatArray:
    """Covariance of the map that is used, as if its kind were known."""
    return fits.of(fits.best).covariance_px2(plane_mm)
