from __future__ import annotations

from PySide6.QtGui import QKeySequence
from PySide6.QtWidgets import QApplication

from labapp.gui.actions import ACTIONS, MENUS
from labapp.gui.help import TEXTS
from labapp.gui.steps import STEPS
from labapp.gui.window import MainWindow


def test_every_action_is_whole():
    names = [action.name for action in ACTIONS]
    assert len(set(names)) == len(names)
    keys = [QKeySequence(action.key).toString() for action in ACTIONS if action.key]
    assert all(keys)
    assert len(set(keys)) == len(keys)
    for action in ACTIONS:
        assert action.menu in MENUS
        assert len(action.tip) > 10
        assert not action.tip.endswith(".") or action.menu == "&Steps"
        assert callable(action.call)
    assert {f"step_{step.key}" for step in STEPS} <= set(names)


def test_the_letters_of_a_menu_are_its_own():
    for menu in MENUS:
        texts = [action.text for action in ACTIONS if action.menu == menu]
        letters = [text[text.index("&") + 1].lower() for text in texts if "&" in text]
        assert len(set(letters)) == len(letters), menu
    letters = [menu[menu.index("&") + 1].lower() for menu in MENUS]
    assert len(set(letters)) == len(letters)


def test_every_action_is_in_the_menu_with_its_tip(window: MainWindow):
    for name, made in window.menus.actions.items():
        assert made.toolTip(), name
        assert made.text(), name
        assert made.parent() is window
    shown = {action.name for action in ACTIONS if not action.name.startswith("step_")}
    assert shown <= set(window.menus.actions)


def test_without_a_session_only_what_is_of_use_is_enabled(window: MainWindow):
    enabled = {name for name, made in window.menus.actions.items() if made.isEnabled()}
    assert {"new", "open", "sample", "import", "quit", "guide"} <= enabled
    assert not {"undo", "redo", "copy", "close", "measure", "next", "cancel"} & enabled


def test_help_names_every_step_and_key(qapp: QApplication):
    guide, keys = TEXTS["guide"](), TEXTS["keys"]()
    for step in STEPS:
        assert step.title in guide
    for action in ACTIONS:
        if action.key:
            assert QKeySequence(action.key).toString() in keys
