from __future__ import annotations

import threading
import time

from pytestqt.qtbot import QtBot

from labapp.errors import InputError
from labapp.gui.shell.messages import StatusLine
from labapp.gui.tasks import Control, Tasks


def test_parts_and_the_result_come_in_order_on_the_gui_thread(qtbot: QtBot):
    tasks = Tasks()
    came: list[tuple[object, bool]] = []
    here = threading.current_thread()

    def take(value: object) -> None:
        came.append((value, threading.current_thread() is here))

    def work(control: Control) -> str:
        for number in range(3):
            control.progress(number + 1, 3)
            control.part(number)
        return "done"

    task = tasks.start("Counting", work, on_done=take, on_part=take)
    qtbot.waitUntil(lambda: not tasks.active)
    assert came == [(0, True), (1, True), (2, True), ("done", True)]
    assert (task.done, task.total) == (3, 3)


def test_a_failure_is_told_in_words(qtbot: QtBot):
    tasks = Tasks()
    told: list[tuple[str, str]] = []
    tasks.failed.connect(lambda title, why: told.append((title, why)))

    def refuse(_: Control) -> None:
        raise InputError("a.avi", "size", "0 bytes", "a video")

    def break_down(_: Control) -> None:
        raise KeyError("x")

    tasks.start("Importing", refuse)
    qtbot.waitUntil(lambda: not tasks.active)
    tasks.start("Measuring", break_down)
    qtbot.waitUntil(lambda: not tasks.active)
    assert told[0] == ("Importing", "a.avi: size: 0 bytes; expected a video")
    assert told[1][0] == "Measuring"
    assert "KeyError" in told[1][1]


def endless(control: Control) -> None:
    number = 0
    while True:
        number += 1
        control.progress(number, 10**9)
        time.sleep(0.001)


def test_cancelling_stops_the_work_and_calls_nothing_back(qtbot: QtBot):
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


def test_closing_waits_for_the_work(qtbot: QtBot):
    tasks = Tasks()
    started = [tasks.start(name, endless) for name in ("Measuring", "Importing")]
    tasks.cancel_all()
    assert not any(task.thread.is_alive() for task in started)
    assert tasks.active == []


def test_a_problem_stays_until_it_was_read(qtbot: QtBot):
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


def test_an_error_after_a_cancel_is_told_to_nobody(qapp: object, qtbot: QtBot):
    tasks, told, begun = Tasks(), [], threading.Event()
    tasks.failed.connect(lambda *words: told.append(words))

    def work(control: Control) -> None:
        begun.set()
        control.cancelled.wait()
        raise RuntimeError("the session is closed")

    task = tasks.start("Reading", work)
    begun.wait()
    task.cancel()
    qtbot.waitUntil(lambda: not tasks.active)
    assert told == []
