"""Values in the text of a setup that may be incomplete, as while it is being entered."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from labapp.config.setup_keys import SECTIONS
from labapp.config.toml_keys import are_numbers, check_keys
from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.geometry.rig import DotPattern
from labapp.core.geometry.uncertainty import ENDINGS
from labapp.core.values import FloatArray
from labapp.errors import InputError

LENS = ("focal_px", "center_px", "distortion")
"""Keys of the lens of the camera."""


def pattern_kind(text: str) -> str:
    """Kind of the pattern."""
    kind = _section(text, "pattern").get("kind")
    return kind if isinstance(kind, str) else DotPattern.kind


def lens_of(text: str) -> Lens | None:
    """Lens of the camera; None if there is none."""
    keys = _section(text, "camera_lens")
    lens: dict[str, Any] = {name: keys.get(name) for name in LENS}
    if check_keys(Path(), "camera_lens", lens, SECTIONS["camera_lens"]):
        return None
    return Lens(**{name: tuple(value) for name, value in lens.items()})


def check_lens(text: str, path: Path) -> None:
    """Check the lens of the camera in the text of a file; the file needs none.

    Raises
    ------
    InputError
        If a key of its section is unknown or invalid, or the lens is incomplete.
    """
    keys = _value(text, "camera_lens")
    problems = (
        [] if keys is None else check_keys(path, "camera_lens", keys, SECTIONS["camera_lens"])
    )
    if isinstance(keys, dict):
        problems += incomplete_lens(path, keys)
    if problems:
        raise InputError.gather(problems)


def incomplete_lens(path: Path, keys: Mapping[str, Any]) -> list[InputError]:
    """Problem of a section with some of the keys of a lens, but not all; empty if it has none."""
    lacking = sorted(set(LENS) - keys.keys())
    if not 0 < len(lacking) < len(LENS):
        return []
    return [InputError(path, f"camera_lens.{lacking[0]}", "missing", "all of the lens, or none")]


def three_points(text: str) -> FloatArray | None:
    """(u, v) of O′ and the points on the axes, shape (3, 2), px; None without all three."""
    keys = _section(text, "image_calibration")
    points = [keys.get(name) for name in ("origin_px", "x_axis_px", "z_axis_px")]
    return np.array(points, float) if all(are_numbers(point, 2) for point in points) else None


def points_of(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of an image calibration without uncertainties and the size of its picture."""
    return {k: v for k, v in keys.items() if not k.endswith(ENDINGS) and k != "frame_px"}


def image_calibration_of(keys: Mapping[str, Any], lens: Lens | None) -> ImageCalibration:
    """Image calibration of a section of a setup.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a key is missing or unknown, or the points do not determine a calibration.
    """
    points = points_of(keys)
    if "homography" in points:
        return ImageCalibration(np.array(points["homography"], float), lens)
    return ImageCalibration.from_three_points(**points, lens=lens)


def frame_px_of(text: str) -> tuple[int, int] | None:
    """(width, height) of the calibration picture, px; None if it is unknown."""
    size = _section(text, "image_calibration").get("frame_px")
    rule = SECTIONS["image_calibration"]["frame_px"]
    return (size[0], size[1]) if rule.accepts(size) and isinstance(size, list) else None


def _section(text: str, name: str) -> dict[str, Any]:
    """A section of the text of a setup; empty if it is missing or the text is not TOML."""
    section = _value(text, name)
    return section if isinstance(section, dict) else {}


def _value(text: str, name: str) -> object:
    """A value of the text of a setup; None if it is missing or the text is not TOML."""
    try:
        return tomllib.loads(text).get(name)
    except (ValueError, RecursionError):  # ValueError: too many digits, too
        return None
