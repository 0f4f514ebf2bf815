"""Every page and dialog is usable by keyboard and with a screen reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PySide6.QtCore import QCoreApplication, QEvent, Qt, QTimer
from PySide6.QtGui import QAccessible
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractScrollArea,
    QAbstractSlider,
    QAbstractSpinBox,
    QApplication,
    QCheckBox,
    QComboBox,
    QDialog,
    QLabel,
    QLineEdit,
    QListWidget,
    QMenu,
    QMessageBox,
    QPlainTextEdit,
    QPushButton,
    QScrollArea,
    QSpinBox,
    QTabBar,
    QTableWidget,
    QTextBrowser,
    QWidget,
)
from pytestqt.qtbot import QtBot
from shiboken6 import isValid

from labapp.gui import dialogs
from labapp.gui.shell.actions import ACTIONS
from labapp.gui.shell.help import HelpDialog
from labapp.gui.shell.steps import STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.tools import TOOLS
from labapp.gui.tools.dynamics_presenter import draw
from labapp.gui.tools.tool import ToolWindow
from labapp.gui.views.canvas import Drawn, Plotted
from labapp.run.study.plan import StudyPlan, StudyRecording
from labapp.run.study.status import RecordingStatus
from labapp.run.study.summary import StudySummary
from labapp.studies.analysis import AnalysisPart
from labapp.studies.tables import Table
from tests.core.dynamics_truth import analysed_step
from tests.gui.conftest import CopySample, let_draw

Role = QAccessible.Role

ROLES: tuple[tuple[type[QWidget], set[QAccessible.Role]], ...] = (
    (QCheckBox, {Role.CheckBox}),
    (QAbstractButton, {Role.Button, Role.ButtonMenu, Role.CheckBox}),
    (QComboBox, {Role.ComboBox}),
    (QAbstractSpinBox, {Role.SpinBox}),
    (QAbstractSlider, {Role.Slider}),
    (QLineEdit, {Role.EditableText}),
    (QPlainTextEdit, {Role.EditableText}),
    (QTextBrowser, {Role.EditableText, Role.StaticText, Role.Document}),
    (QTabBar, {Role.PageTabList}),
    (QTableWidget, {Role.Table}),
    (QListWidget, {Role.List}),
    (Plotted, {Role.Chart}),
    (Drawn, {Role.Graphic}),
    (QAbstractScrollArea, {Role.Client}),
)
"""Allowed accessible roles by widget type; the first matching type counts."""

CANVASES = {
    "plane": {"Picture of the target"},
    "bench_check": {"Picture of the mirror"},
    "capture": {"Frame of the recording"},
    "dots": {"Frame with its dots"},
    "surface": {"The pool in 3-D", "Reflected dots on the imaging plane", "Height profile"},
    "trends": {"Trends over the recording"},
}
"""Accessible names of the canvases of each page, which the keyboard must reach."""

MOST = 200
"""More focus stops than any page has."""


@pytest.fixture
def opened(window: MainWindow, copy_sample: CopySample, qtbot: QtBot) -> MainWindow:
    """The active window with a measured session."""
    assert window.files.open(copy_sample("gtaw"))
    qtbot.waitUntil(window.isActiveWindow)
    return window


def stops(window: QWidget, key: Qt.Key) -> list[QWidget]:
    """Widgets that a key moves the focus to, until the cycle is complete."""
    visited: list[QWidget] = []
    for _ in range(MOST):
        QTest.keyClick(QApplication.focusWidget() or window, key)
        focused = QApplication.focusWidget()
        assert focused is not None, "the keys went to nothing"
        if focused in visited:
            assert focused is visited[0], f"caught at {spoken(focused)}"
            return visited
        visited.append(focused)
    raise AssertionError(f"{key} does not come round")


def controls(window: QWidget) -> set[QWidget]:
    """Widgets that can get the focus: enabled, visible, and not part of another control."""
    tab = Qt.FocusPolicy.TabFocus
    return {
        each
        for each in window.findChildren(QWidget)
        if each.focusPolicy() & tab
        and each.focusProxy() is None
        and each.isEnabled()
        and each.isVisible()
        and each.window() is window
    }


def spoken(widget: QWidget) -> str:
    """The name that a screen reader speaks: the label's and the widget's own."""
    interface = QAccessible.queryAccessibleInterface(widget)
    labels = [
        label.text(QAccessible.Text.Name)
        for label, kind in interface.relations()
        if kind & QAccessible.RelationFlag.Label
    ]
    return " ".join([*labels, widget.accessibleName() or interface.text(QAccessible.Text.Name)])


def check_spoken(widget: QWidget) -> None:
    """Check that a widget has a name in words, a suitable role and a description."""
    interface = QAccessible.queryAccessibleInterface(widget)
    name = spoken(widget).strip()
    assert len(name) > 1 or name.isalpha(), f"{widget} has no name"
    assert type(widget).__name__ not in name
    assert any(letter.isalpha() for letter in name), f"{name!r} is no word"
    if isinstance(widget, QComboBox):  # its own name would be the choice
        assert widget.accessibleName(), widget.currentText()
    roles = next((roles for kind, roles in ROLES if isinstance(widget, kind)), None)
    assert roles is not None, f"{widget}: what is it to a screen reader?"
    assert interface.role() in roles, f"{name}: {interface.role()}"
    described = interface.text(QAccessible.Text.Description)
    assert described or isinstance(widget, QTabBar), f"{name} says nothing of what it does"
    if not isinstance(widget, QTabBar | QAbstractScrollArea | Drawn | QAbstractSlider):
        assert widget.toolTip(), f"{name} has no tip"


def check_round(window: QWidget) -> list[QWidget]:
    """Check that Tab and Shift+Tab cycle through all controls, and that each is described."""
    forward = stops(window, Qt.Key.Key_Tab)
    missed = controls(window) - set(forward)
    assert not missed, f"not reached: {sorted(spoken(each) for each in missed)}"
    backward = stops(window, Qt.Key.Key_Backtab)
    assert set(backward) == set(forward)
    for widget in forward:
        check_spoken(widget)
    return forward


@pytest.mark.parametrize("step", [step.key for step in STEPS])
def test_page_is_keyboard_accessible(opened: MainWindow, step: str, qtbot: QtBot):
    opened.do(f"step_{step}")
    page = opened.page
    assert page is not None
    assert page.key == step
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    let_draw()
    reached = check_round(opened)
    names = {each.accessibleName() for each in reached if page.isAncestorOf(each)}
    empty = opened.stack.currentWidget() is opened.empty
    assert empty or CANVASES.get(step, set()) <= names
    for drawn in page.findChildren(Drawn):
        if drawn.isVisible():
            interface = QAccessible.queryAccessibleInterface(drawn)
            assert interface.role() in (Role.Graphic, Role.Chart)
            assert drawn.accessibleName()
            assert drawn.accessibleDescription()


@pytest.mark.parametrize("tab", [0, 1, 2])
def test_setup_tabs_are_keyboard_accessible(opened: MainWindow, tab: int):
    opened.show_step("setup")
    tabs = opened.page.tabs  # type: ignore[union-attr]
    bar = tabs.tabBar()
    bar.setFocus()
    for _ in range(tab):
        QTest.keyClick(bar, Qt.Key.Key_Right)
    assert tabs.currentIndex() == tab
    check_round(opened)


def test_scheme_comparison_is_keyboard_accessible(opened: MainWindow, qtbot: QtBot):
    opened.show_step("surface")
    opened.page.comparing.click()  # type: ignore[union-attr]
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    let_draw()
    check_round(opened)


def test_pages_fit_a_small_screen_at_150_percent(opened: MainWindow, qtbot: QtBot):
    """1366 × 768 px are then 911 × 512 logical pixels."""
    opened.do("log")
    for step in STEPS:
        opened.show_step(step.key)
    opened.page.workspace.show_frame(1)  # type: ignore[union-attr]
    for step in STEPS:
        opened.show_step(step.key)
        if step.key == "surface":
            opened.page.comparing.click()  # type: ignore[union-attr]
        qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
        opened.resize(911, 512)
        let_draw()
        assert (opened.width(), opened.height()) == (911, 512), step.key
        for area in opened.findChildren(QScrollArea):
            cut = area.isVisible() and area.horizontalScrollBar().maximum() > 0
            assert not cut, area.accessibleName()
        for button in opened.findChildren(QAbstractButton):
            if button.isVisible() and button.text():
                assert button.width() >= button.sizeHint().width() - 1, button.text()


def test_welcome_page_is_keyboard_accessible(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    window.files.open(copy_sample("thumb_tack"))
    window.do("close")
    qtbot.waitUntil(lambda: window.isActiveWindow() and not window.workspace.tasks.active)
    reached = check_round(window)
    assert window.welcome.list in reached
    window.welcome.list.setFocus()
    QTest.keyClick(window.welcome.list, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: window.workspace.session is not None)


def test_f6_cycles_through_the_parts_of_the_window(opened: MainWindow, qtbot: QtBot):
    opened.show_step("dots")
    opened.do("log")
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    parts = [opened.step_list, opened.page, opened.side_panel, opened.timeline, opened.log_panel]

    def focused_part() -> int:
        focus = QApplication.focusWidget()
        return next(k for k, part in enumerate(parts) if part is focus or part.isAncestorOf(focus))

    opened.step_list.setFocus()
    visited = []
    for modifier in [Qt.KeyboardModifier.NoModifier] * 5 + [Qt.KeyboardModifier.ShiftModifier] * 5:
        QTest.keyClick(QApplication.focusWidget(), Qt.Key.Key_F6, modifier)
        visited.append(focused_part())
    assert visited == [1, 2, 3, 4, 0, 4, 3, 2, 1, 0]
    opened.say("The recording is gone", True)
    parts.append(opened.status_line)
    QTest.keyClick(opened, Qt.Key.Key_F6, Qt.KeyboardModifier.ShiftModifier)
    assert QApplication.focusWidget() is opened.status_line.dismiss_button


def test_f6_returns_to_the_last_focused_widget(opened: MainWindow):
    opened.show_step("trends")
    button = opened.timeline.play_button
    button.setFocus()
    opened.do("next_part")
    opened.do("previous_part")
    assert QApplication.focusWidget() is button


def test_step_shortcuts_move_the_focus_to_the_page(opened: MainWindow):
    for step in STEPS:
        opened.side_panel.setFocus()
        opened.do(f"step_{step.key}")
        focus = QApplication.focusWidget()
        shown = opened.stack.currentWidget()
        assert focus is shown or shown.isAncestorOf(focus)
        assert shown.accessibleName() == step.title
    opened.step_list.setFocus()
    QTest.keyClick(opened.step_list, Qt.Key.Key_Up)
    assert QApplication.focusWidget() is opened.step_list


def test_screen_reader_changes_the_frame(opened: MainWindow):
    scrubber = opened.timeline.scrubber
    value = QAccessible.queryAccessibleInterface(scrubber).valueInterface()
    assert (value.minimumValue(), value.maximumValue()) == (0, 29)
    value.setCurrentValue(7)
    assert opened.workspace.frame == 7
    opened.workspace.show_frame(3)
    assert value.currentValue() == 3
    assert "Frame 3" in scrubber.accessibleDescription()


def test_every_action_has_a_shortcut_or_unique_mnemonic(opened: MainWindow):
    for action in ACTIONS:
        assert action.key or "&" in action.text, action.name
    menus = [action.menu() for action in opened.menuBar().actions()]
    menus += [menu for menu in opened.findChildren(QMenu) if menu not in menus]
    check_mnemonics_unique([action.text() for action in opened.menuBar().actions()])
    for menu in menus:
        actions = [each for each in menu.actions() if not each.isSeparator()]
        check_mnemonics_unique([each.text() for each in actions])
        for each in actions:
            assert each.menu() is not None or each.toolTip(), each.text()


def check_mnemonics_unique(texts: list[str]) -> None:
    plain = [text.replace("&&", "") for text in texts]
    letters = [text[text.index("&") + 1].lower() for text in plain if "&" in text]
    assert len(set(letters)) == len(letters), texts


@pytest.mark.parametrize("kind", ["guide", "keys", "about"])
def test_help_is_keyboard_accessible(window: MainWindow, kind: str, qtbot: QtBot):
    window.do(kind)
    dialog = next(each for each in window.findChildren(HelpDialog))
    qtbot.waitUntil(dialog.isActiveWindow)
    check_round(dialog)
    QTest.keyClick(dialog, Qt.Key.Key_Escape)
    assert not dialog.isVisible()


@pytest.mark.usefixtures("little_search")
@pytest.mark.parametrize("key", TOOLS)
def test_tool_windows_are_keyboard_accessible(opened: MainWindow, key: str, qtbot: QtBot):
    opened.do(key)
    tool = opened.findChild(ToolWindow, f"tool-{key}")
    assert tool is not None
    qtbot.waitUntil(tool.isActiveWindow)
    assert tool.form.isAncestorOf(QApplication.focusWidget())
    before = tips(tool)
    FILL[key](tool, qtbot)
    qtbot.waitUntil(lambda: not tool.working)
    for one, (enabled, tip) in tips(tool).items():
        if before[one][0] != enabled:
            assert before[one][1] != tip, f"{one.text()}: no reason why it is disabled"
    reached = check_round(tool)
    enabled = [button for button in (tool.start_button, tool.close_button) if button.isEnabled()]
    assert [each for each in reached if each in enabled] == enabled
    assert tool.form.isAncestorOf(reached[(reached.index(tool.close_button) + 1) % len(reached)])
    assert all(each.window() is tool for each in reached)
    tool.resize(819, 460)  # 1366 × 768 at 150 %
    let_draw()
    assert (tool.width(), tool.height()) == (819, 460)
    for button in tool.findChildren(QAbstractButton):
        if button.isVisible() and button.text():
            assert button.width() >= button.sizeHint().width() - 1, button.text()
    QTest.keyClick(tool, Qt.Key.Key_Escape)
    assert not tool.isVisible()


def tips(tool: ToolWindow) -> dict[QPushButton, tuple[bool, str]]:
    """Whether each button of a tool is enabled, and its tooltip."""
    buttons = tool.findChildren(QPushButton)
    return {each: (each.isEnabled(), each.toolTip()) for each in buttons}


def fill_simulator(tool: Any, qtbot: QtBot) -> None:
    """Show the first frame and a written recording."""
    qtbot.waitUntil(lambda: tool.preview is not None)
    tool.made = tool.preview.scenario, Path("here")
    tool.show_state()


def fill_adviser(tool: Any, qtbot: QtBot) -> None:
    """Show an advice: the one that nothing is possible takes least time."""
    for key, ends in (("pools.height_mm", (0.5, 0.6)), ("bench.distance_mm", (40.0, 40.0))):
        tool.ranges[key].set_value(ends)
    tool.effort.set_value("quick")
    tool.start()
    qtbot.waitUntil(lambda: tool.advice is not None)
    tool.costs.show_table(Table("costs", "Costs", ("quantity", "cost_um"), (("s", 1.0),)))
    tool.groups[-1].show()


def fill_analysis(tool: Any, qtbot: QtBot) -> None:
    """Show one finished part."""
    table = Table("error_budget", "Budget", ("source", "predicted_pct"), (("dots", 1.0),))
    tool.show_part(AnalysisPart((table,), {}, (table,)))


def fill_dynamics(tool: Any, qtbot: QtBot) -> None:
    """Show modes, an event and a response."""
    qtbot.waitUntil(lambda: not tool.working)
    tool.show_found(draw(analysed_step(), lambda: None))
    tool.events.selectRow(0)


def fill_study(tool: Any, qtbot: QtBot) -> None:
    """Show a recording and results."""
    recording = StudyRecording("first", Path("first.avi"), Path("setup.toml"))
    status = RecordingStatus(recording, "done", "", 3, 3)
    plan = StudyPlan("study", (recording,), ())
    tool.study = SimpleNamespace(plan=plan, folder=Path("results"))
    tool.found = [status]
    tool._show_summary(StudySummary("study", (), (), (), ()))
    tool.list.selectRow(0)


FILL = {
    "dynamics": fill_dynamics,
    "study": fill_study,
    "simulator": fill_simulator,
    "adviser": fill_adviser,
    "analysis": fill_analysis,
}


def test_deleting_a_label_deletes_no_other_widget(opened: MainWindow):
    box, label = QSpinBox(opened), QLabel(opened)
    line = box.lineEdit()
    for _ in range(4):
        opened.do("next_part")
    label.deleteLater()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    assert isValid(line)
    assert isValid(opened.windowHandle())


def test_read_only_question_is_keyboard_accessible(window: MainWindow, copy_sample: CopySample):
    path, reached = copy_sample("thumb_tack"), []

    def look() -> None:
        box = QApplication.activeModalWidget()
        if box is None or not box.isActiveWindow():  # a busy machine takes its time
            QTimer.singleShot(20, look)
            return
        assert isinstance(box, QMessageBox)
        try:
            reached.extend(check_round(box))
        finally:
            QTest.keyClick(box, Qt.Key.Key_Escape)

    QTimer.singleShot(50, look)
    assert not dialogs.ask_read_only(window, path)
    assert len(reached) == 2


def test_check_round_finds_accessibility_faults(qtbot: QtBot):
    """`check_round` on windows with one fault each."""

    class Greedy(QLineEdit):
        def event(self, event):  # type: ignore[no-untyped-def]
            if event.type() == event.Type.KeyPress and event.key() == Qt.Key.Key_Tab:
                return True
            return super().event(event)

    def shown(*widgets: QWidget) -> QDialog:
        dialog = QDialog()
        qtbot.addWidget(dialog)
        for widget in widgets:
            widget.setParent(dialog)
        dialog.show()
        qtbot.waitUntil(dialog.isActiveWindow)
        return dialog

    def fails(check: Callable[[], object], words: str) -> None:
        with pytest.raises(AssertionError, match=words):
            check()

    fails(lambda: check_round(shown(QLineEdit(), Greedy(), QLineEdit())), "not reached: .'', ''")
    fails(lambda: check_round(shown(QLineEdit())), "has no name")
    named = QLineEdit()
    named.setAccessibleName("Title")
    fails(lambda: check_round(shown(named)), "says nothing")
    label, combo = QLabel("Way"), QComboBox()
    combo.addItem("fit")
    label.setBuddy(combo)
    fails(lambda: check_round(shown(label, combo)), "fit")
