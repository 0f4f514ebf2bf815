"""Fields for numbers, text and choices, and the form that lays them out.

A field reports an edit only when it is finished: Enter, leaving the field, or a pause after steps.
Problems are shown as text below it: the reason why the last entry was refused, until another one is
accepted; otherwise the problem of its value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from PySide6.QtCore import QEvent, QObject, QSignalBlocker, Qt, QTimer, Signal
from PySide6.QtGui import QFocusEvent, QGuiApplication, QKeyEvent, QPalette, QValidator, QWheelEvent
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QComboBox,
    QGridLayout,
    QLineEdit,
    QPlainTextEdit,
    QSizePolicy,
    QWidget,
)

from labapp.gui.digits import entered, parsed, with_thousands
from labapp.gui.widgets.labels import plain_label, plain_tip, show_words, wrapping_label
from labapp.gui.widgets.layouts import hbox, vbox

MOUSE_MS = 20
"""Interval of the check whether the mouse button was released."""

BUTTONS_PX = 26
"""Space for the step buttons and the frame of a narrow field."""

STEP_PAUSE_MS = 300
"""Steps at shorter intervals than this are one edit."""


class Field(QWidget):
    """An editor with its label, its unit and space for the text of a problem."""

    edited = Signal(object)
    """The operator has entered another value: the value, None if it was cleared."""

    def __init__(self, label: str, editor: QWidget, tooltip: str, unit: str = "") -> None:
        super().__init__()
        self.label = wrapping_label(label)
        """Label in front of the editor; a `FieldForm` places it."""
        self.label.setBuddy(editor)
        self.label.setToolTip(tooltip)
        self.editor = editor
        """The widget that receives the keys."""
        editor.setToolTip(tooltip)
        editor.setAccessibleName(f"{label}, {unit}" if unit else label)
        self._tooltip = tooltip
        self._refusal = self._fault = ""
        self._emitted: Any = None
        self.unit = plain_label(unit)
        self.problem = wrapping_label()
        self.problem.hide()
        self.setFocusProxy(editor)
        line = hbox((editor, 1), self.unit) if unit else hbox((editor, 1))
        vbox(line, self.problem, of=self).setSpacing(2)
        self.set_problem("")

    def flush(self) -> None:
        """Finish an edit in progress; for fields in which one can be."""

    def set_problem(self, words: str) -> None:
        """Show a problem of the field's value; empty: none."""
        self._fault = words
        self._show_problem()

    def lock(self, why: str) -> None:
        """Disable input and show the reason; empty: enable it."""
        self._set_locked(bool(why))
        self.editor.setToolTip(plain_tip(why or self._tooltip))
        self.label.setToolTip(plain_tip(why or self._tooltip))

    def _set_locked(self, locked: bool) -> None:
        self.editor.setEnabled(not locked)

    def refuse(self, words: str) -> None:
        """Show why the last entry was refused, until the field gets another value."""
        self._refusal = words
        self._show_problem()

    def _enter(self, value: Any) -> None:
        """Emit an edit if it changed the value."""
        if value != self._emitted:
            self._emitted = value
            self.refuse("")
            self.edited.emit(value)

    def _show_problem(self) -> None:
        words = self._refusal or self._fault
        described = f"{words}. {self._tooltip}" if words else self._tooltip
        self.editor.setAccessibleDescription(described)
        self._show_problem_text()

    def _show_problem_text(self) -> None:
        """Show or hide the text, but not while a mouse button is down: a click would be lost."""
        words = self._refusal or self._fault
        message = f"⚠ {words}" if words else ""
        if message != self.problem.text() and QGuiApplication.mouseButtons():
            QTimer.singleShot(MOUSE_MS, self, self._show_problem_text)
            return
        show_words(self.problem, message)


class NumberField(Field):
    """A number with its unit, right-aligned; steps by arrow keys, buttons and wheel.

    If an entry is not a number or out of range, the field shows this and keeps the previous value.
    `set_value` does not replace the text while the operator types.

    Parameters
    ----------
    lowest, highest
        The range, including both ends.
    step
        Step of the arrow keys and buttons; Page Up and Down go ten steps.
    decimals
        Number of decimals shown; 0: whole numbers, and values are int.
    """

    def __init__(
        self,
        label: str,
        unit: str = "",
        *,
        lowest: float,
        highest: float,
        step: float = 1.0,
        decimals: int = 2,
        tooltip: str = "",
        optional: bool = False,
    ) -> None:
        self._box = _NumberBox()
        super().__init__(label, self._box, tooltip, unit)
        self.lowest, self.highest, self.step = lowest, highest, step
        self.decimals, self.optional = decimals, optional
        self._value: float | None = None
        self._typed = False
        self._box.line.textEdited.connect(self._note_typing)
        self._box.stepped.connect(self._step)
        self._box.editingFinished.connect(self.flush)
        self._pause = QTimer(self, singleShot=True, interval=STEP_PAUSE_MS)
        self._pause.timeout.connect(self._emit_change)

    def value(self) -> float | None:
        """Value of the field; None if it is empty."""
        return self._value

    def set_value(self, value: float | None) -> None:
        """Show another value; emits no signal."""
        if self._pause.isActive():
            return
        typing = self._box.text() != self._shown(self._value) and self._box.line.isModified()
        if value != self._value:
            self.refuse("")
        self._value = self._emitted = value
        if not typing:
            self._show()
            self.set_problem("")

    def set_placeholder(self, words: str) -> None:
        """Show in grey which value applies while the field is empty."""
        self._box.line.setPlaceholderText(words)

    def _shown(self, value: float | None) -> str:
        return "" if value is None else entered(value, self.decimals)

    def _show(self) -> None:
        with QSignalBlocker(self._box):
            self._box.line.setText(self._shown(self._value))

    def _note_typing(self) -> None:
        self._typed = True

    def flush(self) -> None:
        """Finish a current edit, as leaving the field does."""
        text = self._box.text()
        if text != self._shown(self._value):
            value, problem = self._read(text)
            if not problem:
                self._value = value
            self.refuse(problem)
            self._show()
        elif self._typed:  # the value that the field already has
            self.refuse("")
        self._typed = False
        self._emit_change()

    def _read(self, text: str) -> tuple[float | None, str]:
        shown = self._shown(self._value)
        kept = f"{shown} stays" if shown else "the field stays empty"
        if not text.strip():
            return None, "" if self.optional else f"A number is needed; {kept}"
        if self.decimals == 0 and not {".", ","}.isdisjoint(text):  # they may separate thousands
            return None, f"“{text.strip()}” is not a whole number in digits only; {kept}"
        value = parsed(text)
        if value is None:
            return None, f"“{text.strip()}” is not a number; {kept}"
        other = with_thousands(text)
        if other is not None:
            words = f"“{text.strip()}” can be {value:.7g} or {other:.7g}: write it without a comma"
            return None, f"{words}; {kept}"
        if not self.lowest <= value <= self.highest:
            low, high = (entered(end, 0) for end in (self.lowest, self.highest))
            words = f"from {low} to {high} {self.unit.text()}".strip()
            return None, f"“{text.strip()}” is not {words}; {kept}"
        if self.decimals == 0:
            if value != int(value):
                return None, f"“{text.strip()}” is not a whole number; {kept}"
            return int(value), ""
        return value, ""

    def _step(self, steps: int) -> None:
        value, problem = self._read(self._box.text())
        start = self._value if problem or value is None else value
        if start is None:
            start = min(max(0.0, self.lowest), self.highest) - steps * self.step
        moved = min(max(start + steps * self.step, self.lowest), self.highest)
        self._value = int(moved) if self.decimals == 0 else round(moved, 9)
        self.refuse("")
        self._show()
        self._pause.start()

    def _emit_change(self) -> None:
        self._pause.stop()
        self._enter(self._value)


class _NumberBox(QAbstractSpinBox):
    """The line and the arrow buttons; it accepts any text, which the field checks."""

    stepped = Signal(int)

    def __init__(self) -> None:
        super().__init__()
        self.line = self.lineEdit()
        self.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance("−00000.000") + 28)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def validate(self, text: str, position: int) -> Any:
        return QValidator.State.Acceptable, text, position

    def stepEnabled(self) -> QAbstractSpinBox.StepEnabledFlag:
        flags = QAbstractSpinBox.StepEnabledFlag
        return flags.StepUpEnabled | flags.StepDownEnabled

    def stepBy(self, steps: int) -> None:
        self.stepped.emit(steps)

    def wheelEvent(self, event: QWheelEvent) -> None:
        # Scrolling a panel must not change the numbers that pass under the pointer.
        if self.hasFocus():
            super().wheelEvent(event)
        else:
            event.ignore()


class TextField(Field):
    """Text of one or several lines.

    Parameters
    ----------
    lines
        Number of lines shown; with more than one, Enter begins another and Ctrl+Enter finishes.
    line
        Editor for a single line; None for a plain one.
    """

    def __init__(
        self,
        label: str,
        *,
        tooltip: str = "",
        lines: int = 1,
        line: QLineEdit | None = None,
    ) -> None:
        self._edit: QLineEdit | _Paragraphs = (
            line or QLineEdit() if lines == 1 else _Paragraphs(lines)
        )
        super().__init__(label, self._edit, tooltip)
        self._emitted = ""
        self._edit.editingFinished.connect(self.flush)

    def value(self) -> str:
        """The text."""
        return self._edit.text()

    def set_value(self, value: str) -> None:
        """Show another text; emits no signal, and does not replace text being typed."""
        typing = self._edit.isModified() and self.value() != self._emitted
        if value != self._emitted:
            self.refuse("")
        self._emitted = value
        if not typing and value != self.value():
            self._edit.setText(value)
            if isinstance(self._edit, QLineEdit) and not self._edit.hasFocus():
                self._edit.setCursorPosition(0)  # of a long text, its beginning is in view

    def keep_unstored(self, stored: str) -> None:
        """Keep a text that could not be stored, and say so; leaving the field enters it again."""
        self._emitted = stored
        self.refuse("Not stored: leave the field to try again")

    def flush(self) -> None:
        """Finish a current edit, as leaving the field does."""
        self._enter(self.value())

    def _set_locked(self, locked: bool) -> None:
        if isinstance(self._edit, QLineEdit):
            super()._set_locked(locked)
            return
        # It can still be scrolled and copied from; its background shows that input is disabled.
        self._edit.setReadOnly(locked)
        ground = QPalette.ColorRole.Window if locked else QPalette.ColorRole.Base
        self._edit.viewport().setBackgroundRole(ground)


class _Paragraphs(QPlainTextEdit):
    """Several lines, left with Tab; a field uses it like a `QLineEdit`."""

    editingFinished = Signal()  # noqa: N815  # Qt's name

    def __init__(self, lines: int) -> None:
        super().__init__()
        self.setTabChangesFocus(True)
        self.setFixedHeight(self.fontMetrics().lineSpacing() * lines + 14)

    def text(self) -> str:
        return self.toPlainText()

    def setText(self, text: str) -> None:
        self.setPlainText(text)

    def isModified(self) -> bool:
        return self.document().isModified()

    def focusOutEvent(self, event: QFocusEvent) -> None:
        super().focusOutEvent(event)
        self.editingFinished.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        enter = event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter)
        if enter and event.modifiers() & Qt.KeyboardModifier.ControlModifier:
            self.editingFinished.emit()
        else:
            super().keyPressEvent(event)


class ChoiceField(Field):
    """A choice from several options.

    Parameters
    ----------
    choices
        (key, text) pairs; `value` and ``edited`` give the keys.
    """

    def __init__(
        self, label: str, choices: Sequence[tuple[str, str]] = (), *, tooltip: str = ""
    ) -> None:
        self._combo = QComboBox()
        super().__init__(label, self._combo, tooltip)
        self._combo.setSizeAdjustPolicy(
            QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon
        )
        self._combo.setMinimumContentsLength(8)
        self._combo.installEventFilter(self)
        self._emitted = ""
        self.set_choices(choices)
        self._combo.activated.connect(lambda _: self._enter(self.value()))

    def value(self) -> str:
        """Key of the choice; empty if nothing is chosen."""
        return str(self._combo.currentData() or "")

    def set_value(self, key: str) -> None:
        """Choose by key; emits no signal."""
        self._combo.setCurrentIndex(self._combo.findData(key))
        if self.value() != self._emitted:
            self.refuse("")
        self._emitted = self.value()

    def set_choices(self, choices: Sequence[tuple[str, str]]) -> None:
        """Offer other choices; the current one is kept if it is among them."""
        present = self.value()
        self._combo.clear()
        for key, words in choices:
            self._combo.addItem(words, key)
            place, tip = self._combo.count() - 1, plain_tip(words)
            self._combo.setItemData(place, tip, Qt.ItemDataRole.ToolTipRole)
        self.set_value(present or (choices[0][0] if choices else ""))

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Prevent the wheel from changing a choice without the focus."""
        if event.type() == QEvent.Type.Wheel and not self._combo.hasFocus():
            event.ignore()
            return True
        return super().eventFilter(watched, event)


class FieldForm(QWidget):
    """Parts one below the other; of fields, labels, editors and units are in columns.

    A field may have another beside it, in a narrow column at the right.
    """

    def __init__(self, *parts: QWidget) -> None:
        super().__init__()
        self._grid = QGridLayout(self)
        self._grid.setContentsMargins(0, 0, 0, 0)
        self._grid.setColumnStretch(0, 2)
        self._grid.setColumnStretch(1, 3)
        self._fields: list[Field] = []
        self.add(*parts)

    def add(self, *parts: QWidget, beside: Field | None = None) -> None:
        """Put parts below the others, and perhaps a field without label and unit beside the last.

        What is not a field takes the whole width.
        """
        for part in parts:
            row = self._grid.rowCount()
            if not isinstance(part, Field):
                self._grid.addWidget(part, row, 0, 1, 3)
                continue
            self._grid.addWidget(part.label, row, 0, Qt.AlignmentFlag.AlignTop)
            self._grid.addWidget(part, row, 1)
            # Aligned with the editor's first line.
            height = part.editor.fontMetrics().lineSpacing() + 12
            part.label.setMinimumHeight(min(part.editor.sizeHint().height(), height))
            self._fields.append(part)
        if beside is not None:
            beside.unit.hide()
            digits = beside.editor.fontMetrics().horizontalAdvance("0.0000")
            beside.editor.setMinimumWidth(digits + BUTTONS_PX)
            self._grid.addWidget(beside, self._grid.rowCount() - 1, 2, Qt.AlignmentFlag.AlignTop)
            self._grid.setColumnStretch(2, 1)
        units = [other.unit for other in self._fields if other.unit.text()]
        width = max((unit.sizeHint().width() for unit in units), default=0)
        for unit in units:
            unit.setMinimumWidth(width)


def flush_fields(part: QWidget) -> None:
    """Finish edits in progress in all fields within a part, as leaving them does."""
    for field in part.findChildren(Field):
        field.flush()


def whole(
    label: str, lowest: int, tip: str, highest: int = 10**9, *, unit: str = "", step: int = 1
) -> NumberField:
    """A field for a whole number."""
    return NumberField(
        label, unit, lowest=lowest, highest=highest, step=step, decimals=0, tooltip=tip
    )
