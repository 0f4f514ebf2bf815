"""The export page: items, frames and folder; planned and written files."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from PySide6.QtCore import QSignalBlocker, QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QCheckBox, QGridLayout, QWidget

from labapp.export.meshes import SMALLEST_SPACING_MM
from labapp.gui.dialogs import ask_folder
from labapp.gui.drafts import folder_of
from labapp.gui.pages.export.presenter import (
    FORMATS,
    SIZES,
    USUAL,
    VIEWS,
    ExportPlan,
    ExportRequest,
    Written,
    folder_within,
    groups,
    plan,
    proposed_folder,
    schemes,
    write,
)
from labapp.gui.pages.export.sizes import estimated_bytes
from labapp.gui.pages.page import Page
from labapp.gui.shell.steps import why_not_measurable
from labapp.gui.tasks import DONE, PROBLEM, Control, Task
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, Field, FieldForm, NumberField, whole
from labapp.gui.widgets.labels import Message, heading, keep_room, offer, wrapping_label
from labapp.gui.widgets.layouts import fill, hbox, scrolled, vbox
from labapp.gui.widgets.path_field import PathField
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from labapp.text import format_bytes, pluralize

CHANGED = "The scheme has just changed: see what will be written now, and press Export again"

WHICH = (
    ("all", "all that are measured"),
    ("view", "the frame in view"),
    ("part", "a part"),
)


class ExportPage(Page):
    """Choice and export of results."""

    key = "export"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.request = ExportRequest()
        self.plan: ExportPlan | None = None
        self.written: Written | None = None
        self._writing: Task | None = None
        self.answer = Message(5)
        self._said = ""
        self._in_view: int | None = None
        self._boxes: dict[str, QCheckBox] = {}
        self._make_canvas()
        self._make_panel()
        workspace.opened.connect(self._session_opened)
        workspace.tasks.changed.connect(self._show_state)

    # --- what it shows ------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show what would be written from the current session."""
        session, frame = self.session, self.workspace.frame
        moved = self._in_view not in (None, frame)
        self._in_view = frame
        if moved:  # only the frame in view changed
            if self.request.which == "view":
                self._show_plan(session)
            return
        self._propose_folder()
        self.scheme.set_choices(schemes(session))
        self.request = replace(self.request, scheme=self.scheme.value())
        if len(session.frames) and not self.request.last:
            first, last = int(session.frames[0]), int(session.frames[-1])
            self.request = replace(self.request, first=first, last=last)
            self.first.set_value(first)
            self.last.set_value(last)
        self._show_plan(session)

    def leave(self) -> None:
        """Refresh everything when the page comes back into view."""
        self._in_view = None

    def _show_plan(self, session: Session) -> None:
        self.plan = made = plan(session, self.request, self.workspace.frame)
        self.files.setText("\n".join(made.files) or "Nothing.")
        self.notes.setText("\n".join(made.notes))
        self._lock_choices(made.locked)
        part, drawn = self.request.which == "part", self.request.has_view
        pictures = self.request.some("pictures")
        # Disabled, not hidden, so that nothing below moves.
        for fields, used in (
            ((self.first, self.last, self.every), part),
            ((self.scheme, self.spacing), not made.locked),
            ((self.view, self.picture_size), drawn and not made.locked),
            ((self.rate,), "film" in pictures and not made.locked),
            ((self.picture_format,), "frames" in pictures and not made.locked),
        ):
            for one in fields:
                one.setEnabled(used)
                one.label.setEnabled(used)
        self._show_state()

    def _lock_choices(self, why: str) -> None:
        """Disable and untick all boxes, with the reason; empty: show the ticks of the request."""
        for key, box in self._boxes.items():
            with QSignalBlocker(box):
                box.setChecked(key in self.request.ticked and not why)
            offer(box, why)
            box.setEnabled(not why and (key != "solid" or self.request.has_mesh))
        for each in self._tick_buttons:
            each.setEnabled(not why)

    def _show_state(self) -> None:
        made = self.plan
        if made is None or self.workspace.session is None:
            return
        active = self.workspace.tasks.active
        writing = self._writing in active
        measuring = self.workspace.measuring is not None
        why_not = "Writing…" if writing else made.why_not
        offer(self.export_button, why_not)
        recording = self.workspace.session.recording
        size = estimated_bytes(
            self.request,
            len(made.frames),
            made.surfaces,
            made.area_mm2,
            0 if recording is None else recording.rows * recording.columns,
        )
        about = format_bytes(float(f"{size:.2g}")).replace(".0 ", " ")
        ready = f"{pluralize(len(made.frames), 'frame')} will be written"
        ready += "." if made.locked else f", about {about}."
        wrong = f"{PROBLEM} {why_not}" if why_not and not writing else why_not or self._said
        self.answer.setText(wrong or ready)
        again = len(made.again) > 0 and not self.workspace.session.read_only
        self.again_button.setVisible(again)
        offer(
            self.again_button,
            "Measuring…" if measuring else why_not_measurable(self.workspace.session),
        )
        self.again_button.setText("Measuring…" if measuring else f"Measure {len(made.again)} now")
        unwritten = "" if self.written is not None else "Nothing has been exported yet"
        offer(self.open_button, unwritten)

    def _session_opened(self) -> None:
        self.written = self.plan = self._in_view = None
        self._said = ""
        self.folder.set_value("")
        self.request = replace(self.request, scheme="", first=0, last=0)

    # --- what the operator does ---------------------------------------------------------------

    def _change_request(self, **values: object) -> None:
        self.request = replace(self.request, **values)  # type: ignore[arg-type]
        self._said = ""
        if self.workspace.session is not None:
            self._show_plan(self.workspace.session)

    def _enter(self, name: str, value: Any) -> None:
        """Take the value of a field into the request, by its name there."""
        if name == "size_px":
            value = tuple(int(side) for side in value.split("x"))
        self._change_request(**{name: value})

    def _ticked(self) -> None:
        self._change_request(
            ticked=frozenset(key for key, box in self._boxes.items() if box.isChecked())
        )

    def _tick(self, on: bool) -> None:
        for box in self._boxes.values():
            with QSignalBlocker(box):
                box.setChecked(on)
        self._ticked()

    def _propose_folder(self) -> None:
        """Show the default folder if none is entered."""
        if not self.folder.value().strip():
            self.folder.set_value(str(proposed_folder(self.session)))

    def choose_folder(self) -> None:
        """Ask for a folder; use a new subfolder if it contains something else."""
        here = Path(self.folder.value().strip() or proposed_folder(self.session))
        if folder := ask_folder(self, "Export folder", here.parent):
            self.folder.set_value(str(folder_within(folder, self.session)))

    def measure_again(self) -> None:
        """Measure the chosen frames that are unmeasured or stale."""
        if self.plan is not None:
            self.workspace.measure(self.plan.again.tolist(), show_answer=self._say)

    def export(self) -> None:
        """Export the ticked items in the background."""
        session, shown = self.session, self.plan
        self._show_plan(session)  # the window may show a change with a delay
        made, request = self.plan, self.request
        if made is None or made.why_not:
            return
        if shown is None or made.scheme != shown.scheme:
            self._say(f"{PROBLEM} {CHANGED}")
            return
        name = self.folder.value().strip() or proposed_folder(session)
        folder = Path(os.path.expanduser(name))  # `Path.expanduser` raises for an unknown user
        if not folder.is_absolute():
            folder = folder_of(session) / folder
        frames = made.frames.tolist()

        def work(control: Control) -> Written:
            return write(session, request, frames, folder, control.progress)

        def done(written: Written) -> None:
            self.written = written
            self.workspace.notified.emit(written.words, bool(written.problems))
            self._say(f"{PROBLEM if written.problems else DONE} {written.words}")

        self.written = None
        self._writing = self.workspace.tasks.start(
            f"Exporting to {folder.name}", work, done, show_answer=self._say, kind="Exporting"
        )
        self._show_state()

    def _say(self, words: str) -> None:
        """Show the outcome at the buttons until the request changes."""
        self._said = words
        self._show_state()

    def open_folder(self) -> None:
        """Show the folder in the desktop's file manager."""
        if self.written is not None:
            folder = self.written.folder
            if not QDesktopServices.openUrl(QUrl.fromLocalFile(str(folder))):
                self.workspace.notified.emit(f"The files are in {folder}", False)

    # --- the widgets --------------------------------------------------------------------------

    def _make_canvas(self) -> None:
        inner = QWidget()
        grid = QGridLayout(inner)
        grid.setContentsMargins(16, 12, 16, 12)
        grid.setHorizontalSpacing(32)
        grid.setVerticalSpacing(18)
        for number, (title, items) in enumerate(groups()):
            boxes = {item.key: QCheckBox(item.name) for item in items}
            for item in items:
                box = boxes[item.key]
                box.setToolTip(item.tip)
                box.setChecked(item.key in USUAL)
                box.toggled.connect(lambda _: self._ticked())
            self._boxes |= boxes
            grid.addLayout(vbox(heading(title), *boxes.values(), 1), number // 2, number % 2)
        self.files = wrapping_label()
        will = vbox(heading("The folder will contain"), self.files)
        self._tick_buttons = (
            button("Select all", "Tick all that can be written", lambda: self._tick(True)),
            button("Select none", "Tick nothing", lambda: self._tick(False)),
        )
        choose = hbox(*self._tick_buttons, 1)
        choose.setSpacing(6)
        grid.addLayout(choose, 2, 0, 1, 2)
        grid.addLayout(will, 3, 0, 1, 2)
        grid.setRowStretch(4, 1)
        grid.setColumnStretch(0, 1)
        grid.setColumnStretch(1, 1)
        self.canvas_layout.addWidget(scrolled(inner, "What is exported"))

    def _make_panel(self) -> None:
        self.which = ChoiceField("Frames", WHICH, tooltip="Which frames to write")
        self.first = whole("From frame", 0, "The first frame to write")
        self.last = whole("To frame", 0, "The last frame to write")
        self.every = whole("Every n-th", 1, "1: every frame; 2: every second")
        self.every.set_value(1)
        self.scheme = ChoiceField(
            "Results of", tooltip="The scheme whose results are written; others must be measured"
        )
        tip = "Distance of the surfaces' points: finer makes larger files"
        self.spacing = NumberField(
            "Grid of surfaces", "mm", lowest=SMALLEST_SPACING_MM, highest=1, step=0.01, tooltip=tip
        )
        self.spacing.set_value(self.request.spacing_mm)
        self._make_view_fields()
        fields: dict[str, Field] = {
            "which": self.which,
            "first": self.first,
            "last": self.last,
            "every": self.every,
            "scheme": self.scheme,
            "spacing_mm": self.spacing,
            "view": self.view,
            "size_px": self.picture_size,
            "picture_format": self.picture_format,
            "film_rate_hz": self.rate,
        }
        for name, field in fields.items():
            field.edited.connect(partial(self._enter, name))
        form = FieldForm(*fields.values())
        self.folder = PathField(
            "Folder",
            tooltip="A new or empty folder, or an earlier export, which is replaced",
        )
        self.folder.edited.connect(lambda _: self._propose_folder())
        choose = button("Choose folder…", "Choose where to write", self.choose_folder)
        self.notes = wrapping_label()
        tip = "Measure the selected frames that are not measured or are out of date"
        self.again_button = button("Measure now", tip, self.measure_again)
        keep_room(self.again_button)
        tip = "Write all that is ticked; a cancelled export leaves nothing behind"
        self.export_button = button("Export", tip, self.export)
        tip = "Show what was exported in the file manager"
        self.open_button = button("Open the folder", tip, self.open_folder)
        # The buttons are above the text, whose height varies.
        fill(
            self.panel_layout,
            *(form, self.folder.label, self.folder, choose),
            *(hbox((self.export_button, 1), self.open_button), self.again_button),
            *(self.answer, self.notes, 1),
        )

    def _make_view_fields(self) -> None:
        self.view = ChoiceField(
            "3-D view", VIEWS, tooltip="Direction of view of pictures of surfaces and of the film"
        )
        sizes = [(f"{width}x{height}", f"{width} × {height} px") for width, height in SIZES]
        self.picture_size = ChoiceField(
            "Picture size", sizes, tooltip="Of pictures of surfaces and of the film"
        )
        self.picture_format = ChoiceField(
            "Frames as", FORMATS, tooltip="Format of the pictures of frames"
        )
        tip = "How fast the film runs; empty: as fast as the frames were recorded"
        self.rate = NumberField(
            "Film", "frames/s", lowest=0.1, highest=1000, decimals=1, tooltip=tip, optional=True
        )
