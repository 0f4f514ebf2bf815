"""The adviser: its constraints, predicted errors, and advice when nothing is possible."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from labapp.config.setup import pattern_values
from labapp.core.geometry.rig import DotPattern
from labapp.simulation.forward import trace
from labapp.simulation.pools import spherical_cap
from labapp.studies.adviser import search
from labapp.studies.adviser.bench_limits import BenchLimits, LaserPlace, Place
from labapp.studies.adviser.check import Check, check, check_text
from labapp.studies.adviser.expected_pools import ExpectedPools
from labapp.studies.adviser.height_error import Trial, predicted_errors, simulated_errors
from labapp.studies.adviser.keys import parse_request
from labapp.studies.adviser.report import advice_table, advice_text, cost_table
from labapp.studies.adviser.search import Advice, Effort, Sweep, advise, constraint_text
from labapp.studies.parameter_deviation import NOMINAL
from tests.core.test_patterns import measured_pattern

EXPECTED = ExpectedPools((6.0, 7.0), (6.5, 8.0), (0.12, 0.2))
# A roughly calibrated bench: few pools suffice to show the effect of the plane's distance.
LIMITS = BenchLimits(
    angle_deg=(28.0, 32.0),
    distance_mm=(26.0, 32.0),
    plane_mm=(60.0, 80.0),
    sigma={key: 3 * sigma for key, sigma in NOMINAL.items()},
)
EFFORT = Effort(grid=(2, 2, 1), pools=(2, 3, 8), steps=3, finalists=2, sweep=2)
LITTLE = Effort(grid=(2, 1, 1), pools=(1, 1, 2), steps=1, finalists=1, sweep=2)


@pytest.fixture(scope="module")
def advice() -> Advice:
    return advise(EXPECTED, LIMITS, EFFORT, workers=1)


@pytest.fixture(scope="module")
def checked(advice: Advice) -> Check:
    return check(advice, pools=24, places=1, grid=(2, 1, 1), workers=1)


# --- the pools ----------------------------------------------------------------------------------


@pytest.mark.parametrize("even", [True, False])
def test_pools_are_within_the_ranges_and_reproducible(even: bool) -> None:
    sample = EXPECTED.sample(40, 3, even)
    for pool in sample.pools:
        foot = pool.footprint
        assert 6 <= foot.width_mm <= 7
        assert 6.5 <= foot.head_mm + foot.tail_mm <= 8
        assert 0.12 <= pool.peak_mm <= 0.2
        assert max(map(abs, foot.center_mm)) <= 0.3
    assert sample.pools == EXPECTED.sample(40, 3, even).pools
    assert sample.pools != EXPECTED.sample(40, 4, even).pools
    placed = EXPECTED.sample(10, 3, even, places=4)
    sizes = {(pool.footprint.width_mm, pool.peak_mm) for pool in placed.pools[:4]}
    assert len(sizes) == 1
    assert len({(pool.footprint.width_mm, pool.peak_mm) for pool in placed.pools}) == 10
    assert len({pool.footprint.center_mm for pool in placed.pools}) == len(placed.deviate) == 40
    assert abs(sample.deviate.mean()) < 0.1
    assert sample.deviate.std() == pytest.approx(1, abs=0.1)


def test_concave_pools_have_negative_peaks() -> None:
    concave = replace(EXPECTED, kind="concave")
    assert all(pool.peak_mm < 0 for pool in concave.sample(4, 0).pools)
    assert len(concave.corners(shifted=True)) == 32
    assert len(concave.corners(shifted=False)) == 8


def test_advice_is_sought_for_a_pattern_of_measured_rays() -> None:
    pattern = measured_pattern(DotPattern(rows=5, columns=5))
    pools = {"width_mm": 6.0, "length_mm": 7.0, "height_mm": 0.3}
    _, limits = parse_request({"pools": pools, "pattern": pattern_values(pattern)}, "here")
    assert len(limits.pattern.measured) == 24
    assert np.allclose(limits.pattern.tangents, pattern.tangents, equal_nan=True)


@pytest.mark.parametrize(
    ("width", "height", "word"), [((7, 6), (0.1, 0.2), "width"), ((5, 6), (0.1, 2.6), "overhang")]
)
def test_impossible_pools_are_rejected(
    width: tuple[float, float], height: tuple[float, float], word: str
) -> None:
    with pytest.raises(ValueError, match=word):
        ExpectedPools(width, (6, 7), height)


# --- the margins --------------------------------------------------------------------------------


def test_margins_are_those_of_a_flat_mirror() -> None:
    """On a nearly flat pool rays keep their elevation: plane geometry gives the margins."""
    flat = ExpectedPools((6.0, 6.0), (6.0, 6.0), (0.01, 0.01), shift_mm=0.0)
    limits = BenchLimits(spacing_px=0.0)
    laser = LaserPlace(flat, limits, 30.0, 40.0)
    place = laser.best_plate(50.0)
    margins = laser.margins(place)
    # The rays to the rim's ends, y = ±3, seen from the diode at (y, z) = 40·(cos 30°, sin 30°).
    horizontal, height = 40 * np.cos(np.pi / 6), 20.0
    far, near = height / (horizontal + 3), height / (horizontal - 3)
    lowest, highest = far * (50 - 3), near * (50 + 3)
    # The pool's slope, at most 0.0133, deflects rays by twice that: at most 1.5 mm on the plane.
    assert margins["torch"] == pytest.approx(5 - near * 3, abs=0.15)
    assert place.h_mm == pytest.approx(max((lowest + highest - 101.6) / 2, 0), abs=0.5)
    assert margins["up"] == pytest.approx(lowest - 1, abs=2)
    assert margins["across"] == pytest.approx(50.8 - 3 * (40 + 50) / 40 - 1, abs=3.0)


def test_positive_margins_hold_for_intermediate_pools() -> None:
    laser = LaserPlace(EXPECTED, LIMITS, 28.0, 30.0)
    place = laser.best_plate(70.0)
    assert min(laser.margins(place).values()) >= 0
    for pool in EXPECTED.sample(16, 9).pools:
        reflections = trace(pool, LIMITS.rig(place))
        assert not (reflections.lit & ~reflections.visible).any()


def test_negative_margins_are_confirmed_by_tracing() -> None:
    steep = ExpectedPools((5.0, 5.0), (5.5, 5.5), (0.5, 0.5), shift_mm=0.0)
    laser = LaserPlace(steep, LIMITS, 31.0, 35.0)
    place = laser.best_plate(50.0)
    margins = laser.margins(place)
    reflections = trace(steep.corners(shifted=False)[0], LIMITS.rig(place))
    assert margins["torch"] < 0
    assert (reflections.lit & reflections.blocked).any()
    assert margins["up"] < 0
    assert (reflections.lit & ~reflections.on_plane).any()


# --- the errors ---------------------------------------------------------------------------------


def test_exact_bench_is_better_than_an_uncertain_one() -> None:
    place = LaserPlace(EXPECTED, LIMITS, 28.0, 30.0).best_plate(70.0)
    sigma = {key: 0.0 if key.startswith("image") else 10 * NOMINAL[key] for key in NOMINAL}
    rough = replace(LIMITS, sigma=sigma)
    trial = Trial(rough, place, EXPECTED.sample(4, 1), 0, 4)
    exact = replace(trial, calibrated=False)
    assert simulated_errors(trial)[:, 0].mean() > 2 * simulated_errors(exact)[:, 0].mean()
    assert predicted_errors(trial).mean() > 2 * predicted_errors(exact).mean()


def test_pool_without_dots_has_an_infinite_error() -> None:
    sample = EXPECTED.sample(1, 1)
    small = replace(sample, pools=(spherical_cap(0.5, 0.02),))
    place = Place(26.0, 40.0, 70.0, 50.8, 0.0)
    assert np.isinf(simulated_errors(Trial(LIMITS, place, small, 0, 1))[0, 0])


# --- the advice ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_advice_is_within_the_limits_and_reproducible(advice: Advice) -> None:
    assert advice.possible
    best = advice.best.place
    for value, (low, high) in (
        (best.projection_angle_deg, LIMITS.angle_deg),
        (best.distance_mm, LIMITS.distance_mm),
        (best.plane_mm, LIMITS.plane_mm),
        (best.s_mm, LIMITS.s_mm),
        (best.h_mm, LIMITS.h_mm),
    ):
        assert low <= value <= high
    once, again = (advise(EXPECTED, LIMITS, LITTLE, workers=1) for _ in range(2))
    assert (again.best, again.error_mm) == (once.best, once.error_mm)


@pytest.mark.slow
def test_other_pools_are_visible_and_measured_as_predicted(checked: Check) -> None:
    assert not checked.chosen[..., 1:].any()
    # The mean of so few scatters by a fifth: a little more than twice 20 % is allowed.
    assert abs(checked.off_prediction) < 0.5
    # So little effort finds a bench as good as the dissertation's; each mean scatters by a tenth.
    assert checked.error_mm < 1.3 * checked.text_error_mm
    assert len(checked.places)
    assert checked.errors.min() > 0.6 * checked.error_mm
    assert checked.rematch.shape == (2, 24, 1)
    assert "24 fresh pools at 1 places each: 0 rays hidden, 0 off the plane" in check_text(checked)


def test_broken_constraints_of_the_dissertations_setup_are_listed(checked: Check) -> None:
    # There the dots of a concave pool cross: exact ones can be separated, those of a frame cannot.
    hollow = ExpectedPools((5.0, 5.5), (5.5, 6.0), (0.25, 0.3), kind="concave")
    other = replace(checked, advice=replace(checked.advice, expected=hollow, limits=BenchLimits()))
    assert [words.split(":")[0] for words in other.text_breaks] == ["neighbouring dots apart"]
    assert other.text_breaks[0] in check_text(other)


def test_sweeps_show_where_a_setup_breaks(advice: Advice) -> None:
    names = {sweep.name: sweep for sweep in advice.sweeps}
    assert list(names) == ["projection_angle_deg", "distance_mm", "plane_mm", "s_mm", "h_mm"]
    for name, sweep in names.items():
        index = int(np.flatnonzero(sweep.value == getattr(advice.best.place, name))[0])
        assert sweep.error_mm[index] == pytest.approx(advice.error_mm)
        assert sweep.breaks(index) == ()
    assert "across" in names["s_mm"].breaks(0)


def test_cost_per_mm_is_the_slope_of_its_curve(advice: Advice) -> None:
    best = replace(advice.best, place=Place(30.0, 30.0, 60.0, 50.0, 0.0))
    value, error = np.array([40.0, 50.0, 60.0, 70.0]), np.array([5.0, 4.0, 3.0, 2.5]) / 1000
    fine, bad = dict(advice.best.margins), {**advice.best.margins, "spacing": -1.0}
    sweep = Sweep("plane_mm", value, error, (bad, fine, fine, fine))
    table = cost_table(replace(advice, best=best, sweeps=(sweep,)))
    less, more = (dict(zip(table.columns, row, strict=True)) for row in table.rows)
    assert less["more_error_um_per_unit"] == pytest.approx(0.1)
    assert (less["kept_to"], less["broken_at"]) == (50, 40)
    assert less["what_breaks"] == "neighbouring dots apart"
    assert more["more_error_um_per_unit"] == pytest.approx(-0.05)
    assert (more["kept_to"], more["broken_at"]) == (70, None)


def test_impossible_advice_names_the_broken_constraint() -> None:
    steep = ExpectedPools((5.0, 5.5), (5.5, 6.0), (0.4, 0.5))
    advice = advise(steep, LIMITS, LITTLE, workers=1)
    assert not advice.possible
    assert np.isnan(advice.error_mm)
    assert advice.best.margins["up"] < 0
    words = "dots on the imaging plane, above and below: 2 mm too little"
    assert constraint_text("up", -2.0) == words


@pytest.mark.parametrize("calibrated", [True, False])
def test_pools_without_a_surface_are_counted(
    monkeypatch: pytest.MonkeyPatch, calibrated: bool
) -> None:
    def without_one(trial: Trial) -> np.ndarray:
        found = simulated_errors(trial)
        if trial.calibrated == calibrated:
            found[0, 0] = np.inf
        return found

    monkeypatch.setattr(search, "simulated_errors", without_one)
    advice = advise(EXPECTED, LIMITS, LITTLE, workers=1)
    assert advice.possible
    assert np.isfinite(advice.error_mm)
    assert np.isnan(advice.random_mm)
    assert np.isnan(advice.sigma_mm) == calibrated
    assert (advice.pools, advice.lost) == (2, 1)
    words = advice_text(advice)
    assert "1 of 2 simulated pools gave no surface" in words
    assert not re.search(r"\b(nan|inf)\b", words)


def test_unknown_errors_have_empty_cells(advice: Advice) -> None:
    sweeps = tuple(replace(one, error_mm=np.full(len(one.value), np.inf)) for one in advice.sweeps)
    unknown = replace(advice, sweeps=sweeps)
    for table in (advice_table(unknown), cost_table(unknown)):
        assert not re.search(r"\b(nan|inf)\b", table.csv())


def test_check_counts_the_pools_without_a_surface(checked: Check) -> None:
    chosen = checked.chosen.copy()
    chosen[0, 0, 0] = np.inf
    errors, rematch = np.full(2, np.inf), np.full((2, 3, 1), np.inf)
    words = check_text(replace(checked, chosen=chosen, errors=errors, rematch=rematch))
    assert "1 times no surface" in words.splitlines()[1]
    assert not re.search(r"\b(nan|inf)\b", words)


def test_exception_in_progress_ends_the_search() -> None:
    class StopNow(Exception):
        pass

    def stop(_what: str, done: int, _count: int) -> None:
        if done:
            raise StopNow

    with pytest.raises(StopNow):
        advise(EXPECTED, LIMITS, LITTLE, progress=stop, workers=1)
