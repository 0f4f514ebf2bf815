"""Rules for the keys of a setup file."""

from __future__ import annotations

from typing import get_args

import numpy as np

from labapp.config import bench_check
from labapp.config.toml_keys import (
    LARGEST,
    LARGEST_MM,
    SMALLEST,
    Rule,
    are_numbers,
    between,
    is_matrix,
    is_number,
    one_of,
    whole,
    within,
)
from labapp.core.geometry.line_pattern import KIND as LINES
from labapp.core.geometry.patterns import FEWEST_RAYS, MEASURED, PATTERNS
from labapp.core.geometry.rig import Travel
from labapp.core.geometry.uncertainty import QUANTITIES

_LENGTH = between(0, LARGEST_MM, "mm")
_PLACE = between(-LARGEST_MM, LARGEST_MM, "mm")
_COUNT = Rule(
    "an odd whole number from 3 to 99, for a pattern with a centre",
    lambda value: type(value) is int and 3 <= value <= 99 and value % 2 == 1,
)
_TILT = between(-90, 90, "degrees", required=False)
_AIM = within(-LARGEST_MM, LARGEST_MM, "mm", required=False)
_LARGEST_SIGMA = {"mm": LARGEST_MM, "°": 90.0, "px": 1e4, "%": 100.0, "": 4.0}


def _sigmas(section: str) -> dict[str, Rule]:
    """Keys of standard uncertainties in a section; a typical value replaces a missing one."""
    own = (one for one in QUANTITIES if one.key.startswith(f"{section}."))
    return {
        one.sigma_key.partition(".")[2]: within(0, _LARGEST_SIGMA[one.unit], one.unit)
        for one in own
    }


def _is_rays(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(ray, list) and len(ray) == 2 and all(type(index) is int for index in ray)
        for ray in value
    )


def _are_measured(value: object) -> bool:
    if not isinstance(value, list) or not all(are_numbers(ray, 4) for ray in value):
        return False
    whole = all(type(index) is int for ray in value for index in ray[:2])
    return whole and len({tuple(ray[:2]) for ray in value}) == len(value) >= FEWEST_RAYS


_PIXEL = Rule("[u, v], two numbers (px)", lambda value: are_numbers(value, 2))
_ON_AXIS = Rule(
    f"a number from -{LARGEST_MM:g} to {LARGEST_MM:g} (mm) that is not 0",
    lambda value: is_number(value) and SMALLEST < abs(value) <= LARGEST_MM,
)


def _two_numbers(expected: str, least: float = -LARGEST) -> Rule:
    return Rule(
        expected, lambda value: are_numbers(value, 2) and min(value) >= least, required=False
    )


THREE_POINTS = {
    "origin_px": _PIXEL,
    "x_axis_px": _PIXEL,
    "x_axis_mm": _ON_AXIS,
    "z_axis_px": _PIXEL,
    "z_axis_mm": _ON_AXIS,
}
HOMOGRAPHY = {
    "homography": Rule("3 rows of 3 numbers (px to mm) that can be inverted", is_matrix),
    "points_mm": Rule(
        "[X′, Z′], two numbers that are not 0 (mm): where on the axes the points lie whose ± are "
        "given",
        lambda value: are_numbers(value, 2) and all(map(_ON_AXIS.accepts, value)),
        required=False,
    ),
}


def _is_points_covariance(value: object) -> bool:
    if not (isinstance(value, list) and len(value) == 6):
        return False
    if not all(are_numbers(row, 6) for row in value) or min(np.diag(value)) <= 0:
        return False
    covariance = np.array(value, float)
    sigma = np.sqrt(np.diag(covariance))
    return bench_check.is_correlation((covariance / np.outer(sigma, sigma)).tolist())


_OF_PICTURE = {
    **_sigmas("image_calibration"),
    "frame_px": Rule(
        "[width, height] of the calibration picture, two whole numbers above 0 (px)",
        lambda value: are_numbers(value, 2) and all(type(n) is int and n > 0 for n in value),
        required=False,
    ),
    "points_covariance_px2": Rule(
        "a covariance matrix, 6 x 6 (px²): u and v of O′, of the point on O′X′, of that on O′Z′",
        _is_points_covariance,
        required=False,
    ),
}
RAYS = {
    "rays": Rule(
        f"at least {FEWEST_RAYS} measured rays [row, column, aside, up], each once, with their "
        "tangents to the beam axis in those of the inter-beam angle; or file, a table of rays",
        _are_measured,
    ),
}
LINE_PATTERN = {
    "kind": one_of(LINES, required=True),
    "count": whole(1, 99, required=True),
    "interline_angle_deg": between(0, 45, "degrees"),
    "fan_angle_deg": between(0, 90, "degrees"),
    "rotation_deg": _TILT,
}
"""Keys of ``[pattern]`` of a line pattern."""

SECTIONS = {
    "laser": {
        "projection_angle_deg": between(0, 90, "degrees"),
        "distance_mm": _LENGTH,
        "azimuth_deg": _TILT,
        "aim_x_mm": _AIM,
        "aim_y_mm": _AIM,
        "angle_distance_correlation": within(-1, 1, "correlation"),
        **_sigmas("laser"),
    },
    "pattern": {
        "rows": _COUNT,
        "columns": _COUNT,
        "inter_beam_angle_deg": between(0, 45, "degrees"),
        "absent": Rule(
            "a list of rays [row, column] within the pattern, counted from 1",
            _is_rays,
            required=False,
        ),
        "kind": Rule(
            f"one of {', '.join([*PATTERNS, MEASURED, LINES])}",
            lambda value: isinstance(value, str) and (value in PATTERNS or value == MEASURED),
            required=False,
        ),
        "rotation_deg": _TILT,
        **_sigmas("pattern"),
    },
    "electrode": {
        "height_mm": within(0, LARGEST_MM, "mm", required=True),
    },
    "imaging_plane": {
        "distance_mm": _LENGTH,
        "s_mm": _PLACE,
        "h_mm": _PLACE,
        "width_mm": _LENGTH,
        "height_mm": _LENGTH,
        "pitch_deg": within(-90, 90, "degrees"),
        "yaw_deg": within(-180, 180, "degrees"),
        "roll_deg": within(-180, 180, "degrees"),
        "glass_mm": within(0, 100, "mm"),
        "glass_index": within(1, 4, "refractive index"),
        **_sigmas("imaging_plane"),
    },
    "image_calibration": {**THREE_POINTS, **HOMOGRAPHY, **_OF_PICTURE},
    "camera_lens": {
        "focal_px": _two_numbers("[fu, fv], two numbers from 1 (px)", least=1.0),
        "center_px": _two_numbers("[u, v], two numbers (px)"),
        "distortion": Rule(
            "[k1, k2, p1, p2, k3], five numbers as OpenCV has them",
            lambda value: are_numbers(value, 5),
            required=False,
        ),
        "distortion_percent": within(-50, 50, "%, of the way to the plane's middle"),
        **_sigmas("camera_lens"),
    },
    "torch": {
        "travel": one_of(*get_args(Travel)),
    },
    "bench_check": bench_check.RULES,
}
"""Every section and key; `image_calibration` holds the keys of one of its two forms."""

OPTIONAL = ("camera_lens", "torch", "bench_check")
"""Optional sections."""


def rules_for(section: str, keys: object) -> dict[str, Rule]:
    """Rules for a section, given its keys.

    A homography replaces the three points; only a pattern of measured rays has these, and a line
    pattern has keys of its own.
    """
    if section == "pattern" and isinstance(keys, dict) and keys.get("kind") == MEASURED:
        return SECTIONS[section] | RAYS
    if section == "pattern" and isinstance(keys, dict) and keys.get("kind") == LINES:
        return LINE_PATTERN
    if section != "image_calibration":
        return SECTIONS[section]
    form = HOMOGRAPHY if isinstance(keys, dict) and "homography" in keys else THREE_POINTS
    return form | _OF_PICTURE
