"""Correction of the lines of a frame: selection, and edits that are each one step of undo."""

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
from labapp.gui.pages.dots import presenter
from labapp.gui.pages.dots.line_overlay import LinesOverlay, LinesPanel
from labapp.gui.pages.dots.line_presenter import LinesState
from labapp.gui.pages.page import Page
from labapp.gui.views.drag_point import SHIFT
from labapp.gui.views.picture import Tool

MakeAction = Callable[[str, str, str, Callable[[], object]], QAction]
"""Creates an action of the page from its text, key, tip and function."""

REACH = 12.0
"""Largest distance of the pointer from a line to select it, points of the screen."""

CUT_WHERE = "Click where the line is to be cut (Esc: leave it)"

UNMET = {
    "lines": "There are no lines that can be corrected in this frame",
    "line": "Select a line first",
    "two": "Select two lines first",
    "corrected": presenter.UNMET["corrected"],
}


class LineTool(Tool):
    """Selection of lines by clicks, and their correction.

    Parameters
    ----------
    page, overlay
        The page of the frame, and the lines over its picture.
    make_action, pointer
        Creates an action of the page; returns the position of the pointer in the frame.
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
        """The displayed data."""
        self.chosen: list[int] = []
        """Positions of the selected lines, counted from the lowest up."""
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
        """Panel at the side of the frame."""
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
        """Show the data of a frame."""
        if not same_frame or len(state.lines) != len(self.state.lines):
            self.chosen = []
        self.state = state
        self._draw()

    def choose(self, lines: list[int]) -> None:
        """Select lines."""
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
        """Select the line at a position (Shift: add it to the selection), or cut it there."""
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
        """Select the line for the menu, unless it is selected already."""
        line = self._at(u, v)
        if line is None or line[0] not in self.chosen:
            self.choose([] if line is None else [line[0]])

    def _at(self, u: float, v: float) -> tuple[int, int] | None:
        """Line at a position and its point there; None if there is none."""
        if self.state.correction is None or not self.state.lines:
            return None
        line, point, away = nearest_line(self.state.correction.seen.lines, u, v)
        return (line, point) if away <= REACH * self._overlay.px_per_point else None

    def escape(self) -> None:
        """Clear the selection, and cancel a pending cut."""
        self._cuts = False
        self.choose([])

    # --- edits --------------------------------------------------------------------------------

    def cut(self) -> None:
        """Cut the line under the pointer, or else at the next click."""
        place = self._pointer()
        if place is not None and self._at(*place) is not None:
            self.cut_at(*place)
        else:
            self._cuts = True
            self._draw()

    def cut_at(self, u: float, v: float) -> None:
        """Cut the line at a position."""
        at = self._at(u, v)

        def edit(now: LineCorrection) -> LineCorrection:
            if at is None:
                raise ValueError("there is no line: click on one to cut it")
            return cut_line(now, *at)

        self._edit("cut a line", edit)

    def join(self) -> None:
        """Join the two selected lines."""
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
        """Set the number of the selected line in the pattern; None: determine it automatically."""
        if len(self.chosen) == 1:
            line, rig = self.chosen[0], self._page.session.setup.line_rig
            assert rig is not None
            number, count = int(value or 0), rig.pattern.count
            self._edit("number a line", lambda now: number_line(now, line, number, count))

    def automatic(self) -> None:
        """Remove the correction."""
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
