"""Streams of measures to control software: lines of JSON over TCP, or OPC UA.

Each stream has an event loop in a separate thread, so that publishing never waits for a client.
By default only programs of this machine can connect, as clients are not authenticated.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import json
import logging
import math
import os
import threading
from collections.abc import Coroutine, Iterable, Mapping
from functools import partial
from typing import Any, Protocol

from labapp.errors import InputError
from labapp.export.frame_result import FrameResult
from labapp.export.tables import MEASURE_COLUMNS, sigma_of
from labapp.log import NAME
from labapp.run.alarms import Alarm
from labapp.version import VERSION

MOST_LISTENERS, AT_ONCE = 32, 16
"""Most clients, and backlog of the OPC UA server: each connection takes a file handle, of which the
measurement needs some itself."""

MOST_WAITING = 1_000_000
"""Most bytes buffered for a client; beyond, lines are dropped, and their number is sent later."""

OPCUA_S = 0.05
"""Period at which the OPC UA variables are updated, s: clients sample them."""

ALARMS = ("alarm", "unacknowledged")
"""Names of the alarm values of a live camera."""

WORDS = ("status", "reason", "scheme", "sigma_of", "setup_status", "setup_doubt")
"""Names of the other text values."""

PENETRATION = ("penetration_mm", "penetration_sigma_mm", "penetration_model")
"""Names of a penetration model's values, if there is one: value, ±, name and target."""

NAMESPACE = "urn:labapp:measures"

STARTING_S = 20.0

PATIENCE_S = 1.0
"""Time for clients to read buffered data when the stream closes, s."""

Values = Mapping[str, int | float | str | None]


def stream_values(result: FrameResult, alarms: Iterable[Alarm] | None = None) -> Values:
    """Return the values of a frame, with names and units of ``measures.csv``; None if unknown.

    For a live camera, the codes of alarms are added, separated by spaces: those that hold
    (``alarm``), and those that are ``unacknowledged``.
    """
    measurement = result.measurement

    def number(name: str) -> float | None:
        value = float(getattr(measurement.measures, name, math.nan))
        return value if math.isfinite(value) else None

    values = {
        "frame": result.frame,
        "time_s": result.time_s,
        "status": measurement.status,
        "reason": measurement.reason,
        "scheme": measurement.scheme,
        **{name: number(name) for name in MEASURE_COLUMNS},
        "sigma_of": sigma_of(measurement),
        "setup_status": measurement.setup_status,
        "setup_doubt": result.setup_doubt,
    }
    if alarms is None:
        return values
    shown = tuple(alarms)
    return {
        **values,
        ALARMS[0]: " ".join(each.code for each in shown if each.holds),
        ALARMS[1]: " ".join(each.code for each in shown if not each.acknowledged),
    }


class Stream(Protocol):
    """A server of measures."""

    address: str
    """Address for clients."""

    sent: int
    """Number of frames sent while a client was connected."""

    @property
    def listeners(self) -> int:
        """Number of connected clients."""

    def publish(self, values: Values) -> None:
        """Send the values of a frame without blocking."""

    def close(self) -> None:
        """Send buffered data, and end."""


class LineStream:
    """A line of JSON per frame, to every TCP client.

    The first line names the program: ``{"labapp": "1.0.0"}``. A line has ``missed`` where lines
    before it were dropped because the client did not read. Beyond `MOST_LISTENERS` the first line
    has ``refused``, and is the last.

    Parameters
    ----------
    host, port
        Address to listen at; port 0: any free port.
    anywhere
        Whether other machines may connect.

    Raises
    ------
    InputError
        If other machines could connect and ``anywhere`` is false, or the port is taken.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, anywhere: bool = False) -> None:
        check_host(host, anywhere)
        self.sent = 0
        self._missed: dict[asyncio.StreamWriter, int] = {}
        self._loop = _Loop("labapp line stream")
        try:
            # The backlog includes clients that will be refused.
            serving = asyncio.start_server(self._connected, host, port, backlog=MOST_LISTENERS)
            self._server = self._loop.run(serving)
        except OSError as error:
            self._loop.close()
            raise _taken(host, port, error) from error
        self.port: int = self._server.sockets[0].getsockname()[1]
        self.address = f"{host}:{self.port}"

    @property
    def listeners(self) -> int:
        """Number of connected clients."""
        return len(self._missed)

    def publish(self, values: Values) -> None:
        """Send the values of a frame without blocking."""
        line = json.dumps(values, allow_nan=False).encode()
        self._loop.soon(lambda: self._send(line))

    def close(self) -> None:
        """Send buffered data, and end."""
        self._loop.run(self._close())
        self._loop.close()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        about = {"labapp": VERSION}
        if len(self._missed) >= MOST_LISTENERS:
            refusal = {**about, "refused": f"{MOST_LISTENERS} programs are connected"}
            writer.write(json.dumps(refusal).encode() + b"\n")
            writer.close()
            return
        writer.write(json.dumps(about).encode() + b"\n")
        self._missed[writer] = 0
        try:
            while await reader.read(1024):
                pass  # what clients send is ignored
            await writer.wait_closed()  # a half-closed client may still read
        except OSError:
            pass  # disconnected
        finally:
            self._missed.pop(writer, None)
            writer.close()

    def _send(self, line: bytes) -> None:
        self.sent += bool(self._missed)
        for writer, missed in self._missed.items():
            if writer.transport.get_write_buffer_size() > MOST_WAITING:
                self._missed[writer] += 1
                continue
            full = line[:-1] + b', "missed": %d}' % missed if missed else line
            self._missed[writer] = 0
            writer.write(full + b"\n")

    async def _close(self) -> None:
        self._server.close()
        for writer, missed in self._missed.items():
            if missed:
                writer.write(b'{"missed": %d}\n' % missed)
            writer.transport.close()  # after sending buffered data
        for _ in range(round(PATIENCE_S / 0.01)):
            if not self._missed:
                return
            await asyncio.sleep(0.01)
        for writer in list(self._missed):
            writer.transport.abort()
        while self._missed:
            await asyncio.sleep(0.01)


class OpcuaStream:
    """Measures as variables of an OPC UA server, updated every `OPCUA_S` from the newest frame.

    The variables are ``Objects/Pool/NAME`` in the namespace ``urn:labapp:measures``; NaN if
    unknown. Needs asyncua, which the extra ``control`` installs.

    Raises
    ------
    InputError
        If asyncua is not installed, other machines could connect and ``anywhere`` is false, or the
        port is taken.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 4840, anywhere: bool = False) -> None:
        check_host(host, anywhere)
        try:
            from asyncua import ua
            from asyncua.server.server import Server
        except ImportError as error:
            expected = "asyncua: pip install 'labapp[control]'"
            raise InputError("OPC UA", "library", "missing", expected) from error
        # Its messages about security policies and ports are replaced by `InputError`.
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)
        self._ua = ua
        self._newest: Values | None = None
        self._variables: dict[str, Any] = {}
        self._unknown: dict[str, Any] = {}
        self._ended = False
        self.sent = 0
        self._loop = _Loop("labapp OPC UA stream")
        self.address = f"opc.tcp://{host}:{port}/labapp"
        try:
            self._server = self._loop.run(self._start(Server()))
        except OSError as error:
            self._loop.close()
            raise _taken(host, port, error) from error
        self._updating = self._loop.start(self._update())

    @property
    def listeners(self) -> int:
        """Number of connected clients."""
        return len(self._server.bserver.clients)

    def publish(self, values: Values) -> None:
        """Set the values of a frame without blocking; clients may miss values."""
        self._newest = values

    def close(self) -> None:
        """Write the newest frame, and end."""
        self._ended = True
        self._updating.result(STARTING_S)
        self._loop.run(self._server.stop())
        self._loop.close()

    async def _start(self, server: Any) -> Any:
        # Each accepted connection takes a file handle before it can be refused.
        loop: Any = asyncio.get_running_loop()
        loop.create_server = partial(loop.create_server, backlog=AT_ONCE)
        await server.init()
        server.iserver.max_connections = MOST_LISTENERS
        server.set_endpoint(self.address)
        server.set_server_name("labapp")
        server.set_security_policy([self._ua.SecurityPolicyType.NoSecurity])
        server.allow_remote_admin(False)  # clients may only read
        space = await server.register_namespace(NAMESPACE)
        pool = await server.nodes.objects.add_object(space, "Pool")
        words = dict.fromkeys((*WORDS, *ALARMS, PENETRATION[2]), "")
        sizes = dict.fromkeys((*MEASURE_COLUMNS, *PENETRATION[:2]), math.nan)
        self._unknown = {"frame": -1, "time_s": math.nan, **words, **sizes}
        for name, empty in self._unknown.items():
            self._variables[name] = await pool.add_variable(space, name, empty)
        await server.start()
        return server

    async def _update(self) -> None:
        while not self._ended or self._newest is not None:
            values, self._newest = self._newest, None
            try:
                # What a frame lacks is unknown, and must not remain from a former one.
                known = {k: v for k, v in (values or {}).items() if v is not None}
                for name, value in ({**self._unknown, **known} if values else {}).items():
                    await self._variables[name].write_value(value)
                self.sent += values is not None and self.listeners > 0
            except Exception as error:  # one frame must not end the stream
                logging.getLogger(NAME).error("not sent by OPC UA", exc_info=error)
            if not self._ended:
                await asyncio.sleep(OPCUA_S)


def open_stream(kind: str, address: str, anywhere: bool) -> Stream:
    """Open a stream by its kind, ``lines`` or ``opcua``, at ``PORT`` or ``HOST:PORT``.

    Raises
    ------
    InputError
        If the address has another form, or the port cannot be opened.
    """
    host, _, port = address.rpartition(":")
    if not (port.isdecimal() and int(port) < 65536):
        raise InputError("stream", kind, address, "PORT or HOST:PORT, a port from 0 to 65535")
    at = (host.strip("[]") or "127.0.0.1", int(port), anywhere)
    return LineStream(*at) if kind == "lines" else OpcuaStream(*at)


def check_host(host: str, anywhere: bool) -> None:
    """Check that only this machine can reach an address, unless ``anywhere``.

    Raises
    ------
    InputError
        If other machines can reach it.
    """
    try:
        is_own = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_own = False
    if not is_own and not anywhere:
        expected = "127.0.0.1, ::1 or localhost, unless other machines are allowed to connect"
        raise InputError("stream", "host", host, expected)


def _taken(host: str, port: int, error: OSError) -> InputError:
    """Return the error for an address that cannot be bound."""
    if error.errno in (errno.EADDRINUSE, errno.EACCES):
        why = os.strerror(error.errno)
        return InputError("stream", "port", f"{host}:{port}: {why}", "a free one, from 1024 on")
    return InputError("stream", "host", f"{host}: {error.strerror}", "an address of this machine")


class _Loop:
    """An event loop in a separate thread."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def start(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self.start(work).result(STARTING_S)

    def soon(self, call: Any) -> None:
        self._loop.call_soon_threadsafe(call)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
