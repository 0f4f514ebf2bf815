"""Input of the adviser as TOML: the expected pools and the limits of the bench."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from labapp.config.setup import dot_pattern
from labapp.config.setup_keys import SECTIONS, rules_for
from labapp.config.toml_keys import (
    Rule,
    are_numbers,
    check_keys,
    one_of,
    parse_toml,
    read_text,
    unknown_key,
    within,
)
from labapp.core.geometry.line_pattern import KIND as LINES
from labapp.core.geometry.uncertainty import ANGLE, DISTANCE, POINTS, QUANTITIES, RigUncertainty
from labapp.errors import InputError
from labapp.studies.adviser.bench_limits import BenchLimits
from labapp.studies.adviser.expected_pools import ExpectedPools
from labapp.studies.adviser.search import MOVED
from labapp.studies.parameter_deviation import NOMINAL

A_REQUEST = "a file for labapp advise (TOML, UTF-8)"

CALIBRATION = {
    one.key.partition("[")[0].partition(".")[2]: one.sigma_key
    for one in QUANTITIES
    if one.key != "imaging_plane.distance_mm"
} | {"plane_distance_mm": "imaging_plane.distance_mm_sigma"}
"""Keys of standard uncertainties: those of the setup file without their section."""


LARGEST_SIGMA = 10.0


def calibration_values(known: RigUncertainty) -> dict[str, Any]:
    """Uncertainty of a bench as the keys of ``[calibration]``: key → value."""
    sigma = known.sigma_by_key
    values: dict[str, Any] = {
        name: min(sigma[key], LARGEST_SIGMA) for name, key in CALIBRATION.items()
    }
    values["angle_distance_correlation"] = float(known.correlation[ANGLE, DISTANCE])
    of_points = known.covariance[np.ix_(POINTS, POINTS)]
    if np.diag(of_points).min() > 0.0:
        values["points_covariance_px2"] = of_points.tolist()
    return values


def _range(low: float, high: float, unit: str, required: bool = False) -> Rule:
    def accepts(value: object) -> bool:
        ends = value if isinstance(value, list) else [value, value]
        return are_numbers(ends, 2) and low <= ends[0] <= ends[1] <= high

    expected = f"[least, most] or one number, {low:g} to {high:g} ({unit})"
    return Rule(expected, accepts, required)


POOLS = {
    "kind": one_of("convex", "concave"),
    "width_mm": _range(1, 50, "mm", True),
    "length_mm": _range(1, 50, "mm", True),
    "height_mm": _range(0.01, 10, "mm; above 0 for concave pools, too", True),
    "shift_mm": within(0, 5, "mm"),
}
BENCH = {
    "projection_angle_deg": _range(5, 80, "degrees"),
    "distance_mm": _range(10, 500, "mm"),
    "plane_distance_mm": _range(10, 1000, "mm"),
    "s_mm": _range(-500, 500, "mm"),
    "h_mm": _range(-500, 500, "mm"),
    "width_mm": within(10, 1000, "mm"),
    "height_mm": within(10, 1000, "mm"),
    "edge_mm": within(0, 50, "mm"),
    "electrode_height_mm": within(0, 50, "mm"),
}
CAMERA = {
    "px_per_mm": within(0.5, 200, "px/mm"),
    "spacing_px": within(0, 100, "px"),
    "dot_sigma_px": within(0.01, 10, "px"),
}
TABLES: dict[str, dict[str, Rule]] = {
    "pools": POOLS,
    "bench": BENCH,
    "pattern": SECTIONS["pattern"],
    "camera": CAMERA,
    "calibration": {
        **{name: within(0, LARGEST_SIGMA, "standard uncertainty") for name in CALIBRATION},
        "angle_distance_correlation": within(-1, 1, "correlation"),
        "points_covariance_px2": SECTIONS["image_calibration"]["points_covariance_px2"],
    },
}
"""All tables and keys; only the pools are required."""

NAMES = {
    "projection_angle_deg": "angle_deg",
    "plane_distance_mm": "plane_mm",
    "electrode_height_mm": "electrode_mm",
}
"""Fields of `BenchLimits` by the keys of ``[bench]`` that have another name."""


def read_request(path: Path) -> dict[str, Any]:
    """Read the tables of a request; `parse_request` checks them.

    Raises
    ------
    InputError
        If the file cannot be read or is not TOML.
    """
    return parse_toml(read_text(path, A_REQUEST), path, A_REQUEST)


def parse_request(
    values: Mapping[str, Any], source: str | Path
) -> tuple[ExpectedPools, BenchLimits]:
    """Expected pools and limits of the bench from the tables of a request, table → key → value.

    Raises
    ------
    InputError
        If anything is unknown, missing or impossible; all problems are reported together.
    """
    path = Path(source)
    problems = [unknown_key(path, key, TABLES) for key in values if key not in TABLES]
    for name, rules in TABLES.items():
        given = values.get(name)
        if name == "pattern" and isinstance(given, dict) and given.get("kind") == LINES:
            right = "a pattern of dots: square, hexagonal or directions"
            problems.append(InputError(path, "pattern.kind", f'"{LINES}"', right))
        elif name == "pools" or name in values:
            own = rules_for(name, given) if name == "pattern" else rules
            problems += check_keys(path, name, given, own)
    if problems:
        raise InputError.gather(problems)
    limits = _limits({name: values.get(name, {}) for name in TABLES})
    half_fan = (limits.pattern.rows - 1) / 2 * limits.pattern.inter_beam_angle_deg
    if half_fan >= limits.angle_deg[0]:
        raise InputError(
            path,
            "bench.projection_angle_deg",
            list(limits.angle_deg),
            f"angles above half the fan, {half_fan:.4g} (degrees)",
        )
    pools: dict[str, Any] = {
        key: _span(value) if TABLES["pools"][key].required else value
        for key, value in values["pools"].items()
    }
    try:
        return ExpectedPools(**pools), limits
    except ValueError as error:
        key, _, why = str(error).partition(": ")
        raise InputError(path, f"pools.{key}", values["pools"].get(key), why) from error


def _limits(tables: dict[str, dict[str, Any]]) -> BenchLimits:
    bench, calibration = dict(tables["bench"]), tables["calibration"]
    width, height = BenchLimits.plate_mm
    plate = bench.pop("width_mm", width), bench.pop("height_mm", height)
    given = {NAMES.get(key, key): value for key, value in bench.items()}
    given |= {name: _span(given[name]) for name in MOVED.values() if name in given}
    sigma = {key: float(calibration.get(name, NOMINAL[key])) for name, key in CALIBRATION.items()}
    return BenchLimits(
        **given,
        plate_mm=plate,
        pattern=dot_pattern(tables["pattern"]),
        sigma=sigma,
        angle_distance_correlation=calibration.get("angle_distance_correlation", 0.0),
        points_covariance_px2=calibration.get("points_covariance_px2"),
        **tables["camera"],
    )


def _span(value: Any) -> tuple[float, float]:
    low, high = value if isinstance(value, list) else (value, value)
    return float(low), float(high)
