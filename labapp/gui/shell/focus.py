"""Keyboard focus: moving between parts of the window and into a part."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QStackedWidget, QWidget

from labapp.gui.widgets.fields import flush_fields


def go_to_part(parts: Sequence[QWidget], by: int) -> None:
    """Move the focus to the next part of a window that can have it, or the previous one (-1)."""
    parts = [part for part in parts if part.isVisibleTo(part.window())]
    focus = QApplication.focusWidget()
    here = [k for k, part in enumerate(parts) if focus is not None and _holds(part, focus)]
    start = here[0] if here else (-1 if by > 0 else 0)
    for k in range(1, len(parts) + 1):
        if give_keys(parts[(start + k * by) % len(parts)]):
            return


def give_keys(part: QWidget) -> bool:
    """Focus the widget of a part that had it last, or its first one; False if there is none."""
    # Not by nextInFocusChain: PySide takes its result for a child of the previous widget. The
    # window is last in the chain and would become invalid when the label before it is deleted.
    inside = part.findChildren(QWidget)
    last: QWidget | None = part.focusWidget()  # None for a part that never had them
    candidates = (last, part, *inside)
    found = next((each for each in candidates if each and takes_keys(each, part)), None)
    if found is not None:
        found.setFocus(Qt.FocusReason.TabFocusReason)
    return found is not None


def takes_keys(widget: QWidget, part: QWidget) -> bool:
    """Whether Tab would stop at a widget of a part."""
    stops = bool(widget.focusPolicy() & Qt.FocusPolicy.TabFocus) and widget.focusProxy() is None
    return stops and _holds(part, widget) and widget.isEnabled() and widget.isVisible()


def finish_edit(*parts: QWidget) -> None:
    """Remove the focus from some parts, and finish edits in progress in their fields."""
    focus = QApplication.focusWidget()
    if focus is not None and any(_holds(part, focus) for part in parts):
        focus.clearFocus()
    for part in parts:
        flush_fields(part)  # in an inactive window no field has the focus


def show_in(stack: QStackedWidget, seen: QWidget) -> None:
    """Show another widget of a stack, and give it the focus if it was in the former one.

    Qt would give it to a field beside, which takes the keys of the window: Space plays no frames.
    """
    former, focus = stack.currentWidget(), QApplication.focusWidget()
    if former is seen:
        return
    had_focus = former is not None and focus is not None and _holds(former, focus)
    stack.setCurrentWidget(seen)
    if had_focus:
        seen.setFocus()


def _holds(part: QWidget, widget: QWidget) -> bool:
    return part is widget or part.isAncestorOf(widget)
