"""The live camera from anywhere in the window: recorded from and marked, whatever is in view."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from labapp.gui.pages.page import Page

NONE_LIVE = "No camera is watched: start one in the step Recording"


def live_page(pages: Iterable[Page]) -> Page | None:
    """The page that watches a camera, in view or not; None if none does."""
    return next((page for page in pages if page.live), None)


def trigger(pages: Iterable[Page], say: Callable[[str, bool], object]) -> None:
    """Begin a recording of the live camera, or end it."""
    page = live_page(pages)
    if page is None:
        say(NONE_LIVE, True)
    else:
        page.trigger()


def mark(pages: Iterable[Page], say: Callable[[str, bool], object]) -> None:
    """Note the present moment beside the recording that runs."""
    page = live_page(pages)
    if page is None:
        say(NONE_LIVE, True)
    elif not page.mark():
        say("Nothing is being recorded: there is nothing to mark", False)
