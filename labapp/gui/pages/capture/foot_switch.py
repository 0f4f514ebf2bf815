"""Foot switches on the recording page: those in use, actions of their pedals, new ones."""

from __future__ import annotations

from functools import partial
from typing import cast

from PySide6.QtGui import QGuiApplication, QTextOption
from PySide6.QtWidgets import QPlainTextEdit, QWidget

from labapp.gui.foot_switches import DOES, FootSwitches, pedal_name
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, FieldForm
from labapp.gui.widgets.labels import heading, selectable_label, show_words
from labapp.gui.widgets.layouts import Group, column_of, fill, hbox
from labapp.media.devices.foot_switch import PedalAction
from labapp.media.devices.hid import commands
from labapp.text import capitalized

NOTHING = "nothing"

CHOICES = [*((action, words) for action, words in DOES.items()), (NOTHING, "no action")]

NONE_YET = "No foot switch is in use. Plug one in, press Learn a pedal, and step on it."

LINES = 5
"""Number of visible lines of the commands."""

LISTENING = "Step on the pedal that is to be used…"


class FootSwitchPanel(Group):
    """Shows and sets the foot switches of a window."""

    def __init__(self, switches: FootSwitches) -> None:
        super().__init__("Foot switch")
        self.switches = switches
        self.words, self.learned_words = selectable_label(), selectable_label()
        self.rows = QWidget()
        self.pedals: dict[tuple[str, int], ChoiceField] = {}
        self._make_learning()
        self._make_rights()
        switches.changed.connect(self.refresh)
        self.refresh()

    def _make_learning(self) -> None:
        self.learn_button = button(
            "Learn a pedal", "Wait until a pedal of any device is pressed", self._learn
        )
        self.look_button = button(
            "Find devices", "List the foot switches that are plugged in", self.switches.look
        )
        self.action = ChoiceField(
            "Action", list(DOES.items()), tooltip="What stepping on this pedal does from now on"
        )
        self.use_button = button("Apply", "Use this pedal, now and after every start", self._use)
        leave = button("Discard", "Leave this pedal as it is", self.switches.give_up)
        self.learned = column_of(FieldForm(self.action), hbox(self.use_button, leave))
        # The buttons are above the text, whose height varies.
        fill(
            self.column,
            *(hbox(self.learn_button, self.look_button), self.words, self.rows),
            *(self.learned_words, self.learned),
        )

    def _make_rights(self) -> None:
        self.closed = ChoiceField(
            "No permission", tooltip="Devices that you have no permission to read: choose yours"
        )
        self.commands = QPlainTextEdit()
        self.commands.setReadOnly(True)
        self.commands.setTabChangesFocus(True)
        self.commands.setWordWrapMode(QTextOption.WrapMode.WrapAtWordBoundaryOrAnywhere)
        self.commands.setFixedHeight(LINES * self.commands.fontMetrics().lineSpacing() + 14)
        self.commands.setAccessibleName("Commands that give permission")
        self.commands.setToolTip(
            "Type them in a terminal, then unplug the device and plug it in again"
        )
        tip = "Copy the commands that give permission, for a terminal"
        self.copy_button = button("Copy the commands", tip, self._copy)
        self.closed.edited.connect(lambda _: self._show_commands())
        then = selectable_label("Then unplug it and plug it in again.")
        self.rights = column_of(FieldForm(self.closed), self.commands, self.copy_button, then)
        self.column.addWidget(self.rights)

    # --- what is shown ------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the current state of the foot switches."""
        switches = self.switches
        parts = [each.words for each in switches.in_use.values()] or [NONE_YET]
        if switches.found is not None:
            parts.append(switches.found.words)
        show_words(self.words, "\n".join(parts))
        self._show_rows()
        self.learn_button.setText("Stop waiting" if switches.learns else "Learn a pedal")
        self.look_button.setEnabled(not (switches.looks or switches.learns))
        learned = switches.learned
        words = "\n".join((LISTENING, *switches.unavailable)) if switches.learns else ""
        if learned is not None:
            name = pedal_name(learned.pedal, learned.info.is_keyboard)
            words = f"{learned.info.name}: {name} was pressed."
        show_words(self.learned_words, words)
        if learned is not None and self.learned.isHidden():
            self.action.set_value(switches.proposed)
        self.learned.setVisible(learned is not None)
        closed = () if switches.found is None else switches.found.closed
        self.closed.set_choices([(info.key, info.name) for info in closed])
        self.rights.setVisible(bool(closed))
        self._show_commands()

    def _show_rows(self) -> None:
        """Show a field for each pedal; rebuild them only if the pedals changed."""
        held = {key: each.pedals for key, each in self.switches.in_use.items()}
        wanted = {(key, pedal): does for key in held for pedal, does in held[key].actions.items()}
        if wanted.keys() != self.pedals.keys():
            former, form = self.rows, FieldForm()
            self.pedals = {}
            headed_by = ""
            for key, pedal in sorted(wanted):
                if len(held) > 1 and key != headed_by:
                    form.add(heading(held[key].name))
                    headed_by = key
                name = pedal_name(pedal, held[key].keyboard)
                field = self.pedals[key, pedal] = ChoiceField(
                    capitalized(name),
                    CHOICES,
                    tooltip=f"What {name} of {held[key].name} does",
                )
                field.edited.connect(partial(self._assign, key, pedal))
                form.add(field)
            self.column.replaceWidget(former, form)
            self.rows = form
            former.hide()  # it is deleted only later
            former.deleteLater()
        for place, action in wanted.items():
            self.pedals[place].set_value(action)
        self.rows.setVisible(bool(wanted))

    def _show_commands(self) -> None:
        closed = () if self.switches.found is None else self.switches.found.closed
        chosen = next((info for info in closed if info.key == self.closed.value()), None)
        message = "" if chosen is None else commands(chosen)
        if message != self.commands.toPlainText():
            self.commands.setPlainText(message)

    # --- what is done -------------------------------------------------------------------------

    def _learn(self) -> None:
        (self.switches.give_up if self.switches.learns else self.switches.learn)()

    def _use(self) -> None:
        self.switches.use_learned(cast(PedalAction, self.action.value()))

    def _assign(self, key: str, pedal: int, chosen: str) -> None:
        action = None if chosen == NOTHING else cast(PedalAction, chosen)
        self.switches.assign(key, pedal, action)

    def _copy(self) -> None:
        QGuiApplication.clipboard().setText(self.commands.toPlainText())
        self.switches.notified.emit("The commands are on the clipboard, for a terminal", False)
