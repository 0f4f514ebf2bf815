"""The functions of the window's actions, and creation of the window."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from PySide6.QtCore import QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QApplication, QTableView

from labapp.gui.preferences import THEMES, Preferences, PreferencesStore
from labapp.gui.shell.focus import go_to_part
from labapp.gui.shell.help import TITLES, HelpDialog
from labapp.gui.shell.steps import STEPS, why_not_measurable
from labapp.gui.shell.window import MainWindow
from labapp.gui.tasks import PROBLEM
from labapp.gui.tools import TOOLS, show_tool
from labapp.gui.widgets.tables import table_text
from labapp.gui.workspace import MEASURING
from labapp.log import log_file

FAR = 10**9
"""A number larger than that of the frames."""

NO_CAMERA = "No camera is live: start one in the step Recording"


def make_window(preferences: Preferences, file: Path) -> MainWindow:
    """The app's window."""
    return MainWindow(PreferencesStore(preferences, file), commands)


def commands(window: MainWindow) -> dict[str, Callable[[], object]]:
    """Functions of the actions in a window, by their names."""
    files, workspace, timeline = window.files, window.workspace, window.timeline
    parts = (
        window.step_list,
        window.stack,
        window.side_panel,
        window.timeline,
        window.log_panel,
        window.status_line,
    )
    return {
        "open_recording": files.open_recording,
        "new": files.new,
        "open": files.choose,
        "sample": files.try_sample,
        "copy": files.save_copy,
        "name_draft": lambda: name_draft(window),
        "import": files.choose_recording,
        "load_setup": window.setups.load,
        "last_setup": window.setups.use_last,
        "other_setup": window.setups.use_other,
        "enter_setup": lambda: enter_setup(window),
        "export": lambda: window.show_step("export"),
        "close": files.close,
        "quit": lambda: files.may_close() and window.close(),
        "undo": workspace.undo,
        "redo": workspace.redo,
        "copy_picture": lambda: copy_picture(window),
        "copy_table": lambda: copy_table(window),
        **{f"step_{step.key}": partial(window.show_step, step.key) for step in STEPS},
        "next_step": lambda: window.go_step(1),
        "previous_step": lambda: window.go_step(-1),
        "measure": lambda: measure(window, None),
        "measure_frame": lambda: measure(window, [workspace.frame]),
        "cancel": window.status_line.cancel,
        "previous": lambda: timeline.step(-1),
        "next": lambda: timeline.step(1),
        "first": lambda: timeline.step(-FAR),
        "last": lambda: timeline.step(FAR),
        "play": lambda: timeline.set_playing(not timeline.playing),
        "record": lambda: record(window),
        "mark": lambda: mark(window),
        "next_doubtful": lambda: window.jump("doubtful", True),
        "previous_doubtful": lambda: window.jump("doubtful", False),
        "next_corrected": lambda: window.jump("corrected", True),
        "previous_corrected": lambda: window.jump("corrected", False),
        **{
            name: partial(window.toggle_dock, name)
            for name in ("steps", "panel", "timeline", "log")
        },
        "next_part": lambda: go_to_part(parts, 1),
        "previous_part": lambda: go_to_part(parts, -1),
        **{f"theme_{theme}": partial(window.set_theme, theme) for theme in THEMES},
        "full_screen": lambda: toggle_full_screen(window),
        "reset_layout": window.reset_layout,
        **{key: partial(show_tool, key, files, window) for key in TOOLS},
        **{kind: partial(show_help, window, kind) for kind in TITLES},
        "log_folder": lambda: show_log_folder(window),
    }


def name_draft(window: MainWindow) -> None:
    """Name the draft, keeping the step and the frame in view."""
    key, frame = window.page.key if window.page else "", window.workspace.frame
    window.files.name_draft()
    window.show_step(key)
    if window.workspace.session is not None and frame in window.workspace.session.frames:
        window.workspace.show_frame(frame)


def measure(window: MainWindow, frames: list[int] | None) -> None:
    """Measure frames. None: those that are not measured or whose measures are out of date."""
    workspace, session = window.workspace, window.workspace.session
    if session is None:
        return
    why_not = ""
    if frames is None and not len(session.stale_frames()):
        why_not = "Every frame is measured and up to date"
    elif workspace.measuring is not None:
        why_not = "Frames are being measured already"
    if why_not:
        window.say(why_not)
        window.show_answer(why_not)
    elif why := why_not_measurable(session):
        workspace.say_wrong(MEASURING, why)
        window.show_answer(f"{PROBLEM} {why}")
    else:
        workspace.measure(frames, show_answer=window.show_answer)


def enter_setup(window: MainWindow) -> None:
    """Show the drawing of the bench."""
    from labapp.gui.pages.setup.page import BENCH_TAB, SetupPage

    window.show_step("setup")
    if isinstance(window.page, SetupPage):
        window.page.tabs.setCurrentIndex(BENCH_TAB)


def record(window: MainWindow) -> None:
    """Begin or end a recording of the live camera, regardless of the page in view."""
    if window.camera is None:
        window.say(NO_CAMERA, True)
    else:
        window.camera.trigger()


def mark(window: MainWindow) -> None:
    """Mark the present moment in the current recording."""
    if window.camera is None:
        window.say(NO_CAMERA, True)
    elif not window.camera.mark():
        window.say("Nothing is being recorded: there is nothing to mark")


def copy_picture(window: MainWindow) -> None:
    """Copy the picture of the page in view."""
    if window.page is not None:
        QApplication.clipboard().setPixmap(window.page.picture())
        window.say("The picture is on the clipboard")


def copy_table(window: MainWindow) -> None:
    """Copy the table with the focus, or the first one in view."""
    tables = [each for each in window.findChildren(QTableView) if each.isVisibleTo(window)]
    if not tables:
        window.say("This step has no table")
        return
    table = next((each for each in tables if each.hasFocus()), tables[0])
    QApplication.clipboard().setText(table_text(table))
    window.say("The table is on the clipboard")


def toggle_full_screen(window: MainWindow) -> None:
    """Switch between full screen and window."""
    if window.isFullScreen():
        window.showNormal()
    else:
        window.showFullScreen()


def show_help(window: MainWindow, kind: str) -> None:
    """Show the guide, the keys or the information about the program."""
    HelpDialog(kind, window, window.page).show()


def show_log_folder(window: MainWindow) -> None:
    """Open the folder with the log."""
    folder = log_file().parent
    if not QDesktopServices.openUrl(QUrl.fromLocalFile(str(folder))):
        window.say(f"The log is in {folder}")
