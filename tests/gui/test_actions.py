from __future__ import annotations

from pathlib import Path

import pytest
from PySide6.QtCore import QUrl
from PySide6.QtGui import QAction, QKeySequence, QTextDocument
from PySide6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot

from labapp.gui.shell import help as help_texts
from labapp.gui.shell.actions import ACTIONS, MENUS
from labapp.gui.shell.commands import commands
from labapp.gui.shell.help import HelpDialog, keys
from labapp.gui.shell.steps import STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.views import picture, plots, view3d
from tests.gui.conftest import CopySample


def test_every_action_is_complete():
    names = [action.name for action in ACTIONS]
    assert len(set(names)) == len(names)
    keys = [QKeySequence(action.key).toString() for action in ACTIONS if action.key]
    assert all(keys)
    assert len(set(keys)) == len(keys)
    for action in ACTIONS:
        assert action.menu in MENUS
        assert len(action.tip) > 10
        assert not action.tip.endswith(".") or action.menu == "&Steps"
    assert {f"step_{step.key}" for step in STEPS} <= set(names)


def test_actions_and_commands_correspond(window: MainWindow):
    assert sorted(commands(window)) == sorted(action.name for action in ACTIONS)


def test_active_toggles_are_checked(window: MainWindow):
    def checked() -> set[str]:
        return {name for name, action in window.menus.actions.items() if action.isChecked()}

    checkable = {name for name, action in window.menus.actions.items() if action.isCheckable()}
    assert checkable == {each.name for each in ACTIONS if each.checkable}
    initial = {"steps", "panel", "timeline", "theme_dark"}
    assert checked() == initial
    for name in sorted(checkable - initial - {"play"}):  # there is nothing to play
        window.do(name)
        assert name in checked()
    assert checked() >= initial - {"theme_dark"}
    assert len({name for name in checked() if name.startswith("theme_")}) == 1


def test_menu_mnemonics_are_unique():
    for menu in MENUS:
        texts = [action.text for action in ACTIONS if action.menu == menu]
        letters = [text[text.index("&") + 1].lower() for text in texts if "&" in text]
        assert len(set(letters)) == len(letters), menu
    letters = [menu[menu.index("&") + 1].lower() for menu in MENUS]
    assert len(set(letters)) == len(letters)


def test_every_menu_action_has_text_and_tooltip(window: MainWindow):
    for name, action in window.menus.actions.items():
        assert action.toolTip(), name
        assert action.text(), name
        assert action.parent() is window
    shown = {each.name for each in ACTIONS if not each.name.startswith("step_")}
    assert shown <= set(window.menus.actions)


def test_only_usable_actions_are_enabled_without_a_session(window: MainWindow):
    enabled = {name for name, action in window.menus.actions.items() if action.isEnabled()}
    assert {"open_recording", "new", "open", "sample", "quit", "guide"} <= enabled
    assert not {"undo", "redo", "copy", "close", "measure", "next", "cancel"} & enabled


def test_help_lists_every_shortcut(qapp: QApplication):
    key_list = keys()
    for action in ACTIONS:
        if action.key:
            assert QKeySequence(action.key).toString() in key_list


def test_help_lists_keys_of_the_visible_page_and_drawings(qtbot: QtBot) -> None:
    page = QWidget()
    qtbot.addWidget(page)
    page.setAccessibleName("Dots")
    action = QAction("Row left", page)
    action.setShortcut(QKeySequence("Ctrl+Left"))
    action.setToolTip("Shift the row (Ctrl+Left)")
    page.addAction(action)
    text = keys(page)
    assert "This page: Dots" in text
    assert "<b>Row left</b></td><td>Shift the row</td>" in text
    for words in (picture.KEYS, view3d.KEYS_TOLD, plots.KEYS):
        assert words in keys()


def test_guide_opens_at_the_visible_page_with_pictures(window: MainWindow, copy_sample: CopySample):
    assert window.files.open(copy_sample("gtaw"))
    window.show_step("trends")
    window.do("guide")
    (dialog,) = window.findChildren(HelpDialog)
    browser = dialog.browser
    assert browser.source().fileName() == "trends.md"
    assert "Trends" in browser.toPlainText()
    picture = browser.loadResource(
        QTextDocument.ResourceType.ImageResource.value, QUrl("pictures/trends-spectrum.png")
    )
    assert 0 < picture.width() <= browser.viewport().width()
    browser.anchorClicked.emit(QUrl("surface.md"))
    assert browser.source().fileName() == "surface.md"
    browser.anchorClicked.emit(QUrl("nowhere.md"))
    assert browser.source().fileName() == "surface.md"
    for step in STEPS:
        browser.show_page(step.key)
        assert step.title in browser.toPlainText()
    dialog.close()


def test_missing_guide_is_reported(
    window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(help_texts, "bundled", lambda name: tmp_path / name)
    window.do("guide")
    (dialog,) = window.findChildren(HelpDialog)
    assert dialog.browser.toPlainText() == "The guide did not come with this installation."
    dialog.close()
