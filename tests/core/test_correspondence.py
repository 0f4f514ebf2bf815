"""Correspondence of dots and rays on simulated scenes: correct, or rejected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.rig import DotPattern, Laser, Rig
from labapp.core.images.dots import Dots
from labapp.core.match import ORIENTATIONS, Match, Orientation, signs_of
from labapp.core.matching import match_rays as match_rays_module
from labapp.core.matching.corrected_rows import lattice_of_corrected, match_corrected
from labapp.core.matching.match_rays import lattice_of_match, match_rays
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import Observation
from labapp.core.rows.correction import (
    Correction,
    assign,
    block_row,
    clear_rows,
    delete_dots,
    set_reference,
    shift_row,
)
from labapp.core.rows.lattice import Lattice, Site
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice
from labapp.core.values import BoolArray, CannotMeasure
from labapp.simulation.forward import Reflections, seen_orientation, trace
from labapp.simulation.pools import Dent, Pool, Wave, egg, ellipsoidal_cap, spherical_cap
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, SeenDots, as_dots, see, visible_dots

COARSE_RIG = replace(BENCH_RIG, laser=Laser(35.0, 40.0), pattern=DotPattern(15, 15, 0.8))
FINE_RIG = replace(BENCH_RIG, pattern=DotPattern(19, 19, 0.6))


def cap(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return spherical_cap(width, width * rng.uniform(0.035, 0.06), center)


def ellipse(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    peak, length = width * rng.uniform(0.035, 0.06), width * rng.uniform(0.95, 1.2)
    return ellipsoidal_cap(width, length, peak, center)


def moving(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    peak, head = width * rng.uniform(0.035, 0.06), width * rng.uniform(0.42, 0.5)
    return egg(width, head, width * rng.uniform(0.55, 0.65), peak, center)


def dented(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    peak = width * rng.uniform(0.035, 0.06)
    dent = Dent(peak * rng.uniform(0.08, 0.2), rng.uniform(1.3, 1.8))
    return egg(width, 0.47 * width, 0.6 * width, peak, center, (dent,))


def concave(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return spherical_cap(width, -width * rng.uniform(0.085, 0.11), center)


SCENES: list[tuple[Callable[..., Pool], Rig]] = [
    *[(cap, BENCH_RIG)] * 5,
    *[(ellipse, BENCH_RIG)] * 5,
    *[(moving, BENCH_RIG)] * 4,
    *[(dented, BENCH_RIG)] * 2,
    *[(concave, BENCH_RIG)] * 3,
    *[(cap, COARSE_RIG)] * 2,
    *[(concave, COARSE_RIG)] * 2,
    (ellipse, FINE_RIG),
]


@dataclass(frozen=True)
class SceneResult:
    """Result of matching for one scene, and the truth."""

    pool: Pool
    rig: Rig
    reflections: Reflections
    seen: SeenDots
    match: Match | None
    status: str

    @property
    def wrong(self) -> BoolArray:
        """Whether each pair has another ray than the dot's true one, shape (n,)."""
        assert self.match is not None
        return np.asarray((self.seen.ray[self.match.dot] != self.match.ray).any(axis=-1))


def matched(
    dots: Dots, rig: Rig = BENCH_RIG, settings: MatchSettings | None = None
) -> tuple[Match | None, str]:
    """Return the match, and its status."""
    try:
        lattice = grow_lattice(dots, GrowSettings())
    except CannotMeasure:
        lattice = None
    try:
        observed = Observation.of(dots, Bench(rig, BENCH_VIEW), FRAME_SHAPE)
        match, _ = match_rays(observed, lattice, settings or MatchSettings())
    except CannotMeasure as error:
        return None, error.status if error.reason else "no reason"
    return match, "ok"


@cache
def computed() -> list[SceneResult]:
    results = []
    for seed, (kind, rig) in enumerate(SCENES):
        rng = np.random.default_rng(seed)
        pool = kind(rng, rng.uniform(4.8, 6.0), tuple(rng.uniform(-0.3, 0.3, 2)))
        missing, false = int(rng.integers(0, 4)), int(rng.integers(0, 5))
        seen = see(pool, rng, missing=missing, false=false, rig=rig)
        results.append(SceneResult(pool, rig, trace(pool, rig), seen, *matched(seen.dots, rig)))
    return results


@pytest.fixture
def scene_results() -> list[SceneResult]:
    """Results computed once per process, and only for slow tests."""
    return computed()


def with_match(scene_results: list[SceneResult]) -> list[tuple[SceneResult, Match]]:
    return [(scene, scene.match) for scene in scene_results if scene.match is not None]


@pytest.mark.slow
def test_no_dot_gets_a_wrong_ray(scene_results: list[SceneResult]) -> None:
    assert len(scene_results) >= 24
    assert sum(int(scene.wrong.sum()) for scene, _ in with_match(scene_results)) == 0


@pytest.mark.slow
def test_most_scenes_and_most_of_their_dots_are_matched(scene_results: list[SceneResult]) -> None:
    assert len(with_match(scene_results)) >= len(scene_results) - 2
    true_dots = sum(int((scene.seen.ray[:, 0] > 0).sum()) for scene, _ in with_match(scene_results))
    assert sum(len(match.dot) for _, match in with_match(scene_results)) >= 0.95 * true_dots
    for scene in scene_results:
        assert (scene.match is None) != (scene.status == "ok")
        assert scene.status != "no reason"


@pytest.mark.slow
def test_row_that_growth_does_not_reach_is_seeded(monkeypatch: pytest.MonkeyPatch) -> None:
    # A wave bends the pool so that each dot of an end row could belong to several rays.
    rng = np.random.default_rng(7)
    wave = Wave((2, 1), 0.015, 60.0, rng.uniform(0, 1 / 60), travelling=True)
    seen = see(egg(6.66, 3.0, 4.4, 0.29, (0.0, -0.6), (wave,)), rng)
    match, _ = matched(seen.dots)
    assert match is not None
    np.testing.assert_array_equal(seen.ray[match.dot], match.ray)
    assert len(match.dot) == len(seen.dots)
    # Each of the two finds them, and so do caps.
    monkeypatch.setattr(match_rays_module, "with_rows_beyond", lambda _scene, found: found)
    monkeypatch.setattr(match_rays_module, "with_repaired", lambda _scene, found, new: found + new)
    monkeypatch.setattr(match_rays_module, "_by_caps", lambda _scene: [])
    assert matched(seen.dots) == (None, "no-match")


@pytest.mark.slow
def test_orientation_is_right_with_a_large_margin(scene_results: list[SceneResult]) -> None:
    orientations: set[Orientation] = set()
    for scene, match in with_match(scene_results):
        assert match.orientation == seen_orientation(scene.reflections)
        assert match.residual_ratio >= 5
        assert match.trials[0].orientation == match.orientation
        assert {trial.orientation for trial in match.trials} == set(ORIENTATIONS)
        residuals = [trial.residual_mm for trial in match.trials]
        assert residuals == sorted(residuals)
        orientations.add(match.orientation)
    assert orientations == {"S/S", "I/I"}


@pytest.mark.slow
def test_match_is_consistent(scene_results: list[SceneResult]) -> None:
    for scene, match in with_match(scene_results):
        assert len(np.unique(match.dot)) == len(match.dot)
        assert len(np.unique(match.ray, axis=0)) == len(match.ray)
        labelled = np.zeros(match.ray_states.shape, bool)
        labelled[tuple(match.ray.T - 1)] = True
        np.testing.assert_array_equal(match.ray_states > 0, labelled)
        plane_mm = BENCH_VIEW.to_plane(scene.seen.dots.image_px[match.dot])
        np.testing.assert_allclose(match.plane_mm, plane_mm)
        assert (np.linalg.eigvalsh(match.plane_covariance_mm2) > 0).all()
        # Reflected numbers start at 1; the orientation gives their direction.
        assert match.reflected.min(axis=0).tolist() == [1, 1]
        offset = match.reflected - match.ray * signs_of(match.orientation)
        assert (offset == offset[0]).all()


@pytest.mark.slow
def test_rays_marked_as_dark_have_no_dot(scene_results: list[SceneResult]) -> None:
    # Rays hidden by the torch or missing the plane are not dark. Dots which the test removed at
    # the rim do not count: matching cannot know that they existed.
    dark_count = came_back = 0
    for scene, match in with_match(scene_results):
        dark = match.ray_states < 0
        dark_count += int(dark.sum())
        taken_out = scene.reflections.visible.copy()
        taken_out[tuple(scene.seen.ray[scene.seen.ray[:, 0] > 0].T - 1)] = False
        came_back += int((dark & scene.reflections.hit & ~taken_out).sum())
        assert not (dark & scene.reflections.absent).any()
        assert dark.any()
    assert dark_count >= 40 * len(with_match(scene_results))
    assert came_back <= 0.005 * dark_count


@pytest.mark.slow
def test_only_dots_with_a_ray_are_indexed(scene_results: list[SceneResult]) -> None:
    for scene, match in with_match(scene_results):
        lattice = lattice_of_match(match, scene.rig, len(scene.seen.dots))
        expected = np.zeros((len(scene.seen.dots), 2), int)
        expected[match.dot] = match.reflected
        np.testing.assert_array_equal(np.stack([lattice.row, lattice.column], axis=-1), expected)
        center = np.array(scene.rig.pattern.center_ray)
        offset = match.reflected[0] - match.ray[0] * signs_of(match.orientation)
        assert lattice.reference == tuple(center * signs_of(match.orientation) + offset)


CONVEX = egg(6.2, 2.8, 3.6, 0.32)
CONCAVE = spherical_cap(6.0, -0.6)


def exact(pool: Pool, with_reference: bool = False) -> SeenDots:
    """Return dots with little noise; the absent centre dot is lit on request, with ray 0."""
    reflections = trace(pool, BENCH_RIG)
    image, ray = visible_dots(reflections)
    if with_reference:
        center = tuple(n - 1 for n in BENCH_RIG.pattern.center_ray)
        image = np.vstack([image, BENCH_VIEW.to_image(reflections.plane_mm[center])])
        ray = np.vstack([ray, [0, 0]])
    noise = np.random.default_rng(0).normal(0.0, 0.1, image.shape)
    return SeenDots(as_dots(image + noise), ray)


@pytest.mark.slow
@pytest.mark.parametrize("pool", [CONVEX, CONCAVE])
def test_no_ray_is_wrong_where_the_centre_is_lit(pool: Pool) -> None:
    # Where the rim identifies the rows it may count as a false dot; it never gets a ray itself.
    seen = exact(pool, with_reference=True)
    match, status = matched(seen.dots)
    if match is None:
        assert status in {"no-reference", "no-match", "ambiguous-rows", "ambiguous-orientation"}
    else:
        np.testing.assert_array_equal(match.ray, seen.ray[match.dot])


@pytest.mark.parametrize("pool", [CONVEX, CONCAVE])
@pytest.mark.parametrize("hole", [(11, 10), (9, 10)])
@pytest.mark.slow
def test_second_hole_beside_the_reference_gives_no_wrong_rays(
    pool: Pool, hole: tuple[int, int]
) -> None:
    seen = exact(pool)
    others = np.flatnonzero((seen.ray != hole).any(axis=-1))
    assert len(others) == len(seen.ray) - 1
    match, status = matched(as_dots(seen.dots.image_px[others]))
    if match is None:
        assert status == "ambiguous-rows"
    else:
        np.testing.assert_array_equal(match.ray, seen.ray[others][match.dot])


def test_pool_too_shallow_for_its_orientation_is_rejected() -> None:
    seen = see(egg(6.2, 2.8, 3.6, 0.002), np.random.default_rng(0), sigma_px=0.3)
    match, status = matched(seen.dots)
    assert match is None
    assert status != "ok"


@pytest.mark.parametrize("peak_mm", [0.005, -0.008])
def test_boundary_decides_the_orientation_of_a_shallow_pool(peak_mm: float) -> None:
    seen = see(egg(6.2, 2.8, 3.6, peak_mm), np.random.default_rng(0), sigma_px=0.3)
    match, _ = matched(seen.dots)
    assert match is not None
    np.testing.assert_array_equal(seen.ray[match.dot], match.ray)


def wrong_setup(rng: np.random.Generator) -> Rig:
    """Return the bench with setup errors of 0.2° and 0.3 mm (standard deviations)."""
    laser, plane = BENCH_RIG.laser, BENCH_RIG.imaging_plane
    angle, distance = rng.normal(0.0, [0.2, 0.3])
    return replace(
        BENCH_RIG,
        laser=Laser(laser.projection_angle_deg + angle, laser.distance_mm + distance),
        imaging_plane=replace(plane, origin_mm=plane.origin_mm + rng.normal(0, 0.3, 3)),
    )


def shallow(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return egg(width, 0.47 * width, 0.6 * width, rng.choice([0.004, 0.008, 0.015, 0.03]), center)


def hollow(rng: np.random.Generator, width: float, center: tuple[float, float]) -> Pool:
    return egg(width, 0.47 * width, 0.6 * width, -rng.choice([0.004, 0.008, 0.015, 0.03]), center)


def with_wrong_setup(kind: Callable[..., Pool], seed: int) -> tuple[SeenDots, Match | None]:
    """Return the dots of a pool, and their match with a slightly wrong setup."""
    rng = np.random.default_rng([seed, 77])
    pool = kind(rng, rng.uniform(4.8, 6.6), tuple(rng.uniform(-0.3, 0.3, 2)))
    missing, false = int(rng.integers(0, 5)), int(rng.integers(0, 4))
    seen = see(pool, rng, sigma_px=0.1, missing=missing, false=false)
    return seen, matched(seen.dots, wrong_setup(rng))[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"),
    [(ellipse, 22), *((shallow, n) for n in (5, 9, 11, 16, 18)), (hollow, 9), (hollow, 18)],
)
def test_slightly_wrong_setup_gives_no_wrong_rays(kind: Callable[..., Pool], seed: int) -> None:
    """Once nearly all rays were wrong, and shallow pools had the opposite orientation."""
    seen, match = with_wrong_setup(kind, seed)
    if match is not None:
        assert (seen.ray[match.dot] == match.ray).all(axis=-1).mean() > 0.95


@pytest.mark.parametrize(("kind", "seed"), [(cap, 20), (ellipse, 24), (dented, 20)])
def test_slightly_wrong_setup_does_not_prevent_a_match(
    kind: Callable[..., Pool], seed: int
) -> None:
    seen, match = with_wrong_setup(kind, seed)
    assert match is not None
    np.testing.assert_array_equal(seen.ray[match.dot], match.ray)


def test_pattern_without_an_absent_ray_has_no_reference() -> None:
    rig = replace(BENCH_RIG, pattern=DotPattern(19, 19, 0.77, absent=frozenset()))
    seen = see(CONVEX, np.random.default_rng(0), rig=rig)
    assert matched(seen.dots, rig) == (None, "no-reference")


@pytest.mark.parametrize(("pool", "forced"), [(CONVEX, "I/I"), (CONVEX, "S/I"), (CONCAVE, "S/S")])
@pytest.mark.slow
def test_wrong_forced_correspondence_is_rejected(pool: Pool, forced: Orientation) -> None:
    match, status = matched(exact(pool).dots, settings=MatchSettings(correspondence=forced))
    assert match is None
    assert status != "ok"


@pytest.mark.parametrize(("pool", "forced"), [(CONVEX, "S/S"), (CONCAVE, "I/I")])
def test_right_forced_correspondence_changes_nothing(pool: Pool, forced: Orientation) -> None:
    seen = exact(pool)
    match, _ = matched(seen.dots, settings=MatchSettings(correspondence=forced))
    assert match is not None
    assert match.orientation == forced
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    assert len(match.dot) >= 0.95 * len(seen.ray)


def corrected(correction: Correction, settings: MatchSettings | None = None) -> Match:
    observed = Observation.of(correction.dots, Bench(BENCH_RIG, BENCH_VIEW), FRAME_SHAPE)
    return match_corrected(observed, correction.lattice, settings or MatchSettings())[0]


def by_hand(seen: SeenDots, orientation: Orientation = "S/S") -> tuple[Correction, Site]:
    """Return the true rows and columns as a manual correction, and the reference's site."""
    real = seen.ray[:, 0] > 0
    number = seen.ray * signs_of(orientation)
    step = 1 - number[real].min(axis=0)
    site = np.where(real[:, None], number + step, 0)
    k, t = (np.array([10, 10]) * signs_of(orientation) + step).tolist()
    return Correction.of(seen.dots, Lattice(site[:, 0], site[:, 1])), (k, t)


def grown(seen: SeenDots) -> tuple[Correction, Site]:
    """Return the rows found by the search (S/S), and the reference's site in them."""
    lattice = replace(grow_lattice(seen.dots, GrowSettings()), reference=None)
    site = np.stack([lattice.row, lattice.column], axis=-1)
    offset = (site - seen.ray)[(lattice.row > 0) & (seen.ray[:, 0] > 0)]
    k, t = (np.median(offset, axis=0) + 10).astype(int).tolist()
    return Correction.of(seen.dots, lattice), (k, t)


def without(seen: SeenDots, *rays: tuple[int, int]) -> SeenDots:
    keep = np.array([tuple(ray) not in rays for ray in seen.ray.tolist()])
    return SeenDots(as_dots(seen.dots.image_px[keep]), seen.ray[keep])


FLAT = spherical_cap(4.04, 0.06)
NARROW = spherical_cap(4.7, 0.211)
BEHIND_THE_TORCH = [(i, j) for i in (10, 11, 12) for j in (9, 10, 11)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pool", "hidden", "refusal"),
    [
        (FLAT, [(9, 10)], "ambiguous-rows"),
        (spherical_cap(5.5, 0.27), BEHIND_THE_TORCH, "no-match"),
    ],
)
def test_undetermined_reference_can_be_set_manually(
    pool: Pool, hidden: list[tuple[int, int]], refusal: str
) -> None:
    seen = without(exact(pool), *hidden)
    assert matched(seen.dots) == (None, refusal)
    correction, reference = grown(seen)
    match = corrected(set_reference(correction, reference))
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    assert len(match.dot) == len(seen.ray)
    assert match.orientation == "S/S"
    assert match.residual_ratio > 5


@pytest.mark.slow
def test_dot_that_hides_the_reference_can_be_deleted() -> None:
    seen = exact(NARROW, with_reference=True)
    assert matched(seen.dots) == (None, "no-reference")
    correction, reference = grown(seen)
    with pytest.raises(CannotMeasure, match="where the matrix has no rays"):
        corrected(set_reference(correction, reference))
    false = np.flatnonzero(seen.ray[:, 0] == 0)
    match = corrected(delete_dots(correction, false))  # the hole it leaves is the reference
    np.testing.assert_array_equal(match.ray, np.delete(seen.ray, false, axis=0)[match.dot])
    assert len(match.dot) == len(seen.ray) - 1


@pytest.mark.parametrize(("pool", "orientation"), [(CONVEX, "S/S"), (CONCAVE, "I/I")])
def test_manual_rows_are_binding_and_keep_their_numbers(
    pool: Pool, orientation: Orientation
) -> None:
    seen = without(exact(pool), *BEHIND_THE_TORCH)
    correction, reference = by_hand(seen, orientation)
    # Numbers need not begin at 1.
    lattice = correction.lattice
    raised = replace(lattice, row=lattice.row + 2, blocked_rows=frozenset({5}))
    correction = set_reference(
        replace(correction, lattice=raised), (reference[0] + 2, reference[1])
    )
    match = corrected(correction)
    assert match.orientation == orientation
    assert sorted(match.dot.tolist()) == list(range(len(seen.ray)))
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    after = lattice_of_corrected(match, BENCH_RIG, correction.lattice)
    np.testing.assert_array_equal(after.row, correction.lattice.row)
    np.testing.assert_array_equal(after.column, correction.lattice.column)
    assert after.reference == correction.lattice.reference
    assert after.blocked_rows == {5}


@pytest.mark.slow
def test_dots_in_doubt_get_rays_consistent_with_assigned_numbers() -> None:
    seen = see(CONVEX, np.random.default_rng(3), sigma_px=0.1, false=2)
    correction, reference = by_hand(seen)
    doubt = np.arange(0, len(seen.ray) - 2, 3)
    correction = set_reference(clear_rows(correction, doubt), reference)
    match = corrected(correction)
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    assert len(match.dot) == len(seen.ray) - 2
    # A row that contradicts the surface leaves the dot without a ray.
    one = int(doubt[4])
    true = int(by_hand(seen)[0].lattice.row[one])
    assert one in corrected(assign(correction, [one], row=true)).dot
    assert one not in corrected(assign(correction, [one], row=true + 1)).dot


@pytest.mark.slow
def test_corrected_frame_with_many_false_dots_is_measured() -> None:
    seen = see(CONVEX, np.random.default_rng(5), sigma_px=0.1, false=12)
    match, refusal = matched(seen.dots)
    assert match is not None, refusal
    correction, reference = by_hand(seen)
    again = corrected(set_reference(correction, reference))
    assert len(again.dot) == len(seen.ray) - 12
    np.testing.assert_array_equal(again.ray, seen.ray[again.dot])


@pytest.mark.slow
def test_rows_without_a_reference_are_matched_as_a_block() -> None:
    seen = exact(CONVEX)
    correction, reference = by_hand(seen)
    match = corrected(correction)
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    assert len(match.dot) == len(seen.ray)
    assert lattice_of_corrected(match, BENCH_RIG, correction.lattice).reference == reference


def test_dots_without_rows_are_matched_by_optics() -> None:
    seen = exact(CONVEX)
    match = corrected(Correction.of(seen.dots, None))
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    assert len(match.dot) == len(seen.ray)


@pytest.mark.slow
@pytest.mark.parametrize("pool", [CONVEX, CONCAVE])
@pytest.mark.parametrize("columns", [1, -1])
def test_wrongly_shifted_row_is_rejected_and_named(pool: Pool, columns: int) -> None:
    seen = exact(pool)
    correction, reference = by_hand(seen, "S/S" if pool is CONVEX else "I/I")
    good = set_reference(correction, reference)
    right = corrected(good).trials[0].residual_mm
    for row in (2, reference[0] - 1, reference[0] + 1):
        with pytest.raises(CannotMeasure, match=f"does not fit: .* most in row {row}") as refusal:
            corrected(shift_row(good, row, columns))
        assert refusal.value.status == "no-match"
    # A single dot that is one column off is tolerated, and increases the residual.
    edge = int(np.argmax(good.lattice.column))
    column = int(good.lattice.column[edge]) + 1
    assert corrected(assign(good, [edge], column=column)).trials[0].residual_mm > 1.3 * right


def test_dark_rays_of_blocked_rows_are_ignored() -> None:
    # The torch hides more than the rig predicts: the boundary must not exclude those rays.
    behind = {(i, j) for i in (6, 7) for j in range(12, 20)}
    seen = without(exact(CONVEX), *behind)
    correction, reference = by_hand(seen)
    correction = set_reference(correction, reference)
    silent = behind - set(map(tuple, exact(CONVEX).ray.tolist()))
    misled = corrected(correction).ray_states
    assert any(misled[i - 1, j - 1] < 0 for i, j in behind - silent)
    for i in (6, 7):
        correction = block_row(correction, reference[0] + i - 10)
    match = corrected(correction)
    rows = match.ray_states[5:7]
    assert set(np.unique(rows)) == {0, 1}
    np.testing.assert_array_equal(
        np.delete(match.ray_states, (5, 6), 0) > 0, np.delete(misled, (5, 6), 0) > 0
    )


def test_too_few_rows_or_wrong_orientation_is_rejected() -> None:
    seen = exact(CONVEX)
    correction, reference = by_hand(seen)
    good = set_reference(correction, reference)
    with pytest.raises(CannotMeasure, match="too-few-dots: only 5 dots have a row"):
        corrected(clear_rows(good, np.arange(5, len(seen.ray))))
    with pytest.raises(CannotMeasure, match="no-match: the correction"):
        corrected(good, MatchSettings(correspondence="I/I"))
    with pytest.raises(CannotMeasure, match="too-few-dots"):
        corrected(Correction.of(None, None))


def test_more_dots_than_any_match_can_explain_are_rejected_before_the_search() -> None:
    rng, rays = np.random.default_rng(3), BENCH_RIG.pattern.rows * BENCH_RIG.pattern.columns
    dots = as_dots(rng.uniform(0, FRAME_SHAPE[::-1], (int(1.4 * rays), 2)), 0.1)
    observed = Observation.of(dots, Bench(BENCH_RIG, BENCH_VIEW), FRAME_SHAPE)
    with pytest.raises(CannotMeasure, match=f"too-many-dots: {len(dots)} spots .* {rays} dots"):
        match_rays(observed, None, MatchSettings())


def test_a_few_rows_around_the_reference_suffice() -> None:
    seen = exact(CONVEX)
    correction, reference = by_hand(seen)
    far = np.flatnonzero(np.abs(seen.ray - 10).max(axis=-1) > 1)
    match = corrected(set_reference(clear_rows(correction, far), reference))
    np.testing.assert_array_equal(match.ray, seen.ray[match.dot])
    assert len(match.dot) >= 0.95 * len(seen.ray)


@pytest.mark.slow
def test_scattered_dots_have_no_rays() -> None:
    scattered = np.random.default_rng(1).uniform(40.0, 440.0, (60, 2))
    match, status = matched(as_dots(scattered))
    assert match is None
    assert status != "ok"


@pytest.mark.parametrize(
    "count",
    [
        1,
        2,
        4,
        8,
    ],
)
def test_handful_of_dots_is_rejected(count: int) -> None:
    seen = exact(CONVEX)
    match, status = matched(as_dots(seen.dots.image_px[:count]))
    assert match is None
    assert status != "ok"
