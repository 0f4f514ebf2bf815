"""The live camera from anywhere in the window: recorded from and marked, whatever is in view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from labapp.gui import dialogs

if TYPE_CHECKING:
    from labapp.gui.pages.page import Page
    from labapp.gui.shell.window import MainWindow

NONE_LIVE = "No camera is watched: start one in the step Recording"


def live_page(window: MainWindow) -> Page | None:
    """The page that watches a camera, in view or not; None if none does."""
    return next((page for page in window.pages.values() if page.live), None)


def trigger(window: MainWindow) -> None:
    """Begin a recording of the live camera, or end it."""
    page = live_page(window)
    if page is None:
        window.say(NONE_LIVE, True)
    else:
        page.trigger()


def may_close(window: MainWindow) -> bool:
    """Ask what becomes of a recording that runs; False if it is to go on, and nothing closed."""
    page = live_page(window)
    take = None if page is None else page.recording
    if page is None or take is None:
        return True
    answer = dialogs.ask_recording_end(window, take.path.name)
    if answer == "discard":
        page.discard(take)
    return answer != "go on"


def mark(window: MainWindow) -> None:
    """Note the present moment beside the recording that runs."""
    page = live_page(window)
    if page is None:
        window.say(NONE_LIVE, True)
    elif not page.mark():
        window.say("Nothing is being recorded: there is nothing to mark")
