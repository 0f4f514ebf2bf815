"""Rows of the dots that are not rows of the rays, and rows that lie close together."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.matching import match_rays
from labapp.core.matching.relabelling import BASES, labels_from_lattice
from labapp.core.rows.lattice import Lattice, lattice_of_dots
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice
from labapp.core.values import IntArray
from labapp.simulation.pools import egg
from tests.benchmarks.dips import matched, measure_pool
from tests.scenes import BENCH_RIG, see, true_labels


def test_concave_pool_that_focuses_its_rows_is_measured() -> None:
    """Growth by prediction left the dots of the last rows in doubt: no surface explained them."""
    pool = egg(6.0, 3.0, 3.6, -0.03)
    got = measure_pool(pool, see(pool, np.random.default_rng(3), sigma_px=0.05))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.95 * got.shown


@pytest.mark.parametrize("basis", BASES, ids=str)
def test_lattice_with_other_rows_than_those_of_the_rays_is_labelled(basis: IntArray) -> None:
    seen = see(egg(5.4, 2.6, 3.0, 0.27), np.random.default_rng(3), sigma_px=0.05)
    marker = BENCH_RIG.pattern.marker
    assert marker is not None
    sites = np.rint((seen.ray - marker) @ np.linalg.inv(basis)).astype(int)
    lattice = lattice_of_dots(sites + 30, list(range(len(sites))), len(sites), (30, 30))
    labels = true_labels(seen)
    given = labels_from_lattice(lattice, (30, 30), marker, "S/S", labels.shape, basis)
    np.testing.assert_array_equal(given, labels)


def test_turned_lattice_is_matched_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for other in ("_by_empty_sites", "_by_quadrics", "_by_turned_lattice", "_by_caps"):
        monkeypatch.setattr(match_rays, other, lambda *_: [])
    monkeypatch.setattr("tests.benchmarks.dips.grow_lattice", turned_lattice)
    seen = see(egg(6.0, 2.6, 3.0, 0.3), np.random.default_rng(3), sigma_px=0.05)
    match = matched(seen)
    assert (seen.ray[match.dot] == match.ray).all()
    assert len(match.dot) > 0.95 * len(seen.ray)


def turned_lattice(dots: Dots, settings: GrowSettings) -> Lattice:
    """Return the lattice with rows and columns exchanged."""
    found = grow_lattice(dots, settings)
    candidates = tuple((t, k) for k, t in found.candidates)
    return Lattice(found.column, found.row, None, candidates)
