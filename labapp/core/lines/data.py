"""A frame's lines on the imaging plane: the points and ends that the fit compares."""

from __future__ import annotations

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.lines.find_lines import LightLine
from labapp.core.lines.model import LineData
from labapp.core.values import FloatArray

POINT_STEP_PX = 10.0
"""Distance of the points that a line gives, px."""

SMOOTHED = 2 * np.sqrt(np.pi)
"""A line that is smoothed by a Gaussian has an independent point every so many of its standard
deviations."""

SIGMA_FACTOR, FLOOR_PX = 1.3, 0.06
"""A ridge's scatter along its line is larger than its speckle explains by this factor; and what no
line is better than, px."""

END_SIGMA_PX = 1.0
"""Standard uncertainty of a line's end along it, px."""


def line_data(lines: tuple[LightLine, ...], calibration: ImageCalibration) -> LineData:
    """Points and ends of lines, from the lowest up, on the imaging plane."""
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
    """Places, normals and uncertainties of points about every `POINT_STEP_PX`."""
    count = len(line.image_px)
    chosen = np.linspace(0, count - 1, max(5, round(count / POINT_STEP_PX))).round().astype(int)
    chosen = np.unique(chosen)
    place, along, scale = _on_plane(line.image_px[chosen], line.tangent[chosen], calibration)
    independent = max(count / (SMOOTHED * line.smoothed_px), 1.0)
    common = np.sqrt(max(len(chosen) / independent, 1.0))
    sigma = np.hypot(SIGMA_FACTOR * line.sigma_px[chosen], FLOOR_PX) * common * scale
    return place, np.stack([-along[:, 1], along[:, 0]], axis=-1), sigma


def _ends(line: LightLine, calibration: ImageCalibration) -> tuple[FloatArray, FloatArray]:
    """Places and uncertainties of the ends that are the line's own."""
    own = ~line.cut
    across = np.stack([-line.tangent[:, 1], line.tangent[:, 0]], axis=-1)[[0, -1]][own]
    place, _, scale = _on_plane(line.ends_px[own], across, calibration)
    return place, END_SIGMA_PX * scale


def _on_plane(
    image_px: FloatArray, tangent: FloatArray, calibration: ImageCalibration
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places, unit tangents and mm a pixel across them, from places and tangents in the image."""
    place = calibration.to_plane(image_px)
    jacobian = calibration.jacobian(image_px)
    along = (jacobian @ tangent[..., None])[..., 0]
    length = np.linalg.norm(along, axis=-1)
    scale = np.abs(np.linalg.det(jacobian)) / length
    return place, along / length[:, None], scale
