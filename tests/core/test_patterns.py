"""Kinds of dot pattern: what each must keep to, and that one more is read, simulated, measured."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.config.setup import parse_setup, pattern_values, updated_setup
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.optics import ray_directions
from labapp.core.geometry.patterns import PATTERNS, square
from labapp.core.geometry.rig import DotPattern
from labapp.core.pipeline import Settings, measure
from labapp.errors import InputError
from labapp.simulation.forward import trace
from labapp.simulation.pools import spherical_cap
from labapp.studies.image_error import BENCH, VIEW, axes_of, rendered

SETUP = Path(__file__).parents[2] / "sample_sessions" / "gtaw" / "setup.toml"


def staggered(rows: int, columns: int, step: float) -> np.ndarray:
    """Every other row half a step aside: a ray has six neighbours, all as far."""
    tangents = square(rows, columns, step)
    row = np.arange(rows) - (rows - 1) // 2
    column = np.arange(columns) - (columns - 1) // 2 + row[:, None] % 2 / 2
    tangents[..., 0] = np.tan(column * step)
    tangents[..., 1] = np.tan(-row * step * np.sqrt(3) / 2)[:, None]
    return tangents


@pytest.fixture(autouse=True)
def one_kind_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PATTERNS, "staggered", staggered)


@pytest.mark.parametrize("kind", [*PATTERNS, "staggered"])
def test_a_kind_is_rows_and_columns_about_the_axis(kind: str) -> None:
    step = np.radians(0.77)
    tangents = PATTERNS[kind](19, 17, step)
    assert tangents.shape == (19, 17, 2)
    np.testing.assert_allclose(tangents[9, 8], 0, atol=1e-15)
    assert (np.diff(tangents[..., 0], axis=1) > 0).all()
    assert (np.diff(tangents[..., 1], axis=0) < 0).all()
    # The boundary asks for the rays that would come next, all round.
    np.testing.assert_allclose(PATTERNS[kind](21, 19, step)[1:-1, 1:-1], tangents, atol=1e-15)
    # What a setup file may hold is reckoned from the angle: no neighbours are farther apart.
    assert np.abs(np.diff(tangents[9, :, 0])).min() <= np.tan(step) * (1 + 1e-9)
    assert np.abs(np.diff(tangents[:, 8, 1])).min() <= np.tan(step) * (1 + 1e-9)


def test_a_setup_file_names_the_kind() -> None:
    text = SETUP.read_text("utf-8")
    usual = parse_setup(text, SETUP)
    assert usual.rig.pattern.kind == "square"
    assert "kind" not in pattern_values(usual.rig.pattern)
    other = parse_setup(updated_setup(text, SETUP, {"pattern": {"kind": "staggered"}}), SETUP)
    assert other.rig.pattern == replace(usual.rig.pattern, kind="staggered")
    again = updated_setup(text, SETUP, {"pattern": pattern_values(other.rig.pattern)})
    assert tomllib.loads(again)["pattern"]["kind"] == "staggered"
    with pytest.raises(InputError, match=r"pattern\.kind: .rings.; expected one of square"):
        parse_setup(updated_setup(text, SETUP, {"pattern": {"kind": "rings"}}), SETUP)


def test_the_twin_and_the_measurement_have_the_same_rays() -> None:
    rig = replace(BENCH, pattern=DotPattern(kind="staggered"))
    assert not np.allclose(
        ray_directions(rig.laser, rig.pattern), ray_directions(rig.laser, DotPattern())
    )
    np.testing.assert_allclose(
        trace(spherical_cap(6.0, 0.3), rig).incident,
        ray_directions(rig.laser, rig.pattern),
        atol=1e-12,
    )


@pytest.mark.slow
def test_a_frame_of_another_kind_is_measured() -> None:
    rig = replace(BENCH, pattern=DotPattern(kind="staggered"))
    frame = rendered(spherical_cap(6.0, 0.3), rig, 0)
    found = measure(frame.image, Bench(rig, axes_of(VIEW).calibration), Settings())[0]
    assert found.status == "ok", found.reason
    assert found.match is not None
    assert found.measures is not None
    assert len(found.match.ray) > 0.9 * frame.shown.sum()
    true_px = frame.dot_px[tuple(found.match.ray.T - 1)]
    assert found.dots is not None
    assert np.abs(found.dots.image_px[found.match.dot] - true_px).max() < 3
    assert found.measures.height_mm == pytest.approx(0.3, abs=0.01)
