"""Sending of live measures to control software: switches, and their state as text."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from PySide6.QtWidgets import QCheckBox, QGridLayout, QWidget

from labapp.errors import InputError
from labapp.gui.tasks import Control, Task
from labapp.gui.widgets.buttons import check_box
from labapp.gui.widgets.fields import NumberField, whole
from labapp.gui.widgets.labels import Message, selectable_label, show_words
from labapp.gui.widgets.layouts import Group, vbox
from labapp.gui.workspace import Workspace
from labapp.run.live_watch import LiveWatch
from labapp.run.streams import Stream, open_stream
from labapp.text import pluralize

KINDS = {
    "lines": (
        "Lines of JSON over TCP",
        5020,
        "One line per frame, to every program that connects",
    ),
    "opcua": (
        "OPC UA",
        4840,
        "The newest frame as variables in Objects/Pool, some twenty times a second",
    ),
}
"""The available streams: text, default port, tip."""

OWN, ANY = "127.0.0.1", "0.0.0.0"

WARNING = (
    "⚠ Any machine that reaches this one can then read the measures: there is no password and no "
    "encryption. Protect it by a firewall."
)

PORT_PX = 90

IN_USE = "Choose another port, or end the program that has this one."


class LiveStreams(QWidget):
    """Streams of live measures to other programs; all are off at every start."""

    def __init__(self, workspace: Workspace, watch: Callable[[], LiveWatch | None]) -> None:
        super().__init__()
        self._workspace, self._watch = workspace, watch
        self.boxes: dict[str, QCheckBox] = {}
        self.ports: dict[str, NumberField] = {}
        self.words = {kind: Message(2) for kind in KINDS}
        self._problems: dict[str, str] = {}
        self._tasks: dict[str, Task] = {}
        grid = QGridLayout()
        grid.setColumnStretch(3, 1)
        for row, (kind, (words, port, tip)) in enumerate(KINDS.items()):
            box = self.boxes[kind] = check_box(words, tip, partial(self._switch, kind))
            field = self.ports[kind] = whole("port", 1024, f"Port of {words}", 65_535)
            field.editor.setAccessibleName(f"Port of {words}")
            field.set_value(port)
            field.editor.setMinimumWidth(1)  # a wider one would be cut off
            field.setFixedWidth(PORT_PX)
            field.edited.connect(partial(self._bring_about, kind))
            for column, widget in enumerate((box, field.label, field)):
                grid.addWidget(widget, 2 * row, column)
            grid.addWidget(self.words[kind], 2 * row + 1, 0, 1, 4)
        tip = "Otherwise only programs on this machine can"
        self.anywhere = check_box("Other machines may connect", tip, lambda _: self._open_to_all())
        self.warning = selectable_label()
        words = "Send measures to control software"
        group = Group(words, grid, self.anywhere, self.warning)
        vbox(group, 1, of=self).setContentsMargins(8, 8, 8, 8)
        self.show_state()

    # --- what is done -------------------------------------------------------------------------

    def begin(self) -> None:
        """Start the selected streams of a camera that are not open yet."""
        watch = self._watch()
        for kind, box in self.boxes.items():
            if box.isChecked() and watch is not None and watch.stream(kind) is None:
                self._bring_about(kind)

    def _wanted(self, kind: str) -> tuple[LiveWatch | None, str, bool]:
        """The sender, its address (empty: none), and whether other machines may connect."""
        anywhere, port = self.anywhere.isChecked(), int(self.ports[kind].value() or 0)
        place = f"{ANY if anywhere else OWN}:{port}"
        return self._watch(), place if self.boxes[kind].isChecked() else "", anywhere

    def _bring_about(self, kind: str, _: object = None) -> None:
        """Open or close a stream in the background, one action after the other."""
        watch, place, anywhere = wanted = self._wanted(kind)
        if watch is None or self._is_at_work(kind):
            return
        words, is_open = KINDS[kind][0], watch.stream(kind) is not None
        if not place and not is_open:
            return

        def work(_: Control) -> str:
            watch.set_stream(kind, None)  # it may use the same port
            if place:
                try:
                    watch.set_stream(kind, open_stream(kind, place, anywhere))
                except InputError as error:
                    return problem_text(error)
            return ""

        def done(problem: str) -> None:
            if self._wanted(kind) != wanted:
                self._bring_about(kind)  # the request has changed meanwhile
            elif problem:
                self._problems[kind] = problem
                self.boxes[kind].setChecked(False)
                self._workspace.say_wrong(words, f"{words}: {problem}")
            elif place:
                self._workspace.settle(words)
                self._workspace.notified.emit(f"{words}: measures are sent from {place}", False)
            self.show_state()

        title = f"Opening {words}" if place else f"Ending {words}"
        self._tasks[kind] = self._workspace.tasks.start(title, work, done)

    def _is_at_work(self, kind: str) -> bool:
        return self._tasks.get(kind) in self._workspace.tasks.active

    def _switch(self, kind: str, on: bool) -> None:
        if on:
            self._problems.pop(kind, None)
        self._bring_about(kind)
        self.show_state()

    def _open_to_all(self) -> None:
        for kind, box in self.boxes.items():
            if box.isChecked():
                self._bring_about(kind)
        self.show_state()

    # --- what it shows ------------------------------------------------------------------------

    def show_state(self) -> None:
        """Show how many clients are connected, and how many frames were sent."""
        watch = self._watch()
        for kind in KINDS:
            stream = None if watch is None else watch.stream(kind)
            fault = "" if watch is None else watch.stream_faults.pop(kind, "")
            if fault:
                self._problems[kind] = fault
                self.boxes[kind].setChecked(False)
            message = stream_text(stream, self._is_at_work(kind), self._problems.get(kind, ""))
            self.words[kind].setText(message)
        show_words(self.warning, WARNING if self.anywhere.isChecked() else "")


def stream_text(stream: Stream | None, at_work: bool, problem: str) -> str:
    """Text of a stream's address, number of clients and number of frames sent."""
    if problem:
        return f"⚠ {problem}"
    if stream is None:
        return "○ Opening or closing…" if at_work else "○ Off"
    clients, frames = pluralize(stream.listeners, "client"), pluralize(stream.sent, "frame")
    where = f"{stream.address} (every address of this machine)" * (ANY in stream.address)
    return f"● {where or stream.address}: {clients} connected, {frames} sent"


def problem_text(error: InputError) -> str:
    """Text of the reason why a stream cannot be opened, and what to do."""
    if error.field == "port":
        return f"{error.value}. {IN_USE}"
    return f"{error.value}: it needs {error.expected}."
