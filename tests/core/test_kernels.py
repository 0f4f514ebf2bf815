"""The compiled loops agree with independent NumPy, SciPy and OpenCV implementations."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import multivariate_normal

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.optics import (
    bisecting_gradient,
    intersect_imaging_plane,
    intersect_level,
    ray_directions,
    reflect,
    surface_normal,
)
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.images import (
    band_pass_kernels,
    centroid_kernels,
    dot_fit_kernels,
    dots,
    filters,
    size_kernels,
)
from labapp.core.matching import match_kernels
from labapp.core.matching.initial import quadric_kernels
from labapp.core.sequence.prior import RIDGE, recurrence
from labapp.core.surface.kernels import (
    boundary_kernels,
    level_kernels,
    ray_kernels,
    solver_kernels,
    spline_kernels,
)
from labapp.core.surface.level import Rear
from labapp.core.surface.solver import (
    height_sigma,
    inverse_of,
    mean_splines,
    normal_factor,
    propagate_sigma,
)
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import FloatArray

RIG = Rig(Laser(31.0, 32.0), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50, 45, 3))
PLANE, LASER = RIG.imaging_plane, RIG.laser.position_mm
BASIS = SplineBasis.over(np.array([-4.0, -5.0]), np.array([4.0, 4.0]), 0.9)
COUNT = BASIS.shape[0] * BASIS.shape[1]


def random() -> np.random.Generator:
    return np.random.default_rng(18)


def surface() -> SplineSurface:
    """Return a bumpy dome, 0.3 mm high."""
    x, y = np.random.default_rng(3).uniform(BASIS.low_mm, BASIS.high_mm, (4 * COUNT, 2)).T
    z = 0.3 - 0.02 * (x**2 + 0.8 * y**2) + 0.01 * np.sin(2 * x) * np.cos(y)
    return SplineSurface(BASIS, np.linalg.lstsq(BASIS.matrix(x, y), z, rcond=None)[0])


def landings() -> tuple[FloatArray, FloatArray]:
    """Return rays, and their intersections with z = 0, shapes (n, 3)."""
    rays = ray_directions(RIG.laser, RIG.pattern).reshape(-1, 3)
    return rays, intersect_level(LASER, rays)


def test_splines_and_surfaces_agree_with_the_basis() -> None:
    # Points outside the rectangle are moved to its edge.
    xy = random().uniform(BASIS.low_mm - 0.5, BASIS.high_mm + 0.5, (200, 2))
    inside = np.clip(xy, BASIS.low_mm, BASIS.high_mm)
    cells = BASIS.cells(*inside.T)
    for value, (dx, dy) in zip(cells.value_and_slopes(), ((0, 0), (1, 0), (0, 1)), strict=True):
        matrix = np.zeros((len(xy), COUNT))
        np.put_along_axis(matrix, cells.splines, value, axis=1)
        np.testing.assert_allclose(matrix, BASIS.matrix(*inside.T, dx, dy), atol=1e-12)
    computed = spline_kernels.surface_at(BASIS.grid, surface().coefficients, xy)
    height, gradient = surface().height_and_gradient(*inside.T)
    np.testing.assert_allclose(computed, [height, *gradient.T], atol=1e-12)
    share = random().normal(size=len(xy))
    summed = spline_kernels.gradient_of_sum(BASIS.grid, COUNT, xy, share)
    np.testing.assert_allclose(summed, share @ BASIS.matrix(*inside.T), atol=1e-12)


def test_intersection_and_reflection_agree_with_optics() -> None:
    rays, landing = landings()
    points, slopes, plane = ray_kernels.intersect_and_reflect(
        BASIS.grid, surface().coefficients, rays, landing, 6, PLANE.pose_mm
    )
    known = np.isfinite(plane[:, 0])
    assert 20 < known.sum() < len(rays)  # some rays land beyond the rectangle
    np.testing.assert_allclose(np.cross(points - LASER, rays), 0.0, atol=1e-9)
    height, gradient = surface().height_and_gradient(*points[known, :2].T)
    np.testing.assert_allclose(points[known, 2], height, atol=1e-9)
    np.testing.assert_allclose(slopes[known], gradient, atol=1e-6)  # before the last step
    direction = reflect(rays[known], surface_normal(slopes[known]))
    np.testing.assert_allclose(
        plane[known], intersect_imaging_plane(points[known], direction, PLANE), atol=1e-9
    )
    known_rays = rays[known], landing[known]
    moved, most = solver_kernels.newton_along_rays(
        BASIS.grid, surface().coefficients, *known_rays, 6
    )
    np.testing.assert_allclose(moved, points[known], atol=1e-12)
    assert most == np.abs(moved - landing[known]).max()


def test_ray_reflected_away_from_the_plane_has_no_dot() -> None:
    rays, landing = landings()
    steep = SplineSurface(BASIS, surface().coefficients + 8.0 * BASIS_Y)
    plane = ray_kernels.intersect_and_reflect(
        BASIS.grid, steep.coefficients, rays, landing, 1, PLANE.pose_mm
    )[2]
    assert np.isnan(plane).all()


BASIS_Y = np.tile((BASIS.y_knots[:-4] + BASIS.y_knots[4:]) / 2, BASIS.shape[0]) - 0.3


def slopes_of_dots(points: FloatArray, plane_mm: FloatArray) -> FloatArray:
    """Return ∂(slopes at points)/∂(dots X′, Z′) by differences, shape (n, 2, 2), mm⁻¹."""
    dots = PLANE.to_universal(plane_mm)
    step = 1e-4
    ahead, behind = (
        [
            bisecting_gradient(points - LASER, dots + way * step * axis - points)
            for axis in (PLANE.x_axis, PLANE.z_axis)
        ]
        for way in (1, -1)
    )
    return (np.stack(ahead, axis=-1) - np.stack(behind, axis=-1)) / (2 * step)


def test_slope_weights_invert_the_propagated_covariance() -> None:
    rng, (_, landing) = random(), landings()
    plane_mm = rng.uniform([10.0, 10.0], [80.0, 60.0], (len(landing), 2))
    half = rng.normal(0.0, 0.05, (len(landing), 2, 2))
    covariance, floor = half @ half.swapaxes(1, 2), 0.02
    weights = ray_kernels.slope_weights(
        LASER, PLANE.pose_mm, landing, PLANE.to_universal(plane_mm), covariance, floor
    )
    jacobian = slopes_of_dots(landing, plane_mm)
    spread = jacobian @ (covariance + floor**2 * np.eye(2)) @ jacobian.swapaxes(1, 2)
    np.testing.assert_allclose(
        weights @ spread, np.broadcast_to(np.eye(2), spread.shape), atol=5e-3
    )


def test_dot_covariance_is_propagated_from_the_coefficients() -> None:
    rng = random()
    points = np.column_stack([rng.uniform(BASIS.low_mm, BASIS.high_mm, (60, 2)), np.zeros(60)])
    weights = np.tile(np.diag([4e4, 1e4]), (60, 1, 1))
    factor = normal_factor(BASIS, 10.0 * BASIS.roughness_matrix, points, weights)
    lower = sum(np.diag(line[: COUNT - k], -k) for k, line in enumerate(factor))
    dot_points, plane_mm = points[:7], rng.uniform([10.0, 10.0], [80.0, 60.0], (7, 2))
    inverse = solver_kernels.inverse_band(factor)
    covariance = solver_kernels.covariance_of_dots(
        BASIS.grid, inverse, LASER, PLANE.pose_mm, dot_points, PLANE.to_universal(plane_mm)
    )
    slopes = np.stack(
        [BASIS.matrix(*dot_points[:, :2].T, 1, 0), BASIS.matrix(*dot_points[:, :2].T, 0, 1)], axis=1
    )
    parts = np.linalg.inv(slopes_of_dots(dot_points, plane_mm)) @ slopes
    expected = parts @ np.linalg.inv(lower @ lower.T) @ parts.swapaxes(1, 2)
    np.testing.assert_allclose(covariance, expected, rtol=1e-4)


def test_height_sigma_is_propagated_from_the_coefficients() -> None:
    points = random().uniform(BASIS.low_mm, BASIS.high_mm, (60, 2))
    weights = np.tile(np.diag([4e4, 1e4]), (60, 1, 1))
    factor = normal_factor(BASIS, 10.0 * BASIS.roughness_matrix, points, weights)
    places = random().uniform(BASIS.low_mm, BASIS.high_mm, (7, 2))
    mean = mean_splines(BASIS, points)
    np.testing.assert_allclose(mean, BASIS.matrix(*points.T).mean(axis=0), atol=1e-15)
    sigma = height_sigma(BASIS, factor, inverse_of(factor), mean, places)
    expected = propagate_sigma(factor, BASIS.matrix(*places.T), mean)
    np.testing.assert_allclose(sigma, expected, rtol=1e-6)


def test_pair_deviances_are_those_of_normal_distributions() -> None:
    rng = random()
    places, predicted = rng.normal(0.0, 1.0, (9, 2)), rng.normal(0.0, 1.0, (5, 2))
    half = rng.normal(0.0, 0.5, (9, 2, 2)), rng.normal(0.0, 0.5, (5, 2, 2))
    covariance, uncertain = (one @ one.swapaxes(1, 2) for one in half)
    distance, deviance = match_kernels.pair_deviances(places, covariance, predicted, uncertain)
    for n in range(9):
        for m in range(5):
            law = multivariate_normal(predicted[m], covariance[n] + uncertain[m])
            np.testing.assert_allclose(
                deviance[n, m], -2 * law.logpdf(places[n]) - 2 * np.log(2 * np.pi), rtol=1e-9
            )
            excess = -2 * law.logpdf(places[n]) + 2 * law.logpdf(predicted[m])
            np.testing.assert_allclose(distance[n, m], excess, rtol=1e-9)


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_sure_pairs_are_likelier_than_all_rivals(scale: float) -> None:
    """Likelihoods of all pairs are compared, without any limit of the distance."""
    rng, count = random(), 0
    inflation, error, gate, margin, false = limits = np.array([2.0, 4e-3, 9.0, 2.0, 8.0])
    for _ in range(40):
        predicted = scale * rng.uniform(0.0, 3.0, (8, 2))
        shown = np.concatenate([predicted[:6], scale * rng.uniform(0.0, 3.0, (3, 2))])
        places = rng.permutation(shown) + rng.normal(0.0, 0.1, (9, 2))
        half = rng.normal(0.0, 0.1, (9, 2, 2)), rng.normal(0.0, 0.1, (8, 2, 2))
        covariance, uncertain = (one @ one.swapaxes(1, 2) for one in half)
        spread = inflation * uncertain + error * np.eye(2)
        distance, deviance = match_kernels.pair_deviances(places, covariance, predicted, spread)
        expected = []
        for n, m in np.ndindex(deviance.shape):
            rivals = [*np.delete(deviance[n], m), *np.delete(deviance[:, m], n), false]
            if distance[n, m] < gate and deviance[n, m] + margin < min(rivals):
                expected.append((n, m))
        place, prediction = match_kernels.sure_pairs(
            places, covariance, predicted, uncertain, limits
        )
        assert list(zip(place.tolist(), prediction.tolist(), strict=True)) == expected
        count += len(expected)
    assert count > 20
    empty = match_kernels.sure_pairs(places[:0], covariance[:0], predicted, uncertain, limits)
    assert [len(each) for each in empty] == [0, 0]


def test_normal_equations_are_those_of_least_squares() -> None:
    rng = random()
    points = np.column_stack([rng.uniform(BASIS.low_mm, BASIS.high_mm, (60, 2)), np.zeros(60)])
    root = rng.normal(size=(60, 2, 2))
    weights = root @ np.swapaxes(root, 1, 2)
    slope_matrix = np.stack(
        [BASIS.matrix(*points[:, :2].T, 1, 0), BASIS.matrix(*points[:, :2].T, 0, 1)], 1
    )
    band = 0.1 * BASIS.roughness_matrix
    rough = sum(np.diag(line[: COUNT - k], -k) for k, line in enumerate(band))
    rough += np.tril(rough, -1).T
    normal = np.einsum("nap,nab,nbq->pq", slope_matrix, weights, slope_matrix) + rough
    factor = normal_factor(BASIS, band, points, weights)
    lower = sum(np.diag(line[: COUNT - k], -k) for k, line in enumerate(factor))
    difference = lower @ lower.T - normal
    diagonal = np.unravel_index(np.argmax(difference), difference.shape)
    assert diagonal[0] == diagonal[1]
    assert difference[diagonal] == pytest.approx(np.trace(normal) / COUNT)
    difference[diagonal] = 0.0
    np.testing.assert_allclose(difference, 0.0, atol=1e-9 * normal.max())
    right = rng.normal(size=(2, COUNT))
    solved = np.linalg.solve(lower @ lower.T, right.T).T
    np.testing.assert_allclose(solver_kernels.solve(factor, right), solved, rtol=1e-6)
    indefinite = solver_kernels.normal_factor(
        BASIS.grid, -1e3 * BASIS.roughness_matrix, points, weights
    )
    assert not indefinite[1]
    dots_mm = PLANE.to_universal(rng.uniform([10.0, 10.0], [80.0, 60.0], (60, 2)))
    required = bisecting_gradient(points - LASER, dots_mm - points)
    residual = required - surface().gradient(*points[:, :2].T)
    np.testing.assert_allclose(
        solver_kernels.gradient_rhs(
            BASIS.grid, surface().coefficients, points, weights, LASER, PLANE.pose_mm, dots_mm
        ),
        np.einsum("nap,nab,nb->p", slope_matrix, weights, residual),
        atol=1e-9,
    )


def test_fit_step_solves_normal_equations_and_keeps_mean_height() -> None:
    rng = random()
    points = np.column_stack([rng.uniform(BASIS.low_mm, BASIS.high_mm, (60, 2)), np.zeros(60)])
    weights = np.tile(np.diag([4e4, 1e4]), (60, 1, 1))
    dots_mm = PLANE.to_universal(rng.uniform([10.0, 10.0], [80.0, 60.0], (60, 2)))
    coefficients, rough = surface().coefficients, rng.normal(0.0, 0.1, COUNT)
    band = 10.0 * BASIS.roughness_matrix
    factor = normal_factor(BASIS, band, points, weights)
    half = sum(np.diag(line[: COUNT - k], -k) for k, line in enumerate(band))
    right = solver_kernels.gradient_rhs(
        BASIS.grid, coefficients, points, weights, LASER, PLANE.pose_mm, dots_mm
    )
    right -= (half + np.tril(half, -1).T) @ rough
    change = solver_kernels.solve(factor, right[None])[0]
    change -= (BASIS.matrix(*points[:, :2].T) @ change).mean()
    bench = LASER, PLANE.pose_mm
    stepped = solver_kernels.fit_step(
        BASIS.grid, (band, factor), coefficients, rough, points, weights, bench, dots_mm
    )
    np.testing.assert_allclose(stepped, coefficients + change, atol=1e-9 * np.abs(change).max())


def test_between_needs_lit_rays_on_both_sides() -> None:
    lit = random().uniform(size=(9, 11)) < 0.2
    expected = np.zeros_like(lit)
    for i, j in np.ndindex(lit.shape):
        row, column = lit[i], lit[:, j]
        expected[i, j] = (row[:j].any() and row[j + 1 :].any()) or (
            column[:i].any() and column[i + 1 :].any()
        )
    np.testing.assert_array_equal(match_kernels.between(lit), expected)


def test_amid_agrees_with_numpy() -> None:
    lit = random().uniform(size=(9, 7)) < 0.2
    lit[4] = False
    expected = np.zeros_like(lit)
    for i, j in np.ndindex(lit.shape):
        row, column = lit[i], lit[:, j]
        expected[i, j] |= row[: j + 1].any() and row[j:].any()
        expected[i, j] |= column[: i + 1].any() and column[i:].any()
    np.testing.assert_array_equal(match_kernels.amid(lit), expected)


def test_guessed_level_puts_the_outer_points_at_0() -> None:
    height, outer = random().normal(1.0, 0.3, 12), np.arange(12) % 3 == 0
    guessed = level_kernels.guess_level(height, outer)
    expected = -height[outer].mean(), height.std(), height[~outer].mean()
    np.testing.assert_allclose(guessed, expected)


def test_behind_torch_agrees_with_reflected_rays() -> None:
    rays, landing = landings()
    points = landing + random().normal(0.0, 0.2, landing.shape)
    slopes = random().normal(0.0, 0.1, (len(rays), 2))
    reflected = reflect(rays, surface_normal(slopes))
    # Beside the torch a ray is highest at y = 0, before or after its reflection.
    towards = np.where((points[:, 1] < 0)[:, None], -rays, reflected)
    height = points[:, 2] - points[:, 1] * towards[:, 2] / towards[:, 1]
    hidden = height > 2.4 - 0.3
    assert 10 < hidden.sum() < len(rays) - 10
    np.testing.assert_array_equal(ray_kernels.behind_torch(points, rays, slopes, 2.4), hidden)


def test_rim_of_the_far_side_is_below_dark_rays_that_nothing_stops() -> None:
    """A bowl: two rays at its near side, which dip, and one aside, whose way is free."""
    basis = SplineBasis(np.linspace(-4.0, 4.0, 17), np.linspace(-4.0, 4.0, 17))
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-4, 4, 40), np.linspace(-4, 4, 40)))
    coefficients = np.linalg.lstsq(basis.matrix(x, y), 0.06 * (x**2 + y**2), rcond=None)[0]
    places = np.array([[1.5, 0.0], [0.0, 2.6], [0.0, 2.8], [2.0, 0.0]])
    points = np.column_stack([places, 0.06 * np.sum(places**2, axis=1)])
    rays = np.tile([0.0, -np.cos(np.radians(30.0)), -0.5], (4, 1))
    lit = np.array([True, False, False, False])

    def stopped(dark: list[bool]) -> list[bool]:
        surface = basis.grid, coefficients
        masks = lit, np.array(dark)
        found = ray_kernels.stopped_by_far_side(surface, points, rays, 0.12 * places, *masks)
        return np.asarray(found).tolist()

    assert stopped([False, True, True, False]) == [False, True, True, False]
    assert stopped([False, True, True, True]) == [False, False, False, False]
    assert stopped([False, False, False, False]) == [False, False, False, False]


def test_recurrence_is_ridge_least_squares() -> None:
    slopes, rays, order = random().normal(0.0, 1.0, (30, 40, 2)), np.arange(0, 40, 3), 4
    series = slopes[:, rays].reshape(30, -1)
    series = series - series.mean(axis=0)
    before = np.stack([series[order - 1 - k : 29 - k].ravel() for k in range(order)], axis=-1)
    ridge = np.sqrt(RIDGE * np.sum(before**2)) * np.eye(order)
    right_side = np.concatenate([series[order:].ravel(), np.zeros(order)])
    np.testing.assert_allclose(
        recurrence(slopes, rays, order),
        np.linalg.lstsq(np.concatenate([before, ridge]), right_side, rcond=None)[0],
    )


def test_on_plane_agrees_with_the_calibration() -> None:
    calibration = ImageCalibration(
        np.array([[0.17, 0.01, -8.0], [0.004, -0.18, 95.0], [1e-4, -2e-4, 1.0]])
    )
    image, sigma = random().uniform(0, 480, (30, 2)), random().uniform(0.05, 0.4, (30, 2))
    plane, covariance, scale = band_pass_kernels.on_plane(calibration.matrix, image, sigma)
    np.testing.assert_allclose(plane, calibration.to_plane(image))
    jacobian = calibration.jacobian(image)
    np.testing.assert_allclose(
        covariance, np.einsum("nij,nj,nkj->nik", jacobian, sigma**2, jacobian), atol=1e-15
    )
    np.testing.assert_allclose(scale, np.sqrt(np.abs(np.linalg.det(jacobian))))


def test_two_nearest_agree_with_kd_tree() -> None:
    places, among = random().uniform(0, 10, (2, 40, 2))
    distance, number = band_pass_kernels.two_nearest(places, among)
    expected = cKDTree(among).query(places, k=2)
    np.testing.assert_allclose(distance, expected[0])
    np.testing.assert_array_equal(number, expected[1])
    distance, number = band_pass_kernels.two_nearest(places, among[:1])
    assert np.isinf(distance[:, 1]).all()
    assert (number == [0, 1]).all()


def picture() -> tuple[FloatArray, dots.Grey]:
    """Return the positions (u, v) of dots, some at the edge, and a noisy image of them."""
    rng = random()
    positions = np.stack(np.meshgrid(np.arange(1.0, 150, 18), np.arange(1.0, 110, 16)), -1)
    positions = positions.reshape(-1, 2) + rng.uniform(-1, 1, (positions.size // 2, 2))
    v, u = np.mgrid[:110, :150]
    image = rng.normal(0, 1.0, u.shape)
    for position in positions:
        image += 50 * np.exp(-((u - position[0]) ** 2 + (v - position[1]) ** 2) / (2 * 1.9**2))
    return positions, image.astype(np.float32)


def band_of(image: dots.Grey) -> dots.Grey:
    return filters.blur(image, 1.5) - filters.blur(image, 3.0)


def test_peaks_are_the_local_maxima() -> None:
    band, disc = band_of(picture()[1]), filters.peak_disc(1.9)
    highest = cv2.dilate(band, disc.astype(np.uint8))
    for floor in (np.full((1, 1), 3.0, "f4"), np.full(band.shape, 3.0, "f4")):
        peaks = band_pass_kernels.peaks(band, floor, disc)
        np.testing.assert_array_equal(peaks[::-1], np.nonzero((band >= highest) & (band > 3.0)))
    noise = random().normal(0, 1, (90, 700)).astype(np.float32)  # more peaks than room at first
    peaks = band_pass_kernels.peaks(noise, np.full((1, 1), -9.0, "f4"), np.ones((3, 3), bool))
    assert peaks.shape[1] == (noise >= cv2.dilate(noise, np.ones((3, 3)))).sum() > 256


def test_close_pixels_are_merged() -> None:
    u, v = np.array([5, 6, 30, 5, 31, 60]), np.array([5, 5, 9, 7, 11, 9])
    np.testing.assert_array_equal(band_pass_kernels.first_of_each(u, v, 2.0), [0, 2, 4, 5])


def test_ridges_are_recognised_at_any_angle_and_at_the_edge() -> None:
    v, u = np.mgrid[:60, :80].astype(float)
    for angle in np.linspace(0, np.pi, 9):
        along = (u - 40) * np.cos(angle) + (v - 30) * np.sin(angle)
        across = (v - 30) * np.cos(angle) - (u - 40) * np.sin(angle)
        for times, long in ((2.0, False), (6.0, True)):
            band = np.exp(-(across**2 + (along / times) ** 2) / 18).astype(np.float32)
            assert band_pass_kernels.ridges(band, np.array([40]), np.array([30]), 10.0) == [long]
    for column, times, long in ((0, 6.0, True), (79, 6.0, True), (0, 1.0, False)):
        band = np.exp(-((u - column) ** 2 + ((v - 30) / times) ** 2) / 18).astype(np.float32)
        assert band_pass_kernels.ridges(band, np.array([column]), np.array([30]), 10.0) == [long]


def centroids_by_hand(
    light: FloatArray, u: int, v: int, margin: int, width: float
) -> tuple[float, float, float]:
    """Return column, row and second moment of light in a window moved iteratively (NumPy)."""
    padded = np.pad(np.maximum(light, 0.0), margin)
    patch = padded[v : v + 2 * margin + 1, u : u + 2 * margin + 1].astype(float)
    y, x = np.mgrid[-margin : margin + 1, -margin : margin + 1]
    at_u = at_v = 0.0
    for _ in range(4):
        weight = patch * np.exp(-((x - at_u) ** 2 + (y - at_v) ** 2) / (2 * width**2))
        weight /= weight.sum() + 1e-12
        mean_u, mean_v = (weight * x).sum(), (weight * y).sum()
        square = (weight * (x**2 + y**2)).sum() - mean_u**2 - mean_v**2
        at_u, at_v = at_u + 1.5 * (mean_u - at_u), at_v + 1.5 * (mean_v - at_v)
        at_u, at_v = np.clip(at_u, -2, 2), np.clip(at_v, -2, 2)
    return at_u, at_v, square


@pytest.mark.parametrize("sigma", [0.0, 1.1])
def test_centroids_are_those_of_the_blurred_picture(sigma: float) -> None:
    positions, image = picture()
    u, v = np.rint(positions).astype(np.int64).T
    width = random().uniform(1.0, 2.2, len(u))
    around = filters.blur(image, 4.0) if sigma else np.zeros_like(image)
    taps = filters.kernel(sigma)
    light = cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT) - around
    offset, moment = centroid_kernels.centroids(image, around, taps, u, v, 6, width, 2.0)
    for k in range(len(u)):
        expected = centroids_by_hand(light, u[k], v[k], 6, width[k])
        np.testing.assert_allclose([*offset[:, k], moment[k]], expected, atol=1e-5)


def fitted_picture() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return crowded dots, shape (n, 4), some near edges, their light, and a noisy background."""
    rng = random()
    positions = np.stack(np.meshgrid(np.arange(4.0, 76.0, 8.0), np.arange(6.0, 58.0, 9.0)), -1)
    positions = positions.reshape(-1, 2) + rng.uniform(-1.5, 1.5, (54, 2))
    dots = np.column_stack([positions, rng.uniform(20, 60, 54), rng.uniform(1.2, 2.2, 54)])
    v, u = np.mgrid[:64, :80]
    return dots, light_of(dots, (64, 80)), 12.0 + 0.1 * u - 0.05 * v + rng.normal(0, 2, (64, 80))


def light_of(dots: FloatArray, shape: tuple[int, int], blur: float = 0.0) -> FloatArray:
    """Return the light of round dots; when blurred, the picture is mirrored at its edges."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    light = np.zeros(shape)
    for u_px, v_px, peak, size in dots:
        variance = size**2 + blur**2
        for at_u in (u_px, -1 - u_px, 2 * shape[1] - 1 - u_px) if blur else (u_px,):
            for at_v in (v_px, -1 - v_px, 2 * shape[0] - 1 - v_px) if blur else (v_px,):
                square = (u - at_u) ** 2 + (v - at_v) ** 2
                light += peak * size**2 / variance * np.exp(-square / (2 * variance))
    return light


def test_residual_light_is_the_same_for_bytes_and_floats() -> None:
    dots, light, rest = fitted_picture()
    as_bytes, level = np.rint(light + rest).astype(np.uint8), np.full(light.shape, 12.0, np.float32)
    number, begin = dot_fit_kernels.neighbours(dots[:, 0], dots[:, 1], 25.0)
    arguments = level, 7.0, dots, 1.3 * dots[:, 3], number, begin, 6
    for kernel in (dot_fit_kernels.residual_sums, dot_fit_kernels.residual_modes):
        one, other = kernel(as_bytes, *arguments), kernel(as_bytes.astype(np.float32), *arguments)
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)


def test_dots_are_subtracted_from_a_blurred_picture() -> None:
    dots, light, rest = fitted_picture()
    blurred = light_of(dots, light.shape, 7.0)
    remainder = dot_fit_kernels.without_dots((blurred + rest).astype(np.float32), 1.0, 7.0, dots)
    np.testing.assert_allclose(remainder, rest, atol=0.02)


def test_residual_light_excludes_dots_and_background() -> None:
    dots, light, rest = fitted_picture()
    level = np.full(light.shape, 12.0, np.float32)
    width, margin = 1.3 * dots[:, 3], 6
    number, begin = dot_fit_kernels.neighbours(dots[:, 0], dots[:, 1], 25.0)
    arguments = (light + rest).astype(np.float32), level, 7.0, dots, width, number, begin, margin
    sums, modes = (
        dot_fit_kernels.residual_sums(*arguments),
        dot_fit_kernels.residual_modes(*arguments),
    )
    v, u = np.mgrid[:64, :80]
    for k, (u_px, v_px, _, size) in enumerate(dots):
        near = (np.abs(u - round(u_px)) <= margin) & (np.abs(v - round(v_px)) <= margin)
        p, q = (u - u_px)[near], (v - v_px)[near]
        square = p**2 + q**2
        window = np.exp(-square / (2 * width[k] ** 2))
        remainder, profile = window * (rest - 12.0)[near], np.exp(-square / (2 * size**2))
        expected = remainder @ np.stack([0 * p + 1, p, q, profile, profile * square], -1)
        np.testing.assert_allclose(sums[k, :5], expected, rtol=1e-3, atol=0.15)
        spread = 1 / (1 / width[k] ** 2 + 1 / size**2)
        third = square - 4 * spread
        fifth = square**2 - 12 * spread * square + 24 * spread**2
        mode = np.stack([each for by in (1.0, third, fifth) for each in (by * p, by * q)])
        large = np.sqrt(np.square(mode) @ window**2)
        np.testing.assert_allclose(modes[:, k, 0] / large, mode @ remainder / large, atol=0.1)
        light_part = np.square(mode) @ (window * light[near]) ** 2
        np.testing.assert_allclose(modes[:, k, 2], light_part, rtol=0.03)
        if 8 < u_px < 70 and 8 < v_px < 54:  # the window is in the picture
            np.testing.assert_allclose(modes[:, k, 1], np.square(mode) @ window**2, rtol=1e-3)


def test_upsampled_peaks_are_those_of_the_full_picture() -> None:
    v, u = np.mgrid[:120, :160]
    image = np.zeros((120, 160))
    for u_px, v_px in random().uniform(0.0, 120.0, (30, 2)):
        image += 40.0 * np.exp(-((u - u_px) ** 2 + (v - v_px) ** 2) / (2 * 3.2**2))
    band = band_pass_kernels.halved(image.astype(np.float32))
    low = np.full(band.shape, 10.0, "f4")
    (u, v), high = band_pass_kernels.upsampled_peaks(band, low, np.ones((5, 5), bool))
    blurred = cv2.blur(image, (3, 3)) * 0.375 + image * 0.625  # the blur of the pixel area
    highest = cv2.dilate(blurred, np.ones((5, 5)))
    inner = np.s_[8:-8, 8:-8]
    assert (np.diff(v) >= 0).all()
    u, v, high = u[high > 12.0], v[high > 12.0], high[high > 12.0]
    within = np.zeros(image.shape, bool)
    within[inner] = True
    error = high - highest[v, u]
    assert np.abs(error[within[v, u]]).max() < 0.02 * image.max()
    expected = (blurred >= highest) & (blurred > 13.0)
    is_peak = np.zeros(image.shape, bool)
    is_peak[v, u] = True
    near = cv2.dilate(is_peak.astype(np.uint8), np.ones((3, 3))) > 0
    assert near[inner][expected[inner]].all()


def test_halved_picture_has_means_of_four_pixels() -> None:
    image = random().integers(0, 256, (40, 60)).astype(np.uint8)
    expected = image.reshape(20, 2, 30, 2).mean(axis=(1, 3))
    np.testing.assert_array_equal(band_pass_kernels.halved(image), expected)
    np.testing.assert_array_equal(band_pass_kernels.halved(image.astype(np.float32)), expected)


def test_next_apart_is_the_distance_to_the_nearest_other() -> None:
    places = random().uniform(0, 10, (50, 2))
    expected = np.sort(np.linalg.norm(places[:, None] - places, axis=-1), axis=1)[:, 1]
    np.testing.assert_allclose(band_pass_kernels.next_apart(places), expected)
    np.testing.assert_array_equal(band_pass_kernels.next_apart(places[:1]), [np.inf])
    assert band_pass_kernels.next_apart(places[:0]).shape == (0,)


def test_within_view_needs_all_corners_on_plane_and_image() -> None:
    rng = random()
    places, margin = rng.uniform(-5, 25, (200, 2)), rng.uniform(0, 3, (200, 2))
    to_image = np.array([[10.0, 1.0, 5.0], [-1.0, 9.0, 20.0], [1e-3, 2e-3, 1.0]])
    plane, image = np.array([[0.5, 1.0], [19.0, 18.0]]), np.array([[4.0, 4.0], [170.0, 150.0]])
    expected = np.ones(200, bool)
    for direction in ([1, 1], [1, -1], [-1, 1], [-1, -1]):
        corner = places + direction * margin
        u, v, w = to_image @ np.column_stack([corner, np.ones(200)]).T
        pixel = np.stack([u / w, v / w], axis=1)
        expected &= ((corner > plane[0]) & (corner < plane[1])).all(axis=1)
        expected &= ((pixel > image[0]) & (pixel < image[1])).all(axis=1)
    view = to_image, plane, image, np.zeros((0, 0), bool)
    computed = match_kernels.within_view(places, margin, view)
    np.testing.assert_array_equal(computed, expected)
    assert 10 < computed.sum() < 190


def test_tile_noise_is_that_of_each_tile() -> None:
    rng = random()
    image = 50 + np.concatenate(
        [rng.normal(0, 1.0, (200, 240)), rng.normal(0, 3.0, (200, 240))], axis=1
    )
    sigma = 1.4826 * size_kernels.tile_noise(image.astype(np.float32), 2, 4)
    np.testing.assert_allclose(sigma, [[1, 1, 3, 3]] * 2, rtol=0.08)
    ramp = np.add.outer(np.arange(40.0), 3 * np.arange(50.0)).astype(np.float32)
    np.testing.assert_allclose(size_kernels.tile_noise(ramp, 2, 2), 0.0, atol=1e-4)
    assert size_kernels.tile_noise(ramp[:8, :8].copy(), 1, 1).shape == (1, 1)


@pytest.mark.parametrize("spikes", [0.0, 0.04, 0.5])
@pytest.mark.parametrize("side", [8, 9, 40, 41])
def test_tile_noise_is_the_median_of_the_differences(side: int, spikes: float) -> None:
    rng = random()
    image = np.where(rng.random((side, side)) < spikes, 200, rng.integers(0, 12, (side, side)))
    operator = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]) / 6
    differences = np.abs(cv2.filter2D(image.astype(float), -1, operator))[1:-1:2, 1:-1:2]
    for kind in (np.uint8, np.float32):
        noise = size_kernels.tile_noise(image.astype(kind), 1, 1)
        np.testing.assert_allclose(noise, np.median(differences), rtol=1e-6)


def test_connected_pixels_agree_with_opencv() -> None:
    spots = (random().uniform(size=(40, 50)) < 0.2).astype(np.uint8)
    v, u = np.nonzero(spots)
    seeds = random().uniform(size=len(u)) < 0.1
    spot = np.asarray(cv2.connectedComponents(spots)[1])[v, u]
    connected = band_pass_kernels.connected_pixels(u, v, seeds)
    np.testing.assert_array_equal(connected, np.isin(spot, spot[seeds]))
    assert seeds.sum() < connected.sum() < len(u)


def test_spikes_are_hot_pixels_but_not_dots() -> None:
    image = picture()[1] + 20
    hot = {(75, 49): 500.0, (0, 40): 90.0, (100, 88): 70.0, (101, 88): 70.0, (101, 89): 70.0}
    for (u, v), height in hot.items():
        image[v, u] += height
    spikes, (times, beside) = band_pass_kernels.spikes(image, 6.0, 1.9, 1.5, 5)
    assert set(zip(*spikes.tolist(), strict=True)) == set(hot)
    assert (times > 1.5).all()
    clean = picture()[1] + 20
    for u, v, fit in zip(*spikes, beside, strict=True):
        assert fit == pytest.approx(clean[v, u], abs=0.35 * max(float(clean[v, u]) - 20, 15))


def test_answers_are_local_maxima_of_smaller_pictures() -> None:
    image = random().normal(0, 1, (60, 80)).astype(np.float32)
    for step in (1, 2, 4):
        small = cv2.resize(image, (80 // step, 60 // step), interpolation=cv2.INTER_AREA)
        u, v = np.array([0, 33, 79]), np.array([0, 21, 59])
        highest = cv2.dilate(small, np.ones((3, 3)))
        x, y = (np.rint((pixel + 0.5) / step - 0.5).astype(int) for pixel in (u, v))
        np.testing.assert_array_equal(
            size_kernels.responses(small, u, v, float(step)), highest[y, x]
        )


def test_parts_are_near_a_larger_dot() -> None:
    places, larger = np.array([[0.0, 0], [3, 0], [9, 0], [0, 4]]), np.array([[1.0, 0], [9, 3]])
    is_part = size_kernels.parts(
        places, np.array([1.0, 2, 1, 1]), larger, np.array([1.0, 0.5]), 3, 0.6
    )
    np.testing.assert_array_equal(is_part, [True, False, False, False])


def test_finest_band_is_that_of_the_full_picture() -> None:
    positions, image = picture()
    u, v = np.rint(positions).astype(np.int64).T
    narrow, wide = np.zeros((2, 3, 13), np.float32)
    for weights, sigma, taps in ((narrow, 0.8, 7), (wide, 1.3, 11)):
        kernel = cv2.getGaussianKernel(taps, sigma, cv2.CV_32F).ravel()
        for k in range(3):
            start = (11 - taps) // 2 + k
            weights[k, start : start + taps] = kernel
    fine = cv2.GaussianBlur(image, (7, 7), 0.8, borderType=cv2.BORDER_REFLECT)
    fine -= cv2.GaussianBlur(image, (11, 11), 1.3, borderType=cv2.BORDER_REFLECT)
    highest = np.pad(fine, 1, "symmetric")  # the filters mirror the picture at the edge
    highest = np.array([highest[y : y + 3, x : x + 3].max() for x, y in zip(u, v, strict=True)])
    np.testing.assert_allclose(
        centroid_kernels.largest_fine_response(image, u, v, narrow, wide), highest, atol=1e-4
    )


def test_kernels_give_the_same_for_bytes_and_floats() -> None:
    positions, image = picture()
    u, v = np.rint(positions).astype(np.int64).T
    as_bytes, around = (
        np.clip(image + 20, 0, 255).astype(np.uint8),
        np.full(image.shape, 20.0, "f4"),
    )
    taps, width = cv2.getGaussianKernel(9, 1.1, cv2.CV_32F).ravel(), np.full(len(u), 2.0)
    narrow, wide = np.float32(random().uniform(0, 1, (2, 3, 13)))
    for kernel in (
        lambda own: centroid_kernels.centroids(own, around, taps, u, v, 6, width, 2.0),
        lambda own: centroid_kernels.largest_fine_response(own, u, v, narrow, wide),
        lambda own: band_pass_kernels.spikes(own, 3.0, 1.9, 1.2, 5),
        lambda own: size_kernels.tile_noise(own, 2, 3),
    ):
        for one, other in zip(kernel(as_bytes), kernel(as_bytes.astype(np.float32)), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("rows", [1, 3])
def test_pictures_smaller_than_the_filters_are_mirrored_repeatedly(rows: int) -> None:
    image = random().uniform(0, 90, (rows, 40)).astype(np.float32)
    kernel = np.float32(cv2.getGaussianKernel(31, 4.0).ravel())
    three = np.stack([np.pad(kernel, (k, 2 - k)) for k in range(3)])
    blurred = np.pad(image, 16, "symmetric")
    blurred = cv2.sepFilter2D(blurred, -1, kernel, kernel)[15 : 17 + rows, 15:57]
    u, v = np.array([0, 20, 39]), np.array([0, rows - 1, 0])
    expected = [blurred[y : y + 3, x : x + 3].max() for x, y in zip(u, v, strict=True)]
    computed = centroid_kernels.largest_fine_response(image, u, v, three, np.zeros_like(three))
    np.testing.assert_allclose(computed, expected, rtol=1e-5)


def test_nan_coefficients_give_nan() -> None:
    rays, landing = landings()
    nan = np.full(COUNT, np.nan)
    assert np.isnan(solver_kernels.newton_along_rays(BASIS.grid, nan, rays, landing, 1)[1])
    assert np.isnan(
        ray_kernels.intersect_and_reflect(BASIS.grid, nan, rays, landing, 1, PLANE.pose_mm)[2]
    ).all()


def test_division_by_zero_is_as_in_numpy() -> None:
    matrix, place = np.zeros((3, 3)), np.ones((1, 2))
    assert not np.isfinite(band_pass_kernels.on_plane(matrix, place, place)[0]).any()


@pytest.mark.parametrize("drop_mm", [0.0, 0.06])
def test_boundary_is_where_the_surface_meets_the_level(drop_mm: float) -> None:
    theta = np.linspace(-np.pi, np.pi, 48, endpoint=False)
    directions = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    center, rear = np.array([0.1, -0.4]), Rear(drop_mm, -1.0, -4.5)
    radius, boundary_slope, over = boundary_kernels.newton_to_boundary(
        BASIS.grid, surface().coefficients, np.array([drop_mm, -1.0, -4.5]), center, directions,
        np.full(48, 3.0), np.full(48, 0.3), 1e-10,
    )  # fmt: skip
    boundary = center + radius[:, None] * directions
    height, gradient = surface().height_and_gradient(*boundary.T)
    inside = BASIS.contains(*boundary.T)
    assert inside.sum() > 40
    np.testing.assert_allclose((height - rear.height(boundary[:, 1]))[inside], 0.0, atol=1e-9)
    np.testing.assert_allclose(over[inside], 0.0, atol=1e-9)
    below = np.maximum(-1.0 - boundary[:, 1], 0.0)
    gradient[:, 1] -= 2 * drop_mm * below / 3.5**2
    np.testing.assert_allclose(boundary_slope[inside], gradient[inside], atol=1e-6)


def test_rays_are_reflected_off_quadrics() -> None:
    rays = ray_directions(RIG.laser, RIG.pattern)[7:12, 7:12].reshape(-1, 3)
    center = np.array([0.2, -0.3])
    quadrics = np.array([[0.02, -0.03, -0.05, 0.01, -0.04], [0.0, 0.01, 0.03, 0.0, 0.02]])
    points, plane = quadric_kernels.reflect_off_quadrics(
        center, quadrics, rays, LASER, PLANE.pose_mm
    )
    for (g_x, g_y, k_x, k_xy, k_y), point, dot in zip(quadrics, points, plane, strict=True):
        x, y = (point[:, :2] - center).T
        z = g_x * x + g_y * y + (k_x * x**2 + 2 * k_xy * x * y + k_y * y**2) / 2
        np.testing.assert_allclose(point[:, 2], z, atol=1e-5)
        np.testing.assert_allclose(np.cross(point - LASER, rays), 0.0, atol=1e-9)
        slope = np.stack([g_x + k_x * x + k_xy * y, g_y + k_xy * x + k_y * y], axis=-1)
        reflected = reflect(rays, surface_normal(slope))
        np.testing.assert_allclose(dot, intersect_imaging_plane(point, reflected, PLANE), atol=1e-9)


def test_predicted_dots_match_within_a_share_of_the_spacing() -> None:
    j, i = np.meshgrid(np.arange(4.0), np.arange(3.0))
    pattern = np.stack([2.0 * j, 3.0 * i], axis=-1)
    pattern[2, 3] = np.nan
    absent = np.zeros((3, 4), bool)
    absent[1, 1] = True
    places = np.array([[0.9, 0.0], [2.0, 3.0], [6.0, 1.1], [4.0, 5.0]])
    hit, dot, offset = (
        part[0] for part in quadric_kernels.match_predicted_dots(pattern[None], places, absent, 0.5)
    )
    np.testing.assert_allclose(offset[0, 0], 0.9)  # relative to half the spacing of 2 mm
    assert hit[0, 0]
    assert not hit[1, 1]  # the ray is absent
    assert np.isinf(offset[1, 1])
    assert not hit[0, 3]  # 1.1 of 1 mm
    assert dot[0, 3] == 2
    assert not hit[2, 3]
    assert np.isinf(offset[2, 3])
    assert np.argwhere(hit).tolist() == [[0, 0]]


@pytest.mark.parametrize("lit", [range(9), [0, 1, 2, 3, 8], [3, 4, 5], [0, 4, 8, 5]])
def test_quadrics_are_fitted_to_dots(lit: list[int]) -> None:
    rays, center = ray_directions(RIG.laser, RIG.pattern)[7:12, 7:12], np.array([0.1, -0.2])
    true = np.array([[0.02, -0.03, -0.05, 0.01, -0.04]])
    near, absent = true + 0.003 * random().normal(size=(1, 5)), np.zeros((5, 5), bool)
    bench = LASER, PLANE.pose_mm
    places = quadric_kernels.reflect_off_quadrics(center, true, rays.reshape(-1, 3), *bench)[1]
    places = places.reshape(5, 5, 2)[1:4, 1:4].reshape(-1, 2)[list(lit)]
    fitted = quadric_kernels.fit_quadrics(center, near, rays, *bench, places, absent, 0.5)
    if len(lit) < 4:
        np.testing.assert_array_equal(fitted, near)
        return
    pattern = quadric_kernels.reflect_off_quadrics(center, fitted, rays.reshape(-1, 3), *bench)[1][
        0
    ]
    distance = np.linalg.norm(places[:, None] - pattern, axis=-1).min(axis=1)
    assert distance.max() < 0.02
    if len(lit) > 4:
        np.testing.assert_allclose(fitted, true, atol=2e-4)


@pytest.mark.parametrize("missing", [0.0, 0.004, 0.3])
@pytest.mark.parametrize("known_rays", [1, 90, 2 * level_kernels.RAYS_PER_LOG + 7])
def test_level_likelihood_agrees_with_numpy(known_rays: int, missing: float) -> None:
    # Some heights are so far off that a plain exponential would overflow; one has no slope.
    over = random().normal(0.0, 0.1, (3, known_rays))
    over[:, ::3] = over[0, ::3]  # at the head the drop of the rear changes nothing
    side = random().choice([-1.0, 1.0], known_rays) / random().uniform(0.01, 0.04, known_rays)
    side[0] = 0.0
    levels, blurs = np.linspace(-0.05, 0.07, 31), np.array([0.005, 0.04, 0.25])
    dark = random().uniform(size=known_rays) < 0.4
    spread = np.where(random().uniform(size=known_rays) < 0.5, 0.0, 0.03)
    computed = level_kernels.level_negative_log_likelihood(
        over, side, dark, spread, missing, (levels[0], levels[1] - levels[0], 31),
        np.stack([blurs, np.zeros(3)]),
    )  # fmt: skip
    width = np.sqrt(blurs[:, None, None] ** 2 + spread)
    argument = side * (over[:, None, None] + levels[:, None]) / width
    expected = np.logaddexp(0.0, -argument)
    if missing:  # a dark ray is outside, or inside with its dot missing
        expected -= np.where(dark, np.logaddexp(0.0, np.log(missing) - argument), 0.0)
    expected = expected.sum(axis=-1)
    omitted = np.isinf(computed)
    assert (omitted == omitted.all(axis=0)).all()  # for every drop
    assert not omitted.all()
    assert (expected[omitted] > expected.min() + level_kernels.FARTHEST).all()
    rtol = 1e-9 if missing else 1e-11  # the two sums nearly cancel
    computed, expected = computed[~omitted], expected[~omitted]
    np.testing.assert_allclose(computed, expected, rtol=rtol, atol=1e-9 * bool(missing))


@pytest.mark.parametrize("beyond", [-1.0, 1.0])
def test_blurs_are_omitted_only_if_negligible(beyond: float) -> None:
    """A ray at the head contradicts the sharp blur at all levels; the prior may outweigh that."""
    over = np.array([[-0.2, 0.1, 0.2], [-0.2, 0.1, 0.1]])
    side, levels, blurs = np.full(3, 20.0), -0.05 + 0.01 * np.arange(11), np.array([0.005, 0.25])
    argument = side * (over[:, None, None] + levels[:, None]) / blurs[:, None, None]
    nats = np.logaddexp(0.0, -argument)  # drops, blurs, levels, rays
    sharp, wide = nats[0, 0, :, :2].sum(axis=-1).min(), nats[:, 1].sum(axis=-1).min()
    prior = sharp - wide - level_kernels.FARTHEST - beyond
    computed = level_kernels.level_negative_log_likelihood(
        over, side, np.zeros(3, bool), np.zeros(3), 0.0, (-0.05, 0.01, 11),
        np.array([blurs, [3.0, prior + 3.0]]),
    )  # fmt: skip
    assert np.isinf(computed[:, 0]).all() == (beyond > 0)
    np.testing.assert_allclose(computed[:, 1], nats[:, 1].sum(axis=-1))
    if beyond < 0:
        expected, omitted = nats[:, 0].sum(axis=-1), np.isinf(computed[:, 0])
        assert omitted.any()
        assert (expected[omitted] > wide + prior + level_kernels.FARTHEST).all()
        np.testing.assert_allclose(computed[:, 0][~omitted], expected[~omitted])


@pytest.mark.parametrize("depth", [0, 1])
def test_level_posterior_agrees_with_numpy(depth: int) -> None:
    nats = random().uniform(0.0, 4.0, (3, 4, 21))
    nats[depth] -= 3.0  # selects a sunken rear, or one that is not
    blur_cost, drops, levels = np.linspace(0, 1, 4), np.array([0.0, 0.05, 0.1]), 0.3 + np.arange(21)
    against = nats + blur_cost[:, None]
    against[1:] += 1.5
    posterior = np.exp(-against).sum(axis=1)
    posterior /= posterior.sum()
    part = slice(1, None) if depth else slice(0, 1)
    chosen = posterior[part] / posterior[part].sum()
    mean = chosen.sum(axis=0) @ levels
    drop = chosen.sum(axis=1) @ drops[part]
    higher, deeper = levels - mean, drops - drop
    expected = (
        mean,
        np.sqrt(posterior.sum(axis=0) @ higher**2),
        drop,
        np.sqrt(posterior.sum(axis=1) @ deeper**2),
        deeper @ posterior @ higher,
        posterior[:, [0, -1]].sum(),
    )
    computed = level_kernels.level_posterior(nats, blur_cost, 1.5, drops, 0.3, 1.0)
    np.testing.assert_allclose(computed, expected)


def test_likelihood_of_nan_heights_is_nan() -> None:
    over = np.array([[0.1, np.nan], [0.1, 0.2]])
    lit = np.zeros(2, bool)
    computed = level_kernels.level_negative_log_likelihood(
        over, np.ones(2), lit, np.zeros(2), 0.0, (0.0, 0.1, 3), np.ones((2, 2))
    )
    assert np.isnan(computed[0]).all()
    assert np.isfinite(computed[1]).all()


@pytest.mark.slow
def test_functions_are_compiled_without_a_usable_cache_folder(tmp_path: Path) -> None:
    script = "from labapp.core.compiled import compiled\nfrom numba import types\n" + (
        "made = compiled(types.int64)(eval('lambda x: x + 1'))\nprint(made(1))\n"
    )
    (tmp_path / "file").touch()
    process = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "file")},
    )  # fmt: skip
    assert (process.returncode, process.stdout) == (0, "2\n"), process.stderr


def test_first_compilation_is_announced_once(tmp_path: Path) -> None:
    source = """from numba import types
from labapp.core.compiled import compiled
@compiled(types.float64)
def twice(x): return 2.0 * x
"""
    for name in ("loops", "more_loops"):
        (tmp_path / f"{name}.py").write_text(source, "utf-8")
    messages = []
    for _ in range(2):
        process = subprocess.run(
            [sys.executable, "-c", "import loops, more_loops"],
            capture_output=True, text=True, check=True, cwd=tmp_path,
            env={
                **os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
                "PYTHONPATH": str(Path(__file__).parents[2]),
            },
        )  # fmt: skip
        messages.append(process.stderr.splitlines())
    assert [len(lines) for lines in messages] == [1, 0]


@pytest.mark.parametrize("height_mm", [0.3, -0.5])
def test_caps_are_scored_by_the_dots_near_their_predictions(height_mm: float) -> None:
    rng = np.random.default_rng(7)
    rays = ray_directions(RIG.laser, RIG.pattern).reshape(-1, 3)
    absent = np.zeros(len(rays), bool)
    absent[len(rays) // 2] = True
    middle, axes = np.array([0.2, -0.3]), np.array([2.6, 3.1])
    cap = np.array([*middle, *axes, height_mm])
    # NumPy and a k-d tree: the quadric's top is at 0, so the bench is moved down.
    down = np.array([0.0, 0.0, height_mm])
    plane = np.vstack([PLANE.pose_mm[:1] - down, PLANE.pose_mm[1:]])
    quadric = np.array(
        [[0.0, 0.0, -2 * height_mm / axes[0] ** 2, 0.0, -2 * height_mm / axes[1] ** 2]]
    )
    points, dots = (
        part[0]
        for part in quadric_kernels.reflect_off_quadrics(middle, quadric, rays, LASER - down, plane)
    )
    inside = (((points[:, :2] - middle) / axes) ** 2).sum(axis=1) < 1
    inside &= np.isfinite(dots).all(axis=1)
    predicted = np.flatnonzero(inside & ~absent)
    shown = rng.permutation(predicted)[: len(predicted) // 2]
    places = np.vstack([dots[shown] + rng.normal(0.0, 0.1, (len(shown), 2)), dots[absent]])
    spacing = cKDTree(dots[predicted]).query(dots[predicted], k=2)[0][:, 1]
    distance, dot = cKDTree(places).query(dots[predicted])
    mutual = cKDTree(dots[predicted]).query(places)[1][dot] == np.arange(len(predicted))
    near = mutual & (distance < 0.45 * spacing)
    expected = np.sum(1 - distance[near] / spacing[near]) - 0.5 * np.sum(~near) - 5.0
    labels = np.full(len(rays), -1)
    labels[predicted[near]] = dot[near]

    settings = np.array([10, 0.45, 0.5, 0.3, 5.0])
    far = cap + np.array([9.0, 0.0, 0.0, 0.0, 0.0])
    caps = np.array([cap, far])
    score, labelled = quadric_kernels.score_caps(
        caps, rays, LASER, PLANE.pose_mm, places, absent, settings
    )
    assert len(predicted) > 30
    assert 0 < near.sum() < len(predicted)
    np.testing.assert_allclose(score, [expected, -np.inf], rtol=1e-9)
    np.testing.assert_array_equal(labelled[0], labels)
    assert (labelled[1] == -1).all()
