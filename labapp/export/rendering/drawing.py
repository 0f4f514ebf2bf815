"""A scene drawn with pyvista, in a window or off-screen.

pyvista is of the extra ``gui`` and is imported when something is drawn.
"""

from __future__ import annotations

import ctypes.util
import functools
import os
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray, IntArray
from labapp.export.rendering.scene import EMPTY, Scene
from labapp.system import IS_LINUX

VIEW_ANGLE_DEG = 30.0

Direction = Literal["top", "side", "front", "free"]
"""Where a scene is looked at from; ``free`` is obliquely from the camera's side."""

VIEWS: dict[Direction, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "top": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "side": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "front": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "free": ((0.5, -1.5, 0.9), (0.0, 0.0, 1.0)),
}
"""From where, and what is up there: X runs to the right from the top and the front, Y from the
side."""

COLOURS = {
    "points": "#ffffff",
    "incident": "#e69f00",
    "reflected": "#56b4e9",
    "section": "#ff5fd2",
}

BAR_WIDTH = 0.04
BAR_NUMBERS_PX = 56
"""Width of the colour scale, a part of the picture's, and what its numbers take beside it."""

BESIDE_PX, ASIDE_PX = 110, 62
"""What the scale takes of a picture's width, and how far that moves the pool's middle."""

USUAL_DPI = 72
"""At this resolution VTK draws texts at their nominal size."""

FLAT = 1 / 8
"""Axes less high than this part of their width have one number upwards: more would overlap."""

ROOMY = 1.5
"""Axes that stay are no more times as long as the scene needs."""


def build_scene(plotter: Any, scene: Scene, steady: bool = False) -> Drawing:
    """Add a scene to a `pyvista.Plotter`, of a window or off-screen, without rendering.

    The drawing that it returns takes further scenes.
    """
    drawing = Drawing(plotter, steady)
    drawing.update(scene)
    drawing.look("free")
    return drawing


class Drawing:
    """A scene in a plotter. What is there already takes new places and colours.

    Parameters
    ----------
    plotter
        A `pyvista.Plotter`; nothing but scenes is drawn in it.
    steady
        Whether axes stay while the next scene fills them well: they do not jump from frame to
        frame, and new ones take long to draw. Else a picture does not depend on the scene before.
    """

    def __init__(self, plotter: Any, steady: bool = False) -> None:
        self.plotter = plotter
        self._steady = steady
        self.plotter.theme.allow_empty_mesh = True  # a frame may have no surface
        self._box, self._steps = np.zeros((2, 3)), np.ones(3, int)
        self._stretch = np.ones(3)
        self._axes_actor: Any = None
        self._bar: Any = None
        # Before every picture: its size may have changed.
        plotter.renderer.AddObserver("StartEvent", lambda *_: self._place_bar())
        self._parts: dict[str, tuple[Any, Any]] = {}
        self._made_for: dict[str, object] = {}

    def update(self, scene: Scene) -> None:
        """Replace the scene, without rendering; the camera stays."""
        colours = (scene.foreground, scene.background)
        if self._is_new("colours", colours):
            self.plotter.clear()
            self._parts.clear()
            self.plotter.remove_bounds_axes()
            self._axes_actor = None
            self._made_for = {"colours": colours}
            self.plotter.set_background(scene.background)
            self.plotter.enable_lightkit()
        self._stretch = np.array([1.0, 1.0, scene.exaggeration])
        self._surface(scene)
        points = _polydata(scene.points_mm * self._stretch, "verts", 1)
        style = {"point_size": 6, "render_points_as_spheres": True}
        self._put("points", points, COLOURS["points"], **style)
        for name in ("boundary", "section"):
            line = scene.lines_mm.get(name, EMPTY) * self._stretch
            colour = COLOURS.get(name, scene.foreground)
            self._put(name, _polydata(line, "lines", len(line)), colour, line_width=3)
        for name in ("incident", "reflected"):
            ends = scene.rays_mm.get(name, EMPTY).reshape(-1, 3) * self._stretch
            self._put(name, _polydata(ends, "lines", 2), COLOURS[name], line_width=1)
        self._axes(scene)
        self._set_text("stamp", scene.stamp, scene.foreground, **self._in_corner("upper_right"))
        size = max(5, int(self.plotter.window_size[0] / self._scale) // 90)
        middle = {"position": (0.12, 0.75), "viewport": True, "font_size": size}
        self._set_text("notice", scene.notice, scene.foreground, **middle)

    def look(self, direction: Direction) -> None:
        """Look from one of the `VIEWS`; from the top, side and front without perspective."""
        way, up = VIEWS[direction]
        self.plotter.camera.view_angle = VIEW_ANGLE_DEG  # zooming has made it narrower
        self.plotter.camera.parallel_projection = direction != "free"
        self.plotter.view_vector(way, viewup=up, render=False)
        bounds = (self._box * self._stretch).T.ravel().tolist()
        self.plotter.reset_camera(render=False, bounds=bounds)
        # The numbers along the axes, and the colour scale, are as large in a small picture.
        width, height = np.array(self.plotter.window_size) / self._scale
        fill, below = (1.3, 78) if direction == "free" else (1.15, 85)
        room = min(fill * (height - below), 0.95 * (width - BESIDE_PX)) / min(width, height)
        self.plotter.camera.zoom(max(min(room, fill), 0.5))
        # To the left, beside the colour scale; and up, for the names of the axes are below.
        self.plotter.camera.SetWindowCenter(max(0.12, min(ASIDE_PX / width, 0.25)), -34 / height)

    @property
    def _scale(self) -> float:
        """Pixels of the picture per pixel of a usual screen; text scales by itself."""
        return float(self.plotter.render_window.GetDPI()) / USUAL_DPI

    def _is_new(self, part: str, made_for: object) -> bool:
        """Whether a part was made for something else and must be created again."""
        changed = self._made_for.get(part) != made_for
        self._made_for[part] = made_for
        return changed

    def _put(self, name: str, mesh: Any, colour: str, **style: Any) -> None:
        """Add or update a part; None hides it."""
        held = self._parts.get(name)
        if mesh is None:
            if held is not None:
                held[1].SetVisibility(False)
        elif held is None:
            actor = self.plotter.add_mesh(
                mesh, color=colour, **style, lighting=False, reset_camera=False, render=False
            )
            self._parts[name] = (mesh, actor)
        else:
            held[0].ShallowCopy(mesh)
            held[1].SetVisibility(True)

    def _surface(self, scene: Scene) -> None:
        import pyvista

        mesh = pyvista.PolyData.from_regular_faces(
            scene.vertices_mm * self._stretch, scene.triangles.astype(int)
        )
        mesh.point_data["values"] = scene.values
        mesh.point_data.active_normals = _normals(np.asarray(mesh.points), scene.triangles)
        mesh.set_active_scalars("values")
        title = scene.label.replace(" (", "\n(")  # narrow, to stay within the picture
        made_for = (scene.label, scene.diverging)
        if self._made_for.get("surface") != made_for:
            self._made_for.pop("surface", None)  # what fails below is made another time
            for former in list(self.plotter.scalar_bars.keys()):
                self.plotter.remove_scalar_bar(former, render=False)
            actor = self.plotter.add_mesh(
                mesh,
                scalars="values",
                name="surface",
                cmap="coolwarm" if scene.diverging else "viridis",
                clim=scene.limits,  # the values may all be unknown
                interpolate_before_map=True,
                ambient=0.35,
                diffuse=0.75,
                reset_camera=False,
                render=False,
                scalar_bar_args={
                    "title": title,
                    "color": scene.foreground,
                    "vertical": True,
                    "height": 0.6,
                    "title_font_size": 14,
                    "label_font_size": 13,
                    "unconstrained_font_size": True,
                    "width": BAR_WIDTH,
                },
            )
            actor.prop.interpolation = "Phong"
            # Lines that lie on the surface are seen whole.
            actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            actor.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(2.0, 2.0)
            self._parts["surface"] = (mesh, actor)
            self._bar = self.plotter.scalar_bars[title]
            self._place_bar()
            self._made_for["surface"] = made_for
        held, actor = self._parts["surface"]
        if held is not mesh:
            held.ShallowCopy(mesh)
        actor.mapper.lookup_table.scalar_range = scene.limits
        actor.mapper.scalar_range = scene.limits
        self._bar.SetLabelFormat(_label_format(scene.limits))

    def _place_bar(self) -> None:
        """Put the colour scale where its numbers, as tall in any picture, stay within."""
        if self._bar is not None:
            numbers = BAR_NUMBERS_PX * self._scale / self.plotter.window_size[0]
            left = 1 - BAR_WIDTH - numbers
            self._bar.SetPosition(min(left, 0.85), 0.2)

    def _axes(self, scene: Scene) -> None:
        box, steps = _box(scene)
        if self._steady and _holds(self._box, box):
            box, steps = self._box, self._steps
        self._box, self._steps = box, steps
        if not self._is_new("axes", (box.tobytes(), scene.exaggeration, scene.electrode)):
            return
        axes = self._axes_actor = self._axes_actor or self.plotter.show_bounds(
            xtitle="X (mm)",
            ytitle="Y, along the weld (mm)",
            ztitle="Z (mm)",
            n_zlabels=2,
            fmt="%.1f",
            color=scene.foreground,
            location="outer",
            font_size=round(11 * self._scale),
            use_3d_text=False,
            bounds=(box * self._stretch).T.ravel().tolist(),
            render=False,
        )
        axes.bounds = (box * self._stretch).T.ravel().tolist()
        axes.n_xlabels, axes.n_ylabels = int(steps[0]) + 1, int(steps[1]) + 1
        axes.x_axis_range, axes.y_axis_range, axes.z_axis_range = map(tuple, box.T.tolist())
        if np.ptp(box[:, 2]) * scene.exaggeration < FLAT * np.ptp(box[:, :2], axis=0).max():
            axes.GetAxisLabels(2).SetValue(0, "")
        top = np.array([[0, 0, box[0, 2]], [0, 0, box[1, 2] + 0.5]]) * self._stretch
        mark = _polydata(top if scene.electrode else EMPTY, "lines", 2)
        self._put("electrode", mark, scene.foreground, line_width=1)
        high = scene.exaggeration
        parts = [f"heights drawn {high:g} times as high"] if high != 1 else []
        words = "\n".join(parts + ["upright line: the electrode's axis"] * scene.electrode)
        self._set_text("caption", words, scene.foreground, **self._in_corner("upper_left"))

    def _in_corner(self, position: str) -> dict[str, Any]:
        """Style of text in a corner, whose size VTK does not scale."""
        return {"position": position, "font_size": round(6 * self._scale)}

    def _set_text(self, name: str, words: str, colour: str, **style: Any) -> None:
        """Set a text over the picture; an empty one removes it."""
        if not self._is_new(name, words):
            return
        if words:
            self.plotter.add_text(words, name=name, color=colour, render=False, **style)
        else:
            self.plotter.remove_actor(name, render=False)


def _box(scene: Scene) -> tuple[FloatArray, IntArray]:
    """Lowest and highest corner of the axes, shape (2, 3), mm, and steps along each, shape (3,).

    Whole millimetres, so that the numbers along the axes are; tenths upwards.
    """
    held = np.vstack([scene.vertices_mm, scene.within_mm])
    low, high = held.min(axis=0), held.max(axis=0)
    extent = float(np.max((high - low)[:2]))
    along = next((step for step in (1.0, 2.0, 5.0) if extent <= 6 * step), 10.0)
    step = np.array([along, along, 0.1])
    first, last = np.floor(low / step + 1e-6), np.ceil(high / step - 1e-6)
    last = np.maximum(last, first + 1)
    return np.stack([first, last]) * step, (last - first).astype(int)


def _holds(box: FloatArray, other: FloatArray) -> bool:
    """Whether another box lies within this one and is not much smaller."""
    within = (box[0] <= other[0] + 1e-9).all() and (other[1] <= box[1] + 1e-9).all()
    return bool(within and (np.ptp(box, axis=0) <= ROOMY * np.ptp(other, axis=0) + 1e-9).all())


def _polydata(points: FloatArray, kind: str, length: int) -> Any:
    """Points, or lines of a number of points each, for VTK; None without points."""
    import pyvista

    if not len(points):
        return None
    corner = np.arange(len(points)).reshape(-1, length)
    cells = np.column_stack([np.full(len(corner), length), corner]).ravel()
    made: Any = pyvista.PolyData
    return made(np.ascontiguousarray(points, np.float32), **{kind: cells})


def _normals(vertices: FloatArray, triangles: IntArray) -> npt.NDArray[np.float32]:
    """Unit normals of the surface at its vertices, shape (n, 3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    facet = np.cross(b - a, c - a)
    corners = triangles.ravel()
    summed = np.column_stack(
        [np.bincount(corners, np.repeat(facet[:, k], 3), len(vertices)) for k in range(3)]
    )
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(summed / np.maximum(length, 1e-12), np.float32)


def _label_format(limits: tuple[float, float]) -> str:
    """Number format that resolves the labels of a colour scale to a tenth of their distance."""
    step = max((limits[1] - limits[0]) / 4, 1e-9)
    return f"%.{max(0, int(np.ceil(-np.log10(0.2 * step))))}f"


def draw_without_display() -> None:
    """Let VTK draw through EGL where there is no display; call before the first drawing."""
    if IS_LINUX and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")


@functools.cache
def can_draw() -> bool:
    """Whether this process can draw in 3-D off-screen; VTK would end it otherwise."""
    try:
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401
        from vtkmodules.vtkRenderingCore import vtkRenderWindow
    except ImportError:
        return False
    draw_without_display()
    # VTK falls back on Mesa in memory at last, whether it is there or not.
    last_resort = vtkRenderWindow().GetClassName() == "vtkOSOpenGLRenderWindow"
    return not last_resort or ctypes.util.find_library("OSMesa") is not None
