"""Streams of measures: to clients that read, to clients that do not read, and to no others."""

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
from labapp.export.tables import MEASURE_COLUMNS
from labapp.run import streams
from labapp.run.alarms import Alarm
from labapp.run.streams import LineStream, OpcuaStream, open_stream, stream_values
from labapp.text import SIGMA_OF
from tests.waiting import PATIENCE_S, connect, wait_until

DARK = Measurement("no-dots", "It is dark", "fit")


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "STARTING_S", PATIENCE_S)


@pytest.fixture
def lines() -> Iterator[LineStream]:
    stream = LineStream()
    yield stream
    stream.close()


def connect_file(stream: LineStream) -> Any:
    """Connect to a stream; return its lines as a file, with the first one already read."""
    connection = connect(stream.port)
    file = connection.makefile("rb")
    connection.close()
    assert "labapp" in json.loads(file.readline())
    return file


def test_streamed_values_have_the_names_of_the_table(measured: Measurement) -> None:
    values = stream_values(FrameResult(7, 0.1, measured))
    assert list(values)[:5] == ["frame", "time_s", "status", "reason", "scheme"]
    assert list(values)[5:] == [*MEASURE_COLUMNS, "sigma_of", "setup_status", "setup_doubt"]
    assert values["sigma_of"] == SIGMA_OF
    assert measured.measures is not None
    assert values["height_mm"] == measured.measures.height_mm
    unmeasured = stream_values(FrameResult(8, None, DARK))
    assert unmeasured["time_s"] is unmeasured["height_mm"] is unmeasured["height_sigma_mm"] is None
    assert unmeasured["reason"] == "It is dark"


def test_every_client_gets_every_line(lines: LineStream) -> None:
    files = [connect_file(lines), connect_file(lines)]
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


def test_too_many_clients_are_rejected_without_harm() -> None:
    """The program opens files while more clients connect than a process may have open files."""
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
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with ExitStack() as stack:
        port = int(process.stdout.readline())
        first = stack.enter_context(connect(port)).makefile("rb")
        assert list(json.loads(first.readline())) == ["labapp"]
        connections = [stack.enter_context(connect(port)) for _ in range(300)]
        # The last one is accepted after all others.
        for connection in (connections[0], connections[-1]):
            assert "labapp" in json.loads(connection.makefile("rb").readline())
        _, stderr = process.communicate(b"go\n", PATIENCE_S)
        assert (process.returncode, stderr) == (0, b"")
        assert [json.loads(line)["frame"] for line in first] == list(range(100))
        assert connections[-1].recv(1) == b""


def test_too_many_opc_ua_clients_are_rejected_without_harm(port: int) -> None:
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
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert process.stdout is not None
    with ExitStack() as stack:
        assert process.stdout.readline() == b"begun\n"
        connections = [stack.enter_context(connect(port)) for _ in range(300)]
        assert connections[-1].recv(1) == b""  # rejected, after all others were accepted
        listeners, stderr = process.communicate(b"go\n", PATIENCE_S)
        assert (process.returncode, stderr) == (0, b"")
        assert int(listeners) <= 32  # silent clients are disconnected after half a minute


def test_client_that_does_not_read_gets_the_number_of_missed_lines(lines: LineStream) -> None:
    idle, reader = connect_file(lines), connect_file(lines)
    padding = "x" * 10_000
    for frame in range(3000):
        lines.publish({"frame": frame, "reason": padding})
        assert json.loads(reader.readline())["frame"] == frame
    frames, missed = [], 0
    while not frames or frames[-1] < 2999:
        # Each line states the number missed before it, as soon as there is space again.
        lines.publish({"frame": 3000 + len(frames), "reason": ""})
        line = json.loads(idle.readline())
        frames.append(line["frame"])
        missed += line.get("missed", 0)
    assert missed > 0
    assert frames == sorted(frames)
    assert frames[-1] + 1 == len(frames) + missed
    idle.close()
    reader.close()


def test_number_of_missed_lines_is_sent_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "PATIENCE_S", PATIENCE_S)  # this client reads, but late
    stream = LineStream()
    idle = connect_file(stream)
    for frame in range(1500):
        stream.publish({"frame": frame, "reason": "x" * 10_000})
    stream._loop.run(asyncio.sleep(0))  # all are sent or missed before the first is read
    ending = threading.Thread(target=stream.close)
    ending.start()
    lines = [json.loads(line) for line in idle]
    ending.join()
    assert lines[-1]["missed"] + len(lines) - 1 == 1500
    idle.close()


def test_client_that_closes_its_sending_side_still_gets_lines(lines: LineStream) -> None:
    with connect(lines.port) as connection:
        file = connection.makefile("rb")
        file.readline()
        connection.shutdown(socket.SHUT_WR)
        for frame in range(50):
            lines.publish({"frame": frame})
            assert json.loads(file.readline())["frame"] == frame
        file.close()


def test_disconnected_client_does_not_disturb_others(lines: LineStream) -> None:
    gone, remaining = connect_file(lines), connect_file(lines)
    gone.close()
    for frame in range(200):
        lines.publish({"frame": frame})
        assert json.loads(remaining.readline())["frame"] == frame
    remaining.close()


def test_published_lines_arrive_before_the_stream_ends() -> None:
    stream = LineStream()
    file = connect_file(stream)
    for frame in range(100):
        stream.publish({"frame": frame})
    stream.close()
    assert [json.loads(line)["frame"] for line in file] == list(range(100))
    file.close()


def test_stream_closes_although_a_client_does_not_read() -> None:
    stream = LineStream()
    idle = connect_file(stream)
    for frame in range(2000):
        stream.publish({"frame": frame, "reason": "x" * 5000})
    stream.close()
    idle.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "weld.example"])
@pytest.mark.parametrize("kind", [LineStream, OpcuaStream])
def test_other_machines_are_allowed_only_on_request(kind: Any, host: str) -> None:
    with pytest.raises(InputError, match="other machines"):
        kind(host, 0)


def test_stream_can_be_opened_for_other_machines() -> None:
    open_stream("lines", "0.0.0.0:0", anywhere=True).close()


@pytest.mark.parametrize("address", ["", "x", "127.0.0.1:", "127.0.0.1:-1", "65536", "localhost"])
def test_invalid_address_is_rejected(address: str) -> None:
    with pytest.raises(InputError, match="PORT or HOST:PORT"):
        open_stream("lines", address, anywhere=False)


def test_used_port_is_reported(lines: LineStream) -> None:
    for kind in (LineStream, OpcuaStream):
        with pytest.raises(InputError, match=f"{lines.port}: Address already in use"):
            kind(port=lines.port)


@pytest.mark.parametrize("kind", [LineStream, OpcuaStream])
def test_address_of_another_machine_is_reported(kind: Any, port: int) -> None:
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
    expected = stream_values(
        FrameResult(41, 0.5, measured), [alarm, replace(alarm, code="height-low")]
    )
    assert expected["alarm"] == "width-high height-low"

    async def read() -> dict[str, Any]:
        async with asyncua.Client(stream.address) as client:
            space = await client.get_namespace_index("urn:labapp:measures")
            pool = await client.nodes.objects.get_child(f"{space}:Pool")
            values: dict[str, Any] = {}
            for _ in range(1000):
                values = {
                    name: await (await pool.get_child(f"{space}:{name}")).read_value()
                    for name in (*expected, *predicted)
                }
                if values["frame"] == 41:
                    assert stream.listeners == 1
                    break
                await asyncio.sleep(0.02)
            return values

    try:
        predicted = {"penetration_mm": 3.4, "penetration_model": "bench"}
        stream.publish({**stream_values(FrameResult(40, None, DARK)), **predicted})
        wait_until(lambda: stream._newest is None)
        stream.publish(expected)
        values = asyncio.run(read())
    finally:
        stream.close()
    assert math.isnan(values["penetration_mm"])  # the frame before had it
    assert values["penetration_model"] == ""
    for name, value in expected.items():
        if value is None:
            assert math.isnan(values[name])
        else:
            assert values[name] == value, name


def test_opc_ua_variables_say_what_is_unknown_before_the_first_frame(
    port: int, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("asyncua")
    stream = OpcuaStream(port=port)
    values = stream_values(FrameResult(7, 0.5, DARK))
    stream.publish(values)
    wait_until(lambda: stream._newest is None)
    stream.publish({**values, "frame": None, "time_s": None})
    wait_until(lambda: stream._newest is None)

    async def read(name: str) -> Any:
        return await stream._variables[name].read_value()

    try:
        wait_until(lambda: stream._loop.run(read("frame")) == -1)
        assert math.isnan(stream._loop.run(read("time_s")))
        assert stream._loop.run(read("status")) == DARK.status
    finally:
        stream.close()
    assert not caplog.records
