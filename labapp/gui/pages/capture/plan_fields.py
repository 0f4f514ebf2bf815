"""What of a camera's frames is recorded: fields of the recording page."""

from __future__ import annotations

from PySide6.QtCore import QObject, Signal

from labapp.gui.views.fields import FieldForm, NumberField
from labapp.media.recorder import Plan

BEFORE_S = 2.0


class PlanFields(QObject):
    """Fields for a `Plan`.

    Parameters
    ----------
    form
        Where they stand.

    Signals
    -------
    edited
        Another plan was entered.
    """

    edited = Signal()

    def __init__(self, form: FieldForm) -> None:
        super().__init__(form)
        form.add_heading("Recording")
        self.before = NumberField(
            "Before the trigger",
            "s",
            lowest=0,
            highest=600,
            decimals=1,
            tooltip="So much from before the trigger is recorded, too: it is kept in memory",
        )
        self.before.set_value(BEFORE_S)
        self.after = NumberField(
            "After it",
            "s",
            lowest=0.1,
            highest=86_400,
            decimals=1,
            optional=True,
            tooltip="The recording ends so long after the trigger; empty: when you end it",
        )
        self.every = NumberField(
            "Every n-th frame",
            lowest=1,
            highest=10_000,
            decimals=0,
            tooltip="1: every frame is recorded; 2: every second one …",
        )
        self.every.set_value(1)
        for field in (self.before, self.after, self.every):
            field.edited.connect(lambda _: self.edited.emit())
            form.add(field)

    def plan(self) -> Plan:
        """What they hold."""
        return Plan(
            before_s=self.before.value() or 0.0,
            after_s=self.after.value(),
            every=int(self.every.value() or 1),
        )

    def set_enabled(self, enabled: bool) -> None:
        """Let another plan be entered, or not."""
        for field in (self.before, self.after, self.every):
            field.setEnabled(enabled)
