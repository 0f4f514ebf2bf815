"""Every action of the window as data: its menu, words, key, tip and what it calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from labapp.gui.shell import filming
from labapp.gui.shell.action import Action
from labapp.gui.shell.focus import go_to_part
from labapp.gui.shell.steps import STEPS
from labapp.gui.tools import show_tool

if TYPE_CHECKING:
    from labapp.gui.shell.window import MainWindow

FILE = (
    Action(
        "new",
        "&File",
        "&New session …",
        "Ctrl+N",
        "Make a file for a new experiment",
        lambda window: window.files.new(),
    ),
    Action(
        "open",
        "&File",
        "&Open …",
        "Ctrl+O",
        "Open a session",
        lambda window: window.files.choose(),
    ),
    Action(
        "sample",
        "&File",
        "Try the &sample",
        "",
        "Open a copy of a recorded run that is measured already",
        lambda window: window.files.try_sample(),
    ),
    Action(
        "copy",
        "&File",
        "Save a &copy …",
        "Ctrl+Shift+S",
        "Save the session as it is now under another name; you go on in this one",
        lambda window: window.files.save_copy(),
        needs="session",
        begins=True,
    ),
    Action(
        "import",
        "&File",
        "&Import a recording …",
        "Ctrl+I",
        "Take frames from a video, an image or a stack into the session",
        lambda window: window.files.choose_recording(),
    ),
    Action(
        "export",
        "&File",
        "&Export …",
        "Ctrl+E",
        "Go to the step that writes tables, surfaces, pictures and the report",
        lambda window: window.show_step("export"),
        needs="session",
    ),
    Action(
        "close",
        "&File",
        "C&lose the session",
        "Ctrl+W",
        "Close the session and go back to the welcome page; everything is saved",
        lambda window: window.files.close(),
        needs="session",
        begins=True,
    ),
    Action(
        "quit",
        "&File",
        "&Quit",
        "Ctrl+Q",
        "Stop all work and end the program; everything is saved",
        lambda window: window.files.quit(),
    ),
)

EDIT = (
    Action(
        "undo",
        "&Edit",
        "&Undo",
        "Ctrl+Z",
        "Take back the last change of set-up, calibration, settings, dots or rows",
        lambda window: window.workspace.undo(),
        needs="undo",
    ),
    Action(
        "redo",
        "&Edit",
        "&Redo",
        "Ctrl+Shift+Z",
        "Make the change again that was taken back last",
        lambda window: window.workspace.redo(),
        needs="redo",
    ),
    Action(
        "copy_picture",
        "&Edit",
        "Copy &picture",
        "Ctrl+Shift+C",
        "Copy the picture of this step to the clipboard",
        lambda window: window.copy_picture(),
        needs="session",
        begins=True,
    ),
    Action(
        "copy_table",
        "&Edit",
        "Copy &table",
        "Ctrl+Shift+T",
        "Copy the table of this step to the clipboard, for a spreadsheet",
        lambda window: window.copy_table(),
        needs="session",
    ),
)

FRAMES = (
    Action(
        "measure",
        "F&rames",
        "&Measure what is not measured",
        "F5",
        "Measure every frame that is not measured, or whose measures no longer stand",
        lambda window: window.measure_all(),
        needs="measuring",
    ),
    Action(
        "measure_frame",
        "F&rames",
        "Measure this &frame",
        "Shift+F5",
        "Measure the frame in view",
        lambda window: window.measure_frame(),
        needs="measuring",
    ),
    Action(
        "cancel",
        "F&rames",
        "&Cancel the work",
        "Ctrl+.",
        "Stop the work under way; what is finished is kept",
        lambda window: window.status_line.cancel(),
        needs="work",
    ),
    Action(
        "previous",
        "F&rames",
        "Frame &before",
        "Left",
        "Go to the frame before this one",
        lambda window: window.timeline.step(-1),
        needs="frames",
        begins=True,
    ),
    Action(
        "next",
        "F&rames",
        "&Next frame",
        "Right",
        "Go to the frame after this one",
        lambda window: window.timeline.step(1),
        needs="frames",
    ),
    Action(
        "first",
        "F&rames",
        "F&irst frame",
        "Home",
        "Go to the first frame",
        lambda window: window.timeline.step(-(10**9)),
        needs="frames",
    ),
    Action(
        "last",
        "F&rames",
        "&Last frame",
        "End",
        "Go to the last frame",
        lambda window: window.timeline.step(10**9),
        needs="frames",
    ),
    Action(
        "play",
        "F&rames",
        "&Play",
        "Space",
        "Show one frame after another, or stop at this one",
        lambda window: window.timeline.set_playing(not window.timeline.playing),
        needs="frames",
        checked=lambda window: window.timeline.playing,
    ),
    Action(
        "record",
        "F&rames",
        "&Record, or end the recording",
        "Ctrl+R",
        "Record what the live camera sees, or end that; Space does it, too, while a camera is live",
        filming.trigger,
        needs="live",
        begins=True,
    ),
    Action(
        "mark",
        "F&rames",
        "Mar&k this moment",
        "Ctrl+K",
        "Note this moment beside the recording that runs; M does it, too, while a camera is live",
        filming.mark,
        needs="live",
    ),
    Action(
        "next_doubtful",
        "F&rames",
        "Next frame in &doubt",
        "F8",
        "Go to the next frame that could not be measured, stands out, or was changed since",
        lambda window: window.jump("doubtful", True),
        needs="frames",
        begins=True,
    ),
    Action(
        "previous_doubtful",
        "F&rames",
        "Previous frame in d&oubt",
        "Shift+F8",
        "Go to the last frame before this one that stands out, or could not be measured",
        lambda window: window.jump("doubtful", False),
        needs="frames",
    ),
    Action(
        "next_corrected",
        "F&rames",
        "Next corr&ected frame",
        "F7",
        "Go to the next frame that was corrected by hand",
        lambda window: window.jump("corrected", True),
        needs="frames",
    ),
    Action(
        "previous_corrected",
        "F&rames",
        "Pre&vious corrected frame",
        "Shift+F7",
        "Go to the last frame before this one that was corrected by hand",
        lambda window: window.jump("corrected", False),
        needs="frames",
    ),
)


def _go(key: str) -> Callable[[MainWindow], object]:
    return lambda window: window.show_step(key)


STEP_ACTIONS = (
    *(
        Action(
            f"step_{step.key}",
            "&Steps",
            step.title,
            f"Ctrl+{number}",
            step.hint,
            _go(step.key),
            "session",
        )
        for number, step in enumerate(STEPS, 1)
    ),
    Action(
        "next_step",
        "&Steps",
        "&Next step",
        "Ctrl+PgDown",
        "Go on to the next step",
        lambda window: window.go_step(1),
        needs="session",
        begins=True,
    ),
    Action(
        "previous_step",
        "&Steps",
        "&Previous step",
        "Ctrl+PgUp",
        "Go back to the step before",
        lambda window: window.go_step(-1),
        needs="session",
    ),
)

VIEW = (
    Action(
        "steps",
        "&View",
        "&Steps",
        "Ctrl+Shift+1",
        "Show or hide the steps at the left",
        lambda window: window.toggle_dock("steps"),
        needs="session",
        checked=lambda window: window.dock_is_wanted("steps"),
    ),
    Action(
        "panel",
        "&View",
        "P&arameters and results",
        "Ctrl+Shift+2",
        "Show or hide the panel at the right",
        lambda window: window.toggle_dock("panel"),
        needs="session",
        checked=lambda window: window.dock_is_wanted("panel"),
    ),
    Action(
        "timeline",
        "&View",
        "&Timeline",
        "Ctrl+Shift+3",
        "Show or hide the frames at the bottom",
        lambda window: window.toggle_dock("timeline"),
        needs="session",
        checked=lambda window: window.dock_is_wanted("timeline"),
    ),
    Action(
        "log",
        "&View",
        "&Messages",
        "F4",
        "Show or hide what the app has said since it was started",
        lambda window: window.toggle_dock("log"),
        checked=lambda window: window.dock_is_wanted("log"),
    ),
    Action(
        "next_part",
        "&View",
        "&Next part of the window",
        "F6",
        "Give the keys to the next of steps, page, parameters and timeline",
        lambda window: go_to_part(window, 1),
        begins=True,
    ),
    Action(
        "previous_part",
        "&View",
        "Part of the window &before",
        "Shift+F6",
        "Give the keys to the part of the window before this one",
        lambda window: go_to_part(window, -1),
    ),
    Action(
        "theme_system",
        "&View",
        "As the &desktop",
        "",
        "Light or dark, as the desktop is",
        lambda window: window.set_theme("system"),
        checked=lambda window: window.preferences.theme == "system",
        group="theme",
        begins=True,
    ),
    Action(
        "theme_light",
        "&View",
        "&Light",
        "",
        "Dark words on a light ground",
        lambda window: window.set_theme("light"),
        checked=lambda window: window.preferences.theme == "light",
        group="theme",
    ),
    Action(
        "theme_dark",
        "&View",
        "Dar&k",
        "",
        "Light words on a dark ground, for a dark lab",
        lambda window: window.set_theme("dark"),
        checked=lambda window: window.preferences.theme == "dark",
        group="theme",
    ),
    Action(
        "full_screen",
        "&View",
        "&Full screen",
        "F11",
        "Use all of the screen, or go back to a window",
        lambda window: window.toggle_full_screen(),
        checked=lambda window: window.isFullScreen(),
        begins=True,
    ),
    Action(
        "reset_layout",
        "&View",
        "&Reset the layout",
        "",
        "Put the panels back where they were at the first start",
        lambda window: window.reset_layout(),
    ),
)


def _show(key: str) -> Callable[[MainWindow], object]:
    return lambda window: show_tool(window, key)


TOOLS = tuple(
    Action(name, "&Tools", text, key, tip, _show(name))
    for name, text, key, tip in (
        (
            "simulator",
            "&Simulator …",
            "Ctrl+Shift+M",
            "Render a recording of a pool that is known, with the truth about every dot",
        ),
        (
            "adviser",
            "Configuration &adviser …",
            "Ctrl+Shift+A",
            "Where laser and imaging plane should stand for the pools that are expected",
        ),
        (
            "analysis",
            "&Error analysis …",
            "Ctrl+Shift+E",
            "How large the error is, and what makes it: the budget of a set-up, and chapter 8",
        ),
    )
)

HELP = (
    Action(
        "guide",
        "&Help",
        "&Guide",
        "F1",
        "What to do, step by step",
        lambda window: window.show_help("guide"),
    ),
    Action(
        "keys",
        "&Help",
        "&Keys",
        "Shift+F1",
        "Every action that has a key",
        lambda window: window.show_help("keys"),
    ),
    Action(
        "log_folder",
        "&Help",
        "Show the &log folder",
        "",
        "Open the folder with the log, which tells what went wrong in full",
        lambda window: window.show_log_folder(),
    ),
    Action(
        "about",
        "&Help",
        "&About labapp",
        "",
        "Version, licence and what it is built on",
        lambda window: window.show_help("about"),
        begins=True,
    ),
)

ACTIONS: tuple[Action, ...] = (*FILE, *EDIT, *STEP_ACTIONS, *FRAMES, *VIEW, *TOOLS, *HELP)
