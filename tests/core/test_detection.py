"""The settings select the detector of dots and the search for rows."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.core.images.band_pass import band_pass_dots
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.images.threshold_dots import block_threshold_dots, wavelet_dots
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice_growth import grow_lattice
from labapp.core.rows.row_search import mask_rows, search_rows
from labapp.core.values import CannotMeasure, FloatArray
from tests.scenes import as_dots, gaussian_dots

SHAPE = (400, 420)


def places() -> FloatArray:
    """Return a square grid without its middle, shape (n, 2), px."""
    u, v = np.meshgrid(np.arange(60.0, 380.0, 40.0), np.arange(60.0, 360.0, 44.0))
    grid = np.stack([u.ravel(), v.ravel()], axis=-1)
    return np.delete(grid, len(grid) // 2, axis=0)


@pytest.fixture(scope="module")
def frame() -> FloatArray:
    noise = np.random.default_rng(0).normal(30.0, 0.6, SHAPE)
    return noise + 60.0 * gaussian_dots(SHAPE, places(), 2.4)


@pytest.mark.parametrize("method", ["band-pass", "block-threshold", "wavelet"])
def test_every_detector_finds_the_dots(frame: FloatArray, method: str) -> None:
    dots = find_dots(frame, DotSettings(method=method))
    true = places()
    distance = np.linalg.norm(dots.image_px[None] - true[:, None], axis=-1)
    assert distance.min(axis=1).max() < 1.0
    # The wavelet also enhances noise, as in the dissertation.
    if method != "wavelet":
        assert len(dots) == len(true)


def test_find_dots_uses_the_named_detector(frame: FloatArray) -> None:
    settings = DotSettings()
    by_name = {
        "band-pass": band_pass_dots(frame, settings.band_pass),
        "block-threshold": block_threshold_dots(frame, settings.block_threshold),
        "wavelet": wavelet_dots(frame, settings.wavelet),
    }
    for name, dots in by_name.items():
        chosen = find_dots(frame, DotSettings(method=name))
        np.testing.assert_array_equal(chosen.image_px, dots.image_px)
    # They differ, so that the wrong one would be noticed.
    first = [np.sort(dots.u_px)[:20] for dots in by_name.values()]
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], first[2])
    assert not np.array_equal(first[1], first[2])
    assert settings.method == "band-pass"


@pytest.mark.parametrize(("method", "share"), [("grow", 1.0), ("masks", 0.9)])
def test_search_indexes_the_dots(method: str, share: float) -> None:
    dots = as_dots(places())
    lattice = find_lattice(dots, SHAPE, LatticeSettings(method=method))
    u, v = dots.image_px.T
    indexed = lattice.row > 0
    assert indexed.mean() >= share
    k, t = np.round((v.max() - v) / 44.0) + 1, np.round((u - u.min()) / 40.0) + 1
    np.testing.assert_array_equal(lattice.row[indexed], k[indexed])
    np.testing.assert_array_equal(lattice.column[indexed], t[indexed])


def test_find_lattice_uses_the_named_search() -> None:
    dots = as_dots(places() + np.random.default_rng(1).normal(0.0, 2.0, places().shape))
    settings = LatticeSettings()
    by_name = {
        "grow": grow_lattice(dots, settings.grow),
        "rows": search_rows(dots, settings.rows),
        "masks": mask_rows(dots, SHAPE, settings.masks),
    }
    for name, lattice in by_name.items():
        chosen = find_lattice(dots, SHAPE, LatticeSettings(method=name))
        np.testing.assert_array_equal(chosen.row, lattice.row)
        assert chosen.candidates == lattice.candidates
    assert settings.method == "grow"


@pytest.mark.parametrize(
    "method",
    [
        "band-pass",
        "block-threshold",
        "wavelet",
    ],
)
@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (120, 160)])
def test_blank_frame_raises_no_dots(method: str, shape: tuple[int, int]) -> None:
    with pytest.raises(CannotMeasure) as error:
        find_dots(np.full(shape, 9, np.uint8), DotSettings(method=method))
    assert error.value.status == "no-dots"
    assert error.value.reason


@pytest.mark.parametrize("method", ["grow", "rows", "masks"])
def test_single_dot_raises_no_rows(method: str) -> None:
    with pytest.raises(CannotMeasure) as error:
        find_lattice(
            as_dots(places()[:1]),
            SHAPE,
            LatticeSettings(method=method),
        )
    assert error.value.status in {"too-few-dots", "no-rows"}
