"""How tests wait: until something is so, never for a time."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""What does not come within this will not come, however busy the machine is.

It costs nothing where it comes.
"""


def wait_until(reached: Callable[[], bool]) -> None:
    """Wait for something that happens in another thread or process; fail when it does not."""
    until_s = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < until_s, "it did not happen"
        time.sleep(0.005)


def connect(port: int) -> socket.socket:
    """Connect to a server on this machine."""
    return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
