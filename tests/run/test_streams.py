"""Measures told while they are made: to who listens, to who does not read, and to nobody else."""

from __future__ import annotations

import asyncio
import json
import math
import socket
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import pytest

from labapp.core.pipeline import Measurement
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult
from labapp.export.tables import SIZES
from labapp.run import streams
from labapp.run.alarms import Alarm
from labapp.run.streams import LineStream, OpcuaStream, open_stream, stream_values
from labapp.text import SIGMA_OF
from tests.waiting import PATIENCE_S, connect

DARK = Measurement("no-dots", "It is dark", "fit")


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "STARTING_S", PATIENCE_S)


@pytest.fixture
def lines() -> Iterator[LineStream]:
    stream = LineStream()
    yield stream
    stream.close()


def listener(stream: LineStream) -> Any:
    """A file of lines, the first already read."""
    connected = connect(stream.port)
    file = connected.makefile("rb")
    connected.close()
    assert "labapp" in json.loads(file.readline())
    return file


def test_a_measurement_is_told_with_the_names_of_the_table(measured: Measurement) -> None:
    told = stream_values(FrameResult(7, 0.1, measured))
    assert list(told)[:5] == ["frame", "time_s", "status", "reason", "scheme"]
    assert list(told)[5:] == [*SIZES, "sigma_of", "setup_status", "setup_doubt"]
    assert told["sigma_of"] == SIGMA_OF
    assert measured.measures is not None
    assert told["height_mm"] == measured.measures.height_mm
    without = stream_values(FrameResult(8, None, DARK))
    assert without["time_s"] is without["height_mm"] is without["height_sigma_mm"] is None
    assert without["reason"] == "It is dark"


def test_every_listener_gets_every_line(lines: LineStream) -> None:
    files = [listener(lines), listener(lines)]
    for frame in range(500):
        lines.publish({"frame": frame, "status": "ok", "height_mm": 0.1 * frame})
    for file in files:
        for frame in range(500):
            assert json.loads(file.readline()) == {
                "frame": frame,
                "status": "ok",
                "height_mm": 0.1 * frame,
            }
        file.close()


def test_too_many_listeners_are_refused_and_harm_nobody() -> None:
    """The measurement opens files while more programs connect than a process may have open."""
    script = """
        import resource, sys
        resource.setrlimit(resource.RLIMIT_NOFILE, (200, 200))
        from labapp.run.streams import LineStream
        stream = LineStream()
        print(stream.port, flush=True)
        sys.stdin.readline()
        for frame in range(100):
            with open(sys.executable, "rb"):
                stream.publish({"frame": frame})
        stream.close()
    """
    measuring = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert measuring.stdin is not None
    assert measuring.stdout is not None
    with ExitStack() as stack:
        port = int(measuring.stdout.readline())
        first = stack.enter_context(connect(port)).makefile("rb")
        assert list(json.loads(first.readline())) == ["labapp"]
        connected = [stack.enter_context(connect(port)) for _ in range(300)]
        # The last is answered when all before it were.
        for each in (connected[0], connected[-1]):
            assert "labapp" in json.loads(each.makefile("rb").readline())
        _, told = measuring.communicate(b"go\n", PATIENCE_S)
        assert (measuring.returncode, told) == (0, b"")
        assert [json.loads(line)["frame"] for line in first] == list(range(100))
        assert connected[-1].recv(1) == b""


def test_too_many_clients_of_opc_ua_are_refused_and_harm_nobody(port: int) -> None:
    pytest.importorskip("asyncua")
    script = f"""
        import resource, sys
        resource.setrlimit(resource.RLIMIT_NOFILE, (200, 200))
        from labapp.run.streams import OpcuaStream
        stream = OpcuaStream(port={port})
        print("begun", flush=True)
        sys.stdin.readline()
        for frame in range(100):
            with open(sys.executable, "rb"):
                stream.publish({{"frame": frame}})
        print(stream.listeners)
        stream.close()
    """
    measuring = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert measuring.stdout is not None
    with ExitStack() as stack:
        assert measuring.stdout.readline() == b"begun\n"
        connected = [stack.enter_context(connect(port)) for _ in range(300)]
        assert connected[-1].recv(1) == b""  # refused, after all before it were answered
        listeners, complained = measuring.communicate(b"go\n", PATIENCE_S)
        assert (measuring.returncode, complained) == (0, b"")
        assert int(listeners) <= 32  # who says nothing for half a minute is let go


def test_who_does_not_read_is_told_what_it_missed_and_holds_nobody_up(lines: LineStream) -> None:
    idle, eager = listener(lines), listener(lines)
    padding = "x" * 10_000
    for frame in range(3000):
        lines.publish({"frame": frame, "reason": padding})
        assert json.loads(eager.readline())["frame"] == frame
    seen, missed = [], 0
    while not seen or seen[-1] < 2999:
        # Each tells what was missed before it, if there is room again.
        lines.publish({"frame": 3000 + len(seen), "reason": ""})
        told = json.loads(idle.readline())
        seen.append(told["frame"])
        missed += told.get("missed", 0)
    assert missed > 0
    assert seen == sorted(seen)
    assert seen[-1] + 1 == len(seen) + missed
    idle.close()
    eager.close()


def test_what_was_missed_is_told_at_the_end_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "PATIENCE_S", PATIENCE_S)  # this listener does read, if late
    stream = LineStream()
    idle = listener(stream)
    for frame in range(1500):
        stream.publish({"frame": frame, "reason": "x" * 10_000})
    stream._loop.run(asyncio.sleep(0))  # all were sent, or missed, before any is read
    ending = threading.Thread(target=stream.close)
    ending.start()
    told = [json.loads(line) for line in idle]
    ending.join()
    assert told[-1]["missed"] + len(told) - 1 == 1500
    idle.close()


def test_a_listener_that_says_no_more_is_told_on(lines: LineStream) -> None:
    with connect(lines.port) as connected:
        file = connected.makefile("rb")
        file.readline()
        connected.shutdown(socket.SHUT_WR)
        for frame in range(50):
            lines.publish({"frame": frame})
            assert json.loads(file.readline())["frame"] == frame
        file.close()


def test_a_listener_that_goes_harms_nobody(lines: LineStream) -> None:
    gone, stays = listener(lines), listener(lines)
    gone.close()
    for frame in range(200):
        lines.publish({"frame": frame})
        assert json.loads(stays.readline())["frame"] == frame
    stays.close()


def test_what_was_told_arrives_when_the_stream_ends() -> None:
    stream = LineStream()
    file = listener(stream)
    for frame in range(100):
        stream.publish({"frame": frame})
    stream.close()
    assert [json.loads(line)["frame"] for line in file] == list(range(100))
    file.close()


def test_a_stream_ends_though_a_listener_does_not_read() -> None:
    stream = LineStream()
    idle = listener(stream)
    for frame in range(2000):
        stream.publish({"frame": frame, "reason": "x" * 5000})
    stream.close()
    idle.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "weld.example"])
@pytest.mark.parametrize("kind", [LineStream, OpcuaStream])
def test_other_machines_are_let_in_only_if_that_is_said(kind: Any, host: str) -> None:
    with pytest.raises(InputError, match="other machines"):
        kind(host, 0)


def test_a_way_in_for_others_can_be_asked_for() -> None:
    open_stream("lines", "0.0.0.0:0", anywhere=True).close()


@pytest.mark.parametrize("place", ["", "x", "127.0.0.1:", "127.0.0.1:-1", "65536", "localhost"])
def test_what_is_no_place_is_refused(place: str) -> None:
    with pytest.raises(InputError, match="PORT or HOST:PORT"):
        open_stream("lines", place, anywhere=False)


def test_a_port_that_is_taken_is_said(lines: LineStream) -> None:
    for kind in (LineStream, OpcuaStream):
        with pytest.raises(InputError, match=f"{lines.port}: Address already in use"):
            kind(port=lines.port)


@pytest.mark.parametrize("kind", [LineStream, OpcuaStream])
def test_a_place_that_is_not_on_this_machine_is_said(kind: Any, port: int) -> None:
    with pytest.raises(InputError, match="an address of this machine"):
        kind("192.0.2.1", port, anywhere=True)


def test_opc_ua_clients_cannot_write(port: int, caplog: pytest.LogCaptureFixture) -> None:
    asyncua = pytest.importorskip("asyncua")
    stream = OpcuaStream(port=port)

    async def write(user: str) -> None:
        client = asyncua.Client(stream.address)
        if user:
            client.set_user(user)
        async with client:
            space = await client.get_namespace_index("urn:labapp:measures")
            pool = await client.nodes.objects.get_child(f"{space}:Pool")
            height = await pool.get_child(f"{space}:height_mm")
            await height.write_value(99.0)

    try:
        for user in ("", "admin"):
            with pytest.raises(asyncua.ua.UaStatusCodeError):
                asyncio.run(write(user))
    finally:
        stream.close()
    assert not caplog.records


def test_opc_ua_clients_read_the_newest_frame(port: int, measured: Measurement) -> None:
    asyncua = pytest.importorskip("asyncua")
    stream = OpcuaStream(port=port)
    alarm = Alarm("width-high", "Width 7.1 mm is above 6.9 mm", 40, 0.4, acknowledged=True)
    wanted = stream_values(
        FrameResult(41, 0.5, measured), [alarm, replace(alarm, code="height-low")]
    )
    assert wanted["alarm"] == "width-high height-low"

    async def read() -> dict[str, Any]:
        async with asyncua.Client(stream.address) as client:
            space = await client.get_namespace_index("urn:labapp:measures")
            pool = await client.nodes.objects.get_child(f"{space}:Pool")
            found: dict[str, Any] = {}
            for _ in range(1000):
                found = {
                    name: await (await pool.get_child(f"{space}:{name}")).read_value()
                    for name in wanted
                }
                if found["frame"] == 41:
                    assert stream.listeners == 1
                    break
                await asyncio.sleep(0.02)
            return found

    try:
        stream.publish(stream_values(FrameResult(40, None, DARK)))
        stream.publish(wanted)
        found = asyncio.run(read())
    finally:
        stream.close()
    for name, value in wanted.items():
        if value is None:
            assert math.isnan(found[name])
        else:
            assert found[name] == value, name
