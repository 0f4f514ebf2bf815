"""Drawing of scenes with PyVista, in a window or off-screen.

PyVista belongs to the extra ``gui`` and is imported on first use.
"""

from __future__ import annotations

import ctypes.util
import functools
import os
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray, IntArray
from labapp.export.rendering.axes import Overlay, round_step, round_ticks
from labapp.export.rendering.scene import EMPTY, Scene
from labapp.system import IS_LINUX

VIEW_ANGLE_DEG = 30.0

Direction = Literal["top", "side", "front", "free"]
"""Viewing direction; ``free`` is oblique, from the camera's side."""

Triple = tuple[float, ...]
Camera = tuple[Triple, Triple, Triple, float, float, bool, tuple[float, float]]
"""Position, focal point, up; view angle, parallel scale, whether the projection is parallel; centre
of the window."""

VIEWS: dict[Direction, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "top": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "side": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "front": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "free": ((0.5, -1.5, 0.9), (0.0, 0.0, 1.0)),
}
"""Direction to the viewer, and up: X is to the right from the top and the front, Y from the side.
"""

COLOURS = {
    "points": "#ffffff",
    "incident": "#e69f00",
    "reflected": "#56b4e9",
    "section": "#ff5fd2",
}

BESIDE_PX, ASIDE_PX = 110, 62
"""Width of the colour scale, and the resulting shift of the pool's centre."""

CONTOURS = 8
"""Most contour lines, at round heights."""

PLATE_OPACITY = 0.3

ROOMY = 1.5
"""Largest ratio of the length of steady axes to the extent of the scene."""


def build_scene(plotter: Any, scene: Scene, steady: bool = False) -> Drawing:
    """Add a scene to a `pyvista.Plotter`, without rendering; returns an updatable drawing."""
    drawing = Drawing(plotter, steady)
    drawing.update(scene)
    drawing.look("free")
    return drawing


class Drawing:
    """A scene in a plotter; updates reuse existing actors.

    Parameters
    ----------
    plotter
        A `pyvista.Plotter` for this drawing only.
    steady
        Whether to retain the axes while the next scene fits them: then they do not jump from frame
        to frame, and updates are faster. Otherwise pictures do not depend on previous scenes.
    """

    def __init__(self, plotter: Any, steady: bool = False) -> None:
        self.plotter = plotter
        self._steady = steady
        self.plotter.theme.allow_empty_mesh = True  # a frame may have no surface
        # The work piece is the only transparent part but for lines: sorting pixels is not needed.
        self.plotter.renderer.SetUseOIT(False)
        self._box, self._step_mm = np.zeros((2, 3)), 1.0
        self._stretch = np.ones(3)
        self.overlay = Overlay(plotter, "black")
        """Axes, colour scale and captions."""
        # Before every rendering, as its size or the camera may have changed.
        plotter.renderer.AddObserver("StartEvent", lambda *_: self._place())
        self._parts: dict[str, tuple[Any, Any]] = {}
        self._made_for: dict[str, object] = {}

    def update(self, scene: Scene) -> None:
        """Replace the scene, without rendering; the camera is unchanged."""
        colours = (scene.foreground, scene.background)
        if self._is_new("colours", colours):
            self.plotter.clear()
            self._parts.clear()
            self._made_for = {"colours": colours}
            self.overlay = Overlay(self.plotter, scene.foreground)
            self.plotter.set_background(scene.background)
            self.plotter.enable_lightkit()
        self._stretch = np.array([1.0, 1.0, scene.exaggeration])
        self._surface(scene)
        points = _polydata(scene.points_mm * self._stretch, "verts", 1)
        style = {"point_size": 6, "render_points_as_spheres": True}
        self._put("points", points, COLOURS["points"], **style)
        mark = _polydata(scene.mark_mm * self._stretch, "verts", 1)
        style["point_size"] = 11
        self._put("mark", mark, COLOURS["section"], **style)
        for name in ("boundary", "section"):
            line = scene.lines_mm.get(name, EMPTY) * self._stretch
            colour = COLOURS.get(name, scene.foreground)
            self._put(name, _polydata(line, "lines", len(line)), colour, line_width=3)
        for name in ("incident", "reflected"):
            ends = scene.rays_mm.get(name, EMPTY).reshape(-1, 3) * self._stretch
            self._put(name, _polydata(ends, "lines", 2), COLOURS[name], line_width=1)
        self._axes(scene)
        self.overlay.mark = (scene.mark_mm[0], scene.mark_words) if len(scene.mark_mm) else None

    def look(self, direction: Direction | Camera) -> None:
        """Set one of the `VIEWS`, with parallel projection except ``free``, or a camera."""
        if not isinstance(direction, str):
            self.camera = direction
            return
        way, up = VIEWS[direction]
        self.plotter.camera.view_angle = VIEW_ANGLE_DEG  # changed by zooming
        self.plotter.camera.parallel_projection = direction != "free"
        self.plotter.view_vector(way, viewup=up, render=False)
        bounds = (self._box * self._stretch).T.ravel().tolist()
        self.plotter.reset_camera(render=False, bounds=bounds)
        # Labels and colour scale have a constant size, also in a small picture.
        width, height = np.array(self.plotter.window_size) / self.overlay.point_px
        fill, below = (1.3, 78) if direction == "free" else (1.15, 85)
        room = min(fill * (height - below), 0.95 * (width - BESIDE_PX)) / min(width, height)
        self.plotter.camera.zoom(max(min(room, fill), 0.5))
        # Shift to the left for the colour scale, and up for the axis labels.
        self.plotter.camera.SetWindowCenter(max(0.12, min(ASIDE_PX / width, 0.25)), -34 / height)

    @property
    def camera(self) -> Camera:
        """The present camera."""
        current = self.plotter.camera
        return (
            *(tuple(current.position), tuple(current.focal_point), tuple(current.up)),
            *(float(current.view_angle), float(current.parallel_scale)),
            *(bool(current.parallel_projection), tuple(current.GetWindowCenter())),
        )

    @camera.setter
    def camera(self, camera: Camera) -> None:
        current = self.plotter.camera
        current.position, current.focal_point, current.up = camera[:3]
        current.view_angle, current.parallel_scale, current.parallel_projection = camera[3:6]
        current.SetWindowCenter(*camera[6])
        self.plotter.renderer.ResetCameraClippingRange()

    def _is_new(self, part: str, made_for: object) -> bool:
        """Whether a part must be created again, as ``made_for`` differs from the last call."""
        changed = self._made_for.get(part) != made_for
        self._made_for[part] = made_for
        return changed

    def _put(self, name: str, mesh: Any, colour: str, **style: Any) -> None:
        """Add or update a part; None hides it."""
        existing = self._parts.get(name)
        if mesh is None:
            if existing is not None:
                existing[1].SetVisibility(False)
        elif existing is None:
            actor = self.plotter.add_mesh(
                mesh, color=colour, **style, lighting=False, reset_camera=False, render=False
            )
            self._parts[name] = (mesh, actor)
        else:
            existing[0].ShallowCopy(mesh)
            existing[1].SetVisibility(True)

    def _surface(self, scene: Scene) -> None:
        import pyvista

        mesh = pyvista.PolyData.from_regular_faces(
            scene.vertices_mm * self._stretch, scene.triangles.astype(int)
        )
        mesh.point_data["values"] = scene.values
        mesh.point_data.active_normals = _normals(np.asarray(mesh.points), scene.triangles)
        mesh.set_active_scalars("values")
        made_for = scene.colour_map
        if self._made_for.get("surface") != made_for:
            self._made_for.pop("surface", None)  # retry next time if the following fails
            actor = self.plotter.add_mesh(
                mesh,
                scalars="values",
                name="surface",
                cmap=scene.colour_map,
                clim=scene.limits,  # given, as all values may be unknown
                interpolate_before_map=True,
                ambient=0.35,
                diffuse=0.75,
                reset_camera=False,
                render=False,
                show_scalar_bar=False,
            )
            actor.prop.interpolation = "Phong"
            # Keep lines on the surface visible.
            actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            actor.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(2.0, 2.0)
            self._parts["surface"] = (mesh, actor)
            self._made_for["surface"] = made_for
        drawn, actor = self._parts["surface"]
        if drawn is not mesh:
            drawn.ShallowCopy(mesh)
        actor.mapper.lookup_table.scalar_range = scene.limits
        actor.mapper.scalar_range = scene.limits
        self.overlay.scale = scene.label, scene.limits, actor.mapper.lookup_table
        self._contours(scene, mesh)

    def show_pointed(self, words: str) -> bool:
        """Show the values at the pointer in the lower left corner; returns whether they changed."""
        changed = self.overlay.captions.get("lower left", "") != words
        self.overlay.captions["lower left"] = words
        return changed

    def _contours(self, scene: Scene, mesh: Any) -> None:
        """Draw lines of equal height on the surface."""
        lines, heights = None, scene.vertices_mm[:, 2]
        self._contour_step_mm = 0.0
        if scene.contours and len(heights) and np.ptp(heights) > 0:
            low, high = float(heights.min()), float(heights.max())
            levels, _ = round_ticks(low, high, CONTOURS)
            self._contour_step_mm = round_step(high - low, CONTOURS)
            found = mesh.contour(levels.tolist(), scalars=np.array(heights))
            lines = found if found.n_points else None
        self._put("contours", lines, "#000000", line_width=1, opacity=0.55)

    def _place(self) -> None:
        """Place labels and the Z axis for the present camera."""
        self.overlay.place()
        if "upright" in self._parts:
            line = _polydata(self.overlay.upright_mm * self._stretch, "lines", 2)
            self._parts["upright"][0].ShallowCopy(line)

    def _axes(self, scene: Scene) -> None:
        box, step_mm = _box(scene)
        if self._steady and _holds(self._box, box):
            box, step_mm = self._box, self._step_mm
        self._box, self._step_mm = box, step_mm
        self.overlay.box_mm, self.overlay.stretch = box, self._stretch
        faint = _between(scene.background, scene.foreground, 0.35)
        if self._is_new("grid", (box.tobytes(), scene.exaggeration)):
            self._put("grid", _polydata(_grid(box, step_mm) * self._stretch, "lines", 2), faint)
            upright = _polydata(np.zeros((2, 3)), "lines", 2)
            self._put("upright", upright, scene.foreground, line_width=1)
        self._put("plate", _plate(scene.plate_mm, box, self._stretch), faint, opacity=PLATE_OPACITY)
        top = np.array([[0, 0, box[0, 2]], [0, 0, box[1, 2] + 0.5]]) * self._stretch
        mark = _polydata(top if scene.electrode else EMPTY, "lines", 2)
        self._put("electrode", mark, scene.foreground, line_width=1)
        high, contour = scene.exaggeration, self._contour_step_mm
        captions = [f"heights drawn {high:g} times as high"] * (high != 1)
        captions += ["upright line: the electrode's axis"] * scene.electrode
        captions += [f"contour lines every {contour:g} mm of height"] * (contour > 0)
        places = ("upper left", "lower right", "middle")
        texts = ("\n".join(captions), scene.stamp, scene.notice)
        self.overlay.captions = dict(zip(places, texts, strict=True))


def _box(scene: Scene) -> tuple[FloatArray, float]:
    """Return lowest and highest corner of the axes, shape (2, 3), and the floor's grid step, mm.

    The corners are multiples of the grid step; of 0.1 mm in height.
    """
    points = np.vstack([scene.vertices_mm, scene.within_mm])
    low, high = points.min(axis=0), points.max(axis=0)
    along = round_step(float(np.max((high - low)[:2])), 10)
    step = np.array([along, along, 0.1])
    first, last = np.floor(low / step + 1e-6), np.ceil(high / step - 1e-6)
    last = np.maximum(last, first + 1)
    return np.stack([first, last]) * step, along


def _grid(box: FloatArray, step_mm: float) -> FloatArray:
    """Return the ends of the floor's grid lines, two rows per line, mm."""
    ends = []
    for axis in (0, 1):
        for at in np.arange(box[0, axis], box[1, axis] + step_mm / 2, step_mm):
            line = box * [1, 1, 0] + [0, 0, box[0, 2]]
            line[:, axis] = at
            ends.append(line)
    return np.concatenate(ends)


def _plate(edge_mm: FloatArray, box: FloatArray, stretch: FloatArray) -> Any:
    """Return the work piece's surface from the pool's edge, shape (n, 3), to the box's sides."""
    import pyvista

    if len(edge_mm) < 3:
        return None
    middle = edge_mm[:, :2].mean(axis=0)
    way = edge_mm[:, :2] - middle
    sides = np.where(way >= 0, box[1, :2] - middle, box[0, :2] - middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.nanmin(np.where(way == 0, np.inf, sides / way), axis=1)
    outer = np.column_stack([middle + np.maximum(reach, 1.0)[:, None] * way, np.zeros(len(way))])
    n, k = len(edge_mm), np.arange(len(edge_mm))
    after = (k + 1) % n
    quads = np.column_stack([k, after, after + n, k + n]).astype(int)
    made: Any = pyvista.PolyData.from_regular_faces(np.vstack([edge_mm, outer]) * stretch, quads)
    return made


def _between(one: str, other: str, share: float) -> str:
    import pyvista

    ends = np.array([pyvista.Color(each).float_rgb for each in (one, other)])
    return str(pyvista.Color((1 - share) * ends[0] + share * ends[1]).hex_rgb)


def _holds(box: FloatArray, other: FloatArray) -> bool:
    """Whether another box is within this one and not much smaller."""
    within = (box[0] <= other[0] + 1e-9).all() and (other[1] <= box[1] + 1e-9).all()
    return bool(within and (np.ptp(box, axis=0) <= ROOMY * np.ptp(other, axis=0) + 1e-9).all())


def _polydata(points: FloatArray, kind: str, length: int) -> Any:
    """Return points, or lines of ``length`` points each, for VTK; None without points."""
    import pyvista

    if not len(points):
        return None
    corner = np.arange(len(points)).reshape(-1, length)
    cells = np.column_stack([np.full(len(corner), length), corner]).ravel()
    made: Any = pyvista.PolyData
    return made(np.ascontiguousarray(points, np.float32), **{kind: cells})


def _normals(vertices: FloatArray, triangles: IntArray) -> npt.NDArray[np.float32]:
    """Return unit normals of the surface at its vertices, shape (n, 3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    facet = np.cross(b - a, c - a)
    corners = triangles.ravel()
    summed = np.column_stack(
        [np.bincount(corners, np.repeat(facet[:, k], 3), len(vertices)) for k in range(3)]
    )
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(summed / np.maximum(length, 1e-12), np.float32)


def draw_without_display() -> None:
    """Make VTK draw through EGL if there is no display; to be called before the first drawing."""
    if IS_LINUX and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")


@functools.cache
def can_draw() -> bool:
    """Whether this process can draw in 3-D off-screen; otherwise VTK would end it."""
    try:
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401
        from vtkmodules.vtkRenderingCore import vtkRenderWindow
    except ImportError:
        return False
    draw_without_display()
    # VTK's last resort is OSMesa, whether it is installed or not.
    last_resort = vtkRenderWindow().GetClassName() == "vtkOSOpenGLRenderWindow"
    return not last_resort or ctypes.util.find_library("OSMesa") is not None
