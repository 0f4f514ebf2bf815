"""Events of cameras, recordings and pedals, for the app and the log.

They are passed to an `OnEvent`, which may be called from any thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Kind = Literal["note", "warning", "loss"]
"""Information, a possibly temporary fault, or the permanent loss of frames."""


@dataclass(frozen=True)
class Event:
    """An event."""

    source: str
    """Id of a camera, file of a recording, or name of a pedal."""
    kind: Kind
    words: str
    """One sentence for the operator."""
    passes: bool = False
    """Whether it is over when the camera sends frames again."""

    def __str__(self) -> str:
        return f"{self.source}: {self.words}"


OnEvent = Callable[[Event], None]


def logged(on_event: OnEvent) -> OnEvent:
    """Return a callback that also writes events to the program's log."""
    levels = {"note": logging.INFO, "warning": logging.WARNING, "loss": logging.ERROR}

    def log(event: Event) -> None:
        logging.getLogger("labapp").log(levels[event.kind], "%s", event)
        on_event(event)

    return log


def ignore_event(_: Event) -> None:
    """Discard an event."""


EVERY_S = 1.0
"""Shortest interval between the reports of a `Tally`, s."""


class Tally:
    """Counter of frequent events that reports at most once in an interval.

    Parameters
    ----------
    report
        Called with the count since its last call, `EVERY_S` after it at the earliest.
    """

    def __init__(self, report: Callable[[int], None]) -> None:
        self.total = 0
        self._report = report
        self._unreported = 0
        self._reported_s = -EVERY_S
        self._mutex = threading.Lock()

    def count(self, more: int = 1) -> None:
        """Count, without a report until the next `flush`."""
        with self._mutex:
            self.total += more
            self._unreported += more

    def add(self, more: int = 1) -> None:
        """Count, and report if the interval is over."""
        self.count(more)
        self.flush()

    def flush(self, *, now: bool = False) -> None:
        """Report the unreported count, if the interval is over; with ``now`` in any case."""
        at_s = time.monotonic()
        with self._mutex:
            count = self._unreported
            if not count or not (now or at_s - self._reported_s >= EVERY_S):
                return
            self._unreported, self._reported_s = 0, at_s
        self._report(count)
