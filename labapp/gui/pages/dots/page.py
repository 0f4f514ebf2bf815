"""The dots page: the frame, its dots and rows, and keys and buttons for their correction.

For a line pattern it shows lines instead (`line_tool`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtGui import QAction, QKeyEvent, QKeySequence, QPixmap

from labapp.config.settings import with_methods
from labapp.core.pipeline import Settings
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Site
from labapp.gui.pages.dots import presenter
from labapp.gui.pages.dots.editing import Editor
from labapp.gui.pages.dots.fitting import Refit
from labapp.gui.pages.dots.frame_reader import FrameReader, carry_on
from labapp.gui.pages.dots.line_overlay import LinesOverlay
from labapp.gui.pages.dots.line_presenter import show_lines
from labapp.gui.pages.dots.line_tool import LineTool
from labapp.gui.pages.dots.overlay import DotsOverlay
from labapp.gui.pages.dots.panel import DotsPanel, MeasureLead
from labapp.gui.pages.dots.presenter import DetectorNumber, DotsState, Figures, Need
from labapp.gui.pages.page import Page
from labapp.gui.shell.steps import recording_gone
from labapp.gui.views.drag_point import SHIFT, arrow_step
from labapp.gui.views.picture import PictureView, Tool
from labapp.gui.widgets.layouts import fill, reveal
from labapp.gui.workspace import EDITING, Workspace

NO_REFERENCE = "If you know the reference from other frames, press Reference"

NOT_YET = "The frame is being measured as it was found: edit it when its rows are there"

BY_KEY = Qt.FocusReason.ShortcutFocusReason

REACH = 9.0
"""Largest distance of the pointer from a dot to select it, points of the screen."""


class Command(NamedTuple):
    """Command of a key or button: text, key, tip, function and need.

    If the need is not met, the button is disabled and the key reports what is missing.
    """

    text: str
    key: str
    tip: str
    do: Callable[[], object]
    needs: Need = ""


class DotsPage(Page):
    """Display of the detected dots, and correction by hand."""

    key = "dots"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.editor = Editor(self._commit)
        self.view = PictureView("Frame with its dots")
        self.overlay = DotsOverlay(self.view)
        self.lines = LinesOverlay(self.view)
        self.view.tool = self.dot_tool = DotTool(self)
        self.reader = FrameReader(workspace)
        self.refit = Refit(workspace)
        self.seen: DotsState | None = None
        self._before: tuple[int, Figures | None] | None = None
        self.pointer: tuple[float, float] | None = None
        """Position of the pointer in the frame, (u, v), px."""
        self._lines_frame = -1
        self._in_view = False
        self._unmet: dict[str, str] = {}
        needing = (*self._edits(), *self._frame_commands(), *(c for c in self._keys() if c.needs))
        self._needs = {command.text: command.needs for command in needing}
        edits, frames, keys = (
            [self.action(c.text, c.key, c.tip, partial(self._run, c)) for c in commands]
            for commands in (self._edits(), self._frame_commands(), self._keys())
        )
        self._dot_actions = [*edits, *frames, *keys]
        self.view.menu_actions = self._menu_actions = [*edits, *frames]
        self.line_tool = LineTool(self, self.lines, self.action, lambda: self.pointer)
        self.dots_panel = DotsPanel(edits, frames)
        self.canvas_layout.addWidget(self.view)
        self.lines_panel = self.line_tool.panel
        self.lines_panel.hide()
        self.measure_lead = MeasureLead(workspace.action_requested.emit)
        fill(
            self.panel_layout,
            *(self.measure_lead, self.answer, self.dots_panel, self.lines_panel),
        )
        self.setFocusProxy(self.view)
        panel = self.dots_panel
        self.lock_with_session(panel.method, panel.row_search, *panel.numbers)
        self._connect()

    def _connect(self) -> None:
        panel = self.dots_panel
        panel.rows.itemSelectionChanged.connect(
            lambda: self.choose(self.editor.choose_rows, panel.rows.chosen())
        )
        for name in ("row", "column"):
            getattr(panel, name).edited.connect(partial(self._assign, name))
        for field in (panel.reference_row, panel.reference_column):
            field.edited.connect(lambda _: self._refer(panel.reference))
        panel.method.edited.connect(
            lambda method: self._set(lambda now: with_methods(now, method), "detector")
        )
        panel.row_search.edited.connect(
            lambda method: self._set(lambda now: with_methods(now, rows=method), "rows")
        )
        for number, field in zip(presenter.NUMBERS, panel.numbers, strict=True):
            field.edited.connect(partial(self._set_number, number))
        self.view.pointed.connect(self._point)
        self.view.canvas.installEventFilter(self)
        self.reader.ready.connect(self._again)
        # The window may show a change with a delay; the next edit must start from it.
        self.workspace.changed.connect(self._again)
        self.workspace.tasks.changed.connect(self._show_lead)
        self.workspace.opened.connect(self._forget)

    # --- what is shown ------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the session's current data of the frame in view."""
        session = self.session
        self._in_view = True
        frame = self.workspace.frame
        if not len(session.frames):
            self.view.show_picture(None, "Import a recording first")
            return
        if self.reader.frame != frame:
            self.reader.read(frame)
            return  # the previous frame with its dots stays until this one is read
        same = self.seen is not None and self.seen.frame == frame
        if self.reader.image is None or self.view.picture is not self.reader.image:
            self.view.show_picture(self.reader.image, self.reader.why)
        self._show_pattern(session.has_lines)
        if session.has_lines:
            state = show_lines(session, frame)
            self.lines_panel.show_frame(state)
            self._show_lead()
            self.line_tool.show(state, self._lines_frame == frame)
            self._lines_frame = frame
            self.refit.want(frame, state.due)
            return
        self.seen = presenter.shown(session, frame, self.reader.found)
        if self.seen.correction is None:
            self.reader.look()
        self.refit.want(frame, presenter.needs_fit(self.seen))
        self.editor.show(self.seen.correction, same)
        correction = self.seen.correction
        self.dots_panel.show_reference(None if correction is None else correction.lattice.reference)
        self.dots_panel.show_settings(session.settings)
        self._show_words()
        self.draw()

    def _show_pattern(self, lines: bool) -> None:
        """Show the marks, the panel and the tool for dots, or those for lines."""
        if lines == self.lines_panel.isVisibleTo(self.panel):
            return
        self.lines_panel.setVisible(lines)
        self.dots_panel.setVisible(not lines)
        for action in self._dot_actions:
            action.setEnabled(not lines)
        for action in self.line_tool.actions:
            action.setEnabled(lines)
        self.view.tool = self.line_tool if lines else self.dot_tool
        self.view.menu_actions = self.line_tool.actions if lines else self._menu_actions
        if lines:
            self.seen = None
            self.editor.show(None, same_frame=False)
            self.draw()
        else:
            self.lines.show(())

    def _show_words(self) -> None:
        session, seen = self.session, self.seen
        assert seen is not None
        before = self._before
        sentence = presenter.sentence(seen)
        self.view.describe(sentence)
        figures = presenter.figures(seen.result)
        stands = seen.result is not None and not seen.result.stale
        pending = "fitting…" if self.refit.pending else "" if stands else "–"
        why = seen.why or recording_gone(session)
        dots = seen.correction
        if seen.why and dots is not None and len(dots.dots) and dots.lattice.reference is None:
            why = f"{why}. {NO_REFERENCE}"
        self._show_lead()
        self.dots_panel.show_frame(
            sentence,
            why,
            presenter.compared(
                before[1] if before is not None and before[0] == seen.frame else None,
                figures,
                pending,
            ),
            # The list keeps its size during the detection, so that nothing jumps.
            None if seen.correction is None else presenter.row_lines(seen.correction),
        )

    def _show_lead(self) -> None:
        session = self.workspace.session
        if session is not None:
            measuring = "Frames are being measured" if self.workspace.measuring is not None else ""
            without_setup = bool(session.setup_problems)
            gone = "" if without_setup else recording_gone(session)
            self.measure_lead.offer(without_setup, self.locked or measuring or gone)

    def draw(self) -> None:
        """Draw the marks, including a drag in progress."""
        computed = presenter.NO_PLACES if self.seen is None else self.seen.computed_px
        editor = self.editor
        self.overlay.show(editor.correction, editor.dots_px, editor.selection, computed)
        lattice = None if editor.correction is None else editor.correction.lattice
        site = (0, 0)
        if lattice is not None and len(editor.selection) == 1:
            dot = int(editor.selection[0])
            site = int(lattice.row[dot]), int(lattice.column[dot])
        elif len(editor.rows) == 1:
            site = editor.rows[0], 0
        chosen = presenter.chosen_words(editor.correction, editor.selection.tolist())
        words = self.dot_tool.asked or editor.refusal or chosen
        is_new = words != self.dots_panel.chosen.text()
        self.dots_panel.show_chosen(words, editor.rows, site)
        if is_new and editor.selection.size and self.view.hasFocus():
            reveal(*self.dots_panel.edit_buttons)  # not if the pointer is in the panel
        self._show_unmet_needs()

    def _show_unmet_needs(self) -> None:
        """Disable edits whose needs are not met."""
        found = {text: self._unmet_need(need) for text, need in self._needs.items()}
        if found != self._unmet:  # a drag draws the marks all the time
            self._unmet = found
            self.dots_panel.lock_sites(self._unmet_need("dots"), self._unmet_need(""))
            if self.dots_panel.show_unmet_needs(found):
                self.view.setFocus()  # otherwise the focus would move to another button

    def _unmet_need(self, need: Need) -> str:
        """Say why an edit with a need cannot be made now; empty if it can."""
        chosen, rows = self.editor.selection, self.editor.rows
        return self.locked or presenter.unmet_need(need, self.seen, chosen, rows)

    def choose(self, way: Callable[..., None], *given: object) -> None:
        """Select dots by a function, and show the selection."""
        self.editor.refusal = ""
        way(*given)
        self.draw()

    def leave(self) -> None:
        """End a drag or nudge in progress; a running fit continues."""
        self._in_view = False
        self.dot_tool.release()
        self.dot_tool.give_up()  # a pending click must not affect another session
        self.reader.stop()

    def picture(self) -> QPixmap:
        """Picture of the frame with its marks."""
        return QPixmap.fromImage(self.view.grab_picture())

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Detect that the pointer leaves the picture."""
        if event.type() == QEvent.Type.Leave:
            self.pointer = None
        return super().eventFilter(watched, event)

    def _point(self, u: float, v: float, level: object) -> None:
        self.pointer = (u, v) if level is not None else None

    def _again(self) -> None:
        if self._in_view and self.workspace.session is not None:
            self.workspace.run_or_report(self.refresh)

    def _forget(self) -> None:
        self.seen = self._before = None
        self.editor.show(None, same_frame=False)
        self.view.show_picture(None)
        self.lines.show(())
        self.draw()

    # --- what is changed ----------------------------------------------------------------------

    def _commit(self, label: str, edit: Callable[[], Correction | None]) -> bool:
        """Apply an edit of the frame in view as one step of undo."""
        seen = self.seen
        if seen is None:
            return False
        stood = seen.result is not None and not seen.result.stale
        if presenter.needs_fit(seen) and seen.origin == "found" and self.refit.pending:
            self.workspace.say_wrong(EDITING, NOT_YET)
            self.draw()
            return False
        before, self._before = self._before, (seen.frame, presenter.figures(seen.result))
        if not stood and before is not None and before[0] == seen.frame:
            self._before = before  # edits before the fit is done are compared as one
        done = self.workspace.attempt(
            lambda session: session.correct({seen.frame: edit()}, f"{label}, frame {seen.frame}"),
            show_answer=partial(setattr, self.editor, "refusal"),
        )
        if not done:
            self._before = before
            self.draw()
        return done

    def _assign(self, what: str, value: float | None) -> None:
        if value is not None:
            self.editor.assign(**{what: int(value)})

    def _refer(self, site: Site | None) -> None:
        correction = self.editor.correction
        known = None if correction is None else correction.lattice.reference
        if correction is not None and site not in (None, known):
            self.editor.set_reference(site)

    def _set(self, change: Callable[[Settings], Settings], label: str) -> None:
        self.workspace.attempt(lambda own: own.set_settings(change(own.settings), label))

    def _set_number(self, number: DetectorNumber, value: float | None) -> None:
        if value is not None or number.optional:
            label = f"detector: {number.label.lower()}"
            self._set(lambda now: presenter.with_detector_value(now, number, value), label)

    def add_at(self, u: float, v: float) -> None:
        """Add the dot at a position."""
        image, session = self.reader.image, self.workspace.session
        if image is not None and session is not None:
            self.editor.add(image, u, v, session.settings)
            self.draw()

    def _at_pointer(self, do: Callable[[float, float], object], ask: str) -> None:
        """Call a function with the pointer's position; a button asks for a click first."""
        if self.pointer is not None:
            do(*self.pointer)
        else:
            self.dot_tool.ask(do, f"{ask} (Esc: leave it)")
            self.view.setFocus()
            self.draw()

    def _carry_on(self) -> None:
        assert self.seen is not None
        most = self.dots_panel.most.value()
        carry_on(self, self.seen, None if most is None else int(most), self.dots_panel.carried)

    def _escape(self) -> None:
        if self.dot_tool.busy:
            self.dot_tool.give_up()
            self.draw()
        else:
            self.choose(self.editor.choose_none)

    # --- keys and buttons ---------------------------------------------------------------------

    def action(self, text: str, key: str, tip: str, do: Callable[[], object]) -> QAction:
        """Create an action of the page and its panel from its text, key, tip and function."""
        action = QAction(text, self)
        tip = f"{tip} ({key})" if key else tip
        action.setToolTip(tip)
        action.setStatusTip(tip)
        if key:
            action.setShortcut(QKeySequence(key))
        action.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
        action.triggered.connect(lambda *_: do())
        for widget in (self, self.panel):
            widget.addAction(action)
        return action

    def _run(self, command: Command) -> None:
        """Run a command, or report what it needs."""
        if command.text in self._needs and (why := self._unmet_need(command.needs)):
            if self.locked or command.needs != "corrected":
                self.workspace.say_wrong(EDITING, why)
            else:
                self.workspace.notified.emit(why, False)
        else:
            command.do()

    def _edits(self) -> tuple[Command, ...]:
        editor = self.editor
        return (
            Command("Add dot", "A",
                    "Add a dot: click where it is, or double click it; the key takes the "
                    "one under the pointer",
                    lambda: self._at_pointer(self.add_at, "Click where the dot is")),
            Command("Delete", "Del", "Delete the selected dots", lambda: self._then(editor.delete),
                    "dots"),
            Command("Number", "N", "Number the selected dots by their neighbours",
                    lambda: self._then(editor.number), "dots"),
            Command("Row left", "Ctrl+Left", "Shift the selected rows left by a column",
                    lambda: editor.shift(-1), "row"),
            Command("Row right", "Ctrl+Right", "Shift the selected rows right by a column",
                    lambda: editor.shift(1), "row"),
            Command("In doubt", "U", "Put the selected dots in doubt: without row and column",
                    editor.put_in_doubt, "dots"),
            Command("Split up", "S", "Split the row at the selected dot: the right part lies above",
                    editor.split, "site"),
            Command("Split down", "Shift+S",
                    "Split the row at the selected dot: the right part lies below",
                    lambda: editor.split(above=False), "site"),
            Command("Merge", "M", "Merge the two rows of the selected dots",
                    editor.merge, "two rows"),
            Command("Blocked", "B", "Mark the selected rows as hidden in part by the torch, or not",
                    editor.block, "row"),
            Command("Reference", "R",
                    "Click where the dark centre of the pattern is; the key takes the place "
                    "under the pointer",
                    lambda: self._at_pointer(editor.point_at_reference,
                                             "Click where the dark centre of the pattern is"),
                    "rows"),
            Command("No reference", "Shift+R", "Leave it to the program to find the reference",
                    lambda: editor.set_reference(None), "reference"),
        )  # fmt: skip

    def _frame_commands(self) -> tuple[Command, ...]:
        return (
            Command("Carry on", "Ctrl+Return", "Apply these dots and rows to the following frames "
                    "by tracking, until they no longer fit", self._carry_on, "rows"),
            Command("Back to automatic", "Ctrl+Backspace", "Discard the corrections of this frame",
                    self.editor.back_to_automatic, "corrected"),
        )  # fmt: skip

    def _keys(self) -> tuple[Command, ...]:
        editor = self.editor
        return (
            Command("Select all", "Ctrl+A", "Select every dot",
                    lambda: self.choose(editor.choose_all)),
            Command("Select none", "Esc", "Select no dot, or cancel a drag", self._escape),
            Command("Select in doubt", "D", "Select the dots in doubt",
                    lambda: self.choose(editor.choose_doubtful)),
            Command("Next dot", ".", "Select the next dot along the row",
                    lambda: self.choose(editor.choose_next, 1)),
            Command("Previous dot", ",", "Select the dot before it",
                    lambda: self.choose(editor.choose_next, -1)),
            Command("Whole row", "W", "Select all dots in the rows of the selected ones",
                    lambda: self.choose(editor.choose_rows, editor.rows)),
            Command("Type a row", "T", "Type the row of the selected dots",
                    lambda: self.dots_panel.row.editor.setFocus(BY_KEY), "dots"),
            Command("Hide marks", "H", "Hide the marks, or show them again",
                    self.overlay.toggle),
        )  # fmt: skip

    def _then(self, edit: Callable[[], bool]) -> None:
        edit()
        self.draw()


class DotTool(Tool):
    """Tool for selecting and moving dots with the pointer and the arrow keys."""

    def __init__(self, page: DotsPage) -> None:
        self._page = page
        self._start: tuple[float, float] | None = None
        self._boxing = self._adds = False
        self._next_click: Callable[[float, float], object] | None = None
        self.asked = ""
        """Text of the action that needs a click; empty if none does."""

    @property
    def busy(self) -> bool:
        """Whether a drag is in progress or a click is pending."""
        return self._start is not None or self._next_click is not None

    def ask(self, do: Callable[[float, float], object], words: str) -> None:
        """Call a function with the position of the next click."""
        self._next_click, self.asked = do, words

    def give_up(self) -> None:
        """Cancel a drag or a pending click; the dots keep their positions."""
        self._start = self._next_click = None
        self.asked = ""
        self._page.editor.shift_px[:] = 0
        self._page.overlay.hide_box()

    def click(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> None:
        """Select a dot (Shift: add it to the selection), or run the pending action."""
        if self._next_click is not None:
            do, self._next_click, self.asked = self._next_click, None, ""
            do(u, v)
            self._page.draw()
            return
        self._page.choose(self._page.editor.click, u, v, self._reach(), bool(modifiers & SHIFT))

    def point_out(self, u: float, v: float) -> None:
        """Select the dot for the menu, unless it is selected already."""
        if self._page.editor.at(u, v, self._reach()) not in self._page.editor.selection.tolist():
            self.give_up()
            self.click(u, v, Qt.KeyboardModifier.NoModifier)

    def double_click(self, u: float, v: float) -> None:
        """Add a dot."""
        self._page.add_at(u, v)

    def begin(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> bool:
        """Begin to drag a dot and those selected with it, or begin a selection box."""
        editor = self._page.editor
        add = bool(modifiers & SHIFT)
        on = None if self._page.locked else editor.at(u, v, self._reach())
        self._start, self._adds, self._boxing = (u, v), add, on is None
        if on is not None and on not in editor.selection:
            editor.click(u, v, self._reach(), add)
        return True

    def drag(self, u: float, v: float) -> None:
        """Move the dragged dots, or draw the selection box."""
        if self._start is None:
            return
        if self._boxing:
            self._page.overlay.show_box(self._start, (u, v))
        else:
            self._page.editor.shift_px[:] = u - self._start[0], v - self._start[1]
            self._page.draw()

    def end(self, u: float, v: float) -> None:
        """End the drag: one step of undo, or a selection."""
        if self._start is None:
            return
        start, self._start = self._start, None
        self._page.overlay.hide_box()
        if self._boxing:
            self._page.choose(self._page.editor.box, start, (u, v), self._adds)
        elif len(self._page.editor.selection):  # not if another frame came into view meanwhile
            self._page.editor.shift_px[:] = u - start[0], v - start[1]
            self._page.editor.drop()

    def takes(self, event: QKeyEvent) -> bool:
        """Whether an arrow key moves selected dots; without a selection it changes the frame."""
        held = len(self._page.editor.selection) > 0 and not self._page.locked
        return held and arrow_step(event) is not None

    def key(self, event: QKeyEvent) -> None:
        """Nudge the selected dots; a held key is one step of undo."""
        step = arrow_step(event)
        if step is not None:
            self._page.editor.shift_px += step
            self._page.draw()

    def release(self) -> None:
        """Finish a nudge at the current positions of the dots."""
        if self._start is None and self._page.editor.shift_px.any():
            self._page.editor.drop()

    def _reach(self) -> float:
        return REACH * self._page.view.px_per_point
