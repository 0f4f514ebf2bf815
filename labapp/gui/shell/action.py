"""What an action of the window is, and the menus that actions stand in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
