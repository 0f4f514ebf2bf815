"""Points and ends of a frame's lines on the imaging plane: the data of the fit."""

from __future__ import annotations

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.lines.detection.find_lines import LightLine
from labapp.core.lines.model import LineData
from labapp.core.values import FloatArray

POINT_STEP_PX = 10.0
"""Spacing of the points of a line, px."""

SMOOTHED = 2 * np.sqrt(np.pi)
"""Spacing of independent points of a line smoothed by a Gaussian, in its standard deviations."""

SIGMA_FACTOR, FLOOR_PX = 1.3, 0.06
"""Ratio of the scatter of a ridge to that expected from speckle; and the least uncertainty, px."""

END_SIGMA_PX, END_SHARE = 1.0, 0.25
"""Standard uncertainty of a line's end along it, px, and the least as a share of the line's width:
the edge of the pool cuts a wide line obliquely."""


def line_data(lines: tuple[LightLine, ...], calibration: ImageCalibration) -> LineData:
    """Return points and ends of lines, from the lowest up, on the imaging plane."""
    points = [_points(one, calibration) for one in lines]
    ends = [_ends(one, calibration) for one in lines]
    place, normal, sigma = (np.concatenate(column) for column in zip(*points, strict=True))
    end, end_sigma = (np.concatenate(column) for column in zip(*ends, strict=True))
    line, end_line = (
        np.concatenate([np.full(len(each[0]), k) for k, each in enumerate(some)])
        for some in (points, ends)
    )
    return LineData(line, place, normal, sigma, end_line, end, end_sigma)


def _points(
    line: LightLine, calibration: ImageCalibration
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, normals and uncertainties of points about every `POINT_STEP_PX`."""
    count = len(line.image_px)
    chosen = np.linspace(0, count - 1, max(5, round(count / POINT_STEP_PX))).round().astype(int)
    chosen = np.unique(chosen)
    place, along, scale = _on_plane(line.image_px[chosen], line.tangent[chosen], calibration)
    independent = max(count / (SMOOTHED * line.smoothed_px), 1.0)
    common = np.sqrt(max(len(chosen) / independent, 1.0))
    sigma = np.hypot(SIGMA_FACTOR * line.sigma_px[chosen], FLOOR_PX) * common * scale
    return place, np.stack([-along[:, 1], along[:, 0]], axis=-1), sigma


def _ends(line: LightLine, calibration: ImageCalibration) -> tuple[FloatArray, FloatArray]:
    """Positions and uncertainties of the ends that are not cut off."""
    own = ~line.cut
    across = np.stack([-line.tangent[:, 1], line.tangent[:, 0]], axis=-1)[[0, -1]][own]
    place, _, scale = _on_plane(line.ends_px[own], across, calibration)
    return place, max(END_SIGMA_PX, END_SHARE * line.width_px) * scale


def _on_plane(
    image_px: FloatArray, tangent: FloatArray, calibration: ImageCalibration
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, unit tangents and mm per pixel across them, from those in the image."""
    place = calibration.to_plane(image_px)
    jacobian = calibration.jacobian(image_px)
    along = (jacobian @ tangent[..., None])[..., 0]
    length = np.linalg.norm(along, axis=-1)
    scale = np.abs(np.linalg.det(jacobian)) / length
    return place, along / length[:, None], scale
