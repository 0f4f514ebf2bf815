"""Whether a camera can see the imaging plane as an image calibration has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.values import FloatArray
from labapp.errors import InputError

LEAST_ANGLE_DEG = 10.0
"""Smallest angle between the axes in the picture; a smaller one is taken for an input error."""

UNDONE_PX = 0.01
"""Largest error of a distortion that is undone, px."""


@np.errstate(all="ignore")  # huge numbers become NaN, which is a problem, too
def view_problems(
    path: Path, values: dict[str, dict[str, Any]], calibration: ImageCalibration
) -> list[InputError]:
    """Return problems of an image calibration whose values are each valid.

    Parameters
    ----------
    path
        The setup file, for the errors.
    values
        Its values: section → key → value.
    calibration
        The image calibration of these values.
    """
    keys, plane = values["image_calibration"], values["imaging_plane"]
    size = np.array([plane["width_mm"], plane["height_mm"]])
    if "homography" not in keys:
        seen = np.array([keys[f"{name}_px"] for name in ("origin", "x_axis", "z_axis")], float)
        ideal = calibration.undistorted.ideal_px(seen)
        return [*_nearly_one_line(path, seen), *_folded(path, calibration, ideal, seen)]
    if horizon := _horizon(path, calibration, size):
        return horizon
    points = np.vstack([np.zeros(2), np.diag(keys.get("points_mm", size / 2))])
    flat = ImageCalibration(calibration.matrix).to_image(points)
    return _folded(path, calibration, flat, calibration.undistorted.to_image(points))


def _nearly_one_line(path: Path, seen: FloatArray) -> list[InputError]:
    """Find axes that are closer together in the picture than a camera can see them."""
    x_arm, z_arm = seen[1:] - seen[0]
    sine = (x_arm[0] * z_arm[1] - x_arm[1] * z_arm[0]) / np.hypot(*x_arm) / np.hypot(*z_arm)
    if abs(sine) >= np.sin(np.radians(LEAST_ANGLE_DEG)):
        return []
    return [
        InputError(
            path,
            "image_calibration",
            "O′, x_axis_px and z_axis_px lie nearly on one line",
            f"at least {LEAST_ANGLE_DEG:g} degrees between O′X′ and O′Z′ in the picture",
        )
    ]


def _horizon(path: Path, calibration: ImageCalibration, size: FloatArray) -> list[InputError]:
    """Find a homography that has a part of the imaging plane behind the camera."""
    corners = np.array([[x, z, 1.0] for x in (0.0, size[0]) for z in (0.0, size[1])])
    depth = corners @ calibration.from_plane[2]
    if depth.min() * depth.max() > 0:
        return []
    return [
        InputError(
            path,
            "image_calibration.homography",
            "its horizon crosses the imaging plane",
            "the whole imaging plane before the camera: calibrate it again",
        )
    ]


def _folded(
    path: Path, calibration: ImageCalibration, ideal: FloatArray, seen: FloatArray
) -> list[InputError]:
    """Find a lens whose distortion cannot be undone at O′ and on the axes.

    ``ideal``, ``seen``: the points without the distortion and with it, px.
    """
    lens = calibration.plain_lens
    if lens is None:
        return []
    errors = [*(lens.distorted(ideal) - seen).flat, *(lens.ideal(seen) - ideal).flat]
    if np.abs(errors).max() <= UNDONE_PX:  # also False for NaN
        return []
    return [
        InputError(
            path,
            "camera_lens.distortion",
            list(lens.distortion),
            "a distortion that can be undone at O′ and on the axes: calibrate the lens again",
        )
    ]
