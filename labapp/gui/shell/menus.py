"""The menus, made from the declared actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QKeyCombination, Qt
from PySide6.QtGui import QAction, QActionGroup, QKeyEvent, QKeySequence
from PySide6.QtWidgets import QMainWindow, QMenu

from labapp.gui.shell.actions import MENUS, Action, Needs
from labapp.gui.widgets.labels import plain_tip

if TYPE_CHECKING:
    from labapp.gui.shell.steps import Step
    from labapp.session.session import Session


class Menus:
    """The window's menus, and the states of their actions."""

    def __init__(
        self,
        window: QMainWindow,
        actions: Sequence[Action],
        do: Callable[[str], object],
        open_session: Callable[[Path], object],
    ) -> None:
        self._window = window
        self._needs = {action.name: action.needs for action in actions}
        self._do = do
        self._open_session = open_session
        self.actions: dict[str, QAction] = {}
        """The Qt actions by their names."""
        self._plain: dict[QKeyCombination, str] = {}
        self._menus = {title: window.menuBar().addMenu(title) for title in MENUS}
        groups: dict[str, QActionGroup] = {}
        for action in actions:
            made = self._made(action)
            if action.group:
                groups.setdefault(action.group, QActionGroup(window)).addAction(made)
        self.recent = QMenu("Open &recent", window)
        self.recent.setToolTipsVisible(True)
        self._menus["&File"].insertMenu(self.actions["sample"], self.recent)

    def _made(self, action: Action) -> QAction:
        window, menu = self._window, self._menus[action.menu]
        made = QAction(action.text, window)
        made.setObjectName(action.name)
        made.setToolTip(f"{action.tip} ({action.key})" if action.key else action.tip)
        made.setStatusTip(action.tip)
        made.setMenuRole(QAction.MenuRole.NoRole)
        made.setCheckable(action.checkable)
        made.triggered.connect(lambda *_: self._do(action.name))
        keys = QKeySequence(action.key)
        combination = QKeyCombination() if keys.isEmpty() else keys[0]  # type: ignore[index]
        if action.key and is_plain(combination):
            self._plain[combination] = action.name
            made.setText(f"{action.text}\t{keys.toString(QKeySequence.SequenceFormat.NativeText)}")
        elif action.key:
            made.setShortcut(keys)
        if action.begins:
            menu.addSeparator()
        menu.setToolTipsVisible(True)
        menu.addAction(made)
        self.actions[action.name] = made
        return made

    def key(self, event: QKeyEvent) -> bool:
        """Run the action of a plain key that was not handled; returns whether there is one."""
        name = self._plain.get(event.keyCombination())
        if name is None or not self.actions[name].isEnabled():
            return False
        self._do(name)
        return True

    def refresh(
        self, there: Mapping[Needs, bool], on: Mapping[str, bool], undo: str, redo: str
    ) -> None:
        """Update which actions are enabled and checked, and the texts of undo and redo."""
        for name, made in self.actions.items():
            made.setEnabled(there[self._needs[name]])
        for name, is_on in on.items():
            self.actions[name].setChecked(is_on)
        self.actions["undo"].setText(f"&Undo {undo}".rstrip())
        self.actions["redo"].setText(f"&Redo {redo}".rstrip())

    def show_titles(self, steps: Sequence[Step]) -> None:
        """Show the titles of the steps in the session."""
        for step in steps:
            self.actions[f"step_{step.key}"].setText(step.title)

    def show_recent(self, paths: tuple[str, ...]) -> None:
        """List the recently opened sessions."""
        self.recent.clear()
        self.recent.setEnabled(bool(paths))
        for number, name in enumerate(paths, 1):
            path = Path(name)
            text = f"{path.stem} — {path.parent}".replace("&", "&&")
            made = self.recent.addAction(f"&{number} {text}" if number < 10 else text)
            made.setToolTip(plain_tip(name))
            made.triggered.connect(lambda *_, chosen=path: self._open_session(chosen))


def is_plain(key: QKeyCombination) -> bool:
    """Whether a key goes to the focused widget first: no Ctrl, no Alt, and not F1 … F12."""
    held = key.keyboardModifiers()
    function = Qt.Key.Key_F1 <= key.key() <= Qt.Key.Key_F12
    return not function and held in (
        Qt.KeyboardModifier.NoModifier,
        Qt.KeyboardModifier.ShiftModifier,
    )


def steps_of(session: Session | None) -> tuple[str, str]:
    """Labels of the changes that undo and redo would affect; empty without one."""
    if session is None or session.read_only:
        return "", ""
    history = session.history
    standing = [change.label for change in history if not change.undone]
    undone = [change.label for change in history if change.undone]
    return (standing[-1] if standing else ""), (undone[0] if undone else "")
