"""Off-screen drawing of scenes, in this process or another.

Without OpenGL, VTK ends the process in which it runs.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from labapp.errors import InputError
from labapp.export.rendering.axes import USUAL_DPI
from labapp.export.rendering.drawing import Camera, Direction, Drawing, draw_without_display
from labapp.export.rendering.scene import Scene

PICTURE_PX = (1280, 720)
"""Default width and height of a picture."""

Picture = npt.NDArray[np.uint8]


class Studio:
    """Draws scenes of the same size and view in one plotter.

    It ends the process if nothing can be drawn: check `can_draw`, or use `drawing_process`.

    Parameters
    ----------
    size
        Width and height of the pictures, px.
    direction
        Viewing direction or camera.
    dpi
        Resolution, which determines the size of texts.

    Raises
    ------
    ImportError
        Without PyVista.
    """

    def __init__(
        self, size: tuple[int, int], direction: Direction | Camera, dpi: float = USUAL_DPI
    ) -> None:
        import pyvista

        draw_without_display()
        plotter: Any = pyvista.Plotter(off_screen=True, window_size=list(size))
        self.plotter = plotter
        plotter.render_window.SetDPI(round(dpi))
        self._drawing = Drawing(self.plotter)
        self._direction = direction

    def draw(self, scene: Scene) -> Picture:
        """Draw a scene; returns a picture, shape (height, width, 3), B, G, R."""
        self._drawing.update(scene)
        self._drawing.look(self._direction)
        self.plotter.render()  # a screenshot renders the first time only
        picture = self.plotter.screenshot(return_img=True)
        return np.ascontiguousarray(picture[..., ::-1])

    def close(self) -> None:
        """Release OpenGL."""
        self.plotter.close()


def drawing_process(
    size: tuple[int, int] = PICTURE_PX, direction: Direction | Camera = "free"
) -> ProcessPoolExecutor:
    """Return a process for `draw_there`; parameters as for `Studio`."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, initializer=_begin, initargs=(size, direction))


def draw_there(scene: Scene) -> Picture:
    """Draw a scene in a `drawing_process`, whose studio is created at the first call."""
    if "studio" not in _there:
        _there["studio"] = Studio(*_there["view"])
    picture: Picture = _there["studio"].draw(scene)
    return picture


@contextmanager
def drawing_errors(what: str) -> Iterator[None]:
    """Translate errors of drawing into `InputError`."""
    try:
        yield
    except ImportError as error:
        wanted = f"{error.name}, which is not installed (pip install 'labapp[gui]')"
        raise InputError("export", "pictures", what, wanted) from error
    except BrokenProcessPool as error:
        wanted = "a system on which OpenGL can be used; it cannot be used here"
        raise InputError("export", "pictures", what, wanted) from error


_there: dict[str, Any] = {}
"""View and studio of a drawing process."""


def _begin(*view: Any) -> None:
    """Initialise a drawing process: silence VTK and set size and direction."""
    _there["view"] = view
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
