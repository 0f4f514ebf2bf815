"""Interpolation scheme: base points, its four algorithms, and incomplete sets of dots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.schemes import irs
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import caps_8_3_1, egg, spherical_cap
from labapp.studies.error_analysis import off_centre

RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(1e9),
    ImagingPlane.vertical(50.0, 1e4, -1e4, 2e4, 2e4),
)
ALGORITHMS = ("opa", "epa-r", "epa-c", "epa-rc")


def match_of(pool, **noise):
    return exact_match(trace(pool, RIG), **noise)


def without(match, removed):
    """Return the match without the dots of a mask."""
    remaining = ~np.asarray(removed)
    return replace(
        match,
        dot=match.dot[remaining],
        ray=match.ray[remaining],
        reflected=match.reflected[remaining],
        plane_mm=match.plane_mm[remaining],
        plane_covariance_mm2=match.plane_covariance_mm2[remaining],
    )


@pytest.mark.parametrize(
    ("algorithm", "median"), [("opa", 0.40), ("epa-r", 0.12), ("epa-c", 0.12), ("epa-rc", 0.08)]
)
@pytest.mark.slow
def test_depths_of_the_caps(algorithm, median):
    settings = irs.IrsSettings(algorithm=algorithm, boundary="circle")
    error = []
    for cap in off_centre(caps_8_3_1(), 1):
        match = match_of(cap)
        measures = measure_surface(irs.reconstruct(match, RIG, settings), match, RIG)
        depth = measures.height_mm if cap.peak_mm > 0 else -measures.depth_mm
        error.append(abs(depth / abs(cap.peak_mm) - 1))
    assert np.median(error) < median


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_boundary_is_on_the_work_piece(algorithm):
    match = match_of(egg(6.6, 3.0, 4.0, 0.35))
    reconstruction = irs.reconstruct(match, RIG, irs.IrsSettings(algorithm=algorithm))
    assert (reconstruction.boundary.points_mm[:, 2] == 0).all()
    assert reconstruction.scheme == "irs"
    assert reconstruction.points_mm.shape == (len(match.ray), 3)


def test_edge_points_start_on_the_work_piece():
    match = match_of(spherical_cap(6.0, 0.3))
    # After one loop each end of a row is the mean of 0 and the value from the other end.
    reconstruction = irs.reconstruct(match, RIG, irs.IrsSettings(algorithm="epa-r", loops=1))
    for i in np.unique(match.ray[:, 0]):
        row = reconstruction.points_mm[match.ray[:, 0] == i]
        row = row[np.argsort(row[:, 0])]
        assert row[[0, -1], 2].sum() == pytest.approx(0.0, abs=0.03)
        assert row[len(row) // 2, 2] > 0


def test_rows_and_columns_together_are_the_mean_of_both():
    match = match_of(spherical_cap(6.0, 0.3))
    points = {
        name: irs.reconstruct(match, RIG, irs.IrsSettings(algorithm=name, loops=1)).points_mm
        for name in ("epa-r", "epa-c", "epa-rc")
    }
    np.testing.assert_allclose(points["epa-rc"], (points["epa-r"] + points["epa-c"]) / 2, atol=1e-9)


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.2])
def test_base_point_stays_at_the_trial_height(height):
    match = match_of(spherical_cap(6.0, 0.3))
    reconstruction = irs.reconstruct(match, RIG, irs.IrsSettings(base_heights_mm=(height,)))
    assert reconstruction.points_mm[irs.lower_left(match), 2] == pytest.approx(height)


def test_base_height_has_least_are_or_is_zero_within_the_margin():
    match = match_of(spherical_cap(6.0, -0.3))
    heights = (-0.5, -0.2, 0.0, 0.3)

    def are(*tried, margin=0.0):
        settings = irs.IrsSettings(base_heights_mm=tried, are_margin=margin)
        return irs.reconstruct(match, RIG, settings).own_are_mm

    each = {height: are(height) for height in heights}
    assert are(*heights) == min(each.values())
    assert are(*heights, margin=10.0) == each[0.0]


@pytest.mark.slow
@pytest.mark.parametrize("pool", [*off_centre(caps_8_3_1(), 1), egg(6.6, 3.0, 4.0, 0.35)])
def test_the_boundary_determines_the_base_height(pool):
    # The ARE of the points hardly depends on the base height: by it alone heights were up to 230 %
    # off, and convex pools came out as concave ones.
    match = match_of(pool)
    settings = irs.IrsSettings(boundary="circle")
    measures = measure_surface(irs.reconstruct(match, RIG, settings), match, RIG)
    depth = measures.height_mm if pool.peak_mm > 0 else -measures.depth_mm
    assert depth == pytest.approx(abs(pool.peak_mm), rel=0.3)


def test_base_point_is_the_lower_left_dot():
    match = match_of(spherical_cap(6.0, 0.3))
    lowest = match.reflected[:, 0] == 1
    by_number = irs.lower_left(match)
    assert lowest[by_number]
    assert match.plane_mm[by_number, 0] == match.plane_mm[lowest, 0].min()
    # Without numbers the positions on the imaging plane give the same dot.
    unnumbered = replace(match, reflected=np.zeros_like(match.reflected))
    assert irs.lower_left(unnumbered) == by_number
    # On an inverse pool it is the ray nearest the head.
    inverse = match_of(spherical_cap(6.0, -0.6))
    assert inverse.orientation in ("S/I", "I/I")
    assert inverse.ray[irs.lower_left(inverse), 0] == inverse.ray[:, 0].max()


def test_more_loops_never_increase_the_are():
    match = match_of(egg(6.6, 3.0, 4.0, 0.35))
    are = [
        irs.reconstruct(match, RIG, irs.IrsSettings(algorithm="epa-rc", loops=loops)).own_are_mm
        for loops in (1, 2, 4, 8)
    ]
    assert (np.diff(are) <= 0).all()
    assert are[-1] < are[0]


@examples(max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from([0.1, 0.3, 0.6, 0.9]), st.sampled_from(ALGORITHMS))
@pytest.mark.slow
def test_random_subsets_of_dots_are_measured_or_rejected(seed, share, algorithm):
    rng = np.random.default_rng(seed)
    match = match_of(egg(6.6, 3.0, 4.0, rng.choice([-0.5, 0.4])), sigma_mm=0.1, rng=rng)
    match = without(match, rng.random(len(match.ray)) > share)
    settings = irs.IrsSettings(algorithm=algorithm, loops=10, base_heights_mm=(0.0, 0.2))
    try:
        reconstruction = irs.reconstruct(match, RIG, settings)
    except CannotMeasure as error:
        assert error.status in {"too-few-dots", "no-surface", "no-boundary"}  # noqa: PT017 - or an answer
    else:
        assert np.isfinite(reconstruction.points_mm).all()
        assert np.isfinite(measure_surface(reconstruction, match, RIG).volume_mm3)


def test_too_few_dots_are_rejected():
    match = match_of(spherical_cap(6.0, 0.3))
    for algorithm in ALGORITHMS:
        with pytest.raises(CannotMeasure, match="too-few-dots"):
            irs.reconstruct(
                without(match, np.arange(len(match.ray)) >= 8),
                RIG,
                irs.IrsSettings(algorithm=algorithm),
            )
