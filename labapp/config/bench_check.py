"""The section ``[bench_check]`` of a setup file: the results of a check against known mirrors.

It stores every quantity before and after the check, and all values that the check took as given.
The set-up no longer counts as checked as soon as the file deviates from these.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from labapp.config.mirror_text import mirror_text
from labapp.config.toml_keys import Rule, are_numbers, is_matrix, is_number
from labapp.core.geometry.rig import DotPattern, ImagingPlane, Rig
from labapp.core.geometry.uncertainty import ENDINGS, FIRST, INDEX, QUANTITIES
from labapp.core.values import FloatArray
from labapp.errors import InputError

if TYPE_CHECKING:  # the check itself is loaded where a bench is checked
    from labapp.core.bench_check.check import BenchCheck

SECTION = "bench_check"

MATTERS = ("laser", "pattern", "imaging_plane", "image_calibration", "camera_lens")
"""Sections that a check refers to."""

_DEFAULTS = {key: 0.0 for key in INDEX if not key.startswith("image_calibration.")} | {
    "pattern.kind": DotPattern.kind,
    "imaging_plane.glass_mm": ImagingPlane.glass_mm,
    "imaging_plane.glass_index": ImagingPlane.glass_index,
}
_SETS = ("pattern.absent",)
_SAME = 1e-9
_MOST = 200


def _is_date(value: object) -> bool:
    try:
        return isinstance(value, str) and bool(datetime.fromisoformat(value))
    except ValueError:
        return False


def _texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)


def _are_quantities(value: object) -> bool:
    return (
        isinstance(value, list)
        and len(value) <= _MOST
        and all(map(_is_quantity, value))
        and len({one["key"] for one in value}) == len(value)
    )


def _is_quantity(value: object) -> bool:
    return (
        isinstance(value, dict)
        and value.keys() == {"key", "before", "after", "sigma"}
        and isinstance(value["key"], str)
        and value["key"] in INDEX
        and all(is_number(value[name]) for name in ("before", "after", "sigma"))
        and (value["sigma"] > 0 or (value["sigma"] == 0 and _near(value["before"], value["after"])))
    )


def is_correlation(value: object) -> bool:
    """Whether this is a list of rows that form a correlation matrix, except for rounding."""
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
    "date": Rule("a date and time, as text (ISO 8601)", _is_date),
    "pictures": Rule("names of pictures", _texts),
    "mirrors": Rule("a mirror for each picture", _texts),
    "free": Rule("keys of quantities", _texts, required=False),
    "quantities": Rule(
        "a list of { key, before, after, sigma }, each key once, sigma above 0 unless the quantity "
        "was known exactly and kept its value",
        _are_quantities,
    ),
    "correlation": Rule("a symmetric matrix of correlations", is_correlation),
    "given": Rule("a table of keys and values", lambda value: isinstance(value, dict)),
    "sigmas": Rule(
        "a table of the uncertainties before the check",
        lambda value: isinstance(value, dict),
        required=False,
    ),
    "homography": Rule(
        "3 rows of 3 numbers (px to mm) that can be inverted, those before the check",
        is_matrix,
        required=False,
    ),
}
"""Rules for the keys of the section."""


def section_contradictions(path: Path, values: Mapping[str, Any]) -> list[InputError]:
    """Problems of keys of the section that are each valid but contradict each other."""
    section = values.get(SECTION)
    if section is None:
        return []
    count, rows = len(section["quantities"]), len(section["correlation"])
    if rows == count:
        return []
    right = f"{count} x {count}, a row and a column for each of the quantities"
    return [InputError(path, f"{SECTION}.correlation", f"{rows} x {rows}", right)]


def checked_covariance(
    values: Mapping[str, Any], covariance: FloatArray
) -> tuple[FloatArray, bool]:
    """Covariance of `QUANTITIES`, shape (q, q), and whether the set-up is unchanged since a check.

    Parameters
    ----------
    values
        Sections of a setup file.
    covariance
        The covariance from the uncertainties in the sections. It applies if the set-up has changed
        since the check or if the check lacks any of the `FIRST` quantities. Later quantities that
        the check lacks were taken as exact.
    """
    section = values.get(SECTION)
    if section is None or changed_since_check(values):
        return covariance, False
    if {one.key for one in QUANTITIES[:FIRST]} - {one["key"] for one in section["quantities"]}:
        return covariance, False
    at = [INDEX[one["key"]] for one in section["quantities"]]
    sigma = np.array([one["sigma"] for one in section["quantities"]], float)
    correlation = semidefinite(np.array(section["correlation"], float))
    made = np.zeros_like(covariance)
    made[np.ix_(at, at)] = correlation * np.outer(sigma, sigma)
    return made, True


def semidefinite(covariance: FloatArray) -> FloatArray:
    """Remove negative eigenvalues due to rounding from a covariance or correlation matrix."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = (covariance + covariance.T) / 2 / np.outer(sigma, sigma)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if eigenvalues.min() < 0.0:
        correlation = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
    sigma /= np.sqrt(np.diag(correlation))
    return np.asarray(correlation * np.outer(sigma, sigma))


def changed_since_check(values: Mapping[str, Any]) -> list[str]:
    """Keys of a setup file that have changed since it was checked.

    A missing key is equal to one with its default value. Files of earlier checks, which did not
    store the uncertainties, have no ``sigmas``: there the uncertainties are not compared.
    """
    section = values[SECTION]
    after = {one["key"]: one["after"] for one in section["quantities"]}
    changed = [
        key
        for key, value in after.items()
        if not _near(found := _value(values, key), value)
        and not np.isnan(found)  # a point, if the file has a homography instead
    ]
    pattern = values["pattern"]
    defaults = _DEFAULTS | {
        "pattern.absent": [[(pattern["rows"] + 1) // 2, (pattern["columns"] + 1) // 2]]
    }
    changed += _differing(section["given"], _given(values, after.keys()), defaults)
    if "sigmas" in section:
        changed += _differing(section["sigmas"], _uncertainties(values), {})
    return changed


def same_setup(one: Rig, other: Rig) -> bool:
    """Whether two rigs, including their image calibrations, are equal for a bench check."""
    parts = ("laser", "pattern", "imaging_plane", "uncertainty")
    return all(_equal(getattr(one, part), getattr(other, part)) for part in parts)


def check_values(
    check: BenchCheck, text_values: Mapping[str, Any], date: str
) -> dict[str, dict[str, object]]:
    """Section → key → value that enter a check into a setup file (`setup.update_setup`)."""
    made: dict[str, dict[str, object]] = {}
    quantities, homography = [], "homography" in text_values["image_calibration"]
    for one in check.changes:
        section, name, axis = _parts(one.key)
        if section == "image_calibration" and homography:
            made.setdefault(section, {})["homography"] = check.calibration.matrix.tolist()
        elif axis is not None:
            point = made.setdefault(section, {}).setdefault(name, [0.0, 0.0])
            assert isinstance(point, list)
            point[axis] = one.after
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
        "mirrors": [mirror_text(one.picture.mirror) for one in check.pictures],
        "free": list(check.free),
        "quantities": quantities,
        "correlation": [[round(float(c), 9) for c in row] for row in correlation],
        "given": _given(merged, keys),
        "sigmas": _uncertainties(text_values),
    }
    if homography:
        made[SECTION]["homography"] = text_values["image_calibration"]["homography"]
    return made


def unchecked_values(values: Mapping[str, Any]) -> dict[str, dict[str, object]]:
    """Section → key → value that undo a check, except for values changed since."""
    section = values.get(SECTION)
    if section is None:
        return {}
    made: dict[str, dict[str, object]] = {SECTION: {}}
    written = section["given"].get("image_calibration.homography")
    if "homography" in section and written == values["image_calibration"].get("homography"):
        made["image_calibration"] = {"homography": section["homography"]}
    for one in section["quantities"]:
        if not _near(_value(values, one["key"]), one["after"]):
            continue
        part, name, axis = _parts(one["key"])
        if axis is not None:
            point = made.setdefault(part, {}).setdefault(name, list(values[part][name]))
            assert isinstance(point, list)
            point[axis] = one["before"]
        else:
            made.setdefault(part, {})[name] = one["before"]
    return made


def _parts(key: str) -> tuple[str, str, int | None]:
    """Section, name, and the axis of a point (0 of u, 1 of v) in ``section.name[u]``."""
    section, _, name = key.partition(".")
    name, _, axis = name.partition("[")
    return section, name, "uv".index(axis[0]) if axis else None


def _value(values: Mapping[str, Any], key: str) -> float:
    """A quantity's value in a file; the default value for a missing key, NaN without one."""
    section, name, axis = _parts(key)
    lacking = _DEFAULTS.get(key, np.nan) if axis is None else [np.nan, np.nan]
    found = values.get(section, {}).get(name, lacking)
    return float(found if axis is None else found[axis])


def _given(values: Mapping[str, Any], adjusted: Iterable[str]) -> dict[str, object]:
    """Values that a check takes as given: those of `MATTERS` without adjusted keys and ±."""
    names = {key.partition("[")[0] for key in adjusted}
    return {
        key: value for key, value in _keys(values) if key not in names and not key.endswith(ENDINGS)
    }


def _uncertainties(values: Mapping[str, Any]) -> dict[str, object]:
    """The standard uncertainties and the correlation in the sections `MATTERS`."""
    return {key: value for key, value in _keys(values) if key.endswith(ENDINGS)}


def _keys(values: Mapping[str, Any]) -> list[tuple[str, object]]:
    return [
        (f"{section}.{key}", value)
        for section in MATTERS
        for key, value in values.get(section, {}).items()
    ]


def _differing(
    one: Mapping[str, object], other: Mapping[str, object], defaults: Mapping[str, object]
) -> list[str]:
    """Keys whose values differ; the order of absent rays does not matter."""

    def value(of: Mapping[str, object], key: str) -> object:
        found = of.get(key, defaults.get(key))
        return sorted(found, key=repr) if isinstance(found, list) and key in _SETS else found

    return sorted(key for key in one.keys() | other if value(one, key) != value(other, key))


def _near(one: float, other: float) -> bool:
    return bool(np.isclose(one, other, rtol=_SAME, atol=_SAME))


def _equal(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)  # type: ignore[arg-type]
    if not is_dataclass(one):
        return one == other
    names = (field.name for field in fields(one))
    return type(one) is type(other) and all(
        _equal(getattr(one, name), getattr(other, name)) for name in names
    )
