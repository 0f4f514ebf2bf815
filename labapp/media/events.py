"""What happened to a camera, a recording or a pedal, in words: one stream for the page and the log.

Whoever reports calls a `Say`; it may be called from any thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

Kind = Literal["note", "warning", "loss"]
"""Something to know; something that is not as it should be; frames that are lost for good."""


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Parameters
    ----------
    source
        To what: a camera's id, a recording's file, a pedal's name.
    kind
        How bad it is.
    words
        One sentence for the operator.
    at
        When.
    """

    source: str
    kind: Kind
    words: str
    at: datetime = field(default_factory=lambda: datetime.now().astimezone())

    def __str__(self) -> str:
        return f"{self.source}: {self.words}"


Say = Callable[[Event], None]


def logged(say: Say) -> Say:
    """Tell the same, and keep it in the program's log."""
    levels = {"note": logging.INFO, "warning": logging.WARNING, "loss": logging.ERROR}

    def tell(event: Event) -> None:
        logging.getLogger("labapp").log(levels[event.kind], "%s", event)
        say(event)

    return tell


def silent(_: Event) -> None:
    """Tell nobody."""


class Tally:
    """What happens often, told at once the first time and then together, once a while.

    Parameters
    ----------
    tell
        Called with how many there were since it was called last.
    every_s
        Not called more often.
    """

    def __init__(self, tell: Callable[[int], None], every_s: float = 1.0) -> None:
        self.total = 0
        self._tell = tell
        self._every_s = every_s
        self._untold = 0
        self._told_s = -every_s
        self._turn = threading.Lock()

    def count(self, more: int = 1) -> None:
        """Count some more, to be told at the next `flush`."""
        with self._turn:
            self.total += more
            self._untold += more

    def add(self, more: int = 1) -> None:
        """Count some more, and tell if it is time."""
        self.count(more)
        self.flush()

    def flush(self, *, now: bool = False) -> None:
        """Tell of what was not told yet, if it is time; with ``now`` in any case."""
        at_s = time.monotonic()
        with self._turn:
            count = self._untold
            if not count or not (now or at_s - self._told_s >= self._every_s):
                return
            self._untold, self._told_s = 0, at_s
        self._tell(count)
