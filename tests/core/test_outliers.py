"""Labels that the surface fitted to all other dots does not support."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import convolve, maximum_filter

from labapp.core.matching import match_kernels, observation
from labapp.core.matching.decision import fitted_labels
from labapp.core.matching.hypothesis import USUAL_KNOTS, evaluate
from labapp.core.matching.observation import UNLABELLED, Observation, try_fit
from labapp.core.matching.outliers import unsupported
from labapp.core.matching.prediction import sure_pairs
from labapp.core.surface.level import Witnesses
from labapp.core.surface.pool_fit import FittedPool
from labapp.core.values import FloatArray, IntArray
from labapp.simulation.pools import egg
from tests.core.test_dips import observation_of
from tests.scenes import BENCH_RIG, see

POOL = egg(5.8, 2.6, 3.2, 0.28)
FIT = replace(USUAL_KNOTS, settled_mm=1e-4)


def scene(seed: int = 1) -> tuple[Observation, IntArray]:
    """A pool's dots with 0.15 px of noise, and their true labels."""
    return observation_of(see(POOL, np.random.default_rng(seed)))


def left_out(observed: Observation, labels: IntArray) -> list[int]:
    """Dots that lose their label."""
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    return sorted(unsupported(observed, fitted_labels(observed, hypothesis, FIT)).tolist())


def with_dot(observed: Observation, place_mm: FloatArray) -> Observation:
    """The observation with one more dot, which is the last."""
    covariance = np.concatenate([observed.covariance_mm2, observed.covariance_mm2[:1]])
    size = np.append(observed.size_mm, observed.size_mm[0])
    plane = np.vstack([observed.plane_mm, place_mm])
    return Observation(plane, covariance, size, observed.bench, observed.frame_shape)


def inner_dot(labels: IntArray) -> int:
    """A dot in the pool's middle, two rays beside the absent one."""
    return int(labels[9, 11])


def test_a_label_without_a_neighbour_is_not_supported() -> None:
    # Nothing beside it says whether its dot is that ray's or the next one's.
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


def test_a_dot_off_its_place_by_a_third_of_a_millimetre_is_not_its_ray_s() -> None:
    observed, labels = scene()
    dot = inner_dot(labels)
    plane = observed.plane_mm.copy()
    plane[dot] += [0.4, 0.0]
    assert left_out(replace(observed, plane_mm=plane), labels) == [dot]


def test_of_two_dots_where_a_ray_s_is_predicted_neither_is_its_own() -> None:
    observed, labels = scene()
    dot = inner_dot(labels)
    beside = with_dot(observed, observed.plane_mm[dot] + [0.05, 0.05])
    assert left_out(beside, labels) == [dot]


def test_a_dot_keeps_its_ray_where_the_surface_tells_it_from_one_beside_it() -> None:
    observed, labels = scene()
    beside = with_dot(observed, observed.plane_mm[inner_dot(labels)] + [0.5, 0.0])
    assert left_out(beside, labels) == []


def test_a_wide_dot_beside_the_place_of_one_that_is_not_seen_may_be_both() -> None:
    observed, labels = scene()
    dot, size = inner_dot(labels), np.full(len(observed.plane_mm), 2.0)
    size[dot] *= 1.4
    wide, fewer = replace(observed, size_mm=size), labels.copy()
    fewer[9, 12] = UNLABELLED
    assert left_out(wide, labels) == []
    assert left_out(wide, fewer) == [dot]


def test_a_false_dot_where_a_ray_outside_the_boundary_is_predicted_gets_no_ray() -> None:
    observed, labels = scene()
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    fitted = fitted_labels(observed, hypothesis, FIT)
    # The dark ray beside the lit ones that lands farthest outside the boundary.
    at = [tuple(k) for k in np.argwhere((hypothesis.witness < 0) & _beside(labels))]
    landing = observed.landing_mm[tuple(np.array(at).T)]
    height, _ = hypothesis.pool.surface.height_and_gradient(*landing[:, :2].T)
    ray = at[int(np.argmin(height))]
    place = fitted.paths.plane_mm.reshape(*labels.shape, 2)[ray]
    wrong = labels.copy()
    wrong[ray] = len(observed.plane_mm)
    assert left_out(with_dot(observed, place), wrong) == [len(observed.plane_mm)]


def _beside(labels: IntArray) -> np.ndarray:
    """Rays next to a labelled one in their row or column."""
    lit = np.pad(labels != UNLABELLED, 1)
    beside = lit[2:, 1:-1] | lit[:-2, 1:-1] | lit[1:-1, 2:] | lit[1:-1, :-2]
    return beside & ~lit[1:-1, 1:-1]


def test_a_dot_that_two_rays_may_have_made_is_no_sure_pair() -> None:
    observed, _ = scene()
    dots, far = np.arange(len(observed.plane_mm)), np.array([[30.0, 0.0]])
    covariance = np.tile(1e-4 * np.eye(2), (2, 1, 1))
    one = np.vstack([observed.plane_mm[:1], observed.plane_mm[:1] + far])
    assert [k.tolist() for k in sure_pairs(observed, dots, one, covariance)] == [[0], [0]]
    two = np.vstack([observed.plane_mm[:1], observed.plane_mm[:1] + 0.05])
    assert sure_pairs(observed, dots, two, covariance)[0].tolist() == []
    # Where a prediction is vague a false dot is as likely.
    vague = sure_pairs(observed, dots[:1], one[:1], 100.0 * covariance[:1] / 1e-4)
    assert vague[0].tolist() == []


def test_left_out_residuals_are_those_of_fits_without_each_dot() -> None:
    rng = np.random.default_rng(5)
    design, n = rng.normal(size=(8, 2, 5)), 8
    half = rng.normal(0.0, 0.5, (n, 2, 2))
    dot = half @ half.swapaxes(1, 2) + 0.1 * np.eye(2)
    seen = rng.normal(size=(n, 2))

    def fitted(some: list[int]) -> tuple[FloatArray, FloatArray]:
        weight = np.linalg.inv(dot[some])
        normal = np.einsum("nai,nab,nbj->ij", design[some], weight, design[some])
        right = np.einsum("nai,nab,nb->i", design[some], weight, seen[some])
        return np.linalg.solve(normal, right), np.linalg.inv(normal)

    found, covariance = fitted(list(range(n)))
    computed = design @ covariance @ design.swapaxes(1, 2)
    off, spread = match_kernels.left_out(design @ found - seen, dot, computed, 0.0, 1.0)
    for k in range(n):
        others, uncertain = fitted([m for m in range(n) if m != k])
        np.testing.assert_allclose(off[k], design[k] @ others - seen[k], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(spread[k], design[k] @ uncertain @ design[k].T, rtol=1e-6)


def test_a_fit_that_goes_through_a_dot_says_little_of_it() -> None:
    dot = 1e-4 * np.eye(2)[None]
    off, spread = match_kernels.left_out(np.zeros((1, 2)), dot, 1.1 * dot, 0.0, 0.998)
    assert np.isfinite(off).all()
    assert (np.linalg.eigvalsh(spread[0]) > 20 * 1e-4).all()


def test_labels_fail_by_the_likelihoods_of_ray_rivals_and_false_dots() -> None:
    rng, shape = np.random.default_rng(9), (6, 7)
    labels = np.full(shape, UNLABELLED)
    labels[rng.uniform(size=shape) < 0.7] = 0
    lit = labels != UNLABELLED
    count = int(lit.sum())
    labels[lit] = rng.permutation(count)
    predicted = np.stack(np.indices(shape)[::-1], axis=-1).reshape(-1, 2).astype(float)
    places = rng.uniform(-1, 8, (count + 3, 2))  # the last three have no ray
    places[labels[lit]] = predicted[lit.ravel()] + rng.normal(0.0, 0.1, (count, 2))
    seen, drawn = (0.02 * covariances(rng, n) for n in (len(places), lit.size))
    shows, missed = rng.uniform(0.2, 1.0, count), np.flatnonzero(~lit)[:5]
    drawn[missed[0]] = np.nan
    stray, false, gate, margin = np.arange(count, count + 3), 3.0, 20.0, 1.0
    rim_neighbours, rim_sigma2, rim_times = 4, 4.0, 2.0
    limits = np.array([1e-4, 0.02, 0.998, 1.4, 1e-3, 1.386, false, gate, margin])
    limits = np.append(limits, [rim_neighbours, rim_sigma2, rim_times])
    found = match_kernels.failing_labels(
        labels, (places, seen), (predicted, drawn), shows, missed, stray, limits
    )

    own, rays, fitted = labels[lit], np.flatnonzero(lit), seen + 1e-4 * np.eye(2)
    off, spread = match_kernels.left_out(
        predicted[rays] - places[own], fitted[own], drawn[rays], 0.02, 0.998
    )
    spread = 1.4 * spread + 1e-3 * np.eye(2)

    def deviance(away: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        square = np.einsum("...i,...ij,...j->...", away, np.linalg.inv(covariance), away)
        return square, square + np.log(np.linalg.det(covariance))

    excess = max(1.0, np.median(deviance(off, fitted[own] + spread)[0]) / 1.386)
    square, own_deviance = deviance(off, excess * (fitted[own] + spread))
    to_stray = (places[own] + off)[:, None] - places[stray]
    by_stray = deviance(to_stray, excess * (spread[:, None] + seen[stray]))[1].min(axis=1)
    around = 1.4 * drawn[missed[1:]] + 1e-3 * np.eye(2)
    to_missed = places[own][:, None] - predicted[missed[1:]]
    by_missed = deviance(to_missed, excess * (fitted[own][:, None] + around))[1].min(axis=1)
    neighbours = (convolve(lit.astype(int), np.ones((3, 3)), mode="constant") - 1)[lit]
    rim_gate = min(max(rim_sigma2, rim_times * np.median(square)), gate)
    gates = np.where(neighbours <= rim_neighbours, rim_gate, gate)
    assert (square > gates).sum() > (square > gate).sum()
    fails = (square > gates) | (own_deviance + 2 * np.log((1 - shows) / shows) + margin > false)
    fails |= own_deviance + margin > np.minimum(by_stray, by_missed)
    worst = np.zeros(shape)
    worst[lit] = np.where(fails, square, 0.0)
    wanted = (worst > 0.0) & (worst >= maximum_filter(worst, 3, mode="constant"))
    assert 0 < wanted.sum() < fails.sum() < count
    np.testing.assert_array_equal(found, wanted)


def covariances(rng: np.random.Generator, count: int) -> FloatArray:
    half = rng.normal(0.0, 0.5, (count, 2, 2))
    return half @ half.swapaxes(1, 2) + 0.3 * np.eye(2)


def test_a_ray_far_outside_the_boundary_is_unlikely_to_have_come_back() -> None:
    observed, labels = scene()
    hypothesis = evaluate(observed, labels, FIT)
    assert hypothesis is not None
    surface, pool = hypothesis.pool.surface, hypothesis.pool
    x, y = observed.landing_mm[..., 0], observed.landing_mm[..., 1]
    height, slope = surface.height_and_gradient(x.ravel(), y.ravel())
    rise = np.linalg.norm(slope * observed.spacing_mm, axis=-1).reshape(labels.shape)
    inward = height.reshape(labels.shape) / rise
    dark = np.argwhere((hypothesis.witness < 0) & (inward < -0.5) & (inward > -2.0))

    def evidence(sign: int) -> float:
        witness = hypothesis.witness.copy()
        witness[tuple(dark[0])] = sign
        rays = observed.bench.rays, BENCH_RIG.head_sign, witness, surface.basis, 0.01
        level = pool.level
        return Witnesses.of(*rays).negative_log_evidence(surface.basis, surface.coefficients, level)

    assert evidence(1) - evidence(-1) > 3.0


def test_only_the_newest_fits_of_a_frame_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    observed, labels = scene()
    monkeypatch.setattr(observation, "COUNTED_EVERY", 1)

    def fitted(row: int) -> FittedPool:
        some = labels.copy()
        some[row] = UNLABELLED
        found = try_fit(observed, some)
        assert found is not None
        return found

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
