"""Setups with wrong units, and benches that are unusual but correct."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from labapp.config.setup import parse_setup
from labapp.core.geometry.plausibility import implausible_values
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty, covariance_of
from tests.scenes import BENCH_RIG, BENCH_VIEW

SETUP = (Path(__file__).parents[2] / "sample_sessions" / "gtaw" / "setup.toml").read_text("utf-8")
KNOWN = RigUncertainty(AxisPoints(BENCH_VIEW, 69.85, 31.75), *covariance_of({}))


def warnings_of(rig: Rig) -> tuple[str, ...]:
    return implausible_values(replace(rig, uncertainty=KNOWN))


def slipped(section: str, key: str, change: Callable[[float], float]) -> tuple[str, ...]:
    """Return the warnings for the sample's bench with one value changed."""
    values = tomlkit.parse(SETUP)
    value = values[section][key]  # type: ignore[index]
    values[section][key] = change(float(value))  # type: ignore[index, arg-type]
    return parse_setup(tomlkit.dumps(values), "setup.toml").warnings


TEN, TENTH, INCHES = (lambda v: 10 * v), (lambda v: v / 10), (lambda v: v / 25.4)


@pytest.mark.parametrize("change", [TEN, TENTH, INCHES])
@pytest.mark.parametrize(
    ("section", "key"),
    [
        ("electrode", "height_mm"),
        ("laser", "distance_mm"),
        ("imaging_plane", "distance_mm"),
        ("imaging_plane", "width_mm"),
        ("imaging_plane", "height_mm"),
        ("image_calibration", "x_axis_mm"),
        ("image_calibration", "z_axis_mm"),
    ],
)
def test_length_in_another_unit_is_reported(
    section: str, key: str, change: Callable[[float], float]
) -> None:
    assert parse_setup(SETUP, "setup.toml").warnings == ()
    warnings = slipped(section, key, change)
    assert any(each.startswith(f"{section}.{key} is ") for each in warnings)


@pytest.mark.parametrize("times", [0.1, 0.5, 2.0])
def test_half_and_twice_the_fan_are_reported(times: float) -> None:
    (warning,) = slipped("pattern", "inter_beam_angle_deg", lambda v: times * v)
    assert warning.startswith("pattern.inter_beam_angle_deg")


@pytest.mark.parametrize(("key", "value"), [("s_mm", 450.0), ("h_mm", -200.0), ("s_mm", -60.0)])
def test_beam_that_misses_the_imaging_plane_is_reported(key: str, value: float) -> None:
    (warning,) = slipped("imaging_plane", key, lambda _: value)
    assert key in warning


@pytest.mark.parametrize(
    "rig",
    [
        BENCH_RIG,
        replace(BENCH_RIG, laser=Laser(27.0, 90.0)),
        replace(BENCH_RIG, electrode=Electrode(500.0)),  # no torch
        replace(BENCH_RIG, electrode=Electrode(1.5)),
        replace(BENCH_RIG, pattern=DotPattern(39, 39, 0.385)),
        replace(BENCH_RIG, pattern=DotPattern(25, 25, 0.77, rotation_deg=3.0)),
        replace(BENCH_RIG, imaging_plane=ImagingPlane.vertical(150.0, 50.8, 20.0)),
    ],
)
def test_benches_of_dissertation_and_adviser_are_plausible(rig: Rig) -> None:
    assert warnings_of(rig) == ()


def test_checked_bench_may_be_unusual() -> None:
    far = replace(BENCH_RIG, laser=Laser(31.14, 200.0))
    assert len(warnings_of(far)) == 1
    assert implausible_values(replace(far, uncertainty=replace(KNOWN, checked=True))) == ()
    assert implausible_values(replace(far, uncertainty=None)) == ()


def test_plane_that_no_reflection_reaches_is_reported() -> None:
    behind = ImagingPlane(np.array([-45.0, 50.0, 3.0]))
    assert any(
        "never reaches" in each for each in warnings_of(replace(BENCH_RIG, imaging_plane=behind))
    )
