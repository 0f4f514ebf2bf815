"""Waiting in tests: for a condition, never for a time."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""Longest wait for an event, s; enough for a busy machine.

It costs no time if the event occurs.
"""


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for a condition set by another thread or process; fail if it does not occur."""
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until_s, "it did not happen"
        time.sleep(0.005)


def connect(port: int) -> socket.socket:
    """Connect to a server on this machine."""
    return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
