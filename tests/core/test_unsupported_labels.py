"""Labels that the surface fitted to all other dots does not support."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import convolve, maximum_filter

from labapp.core.matching import match_kernels, observation
from labapp.core.matching.checks.unsupported_labels import unsupported
from labapp.core.matching.decision import fitted_labels
from labapp.core.matching.hypothesis import USUAL_FIT, evaluate
from labapp.core.matching.observation import UNLABELLED, Observation, try_fit
from labapp.core.matching.prediction import sure_pairs
from labapp.core.pipeline import Settings, measure
from labapp.core.surface.level import KnownRays
from labapp.core.surface.pool_fit import FittedPool
from labapp.core.values import FloatArray, IntArray
from labapp.simulation.pools import egg
from tests.benchmarks.benches import compared, draw_scene, image_of
from tests.core.test_dips import observation_of
from tests.scenes import BENCH_RIG, see

POOL = egg(5.8, 2.6, 3.2, 0.28)
FIT = replace(USUAL_FIT, settled_mm=1e-4)


def scene(seed: int = 1) -> tuple[Observation, IntArray]:
    """Return a pool's dots with 0.15 px of noise, and their true labels."""
    return observation_of(see(POOL, np.random.default_rng(seed)))


def left_out(observed: Observation, labels: IntArray) -> list[int]:
    """Return the dots that lose their label."""
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    return sorted(unsupported(observed, fitted_labels(observed, hypothesis, FIT)).tolist())


def with_dot(observed: Observation, place_mm: FloatArray) -> Observation:
    """Return the observation with a dot appended."""
    covariance = np.concatenate([observed.covariance_mm2, observed.covariance_mm2[:1]])
    size = np.append(observed.size_mm, observed.size_mm[0])
    plane = np.vstack([observed.plane_mm, place_mm])
    return Observation(plane, covariance, size, observed.bench, observed.frame_shape)


def inner_dot(labels: IntArray) -> int:
    """Return a dot in the pool's middle, two rays from the absent one."""
    return int(labels[9, 11])


def test_label_without_a_neighbour_is_not_supported() -> None:
    # Without neighbours its dot could also belong to the next ray.
    observed, labels = scene()
    row, column = 10, int(np.flatnonzero(labels[10] != UNLABELLED)[0])
    alone = labels[row, column]
    labels = labels.copy()
    labels[row - 1 : row + 2, : column + 3] = UNLABELLED
    labels[row, column] = alone
    assert alone in left_out(observed, labels)
    labels[row, column + 1 : column + 3] = scene()[1][row, column + 1 : column + 3]
    assert alone not in left_out(observed, labels)


@pytest.mark.parametrize("seed", range(4))
def test_right_labels_are_supported(seed: int) -> None:
    assert left_out(*scene(seed)) == []


def test_dot_0_4_mm_from_its_prediction_loses_its_ray() -> None:
    observed, labels = scene()
    dot = inner_dot(labels)
    plane = observed.plane_mm.copy()
    plane[dot] += [0.4, 0.0]
    assert left_out(replace(observed, plane_mm=plane), labels) == [dot]


def test_two_dots_at_one_prediction_both_get_no_ray() -> None:
    observed, labels = scene()
    dot = inner_dot(labels)
    beside = with_dot(observed, observed.plane_mm[dot] + [0.05, 0.05])
    assert left_out(beside, labels) == [dot]


def test_dot_keeps_its_ray_if_the_surface_excludes_a_neighbour() -> None:
    observed, labels = scene()
    beside = with_dot(observed, observed.plane_mm[inner_dot(labels)] + [0.5, 0.0])
    assert left_out(beside, labels) == []


def test_label_between_two_free_dots_is_not_supported_unless_its_row_is_hidden() -> None:
    observed, labels = scene()
    dot, fewer = inner_dot(labels), labels.copy()
    fewer[9, [10, 12]] = UNLABELLED
    assert left_out(observed, fewer) == [dot]
    assert left_out(replace(observed, hidden_rows=frozenset({10})), fewer) == []


def test_wide_dot_beside_a_missing_one_may_be_both_unless_its_row_is_hidden() -> None:
    observed, labels = scene()
    dot, size = inner_dot(labels), np.full(len(observed.plane_mm), 2.0)
    size[dot] *= 1.4
    wide, fewer = replace(observed, size_mm=size), labels.copy()
    fewer[9, 12] = UNLABELLED
    assert left_out(wide, labels) == []
    assert left_out(wide, fewer) == [dot]
    assert left_out(replace(wide, hidden_rows=frozenset({10})), fewer) == []


def test_false_dot_of_a_ray_outside_the_boundary_gets_no_ray() -> None:
    observed, labels = scene()
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    fitted = fitted_labels(observed, hypothesis, FIT)
    # Among the dark rays next to lit ones, that which lands farthest outside the boundary.
    candidates = [tuple(k) for k in np.argwhere((hypothesis.ray_states < 0) & _beside(labels))]
    landing = observed.rays.landing_mm[tuple(np.array(candidates).T)]
    height, _ = hypothesis.pool.surface.height_and_gradient(*landing[:, :2].T)
    ray = candidates[int(np.argmin(height))]
    predicted = fitted.paths.plane_mm.reshape(*labels.shape, 2)[ray]
    wrong = labels.copy()
    wrong[ray] = len(observed.plane_mm)
    assert left_out(with_dot(observed, predicted), wrong) == [len(observed.plane_mm)]


def _beside(labels: IntArray) -> np.ndarray:
    """Return a mask of rays next to a labelled one in their row or column."""
    lit = np.pad(labels != UNLABELLED, 1)
    beside = lit[2:, 1:-1] | lit[:-2, 1:-1] | lit[1:-1, 2:] | lit[1:-1, :-2]
    return beside & ~lit[1:-1, 1:-1]


def test_dot_near_two_predictions_is_no_sure_pair() -> None:
    observed, _ = scene()
    dots, far = np.arange(len(observed.plane_mm)), np.array([[30.0, 0.0]])
    covariance = np.tile(1e-4 * np.eye(2), (2, 1, 1))
    single = np.vstack([observed.plane_mm[:1], observed.plane_mm[:1] + far])
    assert [k.tolist() for k in sure_pairs(observed, dots, single, covariance)] == [[0], [0]]
    ambiguous = np.vstack([observed.plane_mm[:1], observed.plane_mm[:1] + 0.05])
    assert sure_pairs(observed, dots, ambiguous, covariance)[0].tolist() == []
    # Where a prediction is vague, a false dot is equally likely.
    vague = sure_pairs(observed, dots[:1], single[:1], 100.0 * covariance[:1] / 1e-4)
    assert vague[0].tolist() == []


def test_left_out_residuals_are_those_of_fits_without_each_dot() -> None:
    rng = np.random.default_rng(5)
    design, n = rng.normal(size=(8, 2, 5)), 8
    half = rng.normal(0.0, 0.5, (n, 2, 2))
    dot = half @ half.swapaxes(1, 2) + 0.1 * np.eye(2)
    observed = rng.normal(size=(n, 2))

    def fitted(some: list[int]) -> tuple[FloatArray, FloatArray]:
        weight = np.linalg.inv(dot[some])
        normal = np.einsum("nai,nab,nbj->ij", design[some], weight, design[some])
        right = np.einsum("nai,nab,nb->i", design[some], weight, observed[some])
        return np.linalg.solve(normal, right), np.linalg.inv(normal)

    solution, covariance = fitted(list(range(n)))
    computed = design @ covariance @ design.swapaxes(1, 2)
    residual, spread = match_kernels.left_out(design @ solution - observed, dot, computed, 0.0, 1.0)
    for k in range(n):
        others, uncertain = fitted([m for m in range(n) if m != k])
        np.testing.assert_allclose(
            residual[k], design[k] @ others - observed[k], rtol=1e-6, atol=1e-9
        )
        np.testing.assert_allclose(spread[k], design[k] @ uncertain @ design[k].T, rtol=1e-6)


def test_interpolating_fit_gives_a_vague_left_out_prediction() -> None:
    dot = 1e-4 * np.eye(2)[None]
    residual, spread = match_kernels.left_out(np.zeros((1, 2)), dot, 1.1 * dot, 0.0, 0.998)
    assert np.isfinite(residual).all()
    assert (np.linalg.eigvalsh(spread[0]) > 20 * 1e-4).all()


def test_labels_fail_by_likelihoods_of_rivals_and_false_dots() -> None:
    rng, shape = np.random.default_rng(9), (6, 7)
    labels = np.full(shape, UNLABELLED)
    labels[rng.uniform(size=shape) < 0.7] = 0
    lit = labels != UNLABELLED
    count = int(lit.sum())
    labels[lit] = rng.permutation(count)
    predicted = np.stack(np.indices(shape)[::-1], axis=-1).reshape(-1, 2).astype(float)
    places = rng.uniform(-1, 8, (count + 3, 2))  # the last three have no ray
    places[labels[lit]] = predicted[lit.ravel()] + rng.normal(0.0, 0.1, (count, 2))
    dot_covariance, predicted_covariance = (
        0.02 * covariances(rng, n) for n in (len(places), lit.size)
    )
    shows, missed = rng.uniform(0.2, 1.0, count), np.flatnonzero(~lit)[:5]
    predicted_covariance[missed[0]] = np.nan
    stray, false, gate, margin = np.arange(count, count + 3), 3.0, 20.0, 1.0
    rim_neighbours, rim_sigma2, rim_times = 4, 4.0, 2.0
    limits = np.array([1e-4, 0.02, 0.998, 1.4, 1e-3, 1.386, false, gate, margin])
    limits = np.append(limits, [rim_neighbours, rim_sigma2, rim_times])
    failing = match_kernels.failing_labels(
        labels,
        (places, dot_covariance),
        (predicted, predicted_covariance),
        shows,
        missed,
        stray,
        limits,
    )

    labelled, rays, fitted = labels[lit], np.flatnonzero(lit), dot_covariance + 1e-4 * np.eye(2)
    residual, spread = match_kernels.left_out(
        predicted[rays] - places[labelled],
        fitted[labelled],
        predicted_covariance[rays],
        0.02,
        0.998,
    )
    spread = 1.4 * spread + 1e-3 * np.eye(2)

    def deviance(away: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        square = np.einsum("...i,...ij,...j->...", away, np.linalg.inv(covariance), away)
        return square, square + np.log(np.linalg.det(covariance))

    excess = max(1.0, np.median(deviance(residual, fitted[labelled] + spread)[0]) / 1.386)
    square, own_deviance = deviance(residual, excess * (fitted[labelled] + spread))
    to_stray = (places[labelled] + residual)[:, None] - places[stray]
    by_stray = deviance(to_stray, excess * (spread[:, None] + dot_covariance[stray]))[1].min(axis=1)
    around = 1.4 * predicted_covariance[missed[1:]] + 1e-3 * np.eye(2)
    to_missed = places[labelled][:, None] - predicted[missed[1:]]
    by_missed = deviance(to_missed, excess * (fitted[labelled][:, None] + around))[1].min(axis=1)
    neighbours = (convolve(lit.astype(int), np.ones((3, 3)), mode="constant") - 1)[lit]
    rim_gate = min(max(rim_sigma2, rim_times * np.median(square)), gate)
    gates = np.where(neighbours <= rim_neighbours, rim_gate, gate)
    assert (square > gates).sum() > (square > gate).sum()
    fails = (square > gates) | (own_deviance + 2 * np.log((1 - shows) / shows) + margin > false)
    fails |= own_deviance + margin > np.minimum(by_stray, by_missed)
    worst = np.zeros(shape)
    worst[lit] = np.where(fails, square, 0.0)
    expected = (worst > 0.0) & (worst >= maximum_filter(worst, 3, mode="constant"))
    expected[lit] |= neighbours == 0
    assert 0 < expected.sum() < fails.sum() < count
    np.testing.assert_array_equal(failing, expected)


def covariances(rng: np.random.Generator, count: int) -> FloatArray:
    half = rng.normal(0.0, 0.5, (count, 2, 2))
    return half @ half.swapaxes(1, 2) + 0.3 * np.eye(2)


def test_reflection_far_outside_the_boundary_is_unlikely() -> None:
    observed, labels = scene()
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    surface, pool = hypothesis.pool.surface, hypothesis.pool
    x, y = observed.rays.landing_mm[..., 0], observed.rays.landing_mm[..., 1]
    height, slope = surface.height_and_gradient(x.ravel(), y.ravel())
    rise = np.linalg.norm(slope * observed.rays.spacing_mm, axis=-1).reshape(labels.shape)
    inward = height.reshape(labels.shape) / rise
    dark = np.argwhere((hypothesis.ray_states < 0) & (inward < -0.5) & (inward > -2.0))

    def evidence(sign: int) -> float:
        ray_states = hypothesis.ray_states.copy()
        ray_states[tuple(dark[0])] = sign
        rays = BENCH_RIG, ray_states, surface.basis, 0.01
        level = pool.level
        return KnownRays.of(*rays).negative_log_evidence(surface.basis, surface.coefficients, level)

    assert evidence(1) - evidence(-1) > 3.0


def test_only_the_newest_fits_of_a_frame_are_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    observed, labels = scene()

    def fitted(row: int) -> FittedPool:
        some = labels.copy()
        some[row] = UNLABELLED
        pool = try_fit(observed, some)
        assert pool is not None
        return pool

    first, newest = fitted(8), fitted(10)
    assert fitted(8) is first
    monkeypatch.setattr(observation, "KEPT_BYTES", newest.factor.nbytes)
    fitted(11)
    assert fitted(10) is newest
    again = fitted(8)
    assert again is not first
    assert again.points_mm == pytest.approx(first.points_mm, abs=1e-9)


def test_a_fit_that_is_kept_takes_little_more_than_its_factor() -> None:
    observed, labels = scene()
    fitted = [try_fit(observed, np.where(labels == dot, UNLABELLED, labels)) for dot in range(30)]
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    more = [try_fit(observed, np.where(labels == dot, UNLABELLED, labels)) for dot in range(30, 60)]
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert all(pool is not None for pool in fitted)
    factors = sum(pool.factor.nbytes for pool in more if pool is not None)
    assert factors > 1e6
    assert after - before < 1.5 * factors


def lone_dot() -> tuple[Observation, IntArray, tuple[int, int]]:
    """Return a scene with a false dot where the innermost lone dark ray would make one.

    The labels include it; none beside it in its row has a dot, and 3 dots lie around it.
    """
    observed, labels = scene()
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    lit = labels != UNLABELLED
    around = convolve(lit.astype(int), np.ones((3, 3), int), mode="constant")
    in_row = convolve(lit.astype(int), np.array([[1, 0, 1]]), mode="constant")
    lone = np.argwhere((hypothesis.ray_states < 0) & (around == 3) & (in_row == 0))
    height = hypothesis.pool.surface.height_and_gradient(
        *observed.rays.landing_mm[tuple(lone.T)][:, :2].T
    )[0]
    row, column = lone[np.argmax(height)].tolist()
    predicted = fitted_labels(observed, hypothesis, FIT).paths.plane_mm
    place = predicted.reshape(*labels.shape, 2)[row, column] + [0.15, 0.1]
    wrong = labels.copy()
    wrong[row, column] = len(observed.plane_mm)
    return with_dot(observed, place), wrong, (row, column)


def test_false_dot_beyond_the_last_row_gets_no_ray() -> None:
    observed, labels, ray = lone_dot()
    assert left_out(observed, labels) == [labels[ray]]


def lone_ray() -> tuple[Observation, IntArray, tuple[int, int]]:
    """Return a scene in which one dot, rightly labelled, is the only one of the last row."""
    observed, labels = observation_of(see(egg(5.6, 2.5, 3.6, 0.28), np.random.default_rng(1)))
    assert np.flatnonzero(labels[5] != UNLABELLED).tolist() == [9]
    return observed, labels, (5, 9)


def left_out_after(observed: Observation, labels: IntArray, was_lit: np.ndarray) -> list[int]:
    """Return the dots that lose their label if these rays had dots in the previous frame."""
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    fitted = replace(fitted_labels(observed, hypothesis, FIT), was_lit=was_lit)
    return unsupported(observed, fitted).tolist()


def test_dot_beyond_the_last_row_keeps_its_ray_unless_it_had_none_in_the_previous_frame() -> None:
    observed, labels, ray = lone_ray()
    lit = labels != UNLABELLED
    assert left_out(observed, labels) == []
    assert left_out_after(observed, labels, lit) == []
    lit[ray] = False
    assert left_out_after(observed, labels, lit) == [labels[ray]]
    lit[5, 8] = lit[5, 10] = True  # their dots may be missing in this frame
    assert left_out_after(observed, labels, lit) == []


def test_among_false_dots_it_keeps_its_ray_only_if_it_had_one_in_the_previous_frame() -> None:
    observed, labels, ray = lone_ray()
    for number in range(10):
        observed = with_dot(observed, np.array([2.0 + 3.0 * number, 100.0]))
    assert left_out(observed, labels) == [labels[ray]]
    assert left_out_after(observed, labels, labels != UNLABELLED) == []


@pytest.mark.slow
def test_ray_that_loses_its_label_does_not_count_as_dark() -> None:
    """As dark, it contradicted the boundary, and the frame was refused."""
    scene = draw_scene("egg", 725)
    found = compared(scene, measure(image_of(scene), scene.bench, Settings())[0])
    assert (found.status, found.wrong) == ("ok", 0)
    assert abs(found.height) < 0.1
