"""Every action of the window as data: its menu, text, key, tip and requirement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from labapp.gui.shell.steps import STEPS

Needs = Literal[
    "", "session", "draft", "changing", "frames", "measuring", "undo", "redo", "work", "live"
]
"""Requirement of an action, which is greyed out if it is not met."""


@dataclass(frozen=True)
class Action:
    """One thing the operator can do from anywhere in the window; `commands` does it."""

    name: str
    """Unique name used in code."""
    text: str
    """Text in the menu; ``&`` before the mnemonic letter, … if the action asks something first."""
    key: str
    """Key of the action. One without Ctrl, Alt or F goes to the focused widget first."""
    tip: str
    """Explanation in one sentence."""
    needs: Needs = ""
    checkable: bool = False
    group: str = ""
    """Group of actions of which exactly one is on."""
    begins: bool = False
    """Whether a line separates it from the previous one."""
    menu: str = ""


FILE = (
    Action("open_recording", "Open recor&ding…", "Ctrl+Shift+O",
        "See a video, an image or a stack at once, in a session that needs no name yet"),
    Action("new", "&New session…", "Ctrl+N", "Make a file for a new experiment"),
    Action("open", "&Open session…", "Ctrl+O", "Open a session"),
    Action("sample", "Try the &sample", "",
        "Open a copy of a recorded run that is measured already"),
    Action("name_draft", "N&ame this session…", "Ctrl+S",
        "Move the draft to a folder of yours, under a name; all of it is saved already",
        needs="draft", begins=True),
    Action("copy", "Save a &copy…", "Ctrl+Shift+S",
        "Save the session as it is now under another name; this one stays open", needs="session"),
    Action("import", "&Import recording…", "Ctrl+I",
        "Take frames from a video, an image or a stack into the session", needs="session"),
    Action("load_setup", "Load set-&up…", "",
        "Take the set-up from a setup file (TOML); frames that are there are measured",
        needs="changing", begins=True),
    Action("last_setup", "Use las&t set-up", "",
        "Take the set-up of the session opened last that has a complete one, and measure",
        needs="changing"),
    Action("other_setup", "Set-up o&f a session…", "",
        "Take set-up and calibrations of another session, and measure", needs="changing"),
    Action("enter_setup", "Enter set-u&p", "",
        "Go to the drawing of the bench and enter its dimensions", needs="session"),
    Action("export", "&Export…", "Ctrl+E",
        "Go to the step that writes tables, surfaces, pictures and the report", needs="session"),
    Action("close", "C&lose the session", "Ctrl+W",
        "Close the session and go back to the welcome page; everything is saved", needs="session",
        begins=True),
    Action("quit", "&Quit", "Ctrl+Q", "Stop all work and end the program; everything is saved"),
)  # fmt: skip

EDIT = (
    Action("undo", "&Undo", "Ctrl+Z",
        "Undo the last change of set-up, calibration, settings, dots or rows", needs="undo"),
    Action("redo", "&Redo", "Ctrl+Shift+Z", "Redo the change that was undone last", needs="redo"),
    Action("copy_picture", "Copy &picture", "Ctrl+Shift+C",
        "Copy the picture of this step to the clipboard", needs="session", begins=True),
    Action("copy_table", "Copy &table", "Ctrl+Shift+T",
        "Copy the table of this step to the clipboard, for a spreadsheet", needs="session"),
)  # fmt: skip

FRAMES = (
    Action("measure", "&Measure all frames", "F5",
        "Measure every frame that is not measured, or whose measures are out of date",
        needs="measuring"),
    Action("measure_frame", "Measure this &frame", "Shift+F5",
        "Measure the frame in view", needs="measuring"),
    Action("cancel", "&Cancel the work", "Ctrl+.",
        "Stop the work under way; what is finished is kept", needs="work"),
    Action("previous", "Previo&us frame", "Left",
        "Go to the frame before this one", needs="frames", begins=True),
    Action("next", "&Next frame", "Right", "Go to the frame after this one", needs="frames"),
    Action("first", "F&irst frame", "Home", "Go to the first frame", needs="frames"),
    Action("last", "&Last frame", "End", "Go to the last frame", needs="frames"),
    Action("play", "&Play", "Space",
        "Show one frame after another, or stop at this one", needs="frames", checkable=True),
    Action("record", "&Record, or end the recording", "Ctrl+R",
        "Record what the live camera sees, or end that; Space does it, too, while a camera is live",
        needs="live", begins=True),
    Action("mark", "Mar&k this moment", "Ctrl+K",
        "Note this moment beside the recording that runs; M does it, too, while a camera is live",
        needs="live"),
    Action("next_doubtful", "Next frame &to check", "F8",
        "Go to the next frame that is in doubt, out of date or could not be measured",
        needs="frames", begins=True),
    Action("previous_doubtful", "Previous frame t&o check", "Shift+F8",
        "Go to the last frame before this one that is in doubt, out of date or could not be "
        "measured", needs="frames"),
    Action("next_corrected", "Next corr&ected frame", "F7",
        "Go to the next frame that was corrected by hand", needs="frames"),
    Action("previous_corrected", "Pre&vious corrected frame", "Shift+F7",
        "Go to the last frame before this one that was corrected by hand", needs="frames"),
)  # fmt: skip


STEP_ACTIONS = (
    *(
        Action(f"step_{step.key}", step.title, f"Ctrl+{number % 10}" if number <= 10 else "",
            step.hint, needs="session")
        for number, step in enumerate(STEPS, 1)
    ),
    Action("next_step", "&Next step", "Ctrl+PgDown",
        "Go on to the next step", needs="session", begins=True),
    Action("previous_step", "&Previous step", "Ctrl+PgUp",
        "Go back to the step before", needs="session"),
)  # fmt: skip

VIEW = (
    Action("steps", "&Steps", "Ctrl+Shift+1",
        "Show or hide the steps at the left", needs="session", checkable=True),
    Action("panel", "P&arameters and results", "Ctrl+Shift+2",
        "Show or hide the panel at the right", needs="session", checkable=True),
    Action("timeline", "&Timeline", "Ctrl+Shift+3",
        "Show or hide the frames at the bottom", needs="session", checkable=True),
    Action("log", "&Messages", "F4",
        "Show or hide all messages since the app was started", checkable=True),
    Action("next_part", "&Next part of the window", "F6",
        "Move the keyboard focus to the next of steps, page, parameters and timeline", begins=True),
    Action("previous_part", "Previo&us part of the window", "Shift+F6",
        "Move the keyboard focus to the part of the window before this one"),
    Action("theme_system", "As the &desktop", "",
        "Light or dark, as the desktop is", checkable=True, group="theme", begins=True),
    Action("theme_light", "&Light", "",
        "Dark text on a light ground", checkable=True, group="theme"),
    Action("theme_dark", "Dar&k", "",
        "Light text on a dark ground, for a dark lab", checkable=True, group="theme"),
    Action("full_screen", "&Full screen", "F11",
        "Use all of the screen, or go back to a window", checkable=True, begins=True),
    Action("reset_layout", "&Reset the layout", "",
        "Put the panels back where they were at the first start"),
)  # fmt: skip


TOOLS = (
    Action("dynamics", "Pool &over time…", "Ctrl+Shift+D",
        "Oscillations, modes, events and step responses of the session's pool"),
    Action("study", "St&udy of many recordings…", "Ctrl+Shift+R",
        "Measure many recordings with the same settings, and compare them by condition"),
    Action("simulator", "&Simulator…", "Ctrl+Shift+M",
        "Render a recording of a known pool, with the true place of every dot"),
    Action("adviser", "Configuration &adviser…", "Ctrl+Shift+A",
        "Where laser and imaging plane should stand for the pools that are expected"),
    Action("analysis", "&Error analysis…", "Ctrl+Shift+E",
        "How large the error is, and what makes it: the budget of a set-up, and chapter 8"),
)  # fmt: skip

HELP = (
    Action("guide", "&Guide", "F1", "What to do, step by step"),
    Action("keys", "&Keys", "Shift+F1", "Every action that has a key"),
    Action("log_folder", "Show the &log folder", "",
        "Open the folder with the log, which has every error in full"),
    Action("about", "&About labapp", "", "Version, licence and what it is built on", begins=True),
)  # fmt: skip

BY_MENU = {
    "&File": FILE,
    "&Edit": EDIT,
    "&Steps": STEP_ACTIONS,
    "F&rames": FRAMES,
    "&View": VIEW,
    "&Tools": TOOLS,
    "&Help": HELP,
}

MENUS = tuple(BY_MENU)

ACTIONS: tuple[Action, ...] = tuple(
    replace(action, menu=menu) for menu, actions in BY_MENU.items() for action in actions
)
