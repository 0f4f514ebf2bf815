"""Pictures of results: frames with dots, the surface in 3-D, sizes over time.

Matplotlib and PyVista belong to the extra ``gui`` and are imported on first use.
"""

from __future__ import annotations

import colorsys
import io
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.pipeline import Measurement
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray
from labapp.export.rendering.scene import scene_of
from labapp.export.rendering.studio import draw_there, drawing_process
from labapp.files import write_atomically
from labapp.text import SIGMA_OF, rounded

ENLARGED = 3
"""Picture pixels per pixel of the frame, for legible labels; pixels are replicated."""

SMALL: dict[str, list[int]] = {
    # The filter suits replicated pixels: 0.4 MB instead of 2 MB with OpenCV's default.
    ".png": [cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP],
    ".jpg": [cv2.IMWRITE_JPEG_QUALITY, 90],
    ".tif": [],
}
"""Compression parameters of frame pictures, by suffix."""

UNKNOWN = (150, 150, 150)

LEGEND = "left: row of the ray; above: its column; grey ring: in doubt, no ray"


def frame_picture(image: npt.NDArray[Any], measurement: Measurement) -> npt.NDArray[np.uint8]:
    """Draw a frame with circled dots, ray columns above the dots and ray rows at the left.

    Parameters
    ----------
    image
        Grey levels, shape (rows, columns).
    measurement
        Its measurement. The circle of a dot without a ray is grey.

    Returns
    -------
    npt.NDArray[np.uint8]
        Shape (3·rows, 3·columns, 3), B, G, R; a colour per row of rays.
    """
    low, high = np.percentile(image, [1, 99.8])
    grey = np.clip((image - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    enlarged = cv2.resize(grey, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_NEAREST)
    picture = cv2.cvtColor(enlarged, cv2.COLOR_GRAY2BGR)
    dots, match = measurement.dots, measurement.match
    if dots is None:
        return np.asarray(picture, np.uint8)
    rays = {} if match is None else dict(zip(match.dot.tolist(), match.ray.tolist(), strict=True))
    leftmost: dict[int, list[tuple[int, int]]] = {}
    for k, at in enumerate(dots.image_px):
        u, v = ((at + 0.5) * ENLARGED - 0.5).round().astype(int).tolist()
        ray = rays.get(k)
        colour = UNKNOWN if ray is None else _row_colour(ray[0])
        cv2.circle(picture, (u, v), 4 * ENLARGED, colour, 1, cv2.LINE_AA)
        if ray is not None:
            # The number above a dot must fit between the dots of a row.
            _write(picture, str(ray[1]), (u - 7, v - 6 * ENLARGED), colour, 0.45)
            leftmost.setdefault(ray[0], []).append((u, v))
    for row, places in leftmost.items():
        u, v = min(places)
        _write(picture, f"row {row}", (u - 70, v + 5), _row_colour(row), 0.5)
    if rays:
        _write(picture, LEGEND, (12, 24), (255, 255, 255), 0.5)
    return np.asarray(picture, np.uint8)


def _write(
    picture: npt.NDArray[Any],
    text: str,
    place: tuple[int, int],
    colour: tuple[int, int, int],
    size: float,
) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _row_colour(row: int) -> tuple[int, int, int]:
    """Return the colour (B, G, R) of a row; neighbouring rows differ most."""
    red, green, blue = colorsys.hsv_to_rgb(row * 0.381966 % 1, 0.55, 1.0)
    return int(blue * 255), int(green * 255), int(red * 255)


def write_frame_picture(path: Path, image: npt.NDArray[Any], measurement: Measurement) -> None:
    """Write `frame_picture` in the format of the path's suffix: .png, .jpg or .tif."""
    _, content = cv2.imencode(path.suffix, frame_picture(image, measurement), SMALL[path.suffix])
    write_atomically(path, content.tobytes())


def write_trend_picture(
    path: Path,
    axis: Sequence[float],
    label: str,
    series: Mapping[str, tuple[FloatArray, FloatArray]],
) -> None:
    """Write a PNG with one plot per series of lengths over a common axis, with gaps at NaN.

    Parameters
    ----------
    axis, label
        Time or number of each frame, shape (n,), ascending, and the label of the axis.
    series
        Values and their σ, NaN where unknown, by the name of the length, shape (n,) each, mm.

    Raises
    ------
    ImportError
        Without Matplotlib.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 2.2 * len(series)), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(series), sharex=True, squeeze=False)[:, 0]
    for plot, (name, (values, sigma)) in zip(plots, series.items(), strict=True):
        bars = np.where(np.isfinite(values), np.nan_to_num(sigma), np.nan)
        plot.errorbar(axis, values, bars, fmt="o-", markersize=3, linewidth=1, elinewidth=0.7)
        known = values[np.isfinite(values)]
        if len(known) > 1:
            mean, spread = rounded(known.mean(), known.std())
            spread = f", standard deviation {spread}" * bool(spread)
            plot.set_title(f"mean {mean}{spread} mm", fontsize="small", loc="right")
        if np.isfinite(sigma).any():
            plot.set_title(f"±: one σ, {SIGMA_OF}", fontsize="small", loc="left")
        plot.set_ylabel(f"{name} (mm)")
        plot.grid(alpha=0.3)
    plots[-1].set_xlabel(label)
    margin = 0.02 * (axis[-1] - axis[0])
    if margin > 0:  # shows also frames at the ends that have no surface
        plots[-1].set_xlim(axis[0] - margin, axis[-1] + margin)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    write_atomically(path, content.getvalue())


def write_surface_picture(
    path: Path, reconstruction: Reconstruction, process: Executor | None = None
) -> None:
    """Write a PNG of the surface in 3-D, coloured by height, with the reflection points.

    Parameters
    ----------
    process
        A `drawing_process` for several pictures; None starts one of default size and view.

    Raises
    ------
    ImportError
        Without PyVista.
    BrokenProcessPool
        If nothing can be drawn.
    """
    with ExitStack() as stack:
        process = process or stack.enter_context(drawing_process())
        drawing = process.submit(draw_there, scene_of(reconstruction))
        _, content = cv2.imencode(".png", drawing.result())
    write_atomically(path, content.tobytes())
