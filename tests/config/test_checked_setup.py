"""A setup file with `[bench_check]`: which are rejected, and which changes make it unchecked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tomlkit

from labapp.config.setup import (
    checked_setup,
    parse_setup,
    unchecked_setup,
    updated_setup,
)
from labapp.core.bench_check.adjustment import Adjustment
from labapp.core.bench_check.check import BenchCheck, adjusted_bench
from labapp.core.geometry.uncertainty import FIRST, INDEX, QUANTITIES, covariance_of
from labapp.errors import InputError
from tests.config.test_setup import HOMOGRAPHY, SETUP

PATH = "setup.toml"
DATE = "2026-11-24T12:00:00+00:00"
SIGMA = np.sqrt(np.diag(covariance_of({})[0])) / 10
OFFSET = SIGMA * np.where(np.arange(len(SIGMA)) % 2, 1, -1)


def check_of(text: str, covariance: np.ndarray | None = None) -> BenchCheck:
    """A check that changed every quantity slightly, with a tenth of the uncertainties."""
    before = parse_setup(text, PATH).rig
    nothing = np.zeros(0)
    covariance = np.diag(SIGMA**2) if covariance is None else covariance
    adjustment = Adjustment(**{
        field: {"offset": OFFSET, "covariance": covariance}.get(field, nothing)
        for field in Adjustment.__dataclass_fields__
    })  # fmt: skip
    after = adjusted_bench(before, adjustment, checked=True)
    return BenchCheck(
        *("ok", "", "noise-like", (), (), (), before),
        *(after.rig, after.calibration, (), (), adjustment),
    )


def checked_text(text: str = SETUP) -> str:
    return checked_setup(text, PATH, check_of(text), DATE)


def status(text: str) -> str:
    uncertainty = parse_setup(text, PATH).rig.uncertainty
    assert uncertainty is not None
    return uncertainty.status


def with_check(text: str = "", **changes: Any) -> str:
    """The text of a checked setup with keys of its check replaced, or removed by None."""
    document = tomlkit.parse(text or checked_text())
    for key, value in changes.items():
        if value is None:
            del document["bench_check"][key]  # type: ignore[union-attr]  # a table
        else:
            document["bench_check"][key] = value  # type: ignore[index]  # a table
    return tomlkit.dumps(document)


def quantities(count: int = len(QUANTITIES), **changes: Any) -> list[dict[str, Any]]:
    """The first quantities of a check, with keys of the first one replaced."""
    first = tomlkit.parse(checked_text()).unwrap()["bench_check"]["quantities"][:count]
    return [first[0] | changes, *first[1:]] if first else []


ALONE = np.eye(len(QUANTITIES)).tolist()


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("quantities", {"quantities": quantities(key=[1])}),
        ("quantities", {"quantities": quantities(key="laser.color")}),
        ("quantities", {"quantities": quantities(sigma=-0.1)}),
        ("quantities", {"quantities": quantities(sigma=0.0)}),
        ("correlation", {"correlation": np.eye(3).tolist(), "quantities": quantities(2)}),
        ("correlation", {"correlation": [[1.0]], "quantities": quantities(2)}),
        ("correlation", {"correlation": []}),
        ("correlation", {"correlation": [[1.0]], "quantities": []}),
        ("homography", {"homography": np.zeros((3, 3)).tolist()}),
        ("date", {"date": ""}),
        ("date", {"date": "yesterday"}),
    ],
)
def test_impossible_check_is_rejected(key: str, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        parse_setup(with_check(**changes), PATH)
    assert [problem.field for problem in caught.value.problems] == [f"bench_check.{key}"]


def test_correlation_slightly_indefinite_by_rounding_is_accepted() -> None:
    correlation = np.eye(len(QUANTITIES))
    rounded = [[1, 0.707107, 0.707107], [0.707107, 1, 0], [0.707107, 0, 1]]
    correlation[:3, :3] = rounded
    assert np.linalg.eigvalsh(correlation).min() < -1e-8
    rig = parse_setup(with_check(correlation=correlation.tolist()), PATH).rig
    assert rig.uncertainty is not None
    assert rig.uncertainty.status == "checked"
    without_glass = np.s_[:FIRST, :FIRST]  # this bench has no glass
    np.testing.assert_allclose(
        rig.uncertainty.correlation[without_glass], correlation[without_glass], atol=1e-5
    )
    root = rig.uncertainty.root
    np.testing.assert_allclose(root @ root.T, rig.uncertainty.covariance, atol=1e-8)


@pytest.mark.parametrize("count", [0, 1, FIRST - 1])
def test_check_of_some_quantities_is_ignored(count: int) -> None:
    checked = quantities(count)
    text = with_check(quantities=checked, correlation=np.eye(count).tolist())
    setup = parse_setup(text, PATH)
    assert status(text) == "entered"
    assert not setup.check_date


def test_check_before_the_latest_quantities_is_valid() -> None:
    """It used the entered values of the later quantities, and stored them in `given`."""
    text = checked_text()
    later = {quantity.key for quantity in QUANTITIES[FIRST:]}
    values = tomlkit.parse(text).unwrap()
    given = values["bench_check"]["given"]
    for key in later:
        section, _, name = key.partition(".")
        given[key] = values[section][name]
    old = with_check(
        text, quantities=quantities(FIRST), correlation=np.eye(FIRST).tolist(), given=given
    )
    uncertainty = parse_setup(old, PATH).rig.uncertainty
    assert uncertainty is not None
    assert uncertainty.status == "checked"
    np.testing.assert_allclose(
        uncertainty.sigma, np.where(np.arange(len(SIGMA)) < FIRST, SIGMA, 0.0)
    )
    assert status(changed(old, "image_calibration", x_axis_mm=70.0)) == "entered"


def test_exactly_known_quantity_remains_exact_in_a_check() -> None:
    text = SETUP.replace("[laser]", "[laser]\ndistance_mm_sigma = 0.0")
    check = check_of(text)
    index = INDEX["laser.distance_mm"]
    offset, covariance = OFFSET.copy(), np.diag(SIGMA**2)
    offset[index] = covariance[index, index] = 0.0
    adjustment = replace(check.adjustment, offset=offset, covariance=covariance)
    after = adjusted_bench(check.before, adjustment, checked=True)
    check = replace(check, rig=after.rig, calibration=after.calibration)
    assert status(checked_setup(text, PATH, check, DATE)) == "checked"


def test_check_can_be_reverted() -> None:
    for text in (SETUP, HOMOGRAPHY):
        checked = checked_text(text)
        assert status(checked) == "checked"
        assert parse_setup(checked, PATH).check_date == DATE
        reverted = parse_setup(unchecked_setup(checked, PATH), PATH)
        original = parse_setup(text, PATH)
        assert reverted.rig.laser == original.rig.laser
        np.testing.assert_allclose(
            reverted.calibration.matrix, original.calibration.matrix, rtol=1e-9
        )


def test_image_calibration_after_a_check_is_not_reverted() -> None:
    new = [[0.21, 0.0, -8.0], [0.0, -0.2, 110.0], [0.0, 0.0, 1.0]]
    text = updated_setup(checked_text(HOMOGRAPHY), PATH, {"image_calibration": {"homography": new}})
    assert status(text) == "entered"
    reverted = parse_setup(unchecked_setup(text, PATH), PATH)
    np.testing.assert_array_equal(reverted.calibration.matrix, new)


def changed(text: str, section: str, **keys: Any) -> str:
    return updated_setup(text, PATH, {section: keys})


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("imaging_plane", {"glass_mm": 3.0}),
        ("imaging_plane", {"distance_mm": 60.0}),
        ("pattern", {"absent": [[9, 10]]}),
        ("laser", {"distance_mm_sigma": 0.02}),
    ],
)
def test_check_of_another_setup_is_rejected(section: str, keys: dict[str, Any]) -> None:
    check = check_of(SETUP)
    with pytest.raises(InputError):
        checked_setup(changed(SETUP, section, **keys), PATH, check, DATE)


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("laser", {"distance_mm_sigma": 0.02}),
        ("laser", {"angle_distance_correlation": 0.5}),
        ("image_calibration", {"origin_px_sigma": 0.1}),
        ("image_calibration", {"points_covariance_px2": np.diag([0.09] * 6).tolist()}),
        ("imaging_plane", {"glass_mm": 3.0}),
        ("pattern", {"kind": "hexagonal"}),
    ],
)
def test_change_after_a_check_makes_the_setup_unchecked(section: str, keys: dict[str, Any]) -> None:
    assert status(changed(checked_text(), section, **keys)) != "checked"


def test_removal_of_a_former_uncertainty_makes_the_setup_unchecked() -> None:
    text = checked_text(SETUP.replace("[laser]", "[laser]\ndistance_mm_sigma = 0.2"))
    assert status(text) == "checked"
    assert status(changed(text, "laser", distance_mm_sigma=None)) == "entered"


def test_check_without_stored_uncertainties_is_valid() -> None:
    text = checked_text(SETUP.replace("[laser]", "[laser]\ndistance_mm_sigma = 0.2"))
    assert status(with_check(text, sigmas=None)) == "checked"


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("pattern", {"kind": "square"}),
        ("pattern", {"absent": [[10, 10]]}),
        ("imaging_plane", {"glass_mm": 0.0, "glass_index": 1.5}),
    ],
)
def test_explicit_default_leaves_the_setup_checked(section: str, keys: dict[str, Any]) -> None:
    """So does a default that is removed."""
    assert status(changed(checked_text(), section, **keys)) == "checked"
    written = checked_text(changed(SETUP, section, **keys))
    left_out = changed(written, section, **dict.fromkeys(keys))
    assert status(left_out) == "checked"


def test_order_of_absent_rays_is_irrelevant() -> None:
    text = checked_text(changed(SETUP, "pattern", absent=[[9, 10], [10, 10]]))
    assert status(changed(text, "pattern", absent=[[10, 10], [9, 10]])) == "checked"
    assert status(changed(text, "pattern", absent=[[10, 10], [9, 9]])) == "entered"


def test_revert_of_an_invalid_check_is_rejected() -> None:
    with pytest.raises(InputError):
        unchecked_setup("[bench_check]\ndate = 1\n", PATH)
