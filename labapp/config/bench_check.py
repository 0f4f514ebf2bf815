"""The section ``[bench_check]`` of a setup file: what a check against known mirrors gave.

It keeps what every quantity was before and after the check, and all that the check took as given.
As soon as the file has anything else than that, the set-up no longer counts as checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from labapp.config.toml_keys import Rule, are_numbers, is_number
from labapp.core.bench_check.check import BenchCheck
from labapp.core.geometry.uncertainty import INDEX
from labapp.core.values import FloatArray

SECTION = "bench_check"

MATTERS = ("laser", "pattern", "imaging_plane", "image_calibration", "camera_lens")
"""Sections that a check is about."""

_NEVER = ("angle_distance_correlation",)
_SAME = 1e-9
_MOST = 200


def _texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)


def _are_quantities(value: object) -> bool:
    return (
        isinstance(value, list)
        and len(value) <= _MOST
        and all(
            isinstance(one, dict)
            and one.keys() == {"key", "before", "after", "sigma"}
            and one["key"] in INDEX
            and all(is_number(one[name]) for name in ("before", "after", "sigma"))
            and one["sigma"] >= 0
            for one in value
        )
        and len({one["key"] for one in value}) == len(value)
    )


def _is_correlation(value: object) -> bool:
    if not (isinstance(value, list) and len(value) <= _MOST):
        return False
    if not all(are_numbers(row, len(value)) for row in value):
        return False
    matrix = np.array(value, float).reshape(len(value), len(value))
    return bool(
        np.allclose(matrix, matrix.T, atol=1e-6)
        and np.allclose(np.diag(matrix), 1.0, atol=1e-6)
        and (not len(matrix) or np.linalg.eigvalsh(matrix).min() > -1e-6)
    )


RULES = {
    "date": Rule("a date and time, as text", lambda value: isinstance(value, str)),
    "pictures": Rule("names of pictures", _texts),
    "mirrors": Rule("a mirror for each picture", _texts),
    "quantities": Rule("a list of { key, before, after, sigma }, each key once", _are_quantities),
    "correlation": Rule("a symmetric matrix of correlations", _is_correlation),
    "given": Rule("a table of keys and values", lambda value: isinstance(value, dict)),
    "homography": Rule(
        "3 rows of 3 numbers, those before the check",
        lambda value: (
            isinstance(value, list)
            and len(value) == 3
            and all(are_numbers(row, 3) for row in value)
        ),
        required=False,
    ),
}
"""Rules of its keys."""


def checked_covariance(
    values: Mapping[str, Any], covariance: FloatArray
) -> tuple[FloatArray, bool]:
    """Covariance of `QUANTITIES`, shape (q, q), and whether the set-up is as it was checked.

    Parameters
    ----------
    values
        Sections of a setup file.
    covariance
        That by the uncertainties in its sections: it holds where the set-up is not as it was
        checked, and of quantities that the check did not know.
    """
    section = values.get(SECTION)
    if section is None or changed_since_check(values):
        return covariance, False
    at = [INDEX[one["key"]] for one in section["quantities"]]
    sigma = np.array([one["sigma"] for one in section["quantities"]], float)
    made = covariance.copy()
    made[at, :] = 0.0
    made[:, at] = 0.0
    made[np.ix_(at, at)] = np.array(section["correlation"], float) * np.outer(sigma, sigma)
    return made, True


def changed_since_check(values: Mapping[str, Any]) -> list[str]:
    """Keys of a setup file that are no longer what they were when it was checked."""
    section = values[SECTION]
    after = {one["key"]: one["after"] for one in section["quantities"]}
    changed = [
        key
        for key, value in after.items()
        if not np.isclose(found := _value(values, key), value, rtol=_SAME, atol=_SAME)
        and not np.isnan(found)  # a point that the file has a homography for
    ]
    given, now = section["given"], _given(values, after.keys())
    return changed + sorted(key for key in given.keys() | now if given.get(key) != now.get(key))


def check_values(
    check: BenchCheck, text_values: Mapping[str, Any], date: str
) -> dict[str, dict[str, object]]:
    """Section → key → value that make a setup file that of a check (`setup.update_setup`)."""
    made: dict[str, dict[str, object]] = {}
    quantities, homography = [], "homography" in text_values["image_calibration"]
    for one in check.changes:
        section, _, key = one.key.partition(".")
        name, _, axis = key.partition("[")
        if section == "image_calibration" and homography:
            made.setdefault(section, {})["homography"] = check.calibration.matrix.tolist()
        elif axis:
            point = made.setdefault(section, {}).setdefault(name, [0.0, 0.0])
            assert isinstance(point, list)
            point["uv".index(axis[0])] = one.after
        else:
            made.setdefault(section, {})[name] = one.after
        quantities.append(
            {"key": one.key, "before": one.before, "after": one.after, "sigma": one.after_sigma}
        )
    known = check.rig.uncertainty
    assert known is not None
    merged = {name: {**text_values.get(name, {}), **made.get(name, {})} for name in MATTERS}
    keys = [str(one["key"]) for one in quantities]
    at = [INDEX[key] for key in keys]
    correlation = known.correlation[np.ix_(at, at)]
    np.fill_diagonal(correlation, 1.0)
    made[SECTION] = {
        "date": date,
        "pictures": [one.picture.name for one in check.pictures],
        "mirrors": [one.picture.mirror.name for one in check.pictures],
        "quantities": quantities,
        "correlation": [[round(float(c), 9) for c in row] for row in correlation],
        "given": _given(merged, keys),
    }
    if homography:
        made[SECTION]["homography"] = text_values["image_calibration"]["homography"]
    return made


def unchecked_values(values: Mapping[str, Any]) -> dict[str, dict[str, object]]:
    """Section → key → value that take a check back: what still is as it left it."""
    section = values.get(SECTION)
    if section is None:
        return {}
    made: dict[str, dict[str, object]] = {SECTION: {}}
    if "homography" in section and "homography" in values["image_calibration"]:
        made["image_calibration"] = {"homography": section["homography"]}
    for one in section["quantities"]:
        if not np.isclose(_value(values, one["key"]), one["after"], rtol=_SAME, atol=_SAME):
            continue
        part, _, key = one["key"].partition(".")
        name, _, axis = key.partition("[")
        if axis:
            point = made.setdefault(part, {}).setdefault(name, list(values[part][name]))
            assert isinstance(point, list)
            point["uv".index(axis[0])] = one["before"]
        else:
            made.setdefault(part, {})[name] = one["before"]
    return made


def _value(values: Mapping[str, Any], key: str) -> float:
    """A quantity's value in a file; NaN where it has none, 0 where its key may be left out."""
    section, _, name = key.partition(".")
    name, _, axis = name.partition("[")
    found = values.get(section, {}).get(name, [np.nan, np.nan] if axis else 0.0)
    return float(found["uv".index(axis[0])] if axis else found)


def _given(values: Mapping[str, Any], adjusted: Iterable[str]) -> dict[str, object]:
    """What a check takes as given: all of the sections that matter but adjusted keys and ±."""
    names = {key.partition("[")[0] for key in adjusted}
    return {
        f"{section}.{key}": value
        for section in MATTERS
        for key, value in values.get(section, {}).items()
        if f"{section}.{key}" not in names and not key.endswith("_sigma") and key not in _NEVER
    }
