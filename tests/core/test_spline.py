"""The spline basis, its roughness penalty, and the fit of slopes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.surface.solver import fit_slopes
from labapp.core.surface.spline import AT_ONCE, SplineBasis, SplineSurface
from labapp.core.values import FloatArray

LOW, HIGH = np.array([-3.0, -2.0]), np.array([2.0, 4.0])
BASIS = SplineBasis.over(LOW, HIGH, 1.3)


def places(count: int, seed: int = 0) -> FloatArray:
    """Return points within the rectangle, shape (count, 2)."""
    return np.random.default_rng(seed).uniform(LOW, HIGH, (count, 2))


def quadric(terms: FloatArray, xy: FloatArray) -> FloatArray:
    """Return z = a x + b y + c x² + d xy + e y², in the shape of the points."""
    x, y = xy.T
    return np.stack([x, y, x**2, x * y, y**2], axis=-1) @ terms


def quadric_slopes(terms: FloatArray, xy: FloatArray) -> FloatArray:
    a, b, c, d, e = terms
    x, y = xy.T
    return np.stack([a + 2 * c * x + d * y, b + d * x + 2 * e * y], axis=-1)


def through(values: FloatArray, xy: FloatArray) -> FloatArray:
    """Return the coefficients of the splines that take the given values at points."""
    return np.linalg.lstsq(BASIS.matrix(*xy.T), values, rcond=None)[0]


def test_splines_cover_the_rectangle_within_the_knot_spacing() -> None:
    np.testing.assert_allclose(BASIS.low_mm, LOW)
    np.testing.assert_allclose(BASIS.high_mm, HIGH)
    assert np.diff(BASIS.x_knots).max() <= 1.3
    assert np.diff(BASIS.y_knots).max() <= 1.3
    assert BASIS.matrix(*places(5).T).shape == (5, BASIS.shape[0] * BASIS.shape[1])


def test_splines_add_up_to_one_and_none_is_negative() -> None:
    corners = np.array([LOW, HIGH, [LOW[0], HIGH[1]]])
    matrix = BASIS.matrix(*np.concatenate([places(200), corners]).T)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-12)
    assert matrix.min() >= -1e-12


def test_any_number_of_heights_is_the_sum_of_the_splines() -> None:
    xy = np.concatenate([places(2 * AT_ONCE), LOW[None] - 1.0, places(AT_ONCE + 7, 1)])
    surface = SplineSurface(BASIS, np.random.default_rng(2).normal(size=BASIS.count))
    expected = BASIS.matrix(*xy.T) @ surface.coefficients
    expected[2 * AT_ONCE] = np.nan
    np.testing.assert_allclose(surface.height(*xy.T), expected, atol=1e-12)


@pytest.mark.parametrize(("dx", "dy"), [(1, 0), (0, 1), (2, 0), (1, 1)])
def test_derivatives_agree_with_central_differences(dx: int, dy: int) -> None:
    x, y = places(40).T * 0.9
    h = 1e-5
    if dx:
        before, after = (BASIS.matrix(x + s, y, dx - 1, dy) for s in (-h, h))
    else:
        before, after = (BASIS.matrix(x, y + s, dx, dy - 1) for s in (-h, h))
    np.testing.assert_allclose(BASIS.matrix(x, y, dx, dy), (after - before) / (2 * h), atol=1e-6)


def roughness() -> FloatArray:
    """Return the full symmetric matrix of the band."""
    lower = sum(np.diag(line[: len(line) - k], -k) for k, line in enumerate(BASIS.roughness_matrix))
    return np.asarray(lower + np.tril(lower, -1).T)


@given(st.tuples(*[st.floats(-2.0, 2.0)] * 5))
def test_quadrics_have_no_roughness(terms: tuple[float, ...]) -> None:
    xy = places(300)
    coefficients = through(quadric(np.array(terms), xy), xy)
    assert coefficients @ roughness() @ coefficients == pytest.approx(0.0, abs=1e-9)


def test_roughness_of_a_cubic_is_its_integral() -> None:
    # Cubics are in the basis; x³, x²y, xy² and y³ have third derivatives 6, 2, 2 and 6.
    xy = places(400)
    x, y = xy.T
    area = np.prod(HIGH - LOW)
    for cubic, integrand in ((x**3, 36), (x**2 * y, 3 * 4), (x * y**2, 3 * 4), (y**3, 36)):
        coefficients = through(cubic, xy)
        rough = coefficients @ roughness() @ coefficients
        assert rough == pytest.approx(integrand * area, rel=1e-6)
        assert SplineSurface(BASIS, coefficients).roughness() == pytest.approx(rough)
    assert np.linalg.eigvalsh(roughness()).min() > -1e-9


def test_surface_is_nan_outside_and_can_be_raised() -> None:
    xy = places(200)
    surface = SplineSurface(BASIS, through(quadric(np.array([0.1, 0, 0.2, 0, 0.3]), xy), xy))
    outside = np.array([[LOW[0] - 0.01, 0.0], [0.0, HIGH[1] + 0.01]])
    assert np.isnan(surface.height(*outside.T)).all()
    assert np.isnan(surface.gradient(*outside.T)).all()
    raised = SplineSurface(BASIS, surface.coefficients + 0.7)
    np.testing.assert_allclose(raised.height(*xy.T), surface.height(*xy.T) + 0.7, atol=1e-12)
    np.testing.assert_allclose(raised.gradient(*xy.T), surface.gradient(*xy.T), atol=1e-12)
    grid = xy[:6].reshape(2, 3, 2)
    assert surface.height(grid[..., 0], grid[..., 1]).shape == (2, 3)
    assert surface.gradient(grid[..., 0], grid[..., 1]).shape == (2, 3, 2)


@pytest.mark.parametrize("stiffness", [1e-2, 1.0, 1e3])
def test_fit_of_quadric_slopes_extrapolates_the_quadric(stiffness: float) -> None:
    terms = np.array([0.05, -0.1, 0.06, 0.02, -0.04])
    xy = places(60) * 0.6
    weights = np.tile(np.diag([4e4, 1e4]), (len(xy), 1, 1))
    fitted = fit_slopes(BASIS, xy, quadric_slopes(terms, xy), weights, stiffness)
    everywhere = places(200, seed=1)
    level = quadric(terms, xy).mean()
    height = fitted.surface.height(*everywhere.T)
    np.testing.assert_allclose(height, quadric(terms, everywhere) - level, atol=1e-5)
    assert fitted.surface.height(*xy.T).mean() == pytest.approx(0.0, abs=1e-9)


def test_stiffer_surface_follows_a_ripple_less() -> None:
    xy = places(150)
    slopes = np.stack([np.cos(2 * xy[:, 0]), np.zeros(len(xy))], axis=-1) * 0.1
    weights = np.tile(1e4 * np.eye(2), (len(xy), 1, 1))
    residuals = [
        np.std(slopes - fit_slopes(BASIS, xy, slopes, weights, s).surface.gradient(*xy.T))
        for s in (1e-2, 1e3, 1e6)
    ]
    assert residuals[0] < 0.7 * residuals[2]
    assert residuals == sorted(residuals)


def test_covariance_is_the_spread_of_repeated_fits() -> None:
    rng = np.random.default_rng(2)
    xy = places(120)
    truth = quadric_slopes(np.array([0.0, 0.0, 0.05, 0.01, 0.03]), xy)
    spread = np.array([[0.01, 0.0], [0.006, 0.02]])
    weights = np.tile(np.linalg.inv(spread @ spread.T), (len(xy), 1, 1))
    points = places(12, seed=3) * 0.8
    # Low stiffness: the penalty is a prior on the surface, which does not affect the noise.
    heights = []
    for _ in range(300):
        slopes = truth + rng.normal(size=truth.shape) @ spread.T
        fitted = fit_slopes(BASIS, xy, slopes, weights, 1e-3)
        heights.append(fitted.surface.height(*points.T))
    matrix = BASIS.matrix(*points.T)
    stated = fitted.sigma_of(matrix)
    observed = np.std(heights, axis=0)
    np.testing.assert_allclose(observed / stated, 1.0, atol=0.2)
    level = BASIS.matrix(*xy.T).mean(axis=0)
    assert fitted.sigma_of(level[None])[0] == pytest.approx(0.0, abs=1e-6)
