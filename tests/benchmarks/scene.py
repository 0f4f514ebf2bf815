"""Update rate of the 3-D scene with software rendering.

Run as ``python tests/benchmarks/scene.py``. Prints updates per second, from a new surface to the
picture, and renders per second of the unchanged scene.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"
os.environ["LIBGL_ALWAYS_SOFTWARE"] = "1"

import numpy as np
import pyvista

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.export.rendering.drawing import build_scene
from labapp.export.rendering.scene import scene_of

SIZE = (900, 600)
SECONDS = 3.0
LEAST_PER_S = 20.0
"""Required by the app's windows."""


def pools(count: int) -> list[Reconstruction]:
    """Return growing and shrinking pools as from ``fit``: a spline and 100 points."""
    basis = SplineBasis(np.linspace(-6.0, 6.0, 25), np.linspace(-6.0, 6.0, 25))
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-2, 2, 10), np.linspace(-2, 2, 10)))
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(-6, 6, 60), np.linspace(-6, 6, 60)))
    matrix = basis.matrix(a, b)
    reconstructions = []
    for k in range(count):
        height, radius = 0.3 + 0.05 * np.sin(k), 3.3 + 0.1 * np.cos(k)
        height_mm = height * (1 - (a**2 + b**2) / radius**2)
        surface = SplineSurface(basis, np.linalg.lstsq(matrix, height_mm, rcond=None)[0])
        points = np.column_stack([x, y, surface.height(x, y)])
        boundary = Boundary.polar(np.zeros(2), np.full(360, radius))
        residual, sigma = np.zeros((100, 2)), np.full(100, 0.002)
        ray = np.ones((100, 2), np.int64)
        reconstructions.append(
            Reconstruction("fit", surface, boundary, ray, points, residual, sigma)
        )
    return reconstructions


def rate(work: Callable[[int], None]) -> float:
    """Return how often work can be done per second."""
    work(0)
    start_s, done = time.perf_counter(), 0
    while time.perf_counter() - start_s < SECONDS:
        work(done)
        done += 1
    return done / (time.perf_counter() - start_s)


def main() -> None:
    frames = pools(20)
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=list(SIZE))
    plotter.disable_anti_aliasing()
    plotter.render_window.SetMultiSamples(0)
    drawing = build_scene(plotter, scene_of(frames[0]))
    plotter.show(auto_close=False)

    def update(k: int) -> None:
        drawing.update(scene_of(frames[k % len(frames)]))
        plotter.render()

    bare = rate(lambda _: plotter.render())
    full = rate(update)
    print(f"{SIZE[0]}×{SIZE[1]} px, {len(scene_of(frames[0]).triangles)} triangles")
    print(f"renders   {bare:6.1f} /s")
    print(f"updates   {full:6.1f} /s ({full / bare:.2f} of the renders; wanted {LEAST_PER_S:g} /s)")
    plotter.close()


if __name__ == "__main__":
    main()
