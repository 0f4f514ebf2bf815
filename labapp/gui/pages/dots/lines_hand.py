"""Correcting the lines of a frame: what is chosen, and edits that are each one step of undo."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Qt
from PySide6.QtGui import QAction

from labapp.core.lines.correction import (
    LineCorrection,
    cut_line,
    delete_line,
    join_lines,
    nearest_line,
    number_line,
)
from labapp.gui.pages.dots.lines import LinesState
from labapp.gui.pages.dots.lines_view import LinesOverlay, LinesPanel
from labapp.gui.pages.page import Page
from labapp.gui.views.drag_point import SHIFT
from labapp.gui.views.picture import Tool

MakeAction = Callable[[str, str, str, Callable[[], object]], QAction]
"""Makes an action of the page: its words, its key, what it does in a sentence, and it."""

REACH = 12.0
"""A line is meant by a pointer this near, in points of the screen."""

CUT_WHERE = "Click where the line is to be cut (Esc: leave it)"

UNMET = {
    "lines": "There are no lines that can be corrected in this frame",
    "line": "Select a line first",
    "two": "Select two lines first",
    "corrected": "This frame is as it was found: nothing was corrected",
}


class LinesHand(Tool):
    """Chooses lines by clicks and corrects them.

    Parameters
    ----------
    page, overlay
        Whose frame it works on, and the lines over its picture.
    make_action, pointer
        Makes an action of the page; says where the pointer is in the frame.
    """

    def __init__(
        self,
        page: Page,
        overlay: LinesOverlay,
        make_action: MakeAction,
        pointer: Callable[[], tuple[float, float] | None],
    ) -> None:
        self._page, self._overlay = page, overlay
        self._make_action, self._pointer = make_action, pointer
        self.state = LinesState("")
        """What is shown."""
        self.chosen: list[int] = []
        """Places of the chosen lines, from the lowest up."""
        self._cuts = False
        self._needs: list[tuple[QAction, str, str]] = []
        self.actions = [
            self._action("Cut", "C", "Cut a line in two: click where", self.cut, "lines"),
            self._action("Join", "J", "Join the two selected lines", self.join, "two"),
            self._action("Delete", "Del", "Delete the selected lines", self.delete, "line"),
            self._action("Select none", "Esc", "Select no line, or cancel a cut", self.escape, ""),
            self._action("Back to automatic", "Ctrl+Backspace",
                         "Forget the corrections of this frame", self.automatic, "corrected"),
        ]  # fmt: skip
        self.panel = LinesPanel(self.actions)
        """What stands beside the frame."""
        listed = self.panel.lines
        listed.itemSelectionChanged.connect(lambda: self.choose(listed.places))
        self.panel.number.edited.connect(self.number)

    def _action(
        self, text: str, key: str, tip: str, do: Callable[[], object], need: str
    ) -> QAction:
        action = self._make_action(text, key, tip, do)
        self._needs.append((action, action.toolTip(), need))
        action.setEnabled(False)
        return action

    # --- what is shown and chosen -------------------------------------------------------------

    def show(self, state: LinesState, same_frame: bool) -> None:
        """Work on what a frame shows now."""
        if not same_frame or len(state.lines) != len(self.state.lines):
            self.chosen = []
        self.state = state
        self._draw()

    def choose(self, lines: list[int]) -> None:
        """Choose lines."""
        self.chosen = lines
        self._draw()

    def _draw(self) -> None:
        page, state = self._page, self.state
        self._overlay.show(state.lines, self.chosen)
        number = 0
        if len(self.chosen) == 1 and state.correction is not None:
            number = int(state.correction.number[self.chosen[0]])
        why = page.locked or ("" if len(self.chosen) == 1 else UNMET["line"])
        self.panel.show_chosen(self.chosen, CUT_WHERE if self._cuts else "", number, why)
        there = {
            "": True,
            "lines": state.correction is not None and bool(state.lines),
            "line": bool(self.chosen),
            "two": len(self.chosen) == 2,
            "corrected": state.by_hand,
        }
        for action, tip, need in self._needs:
            unmet = page.locked if page.locked and need else "" if there[need] else UNMET[need]
            action.setEnabled(page.session.has_lines and not unmet)
            action.setToolTip(f"{unmet}. {tip}" if unmet else tip)

    def click(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> None:
        """Choose the line at a place, Shift: in addition; or cut it there."""
        if self._cuts:
            self._cuts = False
            self.cut_at(u, v)
            return
        line = self._at(u, v)
        if line is None:
            self.choose(self.chosen if modifiers & SHIFT else [])
        elif modifiers & SHIFT:
            self.choose(sorted(set(self.chosen) ^ {line[0]}))
        else:
            self.choose([line[0]])

    def point_out(self, u: float, v: float) -> None:
        """Choose the line for the menu, unless it is among the chosen ones."""
        line = self._at(u, v)
        if line is None or line[0] not in self.chosen:
            self.choose([] if line is None else [line[0]])

    def _at(self, u: float, v: float) -> tuple[int, int] | None:
        """Line at a place and its point there; None without one."""
        if self.state.correction is None or not self.state.lines:
            return None
        line, point, away = nearest_line(self.state.correction.seen.lines, u, v)
        return (line, point) if away <= REACH * self._overlay.px_per_point else None

    def escape(self) -> None:
        """Choose no line; no cut is awaited any more."""
        self._cuts = False
        self.choose([])

    # --- edits --------------------------------------------------------------------------------

    def cut(self) -> None:
        """Cut the line under the pointer; without one there, where the next click is."""
        place = self._pointer()
        if place is not None and self._at(*place) is not None:
            self.cut_at(*place)
        else:
            self._cuts = True
            self._draw()

    def cut_at(self, u: float, v: float) -> None:
        """Cut the line at a place."""
        at = self._at(u, v)

        def edit(now: LineCorrection) -> LineCorrection:
            if at is None:
                raise ValueError("there is no line: click on one to cut it")
            return cut_line(now, *at)

        self._edit("cut a line", edit)

    def join(self) -> None:
        """Join the two chosen lines."""
        one, other = self.chosen
        self._edit("join two lines", lambda now: join_lines(now, one, other))

    def delete(self) -> None:
        """Delete the selected lines."""
        chosen = sorted(self.chosen, reverse=True)

        def edit(now: LineCorrection) -> LineCorrection:
            for line in chosen:
                now = delete_line(now, line)
            return now

        self._edit("delete lines", edit)

    def number(self, value: float | None) -> None:
        """Give the chosen line its number in the pattern; None leaves it to be found."""
        if len(self.chosen) == 1:
            line, rig = self.chosen[0], self._page.session.setup.line_rig
            assert rig is not None
            number, count = int(value or 0), rig.pattern.count
            self._edit("number a line", lambda now: number_line(now, line, number, count))

    def automatic(self) -> None:
        """Forget the correction."""
        self._edit("back to automatic", lambda _: None)

    def _edit(self, label: str, edit: Callable[[LineCorrection], LineCorrection | None]) -> None:
        state, frame = self.state, self._page.workspace.frame
        if state.correction is None:
            return
        begun = state.correction
        self._page.workspace.attempt(
            lambda session: session.correct({frame: edit(begun)}, f"{label}, frame {frame}")
        )
        self._draw()
