"""Random actions on the real window: a key, a click, a drag, text, a file, a step, undo …"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from PySide6.QtCore import QEvent, QMimeData, QPoint, QPointF, Qt, QUrl
from PySide6.QtGui import QDropEvent, QKeyEvent, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QComboBox,
    QMenu,
    QTableView,
    QWidget,
)

from labapp.gui.foot_switches import CALLS
from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.pages.laser.page import LaserPage
from labapp.gui.pages.setup.page import SetupPage
from labapp.gui.preferences import Preferences, read_preferences
from labapp.gui.shell.commands import make_window
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.fields import Field, NumberField, TextField
from tests.gui.conftest import KEPT
from tests.gui.watching import Files
from tests.gui.witness import Witness

KEY, BUTTON = Qt.Key, Qt.MouseButton
NONE, SHIFT, CONTROL, ALT = (
    Qt.KeyboardModifier.NoModifier,
    Qt.KeyboardModifier.ShiftModifier,
    Qt.KeyboardModifier.ControlModifier,
    Qt.KeyboardModifier.AltModifier,
)

KEYS = (
    "A B C D E F H I J K L M N O P R S T U W X Y Z 0 1 2 3 4 5 6 7 8 9 Plus Minus Period Comma "
    "BracketLeft BracketRight Left Right Up Down Home End PageUp PageDown Return Enter Escape "
    "Delete Backspace Tab Backtab Space Insert Menu F1 F2 F4 F5 F6 F7 F8"
).split()

CHOOSING = ((CONTROL, KEY.Key_A), *((NONE, getattr(KEY, f"Key_{k}")) for k in "D Period W".split()))
EDITING = (
    *((NONE, getattr(KEY, f"Key_{k}")) for k in "A Delete N U S M B R Left Up".split()),
    *((SHIFT, getattr(KEY, f"Key_{k}")) for k in "S R Down".split()),
    *((CONTROL, getattr(KEY, f"Key_{k}")) for k in "Left Right Return Backspace".split()),
)
"""Keys of the dots page."""

PURPOSES = {
    "setup": ("Use defaults", "Load…", "Laser goggles are worn", "Water cooling is on"),
    "laser": ("Apply",),
    "plane": ("Load picture…", "Find O′ and the axes", "Apply"),
    "bench_check": ("Add picture…", "Predict ± by pictures", "Check", "Apply", "Remove"),
    "capture": (
        *("Choose file…", "New session from this recording…", "Import"),
        *("Start", "● Record", "Mark", "Take a frame", "Learn a pedal"),
        *("Lines of JSON over TCP", "Other machines may connect", "Acknowledge"),
        "Stop camera",
    ),
    "surface": ("Along X", "Compare", "&This frame", "Copy"),
    "trends": ("Load table…", "Width", "Height"),
    "export": ("Measures", "PLY", "Export"),
}
"""Texts of buttons, in the order in which they are pressed."""

TEXTS = (
    *("", " ", "0", "-1", "1", "2", "7", "1e9", "-1e-9", "nan", "inf", "1,5", "3.14", "0.77"),
    *("abc", "12 mm", "°", "日本語", "1" * 400, "'; DROP TABLE document; --", "../x", "\\0"),
)

SIZES = ((1280, 760), (1366, 768), (1920, 1080), (900, 600), (400, 300))

BUSY_S = 0.4
"""Longest wait for a task that an action started; then the next action follows."""

PATIENCE_S = 3.0
"""Longest wait for dots before they are corrected."""


@dataclass
class Run:
    """The state of a run.

    Parameters
    ----------
    files
        Files that can be chosen.
    witness
        Knows what each session must contain.
    random
        Random numbers of the current action.
    window
        The open window.
    played
        The actions so far, one per line.
    faults
        Faults so far.
    """

    files: Files
    witness: Witness
    random: random.Random
    window: MainWindow
    played: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    @property
    def page(self) -> str:
        """Key of the visible page."""
        page = self.window.page
        return "welcome" if page is None else page.key

    def check(self) -> None:
        """Check that every file contains the acknowledged changes."""
        self.faults += self.witness.differences()

    def rest(self, most_s: float) -> None:
        """Let background tasks run until they are done or the time is over."""
        end = time.monotonic() + most_s
        QApplication.processEvents()
        while self.window.workspace.tasks.active and time.monotonic() < end:
            time.sleep(0.005)
            QApplication.processEvents()


def open_window(folder: Path) -> MainWindow:
    """Open a window with the stored preferences, as the program does."""
    file = folder / "preferences.json"
    preferences, problem = read_preferences(file) if file.exists() else (Preferences(), "")
    assert not problem, problem
    window = make_window(preferences, file)
    KEPT.append(window)
    window.resize(*SIZES[0])
    window.apply_theme()
    window.show()
    window.activateWindow()
    QApplication.processEvents()
    return window


class RandomHand:
    """Performs random actions; each method describes what it did.

    Parameters
    ----------
    run
        The run whose window is used.

    Attributes
    ----------
    kinds
        By name: the relative frequency and the method.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self.kinds: dict[str, tuple[int, Callable[[], str]]] = {
            "menu": (10, self._menu), "step": (9, self._step), "key": (12, self._key),
            "click": (12, self._click), "button": (16, self._button), "drag": (9, self._drag),
            "purpose": (18, self._purpose), "type": (14, self._type), "cell": (3, self._cell),
            "choose": (7, self._choose), "undo": (6, self._undo), "frame": (5, self._frame),
            "measure": (3, self._measure), "cancel": (2, self._cancel), "wheel": (3, self._wheel),
            "drop": (3, self._drop), "reopen": (3, self._reopen), "quit": (1, self._quit),
            "resize": (1, self._resize), "pedal": (4, self._pedal),
        }  # fmt: skip

    def act(self, kind: str) -> str:
        """Perform an action of this kind."""
        return self.kinds[kind][1]()

    # --- keys and words ---------------------------------------------------------------------

    def _press(self, key: Qt.Key, modifiers: Qt.KeyboardModifier = NONE) -> None:
        if QApplication.activeWindow() is None:  # after a dialog; a desktop would activate it again
            _activate(self._run.window)
        QTest.keyClick(QApplication.focusWidget() or self._run.window, key, modifiers)
        QApplication.processEvents()

    def _write(self, text: str, widget: QWidget) -> None:
        """Type into the widget with the focus, or into `widget`; QTest types ASCII only."""
        for letter in text:
            focused = QApplication.focusWidget() or widget
            if letter.isascii():
                QTest.keyClicks(focused, letter)
            else:
                event = QKeyEvent(QEvent.Type.KeyPress, 0, NONE, letter)
                QApplication.sendEvent(focused, event)

    def _key(self) -> str:
        rng = self._run.random
        name = rng.choice(KEYS)
        modifiers = rng.choices([NONE, SHIFT, CONTROL, ALT], [12, 3, 4, 1])[0]
        if modifiers == CONTROL and name == "W":
            modifiers = NONE
        times = rng.choice([1, 1, 1, 2, 5])
        for _ in range(times):
            self._press(getattr(KEY, f"Key_{name}"), modifiers)
        return f"{modifiers.name} {name} × {times}"

    def _menu(self) -> str:
        actions = self._run.window.menus.actions
        usable = [
            name
            for name, action in actions.items()
            if action.isEnabled() and name not in ("quit", "full_screen")
        ]
        name = self._run.random.choice(usable)
        actions[name].trigger()
        return name

    def _step(self) -> str:
        number = self._run.random.choice([1, 1, 2, 3, 4, 5, 5, 5, 6, 7, 8])
        self._press(KEY(KEY.Key_0 + number), CONTROL)
        return str(number)

    def _undo(self) -> str:
        modifiers = self._run.random.choice([CONTROL, CONTROL | SHIFT])
        times = self._run.random.choice([1, 1, 2, 4])
        for _ in range(times):
            QTest.keyClick(self._run.window, KEY.Key_Z, modifiers)
        return f"{'undo' if modifiers == CONTROL else 'redo'} × {times}"

    def _frame(self) -> str:
        names = "previous next first last play next_doubtful previous_corrected".split()
        action = self._run.window.menus.actions[self._run.random.choice(names)]
        if action.isEnabled():
            action.trigger()
        return action.objectName()

    def _measure(self) -> str:
        modifiers = self._run.random.choice([NONE, SHIFT])
        QTest.keyClick(self._run.window, KEY.Key_F5, modifiers)
        return f"{modifiers.name} F5"

    def _pedal(self) -> str:
        """Press a configured pedal."""
        name = self._run.random.choice(list(CALLS.values()))
        self._run.window.workspace.foot_switches.pressed.emit(name)
        return name

    def _cancel(self) -> str:
        QTest.keyClick(self._run.window, KEY.Key_Period, CONTROL)
        return "Ctrl+."

    # --- the mouse --------------------------------------------------------------------------

    def _seen(self, *kinds: type[QWidget]) -> list[QWidget]:
        """Enabled widgets of these types that the mouse can reach, in a fixed order."""
        reachable = []
        for window in QApplication.topLevelWidgets():
            if not window.isVisible() or isinstance(window, QMenu):
                continue
            for widget in window.findChildren(QWidget):
                if isinstance(widget, kinds) and widget.isVisible() and widget.isEnabled():
                    target = window.childAt(widget.mapTo(window, widget.rect().center()))
                    if target is not None and (target is widget or widget.isAncestorOf(target)):
                        reachable.append(widget)
        return reachable

    def _place(self, widget: QWidget) -> QPoint:
        """A random point in the visible part of a widget, in window coordinates."""
        rng, visible = self._run.random, widget.visibleRegion().boundingRect()
        across, down = (rng.randrange(max(1, size)) for size in (visible.width(), visible.height()))
        return widget.mapTo(widget.window(), visible.topLeft() + QPoint(across, down))

    def _click(self) -> str:
        rng = self._run.random
        widget = rng.choice(self._seen(QWidget))
        button = rng.choices(
            [BUTTON.LeftButton, BUTTON.RightButton, BUTTON.MiddleButton], [16, 2, 1]
        )
        held = rng.choices([NONE, SHIFT, CONTROL], [8, 1, 1])[0]
        double = rng.random() < 0.15
        pos = self._place(widget)
        text = f"{describe(widget)} {button[0].name} {held.name} {pos.toTuple()}{' twice' * double}"
        _activate(widget)
        act = QTest.mouseDClick if double else QTest.mouseClick
        act(widget.window().windowHandle(), button[0], held, pos)
        return text

    def _button(self) -> str:
        buttons = self._seen(QAbstractButton)
        return self._push(self._run.random.choice(buttons)) if buttons else "none"

    def _push(self, button: QWidget) -> str:
        description, window = describe(button), button.window()
        _activate(button)
        hot = QPoint(min(10, button.width() // 2), button.height() // 2)
        QTest.mouseClick(window.windowHandle(), BUTTON.LeftButton, NONE, button.mapTo(window, hot))
        return description

    def _drag(self) -> str:
        """Drag in the largest widgets of the page: pictures, plots and views."""
        rng = self._run.random
        widgets = sorted(self._seen(QWidget), key=lambda each: each.width() * each.height())[-25:]
        widget = rng.choice([each for each in widgets if each.layout() is None] or widgets)
        description, handle = describe(widget), widget.window().windowHandle()
        places = [self._place(widget) for _ in range(rng.randint(2, 4))]
        button = rng.choices([BUTTON.LeftButton, BUTTON.MiddleButton], [5, 1])[0]
        modifiers = rng.choices([NONE, SHIFT], [5, 1])[0]
        QTest.mousePress(handle, button, modifiers, places[0])
        for place in places[1:]:
            QTest.mouseMove(handle, place)
            QApplication.processEvents()
        QTest.mouseRelease(handle, button, modifiers, places[-1])
        return f"{description} {[place.toTuple() for place in places]}"

    def _wheel(self) -> str:
        widget = self._run.random.choice(self._seen(QWidget))
        at, delta = QPointF(widget.rect().center()), self._run.random.choice([-240, -120, 120, 240])
        description = describe(widget)
        event = QWheelEvent(
            *(at, QPointF(widget.mapToGlobal(at)), QPoint(), QPoint(0, delta)),
            *(BUTTON.NoButton, self._run.random.choice([NONE, NONE, CONTROL, SHIFT])),
            *(Qt.ScrollPhase.NoScrollPhase, False),
        )
        QApplication.sendEvent(widget, event)
        return f"{description} {delta}"

    # --- fields, lists, tables --------------------------------------------------------------

    def _type(self) -> str:
        """Type into a field and finish somehow; what the set-up page accepts must be stored."""
        run = self._run
        fields = [each for each in self._seen(NumberField, TextField) if _editor(each).isEnabled()]
        if not fields:
            return "none"
        chosen = run.random.choice(fields)
        assert isinstance(chosen, Field)
        text, good = self._text_for(chosen)
        _activate(chosen)
        chosen.editor.setFocus(Qt.FocusReason.MouseFocusReason)
        typed_on = [QApplication.focusWidget()]
        self._press(KEY.Key_A, CONTROL)
        self._write(text, chosen.editor)
        typed_on.append(QApplication.focusWidget())
        enter = CONTROL if isinstance(chosen, TextField) else NONE
        ways: dict[str, Callable[[], object]] = {
            "Enter": lambda: self._press(KEY.Key_Return, enter),
            "Tab": lambda: self._press(KEY.Key_Tab),
            "another step": self._step,
            "closing": self._reopen,
            "quitting": self._quit,
            "nothing": lambda: None,
        }
        way = run.random.choices(list(ways), [6, 4, 3, 1, 1, 2])[0]
        page, session, key = run.page, run.window.workspace.session, self._key_of(chosen)
        summary = f"{chosen.label.text()} ← {text[:40]!r}, {way}"
        ways[way]()
        finished = way not in ("nothing", "another step") or run.page != page
        if key and good and finished and session is not None and not session.read_only:
            expected = text if isinstance(chosen, TextField) else float(text)
            value = run.witness.value(session.path, key)
            if value != expected:
                unread = run.window.status_line.unread
                run.faults.append(
                    f"{summary}: {session.path.name} holds {value!r}, the field {chosen.value()!r} "
                    f"and says {chosen.problem.text()!r}; "
                    f"typed on {typed_on[0]}, at the end on {typed_on[1]}; "
                    f"problems not read: {unread}"
                )
        return summary

    def _text_for(self, chosen: Field) -> tuple[str, bool]:
        """A text, and whether the field accepts it."""
        rng = self._run.random
        if rng.random() < 0.35:
            return rng.choice(TEXTS), False
        if isinstance(chosen, TextField):
            return f"words {rng.randrange(1000)}", True
        assert isinstance(chosen, NumberField)
        value = rng.uniform(max(chosen.lowest, -100.0), min(chosen.highest, 100.0))
        text = f"{value:.{chosen.decimals}f}"
        return text, chosen.lowest <= float(text) <= chosen.highest

    def _key_of(self, chosen: Field) -> str:
        """The session's key for a field of the set-up page; "" for other fields."""
        page = self._run.window.page
        if isinstance(page, SetupPage):
            for key, each in (*page.rig_fields.items(), *page.record_fields.items()):
                if each is chosen:
                    return key
        return ""

    def _choose(self) -> str:
        boxes = self._seen(QComboBox)
        if not boxes:
            return "none"
        box = self._run.random.choice(boxes)
        assert isinstance(box, QComboBox)
        description = describe(box)
        _activate(box)
        box.setFocus(Qt.FocusReason.MouseFocusReason)
        for _ in range(self._run.random.randint(1, 3)):
            self._press(self._run.random.choice([KEY.Key_Down, KEY.Key_Up, KEY.Key_End]))
        return f"{description} {box.currentText()}"

    def _cell(self) -> str:
        rng, views = self._run.random, self._seen(QTableView)
        tables = [t for t in views if isinstance(t, QTableView) and t.model().rowCount()]
        if not tables:
            return "none"
        table = rng.choice(tables)
        model, port, window = table.model(), table.viewport(), table.window()
        row, column = rng.randrange(model.rowCount()), rng.randrange(model.columnCount())
        place = port.mapTo(window, table.visualRect(model.index(row, column)).center())
        description = f"{describe(table)} {row}, {column}"
        _activate(table)
        QTest.mouseClick(window.windowHandle(), BUTTON.LeftButton, NONE, place)
        text = rng.choice([*TEXTS, "4.65", "6.22", "2.75"])[:20]
        self._write(text, table)
        self._press(rng.choice([KEY.Key_Return, KEY.Key_Tab, KEY.Key_Escape]))
        return f"{description} ← {text!r}"

    def _purpose(self) -> str:
        """Use the visible page for its purpose, as an experienced operator does."""
        page, rng = self._run.window.page, self._run.random
        _activate(self._run.window)
        if isinstance(page, DotsPage):
            self._run.rest(PATIENCE_S)  # dots are being detected
            page.view.setFocus()
            (modifiers, key), edit = rng.choice(CHOOSING), rng.choice(EDITING)
            for _ in range(rng.choice([1, 1, 3])):
                self._press(key, modifiers)
            self._press(edit[1], edit[0])
            return f"{key.name}, {edit[0].name} {edit[1].name}"
        if isinstance(page, SetupPage):
            page.tabs.setCurrentIndex(rng.randrange(4))
        if isinstance(page, CapturePage):
            parts = page.live_view.canvas.tabs
            parts.setCurrentIndex(rng.randrange(parts.count()) if parts.isVisible() else 0)
        if isinstance(page, LaserPage):
            for column, text in enumerate(("4.65", "6.22", "2.75")):
                page.table.setFocus()
                page.table.setCurrentCell(rng.randrange(3), column)
                self._write(text, page.table)
                self._press(KEY.Key_Return)
        QApplication.processEvents()
        done = []
        for words in PURPOSES.get(self._run.page, ()):
            buttons = [each for each in self._seen(QAbstractButton) if _words(each) == words]
            if buttons and rng.random() < 0.8:
                done.append(self._push(buttons[0]))
                self._run.rest(BUSY_S)
        return ", ".join(done)

    # --- files and windows ------------------------------------------------------------------

    def _drop(self) -> str:
        rng, data = self._run.random, QMimeData()
        paths = [self._run.files.some(rng) for _ in range(rng.choice([1, 1, 1, 2]))]
        data.setUrls([QUrl.fromLocalFile(str(path)) for path in paths])
        copy = Qt.DropAction.CopyAction
        event = QDropEvent(QPointF(9, 9), copy, data, BUTTON.LeftButton, NONE)
        QApplication.sendEvent(self._run.window, event)
        QApplication.processEvents()
        return ", ".join(path.name for path in paths)

    def _reopen(self) -> str:
        """Close the session, then open it again, open another, or create one."""
        run = self._run
        session = run.window.workspace.session
        path = run.random.choice(run.files.sessions)
        if session is not None:
            path = run.random.choice([session.path, path])
            QTest.keyClick(run.window, KEY.Key_W, CONTROL)
            run.check()
        if run.random.random() < 0.25:
            run.window.do("new")
            return "new"
        run.window.files.open(path)
        return path.name

    def _quit(self) -> str:
        """Quit, start again, and open the last session."""
        run = self._run
        run.window.close()
        QApplication.processEvents()
        run.check()
        run.window = open_window(run.files.folder)
        recent = [Path(name) for name in run.window.preferences.current.recent]
        if recent and recent[0].exists():
            run.window.files.open(recent[0])
        return "and start again"

    def _resize(self) -> str:
        size = self._run.random.choice(SIZES)
        self._run.window.resize(*size)
        return f"{size}"


def describe(widget: QWidget) -> str:
    """Describe a widget."""
    words = widget.accessibleName() or widget.objectName() or _words(widget)
    return f"{type(widget).__name__} {words}".strip()


def _activate(widget: QWidget) -> None:
    """Activate the window of a widget, as a desktop does at a click."""
    if not widget.isActiveWindow():
        widget.window().activateWindow()
        QApplication.processEvents()
    if not widget.isActiveWindow():  # offscreen, a closed menu may remain the active window
        QApplication.setActiveWindow(widget.window())


def _words(widget: QWidget) -> str:
    return widget.text() if isinstance(widget, QAbstractButton) else ""


def _editor(widget: QWidget) -> QWidget:
    assert isinstance(widget, Field)
    return widget.editor
