"""A setup file with `[bench_check]`: what is refused, and what makes it one that is not checked."""

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
    """A check that moved every quantity a little and knows each ten times better."""
    before = parse_setup(text, PATH).rig
    nothing = np.zeros(0)
    covariance = np.diag(SIGMA**2) if covariance is None else covariance
    made = Adjustment(**{
        field: {"offset": OFFSET, "covariance": covariance}.get(field, nothing)
        for field in Adjustment.__dataclass_fields__
    })  # fmt: skip
    rig, calibration = adjusted_bench(before, made, checked=True)
    return BenchCheck(
        "ok", "", "noise-like", (), (), (), before, rig, calibration, (), (), made
    )  # fmt: skip


def checked_text(text: str = SETUP) -> str:
    return checked_setup(text, PATH, check_of(text), DATE)


def status(text: str) -> str:
    known = parse_setup(text, PATH).rig.uncertainty
    assert known is not None
    return known.status


def with_check(text: str = "", **changes: Any) -> str:
    """The text of a checked setup with keys of its check replaced; None takes one out."""
    document = tomlkit.parse(text or checked_text())
    for key, value in changes.items():
        if value is None:
            del document["bench_check"][key]  # type: ignore[union-attr]  # a table
        else:
            document["bench_check"][key] = value  # type: ignore[index]  # a table
    return tomlkit.dumps(document)


def quantities(count: int = len(QUANTITIES), **changes: Any) -> list[dict[str, Any]]:
    """The first quantities of a check, the first one's keys replaced."""
    found = tomlkit.parse(checked_text()).unwrap()["bench_check"]["quantities"][:count]
    return [found[0] | changes, *found[1:]] if found else []


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
def test_an_impossible_check_is_refused(key: str, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError) as refused:
        parse_setup(with_check(**changes), PATH)
    assert [one.field for one in refused.value.problems] == [f"bench_check.{key}"]


def test_a_correlation_that_rounding_made_indefinite_is_taken() -> None:
    correlation = np.eye(len(QUANTITIES))
    near = [[1, 0.707107, 0.707107], [0.707107, 1, 0], [0.707107, 0, 1]]
    correlation[:3, :3] = near
    assert np.linalg.eigvalsh(correlation).min() < -1e-8
    rig = parse_setup(with_check(correlation=correlation.tolist()), PATH).rig
    assert rig.uncertainty is not None
    assert rig.uncertainty.status == "checked"
    some = np.s_[:FIRST, :FIRST]  # there is no glass
    np.testing.assert_allclose(rig.uncertainty.correlation[some], correlation[some], atol=1e-5)
    root = rig.uncertainty.root
    np.testing.assert_allclose(root @ root.T, rig.uncertainty.covariance, atol=1e-8)


@pytest.mark.parametrize("count", [0, 1, FIRST - 1])
def test_a_check_of_some_quantities_is_no_check(count: int) -> None:
    some = quantities(count)
    text = with_check(quantities=some, correlation=np.eye(count).tolist())
    setup = parse_setup(text, PATH)
    assert status(text) == "entered"
    assert not setup.checked


def test_a_check_of_before_there_were_more_quantities_still_counts() -> None:
    """It took the later ones as they were, and had them in `given`."""
    text = checked_text()
    later = {one.key for one in QUANTITIES[FIRST:]}
    values = tomlkit.parse(text).unwrap()
    given = values["bench_check"]["given"]
    for key in later:
        section, _, name = key.partition(".")
        given[key] = values[section][name]
    old = with_check(
        text, quantities=quantities(FIRST), correlation=np.eye(FIRST).tolist(), given=given
    )
    known = parse_setup(old, PATH).rig.uncertainty
    assert known is not None
    assert known.status == "checked"
    np.testing.assert_allclose(known.sigma, np.where(np.arange(len(SIGMA)) < FIRST, SIGMA, 0.0))
    assert status(changed(old, "image_calibration", x_axis_mm=70.0)) == "entered"


def test_a_quantity_that_is_known_exactly_stays_so_in_a_check() -> None:
    text = SETUP.replace("[laser]", "[laser]\ndistance_mm_sigma = 0.0")
    check = check_of(text)
    at = INDEX["laser.distance_mm"]
    offset, covariance = OFFSET.copy(), np.diag(SIGMA**2)
    offset[at] = covariance[at, at] = 0.0
    made = replace(check.adjustment, offset=offset, covariance=covariance)
    rig, calibration = adjusted_bench(check.before, made, checked=True)
    check = replace(check, rig=rig, calibration=calibration)
    assert status(checked_setup(text, PATH, check, DATE)) == "checked"


def test_a_check_makes_the_set_up_checked_and_is_taken_back() -> None:
    for text in (SETUP, HOMOGRAPHY):
        checked = checked_text(text)
        assert status(checked) == "checked"
        assert parse_setup(checked, PATH).checked == DATE
        back = parse_setup(unchecked_setup(checked, PATH), PATH)
        was = parse_setup(text, PATH)
        assert back.rig.laser == was.rig.laser
        np.testing.assert_allclose(back.calibration.matrix, was.calibration.matrix, rtol=1e-9)


def test_an_image_calibration_made_after_a_check_outlives_it() -> None:
    new = [[0.21, 0.0, -8.0], [0.0, -0.2, 110.0], [0.0, 0.0, 1.0]]
    text = updated_setup(checked_text(HOMOGRAPHY), PATH, {"image_calibration": {"homography": new}})
    assert status(text) == "entered"
    back = parse_setup(unchecked_setup(text, PATH), PATH)
    np.testing.assert_array_equal(back.calibration.matrix, new)


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
def test_a_check_of_another_set_up_is_refused(section: str, keys: dict[str, Any]) -> None:
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
def test_what_is_entered_after_a_check_unchecks(section: str, keys: dict[str, Any]) -> None:
    assert status(changed(checked_text(), section, **keys)) != "checked"


def test_an_uncertainty_of_before_the_check_stays_and_unchecks_when_it_is_taken_out() -> None:
    text = checked_text(SETUP.replace("[laser]", "[laser]\ndistance_mm_sigma = 0.2"))
    assert status(text) == "checked"
    assert status(changed(text, "laser", distance_mm_sigma=None)) == "entered"


def test_a_check_that_did_not_keep_uncertainties_still_counts() -> None:
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
def test_a_default_that_is_written_changes_nothing(section: str, keys: dict[str, Any]) -> None:
    """Nor one that is left out again."""
    assert status(changed(checked_text(), section, **keys)) == "checked"
    written = checked_text(changed(SETUP, section, **keys))
    left_out = changed(written, section, **dict.fromkeys(keys))
    assert status(left_out) == "checked"


def test_absent_rays_in_another_order_are_the_same() -> None:
    text = checked_text(changed(SETUP, "pattern", absent=[[9, 10], [10, 10]]))
    assert status(changed(text, "pattern", absent=[[10, 10], [9, 10]])) == "checked"
    assert status(changed(text, "pattern", absent=[[10, 10], [9, 9]])) == "entered"


def test_a_check_is_taken_back_from_valid_text_only() -> None:
    with pytest.raises(InputError):
        unchecked_setup("[bench_check]\ndate = 1\n", PATH)
