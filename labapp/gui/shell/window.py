"""The main window: steps at the left, page, panel at the right, timeline at the bottom."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QByteArray, QEvent, QSize, Qt, QTimer
from PySide6.QtGui import QCloseEvent, QDragEnterEvent, QDropEvent, QKeyEvent
from PySide6.QtWidgets import (
    QApplication,
    QDialog,
    QDockWidget,
    QMainWindow,
    QStackedWidget,
    QWidget,
)

from labapp.core.values import IntArray
from labapp.gui.dialogs import dropped_paths
from labapp.gui.drafts import drafts, is_draft
from labapp.gui.pages import make_page
from labapp.gui.pages.page import Page
from labapp.gui.pages.welcome import Welcome
from labapp.gui.preferences import THEMES, PreferencesStore
from labapp.gui.shell.actions import ACTIONS, Needs
from labapp.gui.shell.files import Files, title
from labapp.gui.shell.focus import finish_edit, show_in
from labapp.gui.shell.frame_status import TICKS, TO_CHECK, frame_statuses, next_frame
from labapp.gui.shell.lead import EmptyState
from labapp.gui.shell.menus import Menus, steps_of
from labapp.gui.shell.messages import LogPanel, StatusLine
from labapp.gui.shell.setups import Setups
from labapp.gui.shell.step_list import SidePanel, StepList
from labapp.gui.shell.steps import STEPS, Lead, first_frame, first_step, lead, read_only, states
from labapp.gui.theme import apply_theme
from labapp.gui.widgets.timeline import Timeline
from labapp.gui.workspace import Workspace

if TYPE_CHECKING:
    from labapp.gui.live.view import LiveView

Commands = Callable[["MainWindow"], Mapping[str, Callable[[], object]]]
"""Returns the functions of the actions in a window, by the actions' names."""

REST = 4
"""Pause after displaying a change, as a multiple of its duration, to keep the window responsive."""

LONGEST_REST_MS = 1000

LAYOUT_VERSION = 1

SIZE_PX = (1600, 1000)
PART_OF_SCREEN = 0.92
"""Size at the first start, and the largest fraction of the screen that it covers."""

OF_A_FRAME = (
    *("measure_frame", "next_doubtful", "previous_doubtful", "next_corrected"),
    *("previous_corrected", "first", "last", "play"),
)
"""Actions in the timeline's menu."""

PAGE_PX = QSize(300, 336)
"""Minimum size of a page; with all panels 680 × 492, as 1024 × 768 at 150 % is 682 × 512."""


class MainWindow(QMainWindow):
    """The main window of the app."""

    def __init__(self, preferences: PreferencesStore, commands: Commands) -> None:
        super().__init__()
        self.setObjectName("labapp")
        self.preferences = preferences
        preferences.setParent(self)
        self.workspace = Workspace(self)
        self.pages: dict[str, Page] = {}
        """Pages created so far, by key."""
        self.files = Files(self, self.workspace, preferences, lambda: self.camera)
        self.setups = Setups(self, self.workspace, preferences)
        self.frame_statuses: IntArray = np.zeros(0, np.int64)
        """State of each frame (`FrameStatus`), shape (n,)."""
        self.page: Page | None = None
        """The page in view; None for the welcome page."""
        self._states = states(None)
        self._changes_due = False
        self._rest = QTimer(self, singleShot=True)
        self._rest.timeout.connect(self._rested)
        self._make_views()
        self.menus = Menus(self, ACTIONS, self.do, self.files.open)
        self.timeline.addActions([self.menus.actions[name] for name in OF_A_FRAME])
        self._commands = commands(self)
        self._connect()
        self.setAcceptDrops(True)
        self._plain_layout = self.saveState(LAYOUT_VERSION)
        self._restore()
        if preferences.current.foot_switches:
            self.workspace.foot_switches.use(preferences.current.foot_switches)
        self._session_opened()

    def _make_views(self) -> None:
        self.welcome = Welcome(self.workspace)
        self.stack = QStackedWidget()
        self.stack.setMinimumSize(PAGE_PX)  # otherwise hidden pages could enlarge the window
        self.empty = EmptyState()
        for each in (self.welcome, self.empty):
            self.stack.addWidget(each)
        self.setCentralWidget(self.stack)
        self.step_list = StepList(STEPS)
        self.side_panel = SidePanel()
        self.timeline = Timeline(TICKS)
        self.log_panel = LogPanel()
        self.status_line = StatusLine(self.workspace.tasks)
        self.statusBar().setSizeGripEnabled(False)
        self.statusBar().addWidget(self.status_line, 1)
        left, right = Qt.DockWidgetArea.LeftDockWidgetArea, Qt.DockWidgetArea.RightDockWidgetArea
        bottom = Qt.DockWidgetArea.BottomDockWidgetArea
        self._wanted = {"steps": True, "panel": True, "timeline": True, "log": False}
        self._docks = {
            "steps": self._dock("steps", "Steps", self.step_list, left),
            "panel": self._dock("panel", "Parameters and results", self.side_panel, right),
            "timeline": self._dock("timeline", "Timeline", self.timeline, bottom),
            "log": self._dock("log", "Messages", self.log_panel, bottom),
        }
        self.splitDockWidget(self._docks["timeline"], self._docks["log"], Qt.Orientation.Vertical)

    def _dock(self, name: str, title: str, widget: QWidget, area: Qt.DockWidgetArea) -> QDockWidget:
        dock = QDockWidget(title, self)
        dock.setObjectName(f"dock-{name}")
        dock.setFeatures(QDockWidget.DockWidgetFeature.NoDockWidgetFeatures)
        dock.setTitleBarWidget(QWidget())
        dock.setWidget(widget)
        self.addDockWidget(area, dock)
        return dock

    def _connect(self) -> None:
        space, preferences = self.workspace, self.preferences
        preferences.changed.connect(lambda: self.menus.show_recent(preferences.current.recent))
        preferences.failed.connect(self.say)
        self.files.step_requested.connect(self._show_file)
        self.files.refused.connect(self.welcome.refused.setText)
        self.setups.answered.connect(self.show_answer)
        space.closing.connect(self._leave)
        space.closing.connect(self.status_line.mark_read)  # the messages concern that session
        space.opened.connect(self._session_opened)
        space.changed.connect(self._changed)
        space.measured.connect(self._show_measured)
        space.frame_changed.connect(self._frame_changed)
        space.urgent.connect(self.status_line.put_first)
        space.notified.connect(self.say)
        space.settled.connect(self.status_line.settle)
        space.action_requested.connect(self.do)
        space.next_session_requested.connect(self.files.begin_next)
        space.foot_switches_changed.connect(
            lambda held: preferences.remember(lambda before: replace(before, foot_switches=held))
        )
        space.tasks.changed.connect(self._show_actions)
        space.tasks.changed.connect(self._show_lead)
        self.step_list.chosen.connect(self.show_step)
        self.timeline.moved.connect(space.show_frame)
        self.timeline.jumped.connect(self.jump)
        self.status_line.messages_requested.connect(lambda: self.do("log"))
        self.welcome.action_requested.connect(self.do)
        self.empty.action_requested.connect(self.do)
        self.welcome.chosen.connect(self.files.open)
        self.welcome.sample_chosen.connect(self.files.try_sample)
        self.welcome.forgotten.connect(self._forget)

    # --- actions ----------------------------------------------------------------------------

    def do(self, name: str) -> None:
        """Run an action of the menus, on what is shown."""
        if name not in ("undo", "redo"):  # their keys may be held down
            self._rested()
        self._commands[name]()
        self._show_actions()

    def _show_actions(self) -> None:
        """Update which actions of the menus are enabled and checked."""
        session, frames = self.workspace.session, len(self.frame_statuses) > 0
        undo, redo = steps_of(session)
        there: dict[Needs, bool] = {
            "": True,
            "session": session is not None,
            "draft": session is not None and is_draft(session.path),
            "changing": session is not None and not read_only(session),
            "frames": frames,
            "measuring": frames and not read_only(session),
            "undo": bool(undo),
            "redo": bool(redo),
            "work": bool(self.workspace.tasks.active),
            "live": self.camera is not None,
        }
        on = {
            **self._wanted,
            **{f"theme_{theme}": theme == self.preferences.current.theme for theme in THEMES},
            "play": self.timeline.playing,
            "full_screen": self.isFullScreen(),
        }
        self.menus.refresh(there, on, undo, redo)

    # --- what is in view --------------------------------------------------------------------

    def say(self, text: str, problem: bool = False) -> None:
        """Show a message; a problem stays in the status line until it is read."""
        self.log_panel.add(text, problem)
        self.status_line.say(text, problem)
        if problem:
            self.timeline.set_playing(False)

    def show_step(self, key: str) -> None:
        """Show the page of a step; it is created on first use."""
        step = next((step for step in STEPS if step.key == key), None)
        if self.workspace.session is None or step is None:
            return
        if key not in self.pages:
            made = self.workspace.run_or_report(lambda: make_page(step, self.workspace))
            if made is None:
                return
            self.pages[key] = made
            made.lead_changed.connect(self._show_lead)
            self.stack.addWidget(made)
        page = self.pages[key]
        if page is not self.page:
            self._leave()
            self.page = page
            listed = self.step_list.hasFocus()
            shown = step.of(self.workspace.session)
            page.setAccessibleName(shown.title)
            self.side_panel.show_panel(page.panel, shown)
            self.show_answer("")
            self._show_lead()
            if not listed:
                seen = page if self.stack.currentWidget() is page else self.empty
                seen.setFocus()  # otherwise a hidden widget keeps the focus
        self.step_list.show_step(key)
        self._show_page()
        self._show_actions()

    @property
    def camera(self) -> LiveView | None:
        """The live camera, regardless of the page in view; None if there is none."""
        return next((page.camera for page in self.pages.values() if page.camera), None)

    def go_step(self, by: int) -> None:
        """Go forward or back by some steps."""
        if self.page is not None:
            keys = [step.key for step in STEPS]
            place = keys.index(self.page.key) + by
            self.show_step(keys[max(0, min(len(keys) - 1, place))])

    def jump(self, kind: str, forward: bool) -> None:
        """Go to the next or previous frame to check, ``doubtful``, or ``corrected``."""
        session = self.workspace.session
        if session is None:
            return
        if kind == "doubtful":
            wanted, words = np.isin(self.frame_statuses, TO_CHECK), "to be checked"
        else:
            corrected = session.corrected_frames()
            wanted, words = np.isin(session.frames, corrected), "corrected by hand"
        found = next_frame(session.frames, wanted, self.workspace.frame, forward)
        if found is None:
            self.say(f"No frame {'after' if forward else 'before'} this one is {words}")
        else:
            self.workspace.show_frame(found)

    def _show_file(self, step: str, path: Path | None, at_once: bool) -> None:
        self.show_step(step)
        if path is not None and self.page is not None:
            self.page.take(path, at_once)

    def show_answer(self, words: str) -> None:
        """Show the outcome of an action at the pressed button."""
        self.empty.answer.setText(words)
        if self.page is not None:
            self.page.answer.setText(words)

    def _list_recent(self) -> None:
        """List recently opened sessions, including those opened in other windows."""
        self.preferences.recall()
        recent = self.preferences.current.recent
        self.menus.show_recent(recent)
        if self.workspace.session is None:
            paths = [Path(name) for name in recent]
            self.welcome.show_recent([*paths, *(path for path in drafts() if path not in paths)])

    def _forget(self, path: Path) -> None:
        """Remove a session from the list of recent ones, see `Files.forget`."""
        self.files.forget(path)
        self._list_recent()

    def _leave(self) -> None:
        if self.page is not None:
            finish_edit(self.page, self.page.panel)
            self.workspace.run_or_report(self.page.leave)
            self.page = None

    def _session_opened(self) -> None:
        """Show a newly opened session, or the welcome page."""
        session = self.workspace.session
        self.timeline.set_playing(False)
        self._leave()
        self.side_panel.read_only.setVisible(session is not None and session.read_only)
        self.side_panel.scroll_to_top()
        self._show_session()
        if session is None:
            self.stack.setCurrentWidget(self.welcome)
            self.step_list.show_step("")
            self._list_recent()
        else:
            first = self.workspace.run_or_report(lambda: first_step(session)) or "setup"
            frame = self.workspace.run_or_report(lambda: first_frame(session))
            if frame is not None:
                self.workspace.show_frame(frame)
            self.show_step(first)
        self._show_docks()

    def _changed(self) -> None:
        if self._rest.isActive():
            self._changes_due = True
        else:
            self._show_session()

    def _rested(self) -> None:
        if self._changes_due:
            self._show_session()

    def _show_session(self) -> None:
        """Update the whole window with the current contents of the session."""
        began = time.perf_counter()
        self._changes_due = False
        self._show_frames()
        self._show_page()
        self._show_actions()
        self.setWindowTitle(title(self.workspace.session))
        took_ms = (time.perf_counter() - began) * 1000
        self._rest.start(min(LONGEST_REST_MS, round(REST * took_ms)))

    def _show_frames(self) -> None:
        """Show the states of all frames and of the steps."""
        session = self.workspace.session
        seen = self.workspace.run_or_report(self.workspace.overview)
        if seen is None:
            self.frame_statuses = np.zeros(0, np.int64)
            self.timeline.set_frames(self.frame_statuses, np.zeros(0), self.frame_statuses)
        else:
            self.frame_statuses = frame_statuses(seen)
            self.timeline.set_frames(seen.frame, seen.time_s, self.frame_statuses)
        self.timeline.set_frame(self.workspace.frame)
        self._states = states(session, seen)
        own = {key: page.state(self._states[key]) for key, page in self.pages.items()}
        steps = [step.of(session) for step in STEPS]
        self.step_list.show_titles(steps)
        self.menus.show_titles(steps)
        self.step_list.show_states(self._states | own)

    def _show_measured(self) -> None:
        """Update the window after measurement of frames that are not in view."""
        if self._rest.isActive():
            return  # more follow, and the last one updates everything
        if self.page is None or self.page.shows_all_frames:
            self._show_session()
        else:
            self._show_frames()
            self.side_panel.show_state(self.page.state(self._states[self.page.key]))

    def _show_page(self) -> None:
        if self.page is not None and self.workspace.session is not None:
            self.side_panel.show_state(self.page.state(self._states[self.page.key]))
            self.workspace.run_or_report(self.page.refresh)
            self._show_lead()

    def _show_lead(self) -> None:
        """Show the current page, or its substitute while it has no content."""
        page, session = self.page, self.workspace.session
        if page is None or session is None:
            return
        step = next(step for step in STEPS if step.key == page.key).of(session)
        measuring = self.workspace.measuring is not None

        def find() -> Lead | None:
            return page.lead(lead(step, session, self.workspace.overview(), measuring))

        found = self.workspace.run_or_report(find)
        if found is not None:
            self.empty.show_lead(page.key, found)
            self.empty.setAccessibleName(step.title)
        else:
            self.empty.answer.setText("")
        show_in(self.stack, page if found is None else self.empty)

    def _frame_changed(self, frame: int) -> None:
        self.timeline.set_frame(frame)
        self._show_page()

    # --- look -------------------------------------------------------------------------------

    def set_theme(self, theme: str) -> None:
        """Set and store the theme: light, dark or that of the desktop."""
        self.preferences.remember(lambda before: replace(before, theme=theme))
        self.apply_theme()

    def apply_theme(self) -> None:
        """Apply the stored theme; the desktop's theme may have changed."""
        app = QApplication.instance()
        if isinstance(app, QApplication):
            apply_theme(app, self.preferences.current.theme)
        self._show_session()

    def toggle_dock(self, name: str) -> None:
        """Show or hide a panel."""
        self._wanted[name] = not self._wanted[name]
        if name == "log" and self._wanted[name]:
            self.status_line.mark_read()
        self._show_docks()

    def _show_docks(self, everywhere: bool = False) -> None:
        """Show the selected panels; on the welcome page only the log."""
        here = everywhere or self.workspace.session is not None
        for name, dock in self._docks.items():
            dock.setVisible(self._wanted[name] and (here or name == "log"))

    def reset_layout(self) -> None:
        """Restore the default arrangement of the panels."""
        self.restoreState(self._plain_layout, LAYOUT_VERSION)
        self._wanted = {name: name != "log" for name in self._wanted}
        self._show_docks()

    def _restore(self) -> None:
        preferences, room = self.preferences.current, self.screen().availableSize()
        self.resize(QSize(*SIZE_PX).boundedTo(room * PART_OF_SCREEN))
        restored = (
            (self.restoreGeometry, preferences.geometry),
            (lambda held: self.restoreState(held, LAYOUT_VERSION), preferences.layout),
        )
        for restore, text in restored:
            if text:
                restore(QByteArray.fromBase64(text.encode("ascii", "replace")))
        if preferences.layout:
            self._wanted = {name: not dock.isHidden() for name, dock in self._docks.items()}
            self._wanted["log"] = False  # its messages are old

    # --- events -----------------------------------------------------------------------------

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Run the action of a plain key that no other widget handled."""
        taken = self.page is not None and self.page.takes_key(event)
        if not taken and not self.menus.key(event):
            super().keyPressEvent(event)

    def changeEvent(self, event: QEvent) -> None:
        """Read the preferences again on activation; other windows may have changed them."""
        super().changeEvent(event)
        if event.type() == QEvent.Type.ActivationChange and self.isActiveWindow():
            before = self.preferences.current
            self.preferences.recall()
            if self.preferences.current.recent != before.recent:
                self._list_recent()
            if self.preferences.current.theme != before.theme:
                self.apply_theme()

    def dragEnterEvent(self, event: QDragEnterEvent) -> None:
        """Accept files."""
        if dropped_paths(event.mimeData()):
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent) -> None:
        """Pass dropped files to the page in view, or open them."""
        paths = dropped_paths(event.mimeData())
        event.acceptProposedAction()
        if self.page is None or not self.page.takes_files(paths):
            self.files.open_dropped(paths)

    def closeEvent(self, event: QCloseEvent) -> None:
        """Stop all tasks, store the layout and close the session.

        If the user closes the window, a running recording needs a decision; a close by the program
        asks nothing.
        """
        if event.spontaneous() and not self.files.may_close():
            event.ignore()
            return
        for beside in self.findChildren(QDialog):
            beside.close()
        self.timeline.set_playing(False)
        self._show_docks(everywhere=True)
        held = self.saveGeometry(), self.saveState(LAYOUT_VERSION)
        geometry, layout = (bytes(one.toBase64().data()).decode("ascii") for one in held)
        self.preferences.remember(lambda before: replace(before, geometry=geometry, layout=layout))
        self.workspace.opened.disconnect(self._session_opened)
        self.workspace.close()
        self._rest.stop()
        event.accept()
