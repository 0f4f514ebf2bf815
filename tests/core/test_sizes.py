"""Sizes of a followed surface and their derivatives, compared with `measures.surface_sizes`."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.surface import measures
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.boundary_trace import retrace_boundary
from labapp.core.surface.level import Level, Rear
from labapp.core.surface.shape import shape_and_gradients
from labapp.core.surface.sizes import Sizes, sizes_and_gradients
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import FloatArray

BASIS = SplineBasis.over(np.array([-4.0, -5.0]), np.array([4.0, 4.0]), 0.9)
CENTER = np.array([0.1, -0.4])
DEPTH = measures.SIZES.index("depth_mm")


def coefficients(dent_mm: float) -> FloatArray:
    """Return the splines of a dome, 0.3 mm high, with a dent in the middle."""
    x, y = np.random.default_rng(3).uniform(BASIS.low_mm, BASIS.high_mm, (2000, 2)).T
    z = 0.3 - 0.03 * ((x - 0.2) ** 2 + 0.8 * y**2) + 0.01 * np.sin(2 * x) * np.cos(y)
    z -= dent_mm * np.exp(-2.0 * ((x - 0.2) ** 2 + y**2))
    return np.asarray(np.linalg.lstsq(BASIS.matrix(x, y), z, rcond=None)[0])


def measured(splines: FloatArray, level: Level) -> tuple[Sizes, Boundary]:
    circle = Boundary.polar(CENTER, np.full(360, 3.0))
    for _ in range(4):
        circle, boundary_slope = retrace_boundary(BASIS, splines, level, CENTER, circle)
    return sizes_and_gradients(BASIS, splines, level, circle, boundary_slope), circle


@pytest.mark.parametrize(("sign", "drop_mm"), [(1, 0.0), (1, 0.05), (-1, 0.0)])
@pytest.mark.parametrize("dent_mm", [0.0, 0.2])
def test_sizes_agree_with_dense_sampling(sign: int, drop_mm: float, dent_mm: float) -> None:
    splines = sign * coefficients(dent_mm)
    level = Level(0.0, 0.001, sign, Rear(drop_mm, -1.0, -3.2), 0.0)
    sizes, boundary = measured(splines, level)
    expected, peak = measures.surface_sizes(SplineSurface(BASIS, splines), boundary)
    assert (np.abs(sizes.values - expected) < [1e-9, 1e-9, 1e-5, 1e-5, 1e-9, 2e-4]).all()
    np.testing.assert_allclose(sizes.peak_mm, peak, atol=1e-3)
    assert sizes.holds


def test_surface_below_its_level_inside_the_boundary_is_invalid() -> None:
    x, y = np.random.default_rng(3).uniform(BASIS.low_mm, BASIS.high_mm, (2000, 2)).T
    distance = np.hypot(x - CENTER[0], y - CENTER[1])
    ridge = np.exp(-(((distance - 2.4) / 0.5) ** 2)) + 0.3 * np.exp(-((distance / 0.8) ** 2)) - 0.05
    splines = np.linalg.lstsq(BASIS.matrix(x, y), 0.2 * ridge, rcond=None)[0]
    assert not measured(splines, Level(0.0, 0.001, 1, Rear(), 0.0))[0].holds


@pytest.mark.parametrize("drop_mm", [0.0, 0.05])
def test_derivatives_agree_with_differences(drop_mm: float) -> None:
    splines, step = coefficients(0.0), 1e-5
    level = Level(0.0, 0.001, 1, Rear(drop_mm, -1.0, -3.2), 0.0)
    sizes, _ = measured(splines, level)
    # The deepest point is at the rear of the rim, which is given.
    assert np.isnan(sizes.gradient[DEPTH]).all()
    for spline in np.random.default_rng(5).choice(len(splines), 25, replace=False):
        change = np.zeros_like(splines)
        change[spline] = step
        more, less = (measured(splines + sign * change, level)[0].values for sign in (1, -1))
        error = sizes.gradient[:, spline] - (more - less) / (2 * step)
        assert np.abs(np.delete(error, DEPTH)).max() < 2e-3


@pytest.mark.parametrize(
    ("sign", "drop_mm", "most"), [(1, 0.0, 0.01), (1, 0.05, 0.1), (-1, 0.0, 0.01)]
)
@pytest.mark.parametrize("dent_mm", [0.0, 0.2])
def test_shape_follows_its_derivatives(
    sign: int, drop_mm: float, most: float, dent_mm: float
) -> None:
    """The kink of the boundary where a low rear begins is neglected."""
    level = Level(0.0, 0.001, sign, Rear(drop_mm, -1.0, -3.2), 0.0)

    def shape(splines: FloatArray) -> tuple[FloatArray, FloatArray]:
        boundary = Boundary.polar(CENTER, np.full(360, 3.0))
        for _ in range(4):
            boundary, slope = retrace_boundary(BASIS, splines, level, CENTER, boundary)
        return shape_and_gradients(BASIS, splines, level.rear, boundary, slope)

    splines, rng = sign * coefficients(dent_mm), np.random.default_rng(8)
    gradient = shape(splines)[1][:, :-1]
    assert gradient.shape == (3, BASIS.count)
    for _ in range(8):
        change = 1e-5 * rng.normal(size=BASIS.count)
        moved = (shape(splines + change)[0] - shape(splines - change)[0]) / 2
        usual = 1e-5 * np.linalg.norm(gradient, axis=1)
        assert (np.abs(moved - gradient @ change) < most * usual).all()


@pytest.mark.parametrize("drop_mm", [0.02, 0.05])
def test_derivatives_by_the_drop_agree_with_differences(drop_mm: float) -> None:
    splines, step = coefficients(0.0), 1e-4

    def sized(drop_mm: float) -> tuple[FloatArray, FloatArray]:
        level, boundary = Level(0.0, 0.001, 1, Rear(drop_mm, -1.0, -3.2), 0.0), None
        for _ in range(4):
            boundary, slope = retrace_boundary(
                BASIS, splines, level, CENTER, boundary or Boundary.polar(CENTER, np.full(360, 3.0))
            )
        assert boundary is not None
        sizes = sizes_and_gradients(BASIS, splines, level, boundary, slope)
        shape, by_shape = shape_and_gradients(BASIS, splines, level.rear, boundary, slope)
        return np.append(sizes.values, shape), np.concatenate([sizes.gradient, by_shape])[:, -1]

    gradient = sized(drop_mm)[1]
    moved = (sized(drop_mm + step)[0] - sized(drop_mm - step)[0]) / (2 * step)
    assert np.isnan(gradient[DEPTH])
    # The kink of the boundary is neglected in the last two.
    most = 0.01 * np.abs(moved) + 1e-9
    most[-2:] = 0.05, 0.35 * moved[-1]
    error = np.abs(gradient - moved)
    assert (np.delete(error, DEPTH) < np.delete(most, DEPTH)).all()
