"""Pictures of results: dots over their frame, the surface in 3-D, sizes over time.

matplotlib and pyvista are of the extra ``gui`` and are imported when a picture is drawn.
"""

from __future__ import annotations

import colorsys
import io
import multiprocessing
import os
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.measures import surface_mesh
from labapp.core.pipeline import Measurement
from labapp.core.reconstruction import Reconstruction
from labapp.core.values import FloatArray, IntArray
from labapp.session.files import write_whole

ENLARGED = 3
"""Screen pixels per pixel of the frame, so that labels can be read."""

EXAGGERATION = 3.0
"""Height over width in the 3-D view: pools are flat."""

FROM_CAMERA = (0.5, -1.5, 0.9)
"""Where the 3-D view is taken from: the camera's side, so that X runs to the right."""

UNKNOWN = (150, 150, 150)

LEGEND = "left: row of the ray; above: its column; grey ring: in doubt, no ray"


def frame_picture(image: npt.NDArray[Any], measurement: Measurement) -> npt.NDArray[np.uint8]:
    """The frame with its dots ringed, rays' columns above them and rows left of the first.

    Parameters
    ----------
    image
        Grey levels, shape (rows, columns).
    measurement
        What was found in it. A dot without a ray is ringed in grey; the legend says so.

    Returns
    -------
    npt.NDArray[np.uint8]
        Shape (3·rows, 3·columns, 3), B, G, R; a colour per row of rays.
    """
    low, high = np.percentile(image, [1, 99.8])
    grey = np.clip((image - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    enlarged = cv2.resize(grey, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
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
            # Dots of one row stand closest, and the number above must fit between them.
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
    """A colour (B, G, R) that differs most between neighbouring rows."""
    red, green, blue = colorsys.hsv_to_rgb(row * 0.381966 % 1, 0.55, 1.0)
    return int(blue * 255), int(green * 255), int(red * 255)


def write_frame_picture(path: Path, image: npt.NDArray[Any], measurement: Measurement) -> None:
    """Write `frame_picture` as PNG."""
    _, content = cv2.imencode(".png", frame_picture(image, measurement))
    write_whole(path, content.tobytes())


def write_trend_picture(
    path: Path, axis: Sequence[float | None], label: str, series: Mapping[str, FloatArray]
) -> None:
    """Write a PNG of one plot per series of lengths over a common axis.

    NaN leaves a gap.

    Raises
    ------
    ImportError
        Without matplotlib.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 2.2 * len(series)), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(series), sharex=True, squeeze=False)[:, 0]
    for plot, (name, values) in zip(plots, series.items(), strict=True):
        plot.plot(axis, values, "o-", markersize=3, linewidth=1)
        known = values[np.isfinite(values)]
        if len(known) > 1:
            spread = f"mean {known.mean():.4f}, standard deviation {known.std():.4f} mm"
            plot.set_title(spread, fontsize="small", loc="right")
        plot.set_ylabel(f"{name} (mm)")
        plot.grid(alpha=0.3)
    plots[-1].set_xlabel(label)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    write_whole(path, content.getvalue())


def drawing_process() -> ProcessPoolExecutor:
    """A process to draw in: VTK ends the one it runs in where there is no OpenGL."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, initializer=_without_display)


def write_surface_picture(
    path: Path, reconstruction: Reconstruction, process: Executor | None = None
) -> None:
    """Write a PNG of the surface in 3-D, coloured by height, with the reflection points.

    Parameters
    ----------
    path
        Where to.
    reconstruction
        What to draw.
    process
        A `drawing_process` to draw several pictures in; None starts one for this.

    Raises
    ------
    ImportError
        Without pyvista.
    BrokenProcessPool
        Where nothing can be drawn.
    """
    vertices, triangles = surface_mesh(reconstruction, 0.1)
    with ExitStack() as stack:
        process = process or stack.enter_context(drawing_process())
        drawing = process.submit(draw_surface, vertices, triangles, reconstruction.points_mm)
        _, content = cv2.imencode(".png", drawing.result())
    write_whole(path, content.tobytes())


def _without_display() -> None:
    """Draw through EGL where there is no display; keep VTK's warnings off the terminal."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)


def draw_surface(
    vertices_mm: FloatArray, triangles: IntArray, points_mm: FloatArray
) -> npt.NDArray[np.uint8]:
    """Draw the surface off-screen, shape (800, 1200, 3), B, G, R; see `write_surface_picture`."""
    import pyvista

    stretch = np.array([1.0, 1.0, EXAGGERATION])
    # Whole millimetres, so that the numbers along the axes are; tenths upwards.
    step = np.array([1.0, 1.0, 0.1])
    box = np.stack(
        [np.floor(vertices_mm.min(0) / step + 1e-6), np.ceil(vertices_mm.max(0) / step - 1e-6)]
    )
    box = box * step
    mesh = pyvista.PolyData.from_regular_faces(vertices_mm * stretch, triangles.astype(int))
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[1200, 800])
    plotter.add_mesh(
        mesh,
        scalars=vertices_mm[:, 2],
        cmap="viridis",
        smooth_shading=True,
        scalar_bar_args={
            "title": "height (mm)",
            "fmt": "%.2f",
            "vertical": True,
            "position_x": 0.88,
            "position_y": 0.25,
        },
    )
    plotter.add_points(
        points_mm * stretch, color="white", point_size=7, render_points_as_spheres=True
    )
    plotter.show_bounds(
        bounds=(box * stretch).T.ravel().tolist(),
        axes_ranges=box.T.ravel().tolist(),
        n_xlabels=int(np.ptp(box[:, 0])) + 1,
        n_ylabels=int(np.ptp(box[:, 1])) + 1,
        xtitle="X (mm)",
        ytitle="Y, welding direction (mm)",
        ztitle="Z (mm)",
        fmt="%.1f",
        n_zlabels=2,
        location="outer",
        font_size=12,
        use_3d_text=False,
    )
    plotter.add_text(
        f"heights drawn {EXAGGERATION:g} times as high; white: reflection points; "
        "the electrode is above X = Y = 0",
        font_size=10,
    )
    plotter.view_vector(FROM_CAMERA, viewup=(0.0, 0.0, 1.0))
    plotter.camera.zoom(1.3)
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    return np.ascontiguousarray(picture[..., ::-1])
