"""A short version of `tests/benchmarks/live.py`: all faults occur, and no frame is lost."""

from __future__ import annotations

import csv
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from labapp.gui.live import live
from labapp.gui.live import view as live_view
from labapp.gui.shell.window import MainWindow
from labapp.media import GreyImage
from labapp.media.cameras import feed
from labapp.media.recording import recorder
from labapp.media.recording.nut import NutWriter
from labapp.media.recording.recorder import Recorder
from labapp.session.session import Session
from tests.benchmarks.filming import Disk, FilmedDevice, compare, how_many, times_told
from tests.media.cameras.faulty import Faults

pytestmark = pytest.mark.soak

ROUNDS = 12
STALLED = (3, 8)
"""Rounds in which the disk stalls as well, from before the unplugging to after it."""

BEHIND, CAUGHT_UP = "writing does not keep up", "writing has caught up"


def film(k: int) -> GreyImage:
    """Frame k: moving dots."""
    v, u = np.mgrid[:48, :64] + 3 * np.sin([[[k / 7]], [[k / 5]]])
    return (40 + 80 * (np.sin(u) > 0.9) * (np.sin(v) > 0.9)).astype(np.uint8)


def test_no_frame_is_lost_and_every_fault_is_reported(
    window: MainWindow, tmp_path: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    disk_runs = threading.Event()
    disk_runs.set()

    def writer(path: Path, *args: object) -> NutWriter:
        return NutWriter(path, *args, file=Disk(path, disk_runs))

    device = FilmedDevice(film, 200, 1_000_000)
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: device)
    monkeypatch.setattr(live, "Recorder", partial(Recorder, writer=writer))
    monkeypatch.setattr(recorder, "STALL_S", 0.2)
    monkeypatch.setattr(feed, "RETRY_S", (0.01,))
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    window.show_step("capture")
    view, truth = window.page.live_view, device.truth

    def messages() -> list[str]:
        return times_told(window.log_panel.texts())

    view.start()
    qtbot.waitUntil(lambda: view.updates > 2)
    start_s = time.monotonic()
    view.trigger()
    take = view.live.takes[0]
    device.spoil(Faults(garbage=0.05, seed=4804), 0.05)
    for k in range(ROUNDS):
        before = truth.frames
        qtbot.waitUntil(lambda before=before: truth.frames > before + 10)
        if k in STALLED:
            # The disk of a busy computer can stall by itself, too.
            qtbot.waitUntil(lambda: how_many(messages(), BEHIND) == how_many(messages(), CAUGHT_UP))
            stalls = how_many(messages(), BEHIND)
            disk_runs.clear()
            qtbot.waitUntil(lambda n=stalls: how_many(messages(), BEHIND) > n)
        device.unplug()
        qtbot.waitUntil(lambda k=k: how_many(messages(), "was unplugged") == k + 1)
        device.plug()
        qtbot.waitUntil(lambda k=k: how_many(messages(), "it is back after") == k + 1)
        if k in STALLED:
            disk_runs.set()
            qtbot.waitUntil(lambda n=stalls: how_many(messages(), CAUGHT_UP) > n)
    qtbot.waitUntil(lambda: truth.broken > 5)
    device.faults = Faults()
    qtbot.waitUntil(lambda: how_many(messages(), "incomplete, discarded") == truth.broken)
    end_s = time.monotonic()
    view.trigger()
    qtbot.waitUntil(take.finished.is_set)
    counts = view.live.feed.counts
    view.stop()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert (counts.broken, counts.lost) == (truth.broken, ROUNDS)
    assert (take.lost, take.trouble) == (0, "")
    comparison = compare(take.path, device, start_s, end_s)
    assert comparison.right, comparison
    assert comparison.frames == take.frames
    with take.notes.open(encoding="utf-8", newline="") as file:
        notes = [row["what"] for row in csv.DictReader(file)]
    for words in ("was unplugged", "it is back after", "incomplete, discarded"):
        assert how_many(notes, words) == how_many(messages(), words), words
    for words in (BEHIND, CAUGHT_UP):
        assert how_many(notes, words) >= len(STALLED), words
