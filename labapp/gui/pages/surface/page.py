"""The surface page: 3-D view, dots, section and figures of the pool; comparison of schemes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PySide6.QtCore import QSignalBlocker, QSize, Qt, QTimer
from PySide6.QtGui import (
    QAction,
    QHideEvent,
    QKeySequence,
    QPalette,
    QPixmap,
    QResizeEvent,
    QShowEvent,
)
from PySide6.QtWidgets import (
    QHBoxLayout,
    QMenu,
    QSizePolicy,
    QSplitter,
    QStackedWidget,
    QStyleOptionToolButton,
    QToolButton,
    QWidget,
)

from labapp.core.surface.reconstruction import Reconstruction
from labapp.errors import InputError
from labapp.export.rendering.drawing import Camera, Direction
from labapp.export.rendering.heights import profile, sigma_at
from labapp.export.rendering.paper import Paper, paper_picture
from labapp.gui.dialogs import ask_save
from labapp.gui.pages.page import Page
from labapp.gui.pages.surface.charts import DotsChart, PlanChart, ProfileChart
from labapp.gui.pages.surface.compare import CompareView
from labapp.gui.pages.surface.panel import SurfacePanel
from labapp.gui.pages.surface.presenter import (
    Options,
    SurfaceState,
    height_limits,
    reflected_dots,
    scene,
    shown,
)
from labapp.gui.tasks import PROBLEM, Control
from labapp.gui.views.picture_files import RASTERS, ask_paper, with_suffix, write_image
from labapp.gui.views.steering import Steering
from labapp.gui.views.view3d import LOOKS, View3d, as_image
from labapp.gui.views.view3d_kinds import make_view3d
from labapp.gui.widgets.buttons import add_action, tool_button
from labapp.gui.widgets.fields import ChoiceField, NumberField
from labapp.gui.widgets.labels import Message, offer
from labapp.gui.widgets.layouts import column_of, fill, hbox
from labapp.gui.widgets.parts import PartsBar
from labapp.gui.workspace import Workspace
from labapp.session.results.measured import scheme_name
from labapp.text import HEIGHT_SIGMA_OF, capitalized

LEAST_PLAN_WIDTH = 100
"""Minimum width at which the section line can be dragged beside the section's fields."""

CHARTS_SOON_MS = 20
"""Delay, ms, of the charts after the 3-D view, so that the window stays responsive."""

CHARTS_REST_MS = 250
"""Shortest interval, ms, between drawing charts, which is slower than the 3-D view."""

COLOURED = [("height", "by height"), ("sigma", "by ±"), ("residual", "by residual")]

FILM_PX = (1280, 720)

SCREEN_DPI = 96.0

NOT_OF_LINES = "Only of patterns of dots: this session is of lines"

GAP_PX, TOOL_GAP_PX = 6, 2
"""Gap between groups of tools, and between their lines; gap between the tools of a group."""

DOTS_TAB = 2
"""Tab of the reflected dots on a narrow canvas."""

NARROW_FIELD = 72
"""Width of a field for two digits, so that the tools fit in one or two lines on a small screen."""

SHOWN_PARTS = {
    "points": ("Reflection &points", "White dots: where the rays meet the surface"),
    "boundary": ("&Boundary", "The line where the pool meets unmelted metal"),
    "contours": ("&Contour lines", "Lines of equal height, at round heights"),
    "work_piece": ("&Work piece", "The work piece's top round the pool"),
    "rays": ("&Rays", "The last 3 mm of the incident rays, the first of the reflected ones"),
    "electrode": ("&Electrode's axis", "The upright line X = Y = 0"),
    "same_colours": ("Same colours in &all frames", "One colour scale for the whole recording"),
}


class SurfacePage(Page):
    """Measurement of the frames, and display of the surface."""

    key = "surface"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.options = Options()
        self.surface_state = SurfaceState(None, "unmeasured", "")
        self.view = make_view3d("The pool in 3-D")
        self.dots, self.plan, self.profile = DotsChart(), PlanChart(), ProfileChart()
        self.plan.setMinimumWidth(LEAST_PLAN_WIDTH)
        self.plan.dragged.connect(self._set_section)
        self.compare = CompareView(workspace)
        self.side = SurfacePanel(workspace, self.panel_layout, self.answer)
        self.lock_with_session(self.side.scheme, self.side.correspondence)
        self._exaggerated = self.options.exaggeration
        self._charts_due: Callable[[], None] | None = None
        self._rest = QTimer(self, singleShot=True)
        self._rest.timeout.connect(self._show_charts)
        self.stack = QStackedWidget()
        self.stack.addWidget(self._single())
        self.stack.addWidget(self.compare)
        self.steering = Steering(
            self._steered, lambda text: workspace.notified.emit(text, False), self
        )
        fill(self.canvas_layout, self._tools(), (self.stack, 1))

    # --- what is where -----------------------------------------------------------------------

    def _single(self) -> QWidget:
        left, right = QSplitter(Qt.Orientation.Vertical), QSplitter(Qt.Orientation.Vertical)
        whole = QSplitter(Qt.Orientation.Horizontal)
        below = column_of(self._section_fields(), (self.profile, 1))
        for splitter, widgets, sizes in (
            (left, (self.view, below), (5, 3)),
            (right, (self.dots, self.plan), (1, 1)),
            (whole, (left, right), (5, 3)),
        ):
            for k, (widget, size) in enumerate(zip(widgets, sizes, strict=True)):
                splitter.addWidget(widget)
                splitter.setStretchFactor(k, size)
            splitter.setSizes([100 * size for size in sizes])
            splitter.setChildrenCollapsible(False)
        self.canvas_parts = PartsBar(
            "What is seen of the surface",
            {
                "3-D": (left, self.view),
                "Section": (left, below, right, self.plan),
                "Dots": (right, self.dots),
            },
        )
        return column_of(self.canvas_parts, (whole, 1))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Show parts of a narrow canvas one at a time."""
        super().resizeEvent(event)
        self.canvas_parts.fit(self)

    def _section_fields(self) -> QWidget:
        tip = "Direction of the section line: 0 along X, 90 along Y"
        self.angle = NumberField(
            "Section at", "°", lowest=-180, highest=180, step=5, decimals=1, tooltip=tip
        )
        tip = "How far to the left of the electrode the line passes"
        self.offset = NumberField(
            "offset", "mm", lowest=-50, highest=50, step=0.1, decimals=2, tooltip=tip
        )
        for field in (self.angle, self.offset):
            field.label.setWordWrap(False)
            field.edited.connect(self._enter_section)
        direction = hbox(self.angle.label, (self.angle, 1))
        place = hbox(self.offset.label, (self.offset, 1))
        along = hbox()
        for words, angle in (("Along X", 0.0), ("Along Y", 90.0)):
            cut = partial(self._set_section, angle, 0.0)
            what = f"Cut {words.lower()}, through the electrode's axis"
            along.addWidget(tool_button(words, what, cut))
        return _Tools(direction, along, place)

    def _tools(self) -> QWidget:
        self.colour = ChoiceField(
            "Colour",
            COLOURED,
            tooltip="What the surface is coloured by; ± is one standard uncertainty, "
            f"{HEIGHT_SIGMA_OF}; residuals are interpolated between the points",
        )
        self.colour.edited.connect(lambda key: self._set(colour=key))
        tip = "How many times as high heights are drawn; the axis shows true heights"
        self.high = NumberField(
            "Heights ×", "", lowest=1, highest=20, step=1, decimals=1, tooltip=tip
        )
        self.high.edited.connect(lambda value: self._set(exaggeration=value))
        self.high.editor.setMinimumWidth(NARROW_FIELD)  # a wider one would be cut off
        self.high.setMaximumWidth(NARROW_FIELD)
        self.colour.setMaximumWidth(2 * NARROW_FIELD)
        for field in (self.colour, self.high):
            field.label.setWordWrap(False)
        looks = [
            tool_button(words, what, partial(self._look, direction))
            for direction, (words, what) in LOOKS.items()
        ]
        what = "Draw heights as they are, or as many times as high as before (E)"
        self.true_scale = tool_button("1:1", what, self.toggle_scale, _Toggle())
        self.true_scale.setCheckable(True)
        self.true_scale.setAccessibleName("True scale")
        self.save = tool_button(
            "Save…",
            "Save the 3-D picture at its size on paper: PNG, TIFF or JPEG (Ctrl+Shift+P)",
            self.save_picture,
        )
        self.save.setShortcut(QKeySequence("Ctrl+Shift+P"))
        tip = "Write a film (MP4) of all frames, seen as the 3-D view is now"
        self.film = tool_button("Film…", tip, self.save_film)
        tip = "Put two schemes side by side, or show one again"
        self.comparing = tool_button("Compare", tip, self._toggle_compare, _Toggle())
        self.comparing.setCheckable(True)
        self.saved = Message(1)
        # It has what the buttons leave; where that is nothing, the last line has its text, too.
        self.saved.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._view_actions()
        coloured = self.colour.label, self.colour
        return _Tools(
            hbox(*coloured, 1),
            hbox(self.high.label, self.high, self.true_scale, self._parts_button(), 1),
            hbox(*looks, 1),
            hbox((self.saved, 1), self.save, self.film, self.comparing),
        )

    def _view_actions(self) -> None:
        """Add the page's actions to the menu of the 3-D view."""
        for words, key, work in (
            ("Save picture…", "", self.save_picture),
            ("Film of the recording…", "", self.save_film),
            ("True scale, or exaggerated", "E", self.toggle_scale),
            ("Contour lines", "C", lambda: self._set(contours=not self.options.contours)),
        ):
            add_action(self.view, words, work, key)

    def _parts_button(self) -> QToolButton:
        menu = QMenu(self)
        menu.setToolTipsVisible(True)
        self.drawn_items: dict[str, QAction] = {}
        for name, (words, what) in SHOWN_PARTS.items():
            action = menu.addAction(words)
            action.setCheckable(True)
            action.setToolTip(what)
            action.toggled.connect(lambda ticked, name=name: self._set(**{name: ticked}))
            self.drawn_items[name] = action
        button = tool_button("Show", "Choose what the 3-D view shows", lambda: None)
        button.setMenu(menu)
        button.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        return button

    # --- what is shown -----------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the frame in view, measured by the scheme of the settings."""
        try:
            self.surface_state = shown(self.session, self.workspace.frame)
        except InputError as error:
            words = f"{capitalized(error.field)}: {error.value}. Measure the frame again."
            self.surface_state = SurfaceState(None, "failed", words)
        self.side.show(self.surface_state)
        self._show_options()
        lines = self.session.has_lines
        for each in (self.comparing, self.film):
            offer(each, NOT_OF_LINES if lines else "")
        if lines and self.comparing.isChecked():
            self.comparing.setChecked(False)
            self._show_compare()
        if self.stack.currentWidget() is self.compare:
            self.compare.refresh(self.options)
        else:
            self._show_surface()

    def leave(self) -> None:
        """Stop comparing, drawing and steering; the measurement continues."""
        self._rest.stop()
        self.steering.stop()
        self.compare.leave()

    def picture(self) -> QPixmap:
        """The 3-D picture, or the whole comparison."""
        image = None if self.stack.currentWidget() is self.compare else self.view.image()
        return self.grab() if image is None else QPixmap.fromImage(image)

    def save_picture(self) -> None:
        """Ask for a file and write the picture to it."""
        proposed = self.workspace.folder / f"surface_{self.workspace.frame:06d}.png"
        if asked := ask_paper(self, proposed, RASTERS):
            self.write_picture(*asked)

    def write_picture(self, path: Path, paper: Paper | None = None) -> None:
        """Write the picture at its size on paper, or a comparison as displayed; report a failure.

        Without ``paper`` it is one column wide.
        """
        path, paper = with_suffix(path), paper or Paper()
        view = self.view
        if self.stack.currentWidget() is self.compare or view.camera is None or view.scene is None:
            written = write_image(path, self.picture().toImage(), SCREEN_DPI)
        else:
            shape = view.height() / max(view.width(), 1)
            drawn = paper_picture(view.scene, view.camera, paper, shape)
            written = write_image(path, as_image(drawn[..., ::-1]), paper.dpi)
        if written:
            self.confirm(f"Saved in {path}", self.saved)
        else:
            self.workspace.notified.emit(f"{path} cannot be written", True)
            self.saved.setText(f"{PROBLEM} {path} cannot be written")

    def save_film(self) -> None:
        """Ask for a file and write a film of all frames to it, with the current camera."""
        proposed = self.workspace.folder / f"{self.session.path.stem}.mp4"
        if path := ask_save(self, "Save film", proposed, "Film (*.mp4)"):
            self.write_film(path)

    def write_film(self, path: Path) -> None:
        """Write a film in the background."""
        session = self.session
        camera: Direction | Camera = self.view.camera or "free"
        path = path if path.suffix.lower() == ".mp4" else path.with_name(path.name + ".mp4")

        def work(control: Control) -> None:
            from labapp.session.outgoing import write_view_film

            write_view_film(session, path, camera, FILM_PX, control.progress)

        def done(_: object) -> None:
            self.confirm(f"Saved in {path}", self.saved)

        title = f"Writing {path.name}"
        self.start_task(title, work, done, kind="Film", answer=self.saved, once=True)

    def toggle_scale(self) -> None:
        """Switch between true heights and the previous exaggeration."""
        now = self.options.exaggeration
        self._set(exaggeration=1.0 if now != 1.0 else self._exaggerated)

    def _show_surface(self) -> None:
        result, seen = self.surface_state.result, self.workspace.overview()
        reconstruction = self.surface_state.reconstruction
        drawn, cut, dots = None, None, None
        if reconstruction is not None and self.options.section is not None:
            cut = profile(reconstruction, *self.options.section)
        if result is not None and seen is not None:
            rig, stale = result.parsed_setup.rig, bool(result.stale)
            limits = height_limits(seen) if self.options.same_colours else None
            drawn = scene(result.measurement, rig, self.options, limits, cut, stale)
            dots = reflected_dots(result.measurement)
        self.view.set_words(self.surface_state.words)
        self.view.sigma_at = None if reconstruction is None else partial(_sigma, reconstruction)
        self.view.show_scene(drawn)
        boundary = None if reconstruction is None else reconstruction.boundary
        lines = result is not None and result.measurement.lines is not None
        edge = "edge of what the lines show" if lines else "boundary"
        without = "Reflected lines are in step Pattern" if lines else "No reflected dots to compare"
        self.canvas_parts.setTabVisible(DOTS_TAB, not self.session.has_lines)

        def show_charts() -> None:
            self.dots.show_dots(dots, without)
            self.plan.show_pool(boundary, self.options.section)
            self.profile.show_profile(cut, edge)

        self._charts_due = show_charts
        if not self._rest.isActive():
            self._rest.start(CHARTS_SOON_MS)

    def _show_charts(self) -> None:
        """Update the charts; while frames change quickly, only at intervals and at the end."""
        if self._charts_due is not None:
            self._charts_due()
            self._charts_due = None
            self._rest.start(CHARTS_REST_MS)

    def _show_options(self) -> None:
        self.colour.set_value(self.options.colour)
        high = self.options.exaggeration
        self._exaggerated = high if high != 1.0 else self._exaggerated
        self.high.set_value(high)
        self.true_scale.setChecked(high == 1.0)
        for name, action in self.drawn_items.items():
            with QSignalBlocker(action):
                action.setChecked(getattr(self.options, name))
        if self.options.section is not None:
            self.angle.set_value(self.options.section[0])
            self.offset.set_value(self.options.section[1])

    # --- what is done ------------------------------------------------------------------------

    def _set(self, **changed: object) -> None:
        self.options = replace(self.options, **changed)  # type: ignore[arg-type]
        self._show_options()
        if self.stack.currentWidget() is self.compare:
            self.compare.refresh(self.options)
        else:
            self._show_surface()
            self._show_charts()  # a drag is shown immediately

    def _enter_section(self, _: object) -> None:
        self._set_section(float(self.angle.value() or 0.0), float(self.offset.value() or 0.0))

    def _set_section(self, angle_deg: float, offset_mm: float) -> None:
        self._set(section=(round(angle_deg, 1), round(offset_mm, 2)))

    def _look(self, direction: Direction) -> None:
        self._steered().look(direction)

    def _steered(self) -> View3d:
        """The steered view; the others of a comparison follow it."""
        comparing = self.stack.currentWidget() is self.compare
        return self.compare.first.view if comparing else self.view

    def showEvent(self, event: QShowEvent) -> None:
        """Start steering by a 3-D controller."""
        super().showEvent(event)
        self.steering.start()

    def hideEvent(self, event: QHideEvent) -> None:
        """Release the 3-D controller to other programs."""
        super().hideEvent(event)
        self.steering.stop()

    def _toggle_compare(self) -> None:
        self._show_compare()
        self.refresh()

    def _show_compare(self) -> None:
        wanted = self.comparing.isChecked()
        if wanted:
            self.compare.begin(scheme_name(self.session.settings))
        else:
            self.compare.leave()
        self.stack.setCurrentIndex(int(wanted))


class _Tools(QWidget):
    """Groups of tools, wrapped to the available width."""

    def __init__(self, *groups: QHBoxLayout) -> None:
        super().__init__()
        self._groups = [QWidget(self) for _ in groups]
        for widget, group in zip(self._groups, groups, strict=True):
            widget.setLayout(group)
            group.setSpacing(TOOL_GAP_PX)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        rows: list[list[QWidget]] = []
        left = 0
        for group in self._groups:
            wanted = group.sizeHint().width() + GAP_PX
            if not rows or wanted > left:
                rows.append([])
                left = self.width() + GAP_PX
            rows[-1].append(group)
            left -= wanted
        height = max(group.sizeHint().height() for group in self._groups)
        for k, row in enumerate(rows):
            x = 0
            for group in row:
                wanted = group.sizeHint().width()
                width = self.width() - x if group is row[-1] else wanted
                group.setGeometry(x, k * (height + GAP_PX), width, height)
                x += wanted + GAP_PX
        self.setFixedHeight(len(rows) * (height + GAP_PX) - GAP_PX)

    def minimumSizeHint(self) -> QSize:
        widest = max(group.minimumSizeHint().width() for group in self._groups)
        return QSize(widest, self.height())


class _Toggle(QToolButton):
    """A button with a clear pressed state, which Fusion hardly shows."""

    def initStyleOption(self, option: QStyleOptionToolButton) -> None:
        super().initStyleOption(option)
        if self.isChecked():
            colours = option.palette
            colours.setColor(QPalette.ColorRole.Button, colours.color(QPalette.ColorRole.Highlight))
            text = colours.color(QPalette.ColorRole.HighlightedText)
            colours.setColor(QPalette.ColorRole.ButtonText, text)
            option.palette = colours


def _sigma(reconstruction: Reconstruction, x_mm: float, y_mm: float) -> float:
    """Standard uncertainty of the height at a position, mm; NaN if the scheme gives none."""
    return float(sigma_at(reconstruction, np.array([x_mm]), np.array([y_mm]))[0])
