"""The bar below a live picture: state of the camera and buttons for recording."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Qt
from PySide6.QtGui import QPalette
from PySide6.QtWidgets import QProgressBar, QWidget

from labapp.gui.live.live import Live
from labapp.gui.theme import RED, is_dark
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.labels import Message, offer, plain_label, set_font
from labapp.gui.widgets.layouts import hbox, vbox

BEGIN, END = "● Record", "■ End recording"

NOTHING_TO_MARK = "Only while it records: notes a moment beside the recording (M)"

BUTTON_PX, RING_BAR_PX = 44, 96
"""Minimum size of the buttons, which are pressed with gloves; width of the memory bar."""


class RecordBar(QWidget):
    """Buttons to record, mark and stop; state of the camera and of the recording."""

    def __init__(
        self,
        trigger: Callable[[], object],
        mark: Callable[[], object],
        stop: Callable[[], object],
    ) -> None:
        super().__init__()
        self.state = Message(1)
        self.ring = QProgressBar()
        self.ring.setRange(0, 100)
        self.ring.setFixedWidth(RING_BAR_PX)
        self.ring.setToolTip("How much from before the trigger is in memory")
        line = hbox((self.state, 1), plain_label("Before the trigger:"), self.ring)
        self.recording = Message(2)
        tip = "Record from some seconds before now on, or end the recording (Space, Ctrl+R)"
        self.record_button = button(BEGIN, tip, trigger)
        tip = "Note this moment beside the recording that runs (M)"
        self.mark_button = button("Mark", tip, mark)
        stop_button = button(
            "Stop camera", "Release the camera; a recording is finished first", stop
        )
        buttons = ((self.record_button, 3), (self.mark_button, 2), (stop_button, 2))
        for each, _ in buttons:
            each.setMinimumHeight(BUTTON_PX)
        self.mark_button.setMinimumWidth(BUTTON_PX)  # leaves room for the others at 150 %
        set_font(self.record_button)
        self.record_button.setText(END)
        self.record_button.setMinimumWidth(self.record_button.sizeHint().width())
        self.record_button.setText(BEGIN)
        vbox(line, self.recording, hbox(*buttons), of=self).setContentsMargins(8, 2, 8, 4)

    def show_status(self, live: Live) -> None:
        """Show the state of a camera and its recording."""
        self.state.setText(live.state_text())
        part, message = live.before_trigger()
        self.ring.setValue(round(100 * part))
        self.ring.setFormat(message)
        self.ring.setAccessibleName(f"Kept from before the trigger: {message}")
        self.recording.setText(live.recording_text())
        self._show_failing(live.is_failing)

    def _show_failing(self, failing: bool) -> None:
        """Show whether frames are lost: in bold on red, as it must not be overlooked."""
        if failing == self.recording.autoFillBackground():
            return
        palette = QPalette()
        if failing:
            palette.setColor(QPalette.ColorRole.Window, RED[False])
            palette.setColor(QPalette.ColorRole.WindowText, Qt.GlobalColor.white)
        self.recording.setPalette(palette)
        self.recording.setAutoFillBackground(failing)
        set_font(self.recording, bold=failing)

    def show_recording(self, recording: bool) -> None:
        """Show on the record button whether a recording runs: by text, sign and red colour."""
        offer(self.mark_button, "" if recording else NOTHING_TO_MARK)
        pressed = self.record_button
        pressed.setText(END if recording else BEGIN)
        palette = QPalette()
        if recording:
            palette.setColor(QPalette.ColorRole.ButtonText, RED[is_dark(palette)])
        pressed.setPalette(palette)
