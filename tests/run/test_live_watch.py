"""Measurement of live frames: trend, rate, alarms, streams."""

from __future__ import annotations

import csv
import json
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from labapp.config.setup import Setup, read_setup
from labapp.core.dynamics.penetration import ModelSettings, PenetrationModel
from labapp.core.dynamics.static_maps import LinearMap
from labapp.core.dynamics.weld_series import Orders
from labapp.core.images.dots import Dots
from labapp.core.pipeline import Measurement, Settings
from labapp.core.recording import chain as recording_chain
from labapp.core.surface.measures import Measures
from labapp.export.penetration import Predictor
from labapp.export.rendering.scene import Scene, empty_scene
from labapp.media import open_source
from labapp.media.cameras import CameraFrame
from labapp.media.events import Event
from labapp.run import live_measuring, live_trend, live_watch
from labapp.run.limits import Limits, Size, standing
from labapp.run.live_measuring import (
    JUDGED_S,
    SEARCH_AFTER_S,
    LiveChain,
    LiveMeasuring,
    LiveMeasuringEnded,
    LiveResult,
)
from labapp.run.live_watch import REMEDY, LiveWatch
from labapp.run.streams import LineStream
from tests.waiting import PATIENCE_S, connect, wait_until

SAMPLE = Path(__file__).parents[2] / "sample_sessions" / "gtaw"

MEASURES = Measures(*[0.0] * 4, 6.7, 7.5, 0.30, -0.01, *[0.0] * 6, *[0.03, 0.04, 0.003] * 2)

Events = list[tuple[Event, float | None]]


class Prepared:
    """A measurer with prepared results: a width for each frame number, or None for a failure."""

    def __init__(self, *_: object) -> None:
        self.widths: dict[int, float | None] = {}
        self.drawn: list[bool] = []

    def measure(self, frame: CameraFrame, drawn: bool) -> LiveResult:
        self.drawn.append(drawn)
        width = self.widths.get(int(frame.image[0, 0]), 6.7)
        result = LiveResult(
            frame=frame.number,
            time_s=frame.time_s,
            arrived_s=frame.arrived_s,
            measurement=Measurement("no-dots", "it is dark", "fit"),
            quality=None,  # type: ignore[arg-type]  # no verdict
        )
        if width is None:
            return result
        scene: Scene | None = empty_scene(np.zeros((1, 3)), (0, 1), "", "") if drawn else None
        measurement = Measurement("ok", "", "fit", measures=replace(MEASURES, width_mm=width))
        return replace(result, measurement=measurement, scene=scene)

    def close(self) -> None:
        pass


@pytest.fixture
def setup() -> Setup:
    return read_setup(SAMPLE / "setup.toml")


@pytest.fixture
def events() -> Events:
    return []


@pytest.fixture
def watch(setup: Setup, events: Events, monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveWatch]:
    monkeypatch.setattr(live_watch, "LiveMeasuring", Prepared)
    limits = Limits(width_mm=(6.0, 6.9), unmeasured=2)
    watch = LiveWatch("camera", setup, Settings(), 8, limits, lambda *event: events.append(event))
    yield watch
    watch.close()


def frame(number: int, image: np.ndarray | None = None) -> CameraFrame:
    if image is None:
        image = np.full((2, 2), number, np.uint8)
    return CameraFrame(number, 10.0 + number, time.monotonic(), image)


def prepare(watch: LiveWatch, widths: dict[int, float | None]) -> Prepared:
    prepared: Any = watch._measuring
    prepared.widths = widths
    return prepared


def test_trend_contains_every_tried_frame(watch: LiveWatch):
    prepare(watch, {1: 7.2, 2: None})
    limits = watch.alarms.limits
    assert watch.trend.over(60, limits).names == ("width", "length", "height")
    assert watch.trend.over(60, limits).value_mm.shape == (3, 0)
    for number in range(4):
        watch.measure(frame(number))
    trend = watch.trend.over(60, limits)
    assert trend.number.tolist() == [0, 1, 2, 3]
    assert np.array_equal(trend.value_mm[0], [6.7, 7.2, np.nan, 6.7], equal_nan=True)
    assert np.array_equal(trend.sigma_mm[1], [0.04, 0.04, np.nan, 0.04], equal_nan=True)
    assert trend.beyond.tolist() == [[False, True, False, False], *[[False] * 4] * 2]
    assert (trend.since_s <= 0).all()
    assert (np.diff(trend.since_s) >= 0).all()
    assert len(watch.trend.over(0.0, limits).number) == 0
    pace = watch.trend.pace()
    assert (pace.tried, pace.failed) == (4, 1)
    assert pace.measured_hz == 3 / live_trend.RATE_S


def test_trend_drops_old_frames(watch: LiveWatch, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(live_trend, "TREND_S", 0.0)
    for number in range(50):
        watch.measure(frame(number))
    assert watch.trend.over(60, Limits()).number.tolist() == [49]


def test_alarms_are_reported_with_the_time_of_their_frame(watch: LiveWatch, events: Events):
    prepare(watch, {3: 7.2, 4: 7.2, 6: None, 7: None})
    for number in range(9):
        watch.measure(frame(number))
    watch.acknowledge()
    watch.acknowledge()
    assert [(event.kind, time_s) for event, time_s in events] == [
        ("warning", 13.0),
        ("note", 15.0),
        ("warning", 17.0),
        ("note", 18.0),
        ("note", None),
        ("note", None),
    ]
    words = [event.words for event, _ in events]
    assert words[0] == "ALARM: Width 7.200 ± 0.030 mm is above 6.9 mm (frame 3)"
    assert words[1].startswith("alarm over: Width 7.200")
    assert words[2] == "ALARM: 2 frames in a row could not be measured: it is dark (frame 7)"
    assert words[4].startswith("alarm acknowledged: Width")
    assert watch.alarms.shown == ()
    for _ in range(2):
        watch.set_limits(Limits(width_mm=(6.0, None)))
    assert [event.words for event, _ in events[6:]] == ["limits now: width from 6 mm"]


def test_missing_results_are_an_alarm_until_the_next_result(
    watch: LiveWatch, events: Events, monkeypatch: pytest.MonkeyPatch
):
    watch.measure(frame(3))
    assert watch.next_frame() is None
    assert events == []
    monkeypatch.setattr(live_watch, "SILENT_S", 0.0)
    for _ in range(3):
        watch.next_frame()
    assert [event.words for event, _ in events] == [
        "ALARM: No frame has been measured for 0 s (frame 3)"
    ]
    assert [(alarm.code, alarm.holds) for alarm in watch.alarms.shown] == [("silent", True)]
    watch.measure(frame(5))
    assert [(alarm.code, alarm.holds) for alarm in watch.alarms.shown] == [("silent", False)]
    assert events[-1][0].words.startswith("alarm over: No frame has been measured")


def test_failed_measuring_is_an_alarm_and_is_streamed(
    watch: LiveWatch, events: Events, setup: Setup
):
    stream = LineStream()
    watch.set_stream("lines", stream)
    with connect(stream.port) as connection:
        lines = connection.makefile(encoding="utf-8")
        lines.readline()

        def broken(*_: object) -> LiveResult:
            raise LiveMeasuringEnded("the process was killed")

        prepare(watch, {}).measure = broken  # type: ignore[method-assign]  # it breaks
        for number in (7, 8):
            watch.measure(frame(number))
        line = json.loads(lines.readline())
        assert line["status"] == "silent"
        assert line["alarm"] == "silent"
        assert line.get("width_mm") is None
        assert [event.kind for event, _ in events] == ["warning", "warning"]  # once, and the alarm
        for event, _ in events:
            assert "Nothing is measured any more: the process was killed" in event.words
            assert REMEDY in event.words
        assert REMEDY in watch.stopped
        # Another set-up begins the measuring anew.
        watch.set_setup(setup, Settings())
        assert watch.stopped == ""
        watch.measure(frame(9))
        found = [json.loads(lines.readline())["status"] for _ in range(2)]
        assert found == ["silent", "ok"]
    assert watch.newest() is not None


def test_ended_measuring_is_reported_before_its_process_is_awaited(
    watch: LiveWatch, events: Events, monkeypatch: pytest.MonkeyPatch
):
    """A set-up that is changed meanwhile is not followed by the report."""

    def killed(*_: object) -> LiveResult:
        raise LiveMeasuringEnded("the process was killed")

    reported = []
    prepared = prepare(watch, {})
    monkeypatch.setattr(prepared, "measure", killed)
    monkeypatch.setattr(prepared, "close", lambda: reported.extend(events))
    watch.measure(frame(1))
    assert reported == events
    assert len(reported) > 0


def test_fault_in_a_sink_is_reported_and_lasts_until_the_next_setup(
    watch: LiveWatch, events: Events, setup: Setup, monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as patched:
        patched.setattr(watch.alarms, "judge", lambda *_: 1 / 0)
        watch.measure(frame(1))
    assert "ZeroDivisionError" in watch.stopped
    watch.set_setup(setup, Settings())
    watch.measure(frame(2))
    assert watch.newest() is not None


def test_changed_setup_does_not_wait_for_the_former_process(
    watch: LiveWatch, setup: Setup, monkeypatch: pytest.MonkeyPatch
):
    gate, ended = threading.Event(), threading.Event()

    def close() -> None:
        gate.wait(10.0)
        ended.set()

    prepare(watch, {}).close = close  # type: ignore[method-assign]  # ends slowly
    watch.set_setup(setup, Settings())
    assert not ended.is_set()
    gate.set()
    wait_until(ended.is_set)


def test_streams_say_at_once_that_sizes_of_a_former_setup_do_not_hold(
    watch: LiveWatch, setup: Setup
):
    stream = LineStream()
    watch.set_stream("lines", stream)
    with connect(stream.port) as connection:
        lines = connection.makefile(encoding="utf-8")
        lines.readline()
        watch.measure(frame(1))
        watch.set_setup(setup, Settings())
        watch.set_setup(None, None)
        watch.measure(frame(2))
        watch.set_setup(setup, Settings())
        watch.measure(frame(3))
        values = [json.loads(lines.readline()) for _ in range(5)]
    assert [each["status"] for each in values] == ["ok", *["silent"] * 3, "ok"]
    assert [each["width_mm"] for each in values] == [6.7, None, None, None, 6.7]
    assert watch.stream("lines") is stream


def test_nothing_is_said_of_a_frame_before_the_first_result(watch: LiveWatch, setup: Setup):
    stream = LineStream()
    watch.set_stream("lines", stream)
    with connect(stream.port) as connection:
        lines = connection.makefile(encoding="utf-8")
        lines.readline()
        watch.set_setup(setup, Settings())
        watch.measure(frame(4))
        watch.set_setup(setup, Settings())
        values = [json.loads(lines.readline()) for _ in range(3)]
    assert [each["status"] for each in values] == ["silent", "ok", "silent"]
    assert [each["frame"] for each in values] == [None, 4, 4]
    assert [each["time_s"] for each in values] == [None, 14.0, 14.0]


class Faulty:
    """A stream that cannot send, and does not end."""

    address, sent, listeners = "nowhere:1", 0, 0

    def __init__(self) -> None:
        self.gate, self.closed = threading.Event(), threading.Event()

    def publish(self, _: object) -> None:
        raise RuntimeError("the loop is closed")

    def close(self) -> None:
        self.gate.wait(PATIENCE_S)
        self.closed.set()


def test_faulty_stream_is_closed_and_reported_while_measuring_continues(
    watch: LiveWatch, events: Events
):
    faulty, stream = Faulty(), LineStream()
    watch.set_stream("opcua", faulty)
    watch.set_stream("lines", stream)
    with connect(stream.port) as connection:
        lines = connection.makefile(encoding="utf-8")
        lines.readline()
        for number in (1, 2):
            watch.measure(frame(number))
        assert [json.loads(lines.readline())["frame"] for _ in range(2)] == [1, 2]
    assert watch.stopped == ""
    assert (watch.stream("opcua"), watch.stream("lines")) == (None, stream)
    assert [event.kind for event, _ in events] == ["warning"]
    assert "nowhere:1" in events[0][0].words
    assert "the loop is closed" in watch.stream_faults["opcua"]
    assert not faulty.closed.is_set()  # it is not awaited
    faulty.gate.set()
    wait_until(faulty.closed.is_set)
    watch.set_stream("opcua", None)
    assert watch.stream_faults == {}


def test_alarms_ended_by_new_limits_are_reported(watch: LiveWatch, events: Events):
    prepare(watch, {1: 7.2})
    watch.measure(frame(1))
    watch.set_limits(Limits(width_mm=(6.0, 7.5)))
    kinds = [event.words.partition(":")[0] for event, _ in events]
    assert kinds == ["ALARM", "alarm over", "limits now"]


def test_trend_marks_the_values_beyond_the_limits(watch: LiveWatch):
    rng = np.random.default_rng(3)
    widths = {k: float(w) for k, w in enumerate(rng.uniform(5.8, 7.1, 60))}
    prepare(watch, {**widths, 7: None})
    for number in widths:
        watch.measure(frame(number))
    limits = watch.alarms.limits
    trend = watch.trend.over(60, limits)
    sizes = zip(trend.value_mm[0].tolist(), trend.sigma_mm[0].tolist(), strict=True)
    standings = [standing(Size("width", *size), limits.width_mm) for size in sizes]
    assert trend.beyond[0].tolist() == [size in ("low", "high") for size in standings]
    assert {"low", "high", "in order", "unknown"} <= set(standings)


def test_surface_is_drawn_once_per_request(watch: LiveWatch):
    prepared = prepare(watch, {1: None})
    watch.measure(frame(0))
    watch.ask_for_scene()
    for number in (1, 2, 3):  # the first one has no surface
        watch.measure(frame(number))
    assert prepared.drawn == [False, True, True, False]
    result = watch.newest()
    assert result is not None
    assert result.frame == 3
    assert watch.newest() is None
    # The requested surface is available although another frame was measured since.
    assert watch.scene() is not None
    assert watch.scene() is None


def test_frames_and_alarms_are_streamed(watch: LiveWatch):
    prepare(watch, {1: 7.2, 2: None})
    stream = LineStream()
    watch.set_stream("lines", stream)
    assert watch.stream("lines") is stream
    with connect(stream.port) as connection:
        file = connection.makefile("rb")
        file.readline()
        for number in range(3):
            watch.measure(frame(number))
        lines = [json.loads(file.readline()) for _ in range(3)]
        watch.acknowledge()
        watch.measure(frame(3))
        lines.append(json.loads(file.readline()))
        assert (stream.sent, stream.listeners) == (4, 1)
        file.close()
    assert [line["width_mm"] for line in lines] == [6.7, 7.2, None, 6.7]
    assert [line["status"] for line in lines] == ["ok", "ok", "no-dots", "ok"]
    assert [line["time_s"] for line in lines] == [frame(number).time_s for number in range(4)]
    assert [line["alarm"] for line in lines] == ["", "width-high", "width-high", ""]
    assert [line["unacknowledged"] for line in lines] == ["", "width-high", "width-high", ""]
    assert lines[0]["scheme"] == "fit"
    watch.set_stream("lines", None)
    assert watch.stream("lines") is None


def test_stream_added_after_the_end_is_closed(watch: LiveWatch):
    watch.close()
    stream = LineStream()
    watch.set_stream("lines", stream)
    with pytest.raises(OSError, match="refused"):
        connect(stream.port)


def test_pool_beyond_a_limit_and_darkness_raise_alarms(setup: Setup, events: Events):
    """A rendered pool of known width is measured in the measuring process."""
    with (SAMPLE / "truth.csv").open() as file:
        width = float(next(csv.DictReader(file))["width_mm"])
    with open_source(SAMPLE / "recording.avi") as video:
        image = video.frame(0).image
    narrow = Limits(width_mm=(None, 0.9 * width), height_mm=(None, 5.0), unmeasured=2)
    watch = LiveWatch("camera", setup, Settings(), 8, narrow, lambda *event: events.append(event))
    try:
        watch.ask_for_scene()
        watch.measure(frame(0, image))
        scene = watch.scene()
        assert scene is not None
        assert np.ptp(scene.vertices_mm[:, 0]) == pytest.approx(width, rel=0.02)
        assert [alarm.code for alarm in watch.alarms.shown] == ["width-high"]
        watch.alarms.set_limits(replace(narrow, width_mm=(0.9 * width, 1.1 * width)))
        watch.acknowledge()
        watch.measure(frame(1, image))
        assert watch.alarms.shown == ()
        dark = np.random.default_rng(3).integers(0, 4, image.shape).astype(np.uint8)
        began_s = time.monotonic()
        for number in count(2):  # the first dark frames are skipped
            watch.measure(frame(number, dark))
            if watch.alarms.shown:
                break
            assert time.monotonic() < began_s + PATIENCE_S
        assert [alarm.code for alarm in watch.alarms.shown] == ["not-measured"]
        assert events[-1][0].words.startswith("ALARM: 2 frames in a row could not be measured: ")
    finally:
        watch.close()


def test_changed_setup_replaces_the_results(watch: LiveWatch, events: Events, setup: Setup):
    former = prepare(watch, {1: 7.2})
    watch.measure(frame(1))
    assert [alarm.code for alarm in watch.alarms.shown] == ["width-high"]

    def replaced_meanwhile(given: CameraFrame, drawn: bool) -> LiveResult | None:
        watch.set_setup(setup, Settings())
        prepare(watch, {3: 6.5})
        return Prepared.measure(former, given, drawn)

    former.measure = replaced_meanwhile  # type: ignore[method-assign]  # in mid-measurement
    watch.measure(frame(2))
    assert watch.newest() is None
    assert watch.trend.over(60, Limits()).number.tolist() == []
    assert [alarm.code for alarm in watch.alarms.shown] == ["width-high"]  # until it is measured
    watch.measure(frame(3))
    assert watch.trend.over(60, Limits()).number.tolist() == [3]
    assert "set-up" in events[-2][0].words
    watch.set_setup(None, Settings())
    watch.measure(frame(4))
    assert watch.newest() is None


@pytest.mark.skipif(not hasattr(os, "nice"), reason="the system knows no niceness")
def test_measuring_process_has_normal_priority(setup: Setup):
    """With a lower priority, its results could be a minute old on a busy machine."""
    with closing(LiveMeasuring(setup, Settings(), 8)) as measuring:
        assert measuring._pool.submit(os.nice, 0).result() == os.nice(0)


def test_skipped_frame_is_not_a_failed_frame(watch: LiveWatch, events: Events):
    prepared = prepare(watch, {})
    watch.measure(frame(1))
    measure = prepared.measure
    prepared.measure = lambda *_: None  # type: ignore[method-assign, assignment]
    for number in range(2, 9):
        watch.measure(frame(number))
    prepared.measure = measure  # type: ignore[method-assign]
    watch.measure(frame(9))
    assert watch.trend.over(60, Limits()).number.tolist() == [1, 9]
    assert watch.trend.pace().failed == 0
    assert events == []


class Chain:
    """Follows frames unless it is lost; records the times of searches, skips and judgements."""

    def __init__(self) -> None:
        self.now_s, self.is_lost = 100.0, True
        self.searched: list[float] = []
        self.judged: list[float] = []
        self.skipped: list[float] = []
        self.track_lost: str | None = None
        self.measurement = Measurement("ok", "", "fit", Dots(*np.ones((7, 2))), measures=MEASURES)

    def track(self, _: np.ndarray) -> Measurement | None:
        self.track_lost = "it jumped" if self.is_lost else None
        return None if self.is_lost else self.measurement

    def search(self, _: np.ndarray) -> Measurement:
        self.searched.append(self.now_s)
        return self.measurement

    def skip(self) -> None:
        self.skipped.append(self.now_s)

    def judge(self, *_: object) -> Any:
        self.judged.append(self.now_s)


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> Chain:
    chain = Chain()
    monkeypatch.setattr(recording_chain, "WarmChain", lambda *_: chain)
    monkeypatch.setattr(live_measuring, "judge_quality", chain.judge)
    monkeypatch.setattr(time, "monotonic", lambda: chain.now_s)
    return chain


def test_search_only_after_a_long_time_without_followed_frames(setup: Setup, chain: Chain):
    measure, live_frame = LiveChain(setup, Settings(), 8).measure, frame(1)
    assert measure(live_frame, False) is not None  # the first
    assert chain.searched == [100.0]
    chain.now_s += 0.9 * SEARCH_AFTER_S
    assert measure(live_frame, False) is None
    chain.is_lost = False
    followed = measure(live_frame, False)
    assert followed is not None
    assert followed.track_lost is None
    chain.is_lost = True
    chain.now_s += 0.9 * SEARCH_AFTER_S
    assert measure(live_frame, False) is None
    chain.now_s += 0.2 * SEARCH_AFTER_S
    searched = measure(live_frame, False)
    assert searched is not None
    assert searched.track_lost == "it jumped"
    assert chain.skipped == pytest.approx([100 + 0.9 * SEARCH_AFTER_S, 100 + 1.8 * SEARCH_AFTER_S])
    assert chain.searched == [100.0, chain.now_s]


def test_followed_frames_are_judged_at_the_set_rate(setup: Setup, chain: Chain):
    measure, live_frame = LiveChain(setup, Settings(), 8).measure, frame(7)
    result = measure(live_frame, False)
    assert result is not None
    assert (result.frame, result.time_s, result.arrived_s) == (
        7,
        live_frame.time_s,
        live_frame.arrived_s,
    )
    assert result.measurement.measures == MEASURES
    assert result.measurement.dots is None  # dots stay in the process
    chain.is_lost = False
    expected = [100.0]
    for share in (0.6, 1.2, 1.8, 2.3):
        chain.now_s = 100.0 + share * JUDGED_S
        measure(live_frame, False)
        expected += [chain.now_s] if share in (1.2, 2.3) else []
        assert chain.judged == expected
    chain.is_lost, chain.now_s = True, chain.now_s + 1.1 * SEARCH_AFTER_S
    for _ in range(2):  # every searched frame is judged
        measure(live_frame, False)
        chain.now_s += 1.1 * SEARCH_AFTER_S
    assert len(chain.judged) == len(expected) + 2


def test_model_predicts_only_from_measured_frames(watch: LiveWatch):
    """The model gives half the width of the frame before, one step per frame."""
    settings = ModelSettings(("width_mm",), "back_width_mm", 1.0, Orders(0, 1, 0))
    one, half = np.ones(1), LinearMap(np.array([0.5, 0.0]), np.zeros((2, 2)))
    model = PenetrationModel("arx", settings, (), 0 * one, one, 0 * one, 9 * one, 0.0, half, 0.1)
    watch.predictor = Predictor("bench", model, keeps=False)
    prepare(watch, {1: 7.0, 2: 5.0, **dict.fromkeys(range(4, 12))})
    stream = LineStream()
    watch.set_stream("lines", stream)
    with connect(stream.port) as connected:
        file = connected.makefile("rb")
        file.readline()
        for number in range(12):
            watch.measure(frame(number))
        lines = [json.loads(file.readline()) for _ in range(12)]
        predictions = [line["penetration_mm"] for line in lines]
        assert predictions[:5] == [None, *map(pytest.approx, (3.35, 3.5, 2.5, 3.35))]
        assert predictions[-1] is None
        assert {line["penetration_model"] for line in lines} == {"bench back_width_mm"}
        assert lines[2]["penetration_sigma_mm"] == pytest.approx(np.hypot(0.1, 0.5 * 0.03))
        watch._raise_silence("nothing came")
        assert "penetration_mm" not in json.loads(file.readline())


def test_a_fault_of_the_measuring_is_not_taken_for_its_end(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed: Future[LiveResult | None] = Future()
    failed.set_exception(RecursionError("too deep"))
    monkeypatch.setattr(
        live_measuring, "worker_pool", lambda *_: SimpleNamespace(submit=lambda *_: failed)
    )
    measuring = LiveMeasuring(setup, Settings(), 8)
    with pytest.raises(RecursionError):
        measuring.measure(frame(1))
