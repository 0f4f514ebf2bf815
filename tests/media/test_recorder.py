from __future__ import annotations

import csv
import errno
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media import GreyImage, open_source
from labapp.media.cameras import CameraFrame, Feed, feed
from labapp.media.events import Event
from labapp.media.recording import recorder as recorder_module
from labapp.media.recording.nut import NutWriter
from labapp.media.recording.recorder import Plan, Recorder, recording_path
from labapp.media.recording.take_files import Take
from labapp.session.session import Session
from tests.media.cameras.faulty import Faults, FaultyDevice
from tests.media.cameras.watching import Events, number_in, numbered
from tests.waiting import PATIENCE_S, wait_until

RATE_HZ = 100.0


class Disk:
    """A file whose writing can be stalled, with limited space."""

    def __init__(self, path: Path, room: int = sys.maxsize) -> None:
        self.file, self.room = path.open("xb", buffering=0), room
        self.goes = threading.Event()
        self.goes.set()

    def write(self, content: memoryview) -> int:
        self.goes.wait()
        if not self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self.file.write(content[: self.room])
        self.room -= written
        return written

    def close(self) -> None:
        self.file.close()


def frame(k: int) -> CameraFrame:
    return CameraFrame(k, k / RATE_HZ, 0.0, numbered(k))


def numbers(take: Take) -> list[int]:
    """Return the numbers of the frames in a recording."""
    with open_source(take.path) as video:
        return [number_in(frame.image) for frame in video]


def notes(take: Take) -> list[dict[str, str]]:
    with take.notes.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., Recorder]:
    """Start a recorder of a camera of 100 frames/s: (fields of the plan …, say, writer)."""

    def begin(say: Callable[[Event], None] = lambda _: None, **fields: object) -> Recorder:
        writer = fields.pop("writer", NutWriter)
        next_path = partial(recording_path, tmp_path, "run")
        return Recorder(next_path, Plan(**fields), 8, RATE_HZ, say, writer)

    return begin


Start = Callable[..., Recorder]


def test_recording_starts_before_the_trigger_and_ends_after_it(start: Start) -> None:
    with start(before_s=0.1, after_s=0.2) as recorder:
        for k in range(200):
            if k == 100:
                take = recorder.trigger()
            recorder.take(frame(k))
    # The newest frame at the trigger is 99: from 0.1 s before it to 0.2 s after it.
    assert numbers(take) == list(range(89, 120))
    assert (take.frames, take.lost, take.trouble) == (31, 0, "")
    with open_source(take.path) as video:
        assert video.frame(0).time_s == 0
        assert video.frame(30).time_s == pytest.approx(0.30)
        assert video.frame_rate_hz == RATE_HZ
    row, last = notes(take)
    assert last["what"] == "31 frames recorded"
    assert row["what"] == "trigger, 11 frames before it"
    assert float(row["time_s"]) == pytest.approx(0.1)


def test_every_third_frame_is_recorded_until_stopped(start: Start) -> None:
    with start(every=3) as recorder:
        for k in range(10):
            recorder.take(frame(k))
        take = recorder.trigger()
        assert recorder.trigger() is take  # one at a time
        for k in range(10, 40):
            recorder.take(frame(k))
        recorder.stop()
        for k in range(40, 60):
            recorder.take(frame(k))
        assert take.finished.wait(PATIENCE_S)
    assert numbers(take) == list(range(12, 40, 3))
    with open_source(take.path) as video:
        assert video.frame_rate_hz == pytest.approx(RATE_HZ / 3, rel=1e-3)


def test_recording_triggered_without_camera_starts_when_it_returns(start: Start) -> None:
    with start(after_s=0.2) as recorder:
        for k in range(10):
            recorder.take(frame(k))
        take = recorder.trigger()
        for k in range(6000, 6100):  # a minute later
            recorder.take(frame(k))
    assert numbers(take) == list(range(6000, 6020))


def test_successive_recordings_have_separate_files(start: Start) -> None:
    with start(before_s=0.05, after_s=0.1) as recorder:
        for k in range(100):
            if k in (20, 60):
                recorder.trigger()
            recorder.take(frame(k))
    first, second = recorder.takes
    assert numbers(first) == list(range(14, 30))
    assert numbers(second) == list(range(54, 70))
    assert first.path != second.path


def test_marks_and_events_are_written_beside_the_recording(start: Start) -> None:
    with start() as recorder:
        recorder.note(Event("pedal", "note", "before there is a recording"))
        take = recorder.trigger()
        for k in range(10):
            recorder.take(frame(k))
            if k == 4:
                recorder.note(Event("pedal", "note", 'mark, "here"'))
    rows = notes(take)
    assert [row["what"] for row in rows] == [
        "trigger, 0 frames before it",
        'mark, "here"',
        "10 frames recorded",
    ]
    assert (rows[1]["source"], rows[1]["kind"]) == ("pedal", "note")
    assert float(rows[1]["time_s"]) == pytest.approx(0.04)
    assert int(rows[1]["frame"]) == 5


def test_late_note_refers_to_its_frame(start: Start) -> None:
    with start() as recorder:
        take = recorder.trigger()
        for k in range(20):
            recorder.take(frame(k))
        recorder.note(Event("camera", "warning", "late"), frame(6).time_s)
    late = next(row for row in notes(take) if row["what"] == "late")
    assert (float(late["time_s"]), int(late["frame"])) == (pytest.approx(0.06), 7)


def test_closed_recorder_frees_frames_and_rejects_triggers(start: Start) -> None:
    with start(before_s=1) as recorder:
        for k in range(50):
            recorder.take(frame(k))
        assert recorder.waiting_mb > 0.04
    assert recorder.waiting_mb == 0
    assert not recorder._ring
    with pytest.raises(InputError, match="recording: trigger: closed"):
        recorder.trigger()
    assert not recorder.takes


def test_stalled_disk_loses_no_frames_while_memory_suffices(start: Start, tmp_path: Path) -> None:
    disk = Disk(tmp_path / "disk.nut")
    disk.goes.clear()
    events = Events()
    writer = partial(NutWriter, file=disk)
    with start(events.append, memory_mb=1, writer=writer) as recorder:
        take = recorder.trigger()
        for k in range(800):  # of 968 bytes in memory each
            recorder.take(frame(k))
        assert 0.5 < recorder.waiting_mb < 1
        assert "writing does not keep up" in events.words()
        disk.goes.set()
        wait_until(lambda: recorder.waiting_mb == 0)
        assert "writing has caught up" in events.words()
    assert (take.frames, take.lost) == (800, 0)
    with open_source(tmp_path / "disk.nut") as video:
        assert [number_in(stored.image) for stored in video] == list(range(800))


def test_stalled_disk_is_reported(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "STALL_S", 0.05)
    disk = Disk(tmp_path / "disk.nut")
    events = Events()
    numbers_from = iter(range(1_000_000))
    with start(events.append, writer=partial(NutWriter, file=disk)) as recorder:
        take = recorder.trigger()
        for _ in range(2):
            disk.goes.clear()
            count = len(events)

            def is_reported(count: int = count) -> bool:
                recorder.take(frame(next(numbers_from)))
                return len(events) > count

            wait_until(is_reported)
            disk.goes.set()
            wait_until(lambda: events[-1].words == "writing has caught up")
    messages = [event.words for event in events if event.source == "recording"]
    stalled, caught_up = messages[::2], messages[1::2]
    assert caught_up == ["writing has caught up"] * 2
    for words in stalled:
        assert words.startswith("writing does not keep up, the disk has stalled for 0.")
        assert words.endswith(" 0 MB are queued in memory")
    assert [row["what"] for row in notes(take)][1:-1] == messages
    assert (take.frames, take.lost) == (next(numbers_from), 0)


def test_frames_beyond_the_memory_are_dropped_and_reported(start: Start, tmp_path: Path) -> None:
    disk = Disk(tmp_path / "disk.nut")
    disk.goes.clear()
    events = Events()
    writer = partial(NutWriter, file=disk)
    with start(events.append, memory_mb=1, writer=writer) as recorder:
        take = recorder.trigger()
        for k in range(1500):
            recorder.take(frame(k))
            assert recorder.waiting_mb <= 1
        disk.goes.set()
        wait_until(lambda: recorder.waiting_mb == 0)
        for k in range(1500, 1600):
            recorder.take(frame(k))
    with open_source(tmp_path / "disk.nut") as video:
        recorded = [number_in(stored.image) for stored in video]
    assert len(recorded) + take.lost == 1600
    assert recorded == [*range(1500 - take.lost), *range(1500, 1600)]
    messages = [event.words for event in events if event.kind == "loss"]
    counted = [int(words.split()[0]) for words in messages if "memory is full" in words]
    assert sum(counted) == take.lost > 0
    assert f"{take.lost} lost" in messages[-1]
    assert any("memory is full" in row["what"] for row in notes(take))


def test_pre_trigger_time_beyond_the_memory_is_reported(start: Start) -> None:
    events = Events()
    with start(events.append, before_s=60, memory_mb=1) as recorder:
        for k in range(2000):
            recorder.take(frame(k))
            assert recorder.waiting_mb <= 1
        take = recorder.trigger()
    assert numbers(take) == list(range(2000 - take.frames, 2000))
    assert take.frames == 1_000_000 // (24 * 32 + 200)
    assert events.words().count("before the trigger are buffered, not 60 s") == 1


def test_full_disk_is_reported_and_recorded_frames_are_complete(
    start: Start, tmp_path: Path
) -> None:
    disk = Disk(tmp_path / "disk.nut", room=20 * 24 * 32)
    events = Events()
    writer = partial(NutWriter, file=disk)
    with start(events.append, writer=writer) as recorder:
        take = recorder.trigger()
        for k in range(100):
            recorder.take(frame(k))
        wait_until(lambda: bool(take.trouble))
    assert "No space left on device" in take.trouble
    assert take.finished.is_set()
    assert 10 < take.frames < 20
    assert take.frames + take.lost == 100
    with open_source(tmp_path / "disk.nut") as video:
        assert [number_in(stored.image) for stored in video] == list(range(take.frames))
    assert f"written so far and intact: {take.frames} frames" in events.words()


def test_frames_of_another_format_are_dropped_and_reported(tmp_path: Path) -> None:
    events = Events()
    wrong = {0: (24, 32), 7: (24, 32), 8: (12, 32)}
    with Recorder(lambda: tmp_path / "run.nut", Plan(), 12, RATE_HZ, events.append) as recorder:
        take = recorder.trigger()
        for k in range(30):
            levels = 5000 if k in wrong else 100 + k  # of 4095
            image = np.full(wrong.get(k, (24, 32)), levels, np.uint16)
            recorder.take(CameraFrame(k, k / RATE_HZ, 0.0, image))
    assert (take.frames, take.lost, take.trouble) == (27, 3, "")
    with open_source(take.path) as video:
        recorded = [int(item.image[0, 0]) - 100 for item in video]
        assert recorded == [k for k in range(30) if k not in wrong]
        assert [video.frame(k).time_s for k in (0, 5, 6)] == pytest.approx([0, 0.05, 0.08])
    messages = [item.words for item in events if "discarded: of another size" in item.words]
    assert sum(int(words.split()[0]) for words in messages) == 3
    assert [row["what"] for row in notes(take) if row["what"] in messages] == messages


def test_unwritable_notes_are_reported_once_without_ending_the_video(start: Start) -> None:
    events = Events()
    with start(events.append) as recorder:
        take = recorder.trigger()
        take.notes.mkdir()
        for k in range(30):
            recorder.take(frame(k))
            recorder.note(Event("pedal", "note", "mark"))
    assert numbers(take) == list(range(30))
    assert (take.frames, take.lost, take.trouble) == (30, 0, "")
    assert events.words().count("not all notes can be written beside it: Is a directory") == 1
    with open_source(take.path) as video:
        assert not video.warnings  # it was closed properly


@pytest.mark.parametrize("marks", [0, 4])
def test_frames_lost_by_a_broken_disk_are_counted(start: Start, marks: int) -> None:
    class Breaking(NutWriter):
        def write(self, image: GreyImage, time_s: float) -> None:
            if self.frames == 5:
                raise OSError(errno.EIO, "Input/output error")
            super().write(image, time_s)

    with start(writer=Breaking) as recorder:
        take = recorder.trigger()
        for k in range(50):
            recorder.take(frame(k))
        wait_until(lambda: recorder.waiting_mb == 0)
        for _ in range(marks):
            recorder.note(Event("pedal", "note", "mark"))
    assert (take.frames, take.lost) == (5, 45)
    assert take.trouble == "cannot be written: Input/output error"
    assert notes(take)[-1]["what"] == "5 frames recorded, 45 lost"


def test_missing_folder_is_reported(tmp_path: Path) -> None:
    events = Events()
    next_path = partial(recording_path, tmp_path / "away", "run")
    with Recorder(next_path, Plan(), 8, RATE_HZ, events.append) as recorder:
        take = recorder.trigger()
        recorder.take(frame(0))
        wait_until(lambda: bool(take.trouble))
    assert "No such file or directory" in take.trouble


@pytest.mark.parametrize("name", ["mine.nut", "mine-notes.csv"])
def test_dangling_link_is_not_followed(tmp_path: Path, name: str) -> None:
    (tmp_path / name).symlink_to("elsewhere")
    with (
        Recorder(lambda: tmp_path / "mine.nut", Plan(), 8, RATE_HZ) as recorder,
        pytest.raises(InputError, match=f"{name}: recording: is there already"),
    ):
        recorder.trigger()
    assert not (tmp_path / "elsewhere").exists()


def test_notes_do_not_follow_a_link_created_meanwhile(start: Start, tmp_path: Path) -> None:
    events = Events()
    with start(events.append) as recorder:
        take = recorder.trigger()
        take.notes.symlink_to(tmp_path / "elsewhere")
        for number in range(5):
            recorder.take(frame(number))
    assert take.frames == 5
    assert events.words().count("not all notes can be written beside it: File exists") == 1
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("name", ["mine.nut", "mine-notes.csv"])
def test_existing_file_is_not_overwritten(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with Recorder(lambda: tmp_path / "mine.nut", Plan(), 8, RATE_HZ) as recorder:
        with pytest.raises(InputError, match=f"{name}: recording: is there already"):
            recorder.trigger()
        assert recorder.running is None
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(name, "mine")]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("before_s", -1),
        ("before_s", float("nan")),
        ("after_s", -1),
        ("every", 0),
        ("codec", "h264"),
        ("memory_mb", 0),
    ],
)
def test_impossible_plan_is_rejected(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"recording: {name}: "):
        Plan(**{name: value})


def test_recording_survives_unplugging_garbage_and_a_stalled_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "RETRY_S", (0.01,))
    faults = Faults(garbage=0.01, unplug_every=30, unplugged_s=0.03, stall_every=400, seed=9)
    device = FaultyDevice("test", numbered, rate_hz=1000, faults=faults)
    disk = Disk(tmp_path / "disk.nut")
    events = Events()
    passed_on: list[int] = []
    writer = partial(NutWriter, file=disk)
    with Recorder(
        lambda: tmp_path / "run.nut", Plan(memory_mb=4), 8, 1000, events.append, writer
    ) as recorder:
        take = recorder.trigger()

        def pass_on(item: CameraFrame) -> None:
            passed_on.append(number_in(item.image))
            recorder.take(item)

        def say(event: Event) -> None:
            events.append(event)
            recorder.note(event)

        with Feed("camera", device.open, pass_on, say) as running:
            wait_until(lambda: device.disconnects >= 20)
            disk.goes.clear()
            wait_until(lambda: device.disconnects >= 40)
            disk.goes.set()
            wait_until(lambda: device.disconnects >= 50)
    assert take.lost == 0
    assert take.frames == len(passed_on) == running.counts.frames
    with open_source(tmp_path / "disk.nut") as video:
        assert [number_in(item.image) for item in video] == passed_on
        times_s = [item.time_s for item in video]
    assert (np.diff(np.array(times_s, float)) > 0).all()
    texts = [row["what"] for row in notes(take)]
    assert sum("was unplugged" in words for words in texts) == running.counts.lost >= 45
    assert sum("is back" in words for words in texts) >= 45


def test_recording_can_be_imported_into_a_session(start: Start, tmp_path: Path) -> None:
    with start(before_s=1, codec="ffv1") as recorder:
        for k in range(30):
            recorder.take(frame(k))
        take = recorder.trigger()
    with Session.create(tmp_path / "run.labsession") as session:
        recording = session.import_recording(take.path)
        assert recording.frame_exact
        assert recording.description.startswith("NUT, FFV1, 32×24 px, 8 bit grey")
        assert session.frames.tolist() == list(range(30))
        assert np.array_equal(session.frame(17).image, numbered(17))
        assert session.frame(17).time_s == pytest.approx(0.17)
