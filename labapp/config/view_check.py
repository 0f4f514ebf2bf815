"""Whether a camera can see the imaging plane as an image calibration has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.values import FloatArray
from labapp.errors import InputError

LEAST_ANGLE_DEG = 10.0
"""Smallest angle between the axes in the picture; a smaller one is taken for an input error."""

UNDONE_PX = 0.01
"""Largest error of a distortion that is undone, px."""

SAMPLES = 65
"""Number of points on each edge of the imaging plane, and on each line from the picture's middle to
them, at which a distortion is assessed.
"""

ROUNDING = 1e-9
"""Largest rounding error of a point's distance from the principal point, in focal lengths."""


@np.errstate(all="ignore")  # huge numbers become NaN, which is a problem, too
def view_problems(
    path: Path, values: dict[str, dict[str, Any]], calibration: ImageCalibration
) -> list[InputError]:
    """Return problems of an image calibration whose values are each valid.

    Parameters
    ----------
    values
        Its values: section → key → value.
    """
    keys, plane = values["image_calibration"], values["imaging_plane"]
    size = np.array([plane["width_mm"], plane["height_mm"]])
    if "homography" not in keys:
        seen = np.array([keys[f"{name}_px"] for name in ("origin", "x_axis", "z_axis")], float)
        ideal = calibration.undistorted.ideal_px(seen)
        folded = _folded(path, calibration, ideal, seen) or _folded_elsewhere(
            path, values, calibration
        )
        return [*_nearly_one_line(path, seen), *folded]
    if horizon := _horizon(path, calibration, size):
        return horizon
    points = np.vstack([np.zeros(2), np.diag(keys.get("points_mm", size / 2))])
    flat = ImageCalibration(calibration.matrix).to_image(points)
    seen = calibration.undistorted.to_image(points)
    return _folded(path, calibration, flat, seen) or _folded_elsewhere(path, values, calibration)


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
    return [_not_undone(path, lens, "at O′ and on the axes")]


def _folded_elsewhere(
    path: Path, values: dict[str, dict[str, Any]], calibration: ImageCalibration
) -> list[InputError]:
    """Find a lens that maps several points of the imaging plane to one point of the picture.

    From the principal point to the plane's edges, the distorted points must move outward until they
    leave the picture; what a distortion does outside the picture does not matter.
    """
    lens = calibration.plain_lens
    if lens is None:
        return []
    plane, middle = values["imaging_plane"], np.array(lens.center_px)
    # Without the size of the picture: the principal point is about its middle.
    frame_px = np.array(values["image_calibration"].get("frame_px", 2 * middle), float)
    part = np.linspace(0.0, 1.0, SAMPLES)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * [
        plane["width_mm"],
        plane["height_mm"],
    ]
    edges = corners[:-1, None] + part[:, None] * np.diff(corners, axis=0)[:, None]
    ends = ImageCalibration(calibration.matrix).to_image(edges.reshape(-1, 2))
    seen = lens.distorted(middle + part[:, None] * (ends - middle)[:, None])
    within = ((seen >= 0) & (seen <= frame_px)).all(axis=-1)
    inside = np.logical_and.accumulate(within, axis=1)[:, :-1]
    far = np.hypot(*np.moveaxis((seen - middle) / lens.focal_px, -1, 0))
    if not (inside & (np.diff(far, axis=1) < -ROUNDING)).any():
        return []
    return [_not_undone(path, lens, "on all of the imaging plane")]


def _not_undone(path: Path, lens: Lens, where: str) -> InputError:
    expected = f"a distortion that can be undone {where}: calibrate the lens again"
    return InputError(path, "camera_lens.distortion", list(lens.distortion), expected)
