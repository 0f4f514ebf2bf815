"""Fields of the recording page that determine which frames of a camera are recorded."""

from __future__ import annotations

from PySide6.QtCore import QObject, Signal
from PySide6.QtWidgets import QCheckBox

from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField, whole
from labapp.gui.widgets.labels import heading, selectable_label
from labapp.media.recording.nut import Codec
from labapp.media.recording.recorder import Plan
from labapp.text import format_bytes

BEFORE_S = 2.0

CODECS: dict[Codec, str] = {"raw": "Raw: large, quick", "ffv1": "FFV1: small, slow"}

COSTS: dict[Codec, tuple[float, float]] = {"raw": (1.0, 2.3e-9), "ffv1": (0.42, 15e-9)}
"""Written fraction of a frame's bytes, and seconds of a core per byte (docs/cameras.md)."""

SHARE = 0.5
"""Load of a core above which there is a warning: the rest is needed for measuring live."""


class PlanFields(QObject):
    """Fields for a `Plan`."""

    edited = Signal()
    """The plan was changed by the operator."""

    def __init__(self, form: FieldForm) -> None:
        super().__init__(form)
        form.add(heading("Recording"))
        tip = "How much from before the trigger is recorded, too: it is kept in memory"
        self.before = NumberField(
            "Before the trigger", "s", lowest=0, highest=600, decimals=1, tooltip=tip
        )
        self.before.set_value(BEFORE_S)
        tip = "How long after the trigger the recording ends; empty: when you end it"
        self.after = NumberField(
            "After it", "s", lowest=0.1, highest=86_400, decimals=1, optional=True, tooltip=tip
        )
        tip = "1: every frame is recorded; 2: every second one…"
        self.every = whole("Every n-th frame", 1, tip, 10_000)
        self.every.set_value(1)
        self.codec = ChoiceField(
            "Written as",
            list(CODECS.items()),
            tooltip="Both are lossless. Raw is as fast as the disk; FFV1 is less than half "
            "the size, for six times the processor time",
        )
        for field in (self.before, self.after, self.every, self.codec):
            field.edited.connect(lambda _: self.edited.emit())
            form.add(field)
        self.measured = QCheckBox("Measure it afterwards")
        self.measured.setToolTip(
            "When a recording has ended and the set-up is complete, all its frames are measured in "
            "the background, each from the one before; the bar below shows how far that is"
        )
        self.measured.setChecked(True)
        self.cost = selectable_label()
        form.add(self.measured, self.cost)

    def plan(self) -> Plan:
        """The plan in the fields."""
        return Plan(
            before_s=self.before.value() or 0.0,
            after_s=self.after.value(),
            every=int(self.every.value() or 1),
            codec="ffv1" if self.codec.value() == "ffv1" else "raw",
        )

    def show_cost(self, frame_byte: int, rate_hz: float | None) -> None:
        """Show the cost of the recording, if size and rate of the frames are known."""
        words = cost_text(self.plan(), frame_byte, rate_hz) if frame_byte and rate_hz else ""
        self.cost.setText(words)

    def set_enabled(self, enabled: bool) -> None:
        """Enable or disable the fields."""
        for field in (self.before, self.after, self.every, self.codec):
            field.setEnabled(enabled)


def cost_text(plan: Plan, frame_byte: int, rate_hz: float) -> str:
    """Text of the approximate cost of a plan: disk space and processor time."""
    part, core_s = COSTS[plan.codec]
    byte_s = frame_byte * rate_hz / plan.every
    core = core_s * byte_s
    message = (
        f"About {format_bytes(round(part * byte_s))} a second, {max(1, round(100 * core))} % of a "
        "core"
    )
    if plan.codec == "ffv1" and core > SHARE:
        lost = "frames will be lost" if core > 1 else "little is left to measure live"
        return f"⚠ {message}: {lost}. Raw takes {max(1, round(100 * COSTS['raw'][1] * byte_s))} %"
    return message
