"""Panel of the surface page: scheme and correspondence, measuring, and results."""

from __future__ import annotations

from dataclasses import replace

from PySide6.QtWidgets import QGridLayout, QProgressBar, QVBoxLayout

from labapp.gui.pages.surface.presenter import (
    CORRESPONDENCES,
    SCHEME_CHOICES,
    SCHEMES,
    SurfaceState,
    with_scheme,
)
from labapp.gui.shell.steps import why_not_measurable
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField
from labapp.gui.widgets.labels import (
    Message,
    heading,
    keep_room,
    offer,
    show_words,
    wrapping_label,
)
from labapp.gui.widgets.layouts import fill, vbox
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.workspace import Workspace
from labapp.session.results.measured import scheme_name
from labapp.text import SETUP_MARKS

LABEL_GAP_PX = 3
"""Gap between a label and the field below it."""

SIGNS = {"measured": "✓", "stale": "⟳", "failed": "✗", "unmeasured": "○"}
"""Signs for the state of a frame."""


class SurfacePanel:
    """Contents of the page's panel."""

    def __init__(self, workspace: Workspace, layout: QVBoxLayout, answer: Message) -> None:
        self.workspace, self._answer = workspace, answer
        self.scheme = ChoiceField(
            "Scheme", SCHEME_CHOICES, tooltip="How the surface is found from the dots"
        )
        self.correspondence = ChoiceField(
            "Correspondence",
            list(CORRESPONDENCES.items()),
            tooltip="Order of the dots' columns and rows: found by trial, or fixed",
        )
        self.scheme.edited.connect(self._choose_scheme)
        self.correspondence.edited.connect(self._choose_correspondence)
        fields = (self.scheme, self.correspondence)
        # Labels above: beside them, a small window would cut the texts of the choices off.
        form = vbox(*(part for field in fields for part in (field.label, field)))
        form.setSpacing(LABEL_GAP_PX)
        self.status, self.setup_words = wrapping_label(), wrapping_label()
        self.provenance, self.verdict = wrapping_label(), wrapping_label()
        self._stale = False
        self.status.setAccessibleName("How this frame stands")
        self.again = button(
            "&Again", "Measure this frame again: its figures are out of date", self.this_one
        )
        self.sizes = ResultTable("Size of the pool")
        self.errors = ResultTable("Reflection errors")
        self.trials = ResultTable("Errors of the correspondences tried")
        grid = self._measuring()
        measuring = (self.one, self.missing, self.all, self.again)
        self._tips = {each: each.toolTip() for each in measuring}
        keep_room(self.progress, self.cancel, self.again, answer)
        fill(
            layout,
            *(form, grid, self.status, self.sizes, self.setup_words),
            *(self.errors, self.provenance, self.verdict, self.trials, 1),
        )
        workspace.tasks.changed.connect(self._show_progress)
        workspace.tasks.progressed.connect(self._show_progress)

    def _measuring(self) -> QGridLayout:
        self.one = button("&This frame", "Measure the frame in view (Shift+F5)", self.this_one)
        tip = "Measure every frame that is not measured or is out of date (F5)"
        self.missing = button("&Not measured", tip, self.not_measured)
        self.all = button("A&ll frames", "Measure every frame again", self.all_frames)
        self.progress = QProgressBar()
        self.progress.setAccessibleName("How far the measurement is")
        self.progress.setToolTip("How far the measurement is")
        self.cancel = button("&Cancel", "Stop measuring; what is done stays (Ctrl+.)", self.stop)
        grid = QGridLayout()
        grid.addWidget(heading("Measure"), 0, 0)
        for column, each in enumerate((self.one, self.missing, self.all)):
            grid.addWidget(each, 1, column)
        # In the same places, so that the sizes are in view on a small screen: the answer comes when
        # there is no progress any more, and nothing is out of date while frames are measured.
        grid.addWidget(self._answer, 2, 0, 1, 2)
        grid.addWidget(self.progress, 2, 0, 1, 2)
        grid.addWidget(self.again, 2, 2)
        grid.addWidget(self.cancel, 2, 2)
        return grid

    # --- what is shown -----------------------------------------------------------------------

    def show(self, surface_state: SurfaceState) -> None:
        """Show the state of the frame in view and the session's settings."""
        session = self.workspace.session
        if session is None:
            return
        settings = session.settings
        self.scheme.set_value(scheme_name(settings))
        self.correspondence.set_value(settings.correspondence)
        for field in (self.scheme, self.correspondence):  # lines have neither
            for widget in (field, field.label):
                widget.setVisible(not session.has_lines)
        failed = surface_state.state == "failed" and surface_state.result is not None
        dots = failed and not session.has_lines
        remedy = " Its dots can be corrected in step Dots." if dots else ""
        status = f"{SIGNS[surface_state.state]} {surface_state.words}{remedy}"
        about_setup = surface_state.setup_words
        if about_setup.startswith(SETUP_MARKS["doubtful"]):  # a doubt must not need scrolling
            status, about_setup = f"{status}\n{about_setup}", ""
        self.status.setText(status)
        self._stale = surface_state.state == "stale"
        show_words(self.setup_words, about_setup)
        show_words(self.provenance, surface_state.provenance)
        show_words(self.verdict, surface_state.verdict)
        for table, rows in (
            (self.sizes, surface_state.sizes),
            (self.errors, surface_state.errors),
            (self.trials, surface_state.trials),
        ):
            table.set_rows(rows)
            table.setVisible(bool(rows))
        self._show_progress()

    def _show_progress(self) -> None:
        session, task = self.workspace.session, self.workspace.measuring
        if task is not None:
            why = "Measuring is under way"
        else:
            why = "No session is open" if session is None else why_not_measurable(session)
        for each, tip in self._tips.items():
            offer(each, f"{tip}. {why}" if why else "")
        self.progress.setVisible(task is not None)
        self.cancel.setVisible(task is not None)
        self._answer.setVisible(task is None)
        self.again.setVisible(self._stale and task is None)
        if task is not None:
            self.progress.setRange(0, task.total)
            self.progress.setValue(task.done)
            self.progress.setFormat(f"{task.done} of {task.total} frames")

    # --- what is done ------------------------------------------------------------------------

    def this_one(self) -> None:
        """Measure the frame in view."""
        self._measure([self.workspace.frame])

    def not_measured(self) -> None:
        """Measure the frames that are unmeasured or stale."""
        self._measure(None)

    def all_frames(self) -> None:
        """Measure every frame again."""
        if self.workspace.session is not None:
            self._measure(self.workspace.session.frames.tolist())

    def _measure(self, frames: list[int] | None) -> None:
        self.workspace.measure(frames, show_answer=self._answer.setText)

    def stop(self) -> None:
        """Stop measuring."""
        if self.workspace.measuring is not None:
            self.workspace.measuring.stop()

    def _choose_scheme(self, name: str) -> None:
        self.workspace.attempt(
            lambda session: session.set_settings(
                with_scheme(session.settings, name), f"scheme {SCHEMES[name].title}"
            ),
            show_answer=self._answer.setText,
        )

    def _choose_correspondence(self, choice: str) -> None:
        self.workspace.attempt(
            lambda session: session.set_settings(
                replace(session.settings, correspondence=choice),  # type: ignore[arg-type]
                f"correspondence {choice}",
            ),
            show_answer=self._answer.setText,
        )
