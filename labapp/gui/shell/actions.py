"""Every action of the window as data: its menu, words, key, tip and what it needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from labapp.gui.shell.steps import STEPS

Needs = Literal["", "session", "frames", "measuring", "undo", "redo", "work", "live"]
"""What must be there for an action to be of use; it is greyed out without."""


@dataclass(frozen=True)
class Action:
    """One thing the operator can do from anywhere in the window; `commands` does it.

    Parameters
    ----------
    name
        In code; unique.
    menu
        Where it stands.
    text
        Its words there; ``&`` before the letter that chooses it, … where it asks something first.
    key
        Its key. One without Ctrl, Alt or F is first the key of what has the focus.
    tip
        What it does, a sentence.
    needs
        What must be there.
    checkable
        Whether it can be on or off.
    group
        Of actions of which one is on.
    begins
        Whether a line divides it from the one before.
    """

    name: str
    menu: str
    text: str
    key: str
    tip: str
    needs: Needs = ""
    checkable: bool = False
    group: str = ""
    begins: bool = False


MENUS = ("&File", "&Edit", "&Steps", "F&rames", "&View", "&Tools", "&Help")

FILE = (
    Action(
        "new",
        "&File",
        "&New session …",
        "Ctrl+N",
        "Make a file for a new experiment",
    ),
    Action(
        "open",
        "&File",
        "&Open …",
        "Ctrl+O",
        "Open a session",
    ),
    Action(
        "sample",
        "&File",
        "Try the &sample",
        "",
        "Open a copy of a recorded run that is measured already",
    ),
    Action(
        "copy",
        "&File",
        "Save a &copy …",
        "Ctrl+Shift+S",
        "Save the session as it is now under another name; you go on in this one",
        needs="session",
        begins=True,
    ),
    Action(
        "import",
        "&File",
        "&Import a recording …",
        "Ctrl+I",
        "Take frames from a video, an image or a stack into the session",
    ),
    Action(
        "export",
        "&File",
        "&Export …",
        "Ctrl+E",
        "Go to the step that writes tables, surfaces, pictures and the report",
        needs="session",
    ),
    Action(
        "close",
        "&File",
        "C&lose the session",
        "Ctrl+W",
        "Close the session and go back to the welcome page; everything is saved",
        needs="session",
        begins=True,
    ),
    Action(
        "quit",
        "&File",
        "&Quit",
        "Ctrl+Q",
        "Stop all work and end the program; everything is saved",
    ),
)

EDIT = (
    Action(
        "undo",
        "&Edit",
        "&Undo",
        "Ctrl+Z",
        "Take back the last change of set-up, calibration, settings, dots or rows",
        needs="undo",
    ),
    Action(
        "redo",
        "&Edit",
        "&Redo",
        "Ctrl+Shift+Z",
        "Make the change again that was taken back last",
        needs="redo",
    ),
    Action(
        "copy_picture",
        "&Edit",
        "Copy &picture",
        "Ctrl+Shift+C",
        "Copy the picture of this step to the clipboard",
        needs="session",
        begins=True,
    ),
    Action(
        "copy_table",
        "&Edit",
        "Copy &table",
        "Ctrl+Shift+T",
        "Copy the table of this step to the clipboard, for a spreadsheet",
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
        needs="measuring",
    ),
    Action(
        "measure_frame",
        "F&rames",
        "Measure this &frame",
        "Shift+F5",
        "Measure the frame in view",
        needs="measuring",
    ),
    Action(
        "cancel",
        "F&rames",
        "&Cancel the work",
        "Ctrl+.",
        "Stop the work under way; what is finished is kept",
        needs="work",
    ),
    Action(
        "previous",
        "F&rames",
        "Frame &before",
        "Left",
        "Go to the frame before this one",
        needs="frames",
        begins=True,
    ),
    Action(
        "next",
        "F&rames",
        "&Next frame",
        "Right",
        "Go to the frame after this one",
        needs="frames",
    ),
    Action(
        "first",
        "F&rames",
        "F&irst frame",
        "Home",
        "Go to the first frame",
        needs="frames",
    ),
    Action(
        "last",
        "F&rames",
        "&Last frame",
        "End",
        "Go to the last frame",
        needs="frames",
    ),
    Action(
        "play",
        "F&rames",
        "&Play",
        "Space",
        "Show one frame after another, or stop at this one",
        needs="frames",
        checkable=True,
    ),
    Action(
        "record",
        "F&rames",
        "&Record, or end the recording",
        "Ctrl+R",
        "Record what the live camera sees, or end that; Space does it, too, while a camera is live",
        needs="live",
        begins=True,
    ),
    Action(
        "mark",
        "F&rames",
        "Mar&k this moment",
        "Ctrl+K",
        "Note this moment beside the recording that runs; M does it, too, while a camera is live",
        needs="live",
    ),
    Action(
        "next_doubtful",
        "F&rames",
        "Next frame in &doubt",
        "F8",
        "Go to the next frame that could not be measured, stands out, or was changed since",
        needs="frames",
        begins=True,
    ),
    Action(
        "previous_doubtful",
        "F&rames",
        "Previous frame in d&oubt",
        "Shift+F8",
        "Go to the last frame before this one that stands out, or could not be measured",
        needs="frames",
    ),
    Action(
        "next_corrected",
        "F&rames",
        "Next corr&ected frame",
        "F7",
        "Go to the next frame that was corrected by hand",
        needs="frames",
    ),
    Action(
        "previous_corrected",
        "F&rames",
        "Pre&vious corrected frame",
        "Shift+F7",
        "Go to the last frame before this one that was corrected by hand",
        needs="frames",
    ),
)


STEP_ACTIONS = (
    *(
        Action(
            f"step_{step.key}",
            "&Steps",
            step.title,
            f"Ctrl+{number}" if number < 10 else "",
            step.hint,
            needs="session",
        )
        for number, step in enumerate(STEPS, 1)
    ),
    Action(
        "next_step",
        "&Steps",
        "&Next step",
        "Ctrl+PgDown",
        "Go on to the next step",
        needs="session",
        begins=True,
    ),
    Action(
        "previous_step",
        "&Steps",
        "&Previous step",
        "Ctrl+PgUp",
        "Go back to the step before",
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
        needs="session",
        checkable=True,
    ),
    Action(
        "panel",
        "&View",
        "P&arameters and results",
        "Ctrl+Shift+2",
        "Show or hide the panel at the right",
        needs="session",
        checkable=True,
    ),
    Action(
        "timeline",
        "&View",
        "&Timeline",
        "Ctrl+Shift+3",
        "Show or hide the frames at the bottom",
        needs="session",
        checkable=True,
    ),
    Action(
        "log",
        "&View",
        "&Messages",
        "F4",
        "Show or hide what the app has said since it was started",
        checkable=True,
    ),
    Action(
        "next_part",
        "&View",
        "&Next part of the window",
        "F6",
        "Give the keys to the next of steps, page, parameters and timeline",
        begins=True,
    ),
    Action(
        "previous_part",
        "&View",
        "Part of the window &before",
        "Shift+F6",
        "Give the keys to the part of the window before this one",
    ),
    Action(
        "theme_system",
        "&View",
        "As the &desktop",
        "",
        "Light or dark, as the desktop is",
        checkable=True,
        group="theme",
        begins=True,
    ),
    Action(
        "theme_light",
        "&View",
        "&Light",
        "",
        "Dark words on a light ground",
        checkable=True,
        group="theme",
    ),
    Action(
        "theme_dark",
        "&View",
        "Dar&k",
        "",
        "Light words on a dark ground, for a dark lab",
        checkable=True,
        group="theme",
    ),
    Action(
        "full_screen",
        "&View",
        "&Full screen",
        "F11",
        "Use all of the screen, or go back to a window",
        checkable=True,
        begins=True,
    ),
    Action(
        "reset_layout",
        "&View",
        "&Reset the layout",
        "",
        "Put the panels back where they were at the first start",
    ),
)


TOOLS = tuple(
    Action(name, "&Tools", text, key, tip)
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
    ),
    Action(
        "keys",
        "&Help",
        "&Keys",
        "Shift+F1",
        "Every action that has a key",
    ),
    Action(
        "log_folder",
        "&Help",
        "Show the &log folder",
        "",
        "Open the folder with the log, which tells what went wrong in full",
    ),
    Action(
        "about",
        "&Help",
        "&About labapp",
        "",
        "Version, licence and what it is built on",
        begins=True,
    ),
)

ACTIONS: tuple[Action, ...] = (*FILE, *EDIT, *STEP_ACTIONS, *FRAMES, *VIEW, *TOOLS, *HELP)
