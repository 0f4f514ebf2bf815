from __future__ import annotations

import threading
import time

from pytestqt.qtbot import QtBot

from labapp.errors import InputError
from labapp.gui.shell.messages import StatusLine
from labapp.gui.tasks import Control, Tasks


def test_parts_and_result_arrive_in_order_on_the_gui_thread(qtbot: QtBot):
    tasks = Tasks()
    received: list[tuple[object, bool]] = []
    gui_thread = threading.current_thread()

    def receive(value: object) -> None:
        received.append((value, threading.current_thread() is gui_thread))

    def work(control: Control) -> str:
        for number in range(3):
            control.progress(number + 1, 3)
            control.part(number)
        return "done"

    task = tasks.start("Counting", work, on_done=receive, on_part=receive)
    qtbot.waitUntil(lambda: not tasks.active)
    assert received == [(0, True), (1, True), (2, True), ("done", True)]
    assert (task.done, task.total) == (3, 3)


def test_failures_are_reported(qtbot: QtBot):
    tasks = Tasks()
    failures: list[tuple[str, str]] = []
    tasks.failed.connect(lambda title, why: failures.append((title, why)))

    def reject(_: Control) -> None:
        raise InputError("a.avi", "size", "0 bytes", "a video")

    def crash(_: Control) -> None:
        raise KeyError("x")

    tasks.start("Importing", reject)
    qtbot.waitUntil(lambda: not tasks.active)
    tasks.start("Measuring", crash)
    qtbot.waitUntil(lambda: not tasks.active)
    assert failures[0] == ("Importing", "a.avi: size: 0 bytes; expected a video")
    assert failures[1][0] == "Measuring"
    assert "KeyError" in failures[1][1]


def endless(control: Control) -> None:
    number = 0
    while True:
        number += 1
        control.progress(number, 10**9)
        time.sleep(0.001)


def test_cancelling_stops_the_task_without_a_callback(qtbot: QtBot):
    tasks = Tasks()
    called: list[object] = []
    line = StatusLine(tasks)
    qtbot.addWidget(line)
    line.show()
    task = tasks.start("Measuring", endless, on_done=called.append)
    qtbot.waitUntil(lambda: task.done > 3)
    assert line.title.text() == "Measuring"
    assert line.bar.isVisibleTo(line)
    line.cancel_button.click()
    assert "stopping" in line.title.text()
    qtbot.waitUntil(lambda: not tasks.active)
    assert called == []
    assert not task.thread.is_alive()
    assert not line.bar.isVisibleTo(line)


def test_only_what_the_operator_cancelled_is_said_to_be_so(qtbot: QtBot):
    tasks = Tasks()
    line = StatusLine(tasks)
    qtbot.addWidget(line)
    line.say("The table is on the clipboard", False)
    tasks.start("Drawing", endless).cancel()
    qtbot.waitUntil(lambda: not tasks.active)
    assert line.message.text() == "The table is on the clipboard"
    tasks.start("Measuring", endless)
    line.cancel()
    qtbot.waitUntil(lambda: not tasks.active)
    assert line.message.text().startswith("Measuring")


def test_cancel_all_waits_for_the_tasks(qtbot: QtBot):
    tasks = Tasks()
    started = [tasks.start(name, endless) for name in ("Measuring", "Importing")]
    tasks.cancel_all()
    assert not any(task.thread.is_alive() for task in started)
    assert tasks.active == []


def test_problem_is_shown_until_it_is_dismissed(qtbot: QtBot):
    line = StatusLine(Tasks())
    qtbot.addWidget(line)
    line.say("30 frames measured", False)
    assert line.message.text() == "30 frames measured"
    assert not line.dismiss_button.isVisibleTo(line)
    line.say("The disk is full", True)
    line.say("One frame measured", False)
    assert "The disk is full" in line.message.text()
    line.say("The recording is gone", True)
    assert "(2 problems)" in line.message.text()
    assert line.dismiss_button.isVisibleTo(line)
    line.dismiss_button.click()
    assert line.message.text() == ""
    line.say("One frame measured", False)
    assert line.message.text() == "One frame measured"


def test_error_after_a_cancel_is_not_reported(qapp: object, qtbot: QtBot):
    tasks, failures, started = Tasks(), [], threading.Event()
    tasks.failed.connect(lambda *words: failures.append(words))

    def work(control: Control) -> None:
        started.set()
        control.cancelled.wait()
        raise RuntimeError("the session is closed")

    task = tasks.start("Reading", work)
    started.wait()
    task.cancel()
    qtbot.waitUntil(lambda: not tasks.active)
    assert failures == []
