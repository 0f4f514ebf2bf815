"""A session that is open read-only is shown as such on every page, with the reason."""

from __future__ import annotations

import errno

import pytest
from PySide6.QtWidgets import QAbstractButton, QCheckBox, QComboBox, QLineEdit
from pytestqt.qtbot import QtBot

from labapp.gui import dialogs
from labapp.gui.shell.steps import READ_ONLY, STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.fields import ChoiceField, Field, NumberField
from labapp.session.file import database
from labapp.session.session import Session
from tests.gui.conftest import CopySample


def enter_something(field: Field) -> None:
    """Enter another value, as a user does."""
    editor = field.editor
    if isinstance(field, NumberField):
        field._step(1)
        field.flush()
    elif isinstance(field, ChoiceField) and isinstance(editor, QComboBox):
        editor.setCurrentIndex((editor.currentIndex() + 1) % editor.count())
        editor.activated.emit(editor.currentIndex())
    elif isinstance(editor, QLineEdit):
        editor.setText("x")
        editor.editingFinished.emit()


def test_enabled_fields_accept_input(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
) -> None:
    window.workspace.show(Session.open(copy_sample("gtaw"), read_only=True))
    messages: list[str] = []
    window.workspace.notified.connect(lambda words, problem: messages.append(words))
    entered = 0
    for step in STEPS:
        window.show_step(step.key)
        qtbot.waitUntil(lambda: not window.workspace.tasks.active)
        assert window.side_panel.read_only.isVisible()
        panel = window.page.panel
        usable = [e for e in panel.findChildren(Field) if e.isVisible() and e.editor.isEnabled()]
        for field in usable:
            enter_something(field)
        for box in panel.findChildren(QCheckBox):
            if box.isEnabled() and box.isVisible():
                box.click()
        entered += len(usable)
        assert [words for words in messages if "read-only" in words] == []
    assert entered > 0  # values that only the page uses can still be entered


def test_session_in_a_folder_that_cannot_be_written_is_offered_read_only(
    window: MainWindow, copy_sample: CopySample, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, asked = copy_sample("gtaw"), []

    def fail(_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    def ask(*given: object) -> bool:
        asked.append(given)
        return True

    with monkeypatch.context() as patch:
        patch.setattr(database, "acquire", fail)
        patch.setattr(dialogs, "ask_read_only", ask)
        assert window.files.open(path)
    assert asked == [(window, path, False)]
    session = window.workspace.session
    assert session is not None
    assert (session.path, session.read_only) == (path, True)
    assert window.status_line.unread == []


def test_locked_fields_give_a_reason_and_unlock_with_the_session(
    window: MainWindow, copy_sample: CopySample
) -> None:
    path = copy_sample("gtaw")
    window.workspace.show(Session.open(path))
    window.show_step("setup")
    page = window.page
    height, notes = page.rig_fields["electrode.height_mm"], page.record_fields["notes"]
    tick = next(iter(page.ticks.values()))
    tips = [each.toolTip() for each in (height.editor, notes.editor, tick)]
    assert window.menus.actions["measure"].isEnabled()
    assert not window.side_panel.read_only.isVisible()

    window.workspace.show(Session.open(path, read_only=True))
    window.show_step("setup")
    for each in (height.editor, notes.editor, tick):
        assert each.toolTip() == READ_ONLY
    assert not height.editor.isEnabled()
    assert not tick.isEnabled()
    assert notes.editor.isReadOnly()  # but can be scrolled and copied
    assert not window.menus.actions["measure"].isEnabled()
    for key in ("laser", "plane", "bench_check"):
        window.show_step(key)
        assert not window.page.use_button.isEnabled()
    assert not window.page.add_button.isEnabled()
    window.show_step("surface")
    assert not window.page.side.one.isEnabled()
    assert READ_ONLY in window.page.side.one.toolTip()

    window.workspace.show(Session.open(path))
    window.show_step("setup")
    assert height.editor.isEnabled()
    assert tick.isEnabled()
    assert not notes.editor.isReadOnly()
    assert [each.toolTip() for each in (height.editor, notes.editor, tick)] == tips
    assert window.menus.actions["measure"].isEnabled()


def tips(window: MainWindow, qtbot: QtBot) -> dict[str, tuple[bool, str]]:
    """Whether each visible button of the pages is enabled, and its tooltip."""
    found = {}
    for step in STEPS:
        window.show_step(step.key)
        qtbot.waitUntil(lambda: not window.workspace.tasks.active)
        for side in (window.page, window.page.panel):
            for each in side.findChildren(QAbstractButton):
                if each.isVisible() and each.text():
                    found[f"{step.key}: {each.text()}"] = each.isEnabled(), each.toolTip()
    return found


def test_disabled_buttons_give_a_reason(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
) -> None:
    path = copy_sample("gtaw")
    window.workspace.show(Session.open(path))
    usual = tips(window, qtbot)
    window.workspace.show(Session.open(path, read_only=True))
    locked = tips(window, qtbot)
    disabled = {name for name in usual if usual[name][0] and not locked[name][0]}
    assert {"trends: Load table…", "plane: Find O′ and the axes"} <= disabled
    assert not {name for name in disabled if locked[name][1] == usual[name][1]}
    assert not {name for name in disabled if READ_ONLY not in locked[name][1]}
