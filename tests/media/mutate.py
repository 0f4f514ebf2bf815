"""Damage a recording in many ways and hold that only `InputError` comes of it, and soon."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from labapp.errors import InputError
from labapp.media import open_source

MOST_BYTES = 1 << 30
"""No damaged file of a few kilobytes makes a reader take so much more memory."""


@contextmanager
def little_memory() -> Iterator[None]:
    """Let an allocation of a gigabyte fail."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MOST_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def read_all(path: Path) -> int:
    """Number of frames that can be read."""
    whole = 0
    with open_source(path) as source:
        for index in range(min(len(source), 50)):
            try:
                frame = source.frame(index)
            except InputError:
                continue
            assert frame.image.shape == source.shape
            whole += 1
    return whole


def survives_damage(path: Path, count: int, head: int, seed: int) -> None:
    """Flip bytes (most of them in the first or last ``head``) and cut, ``count`` times."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    places = np.r_[: min(head, len(content)), max(0, len(content) - head) : len(content)]
    opened = 0
    with little_memory():
        for k in range(count):
            damaged = bytearray(content)
            if k % 10 == 9:
                del damaged[int(rng.integers(1, len(content))) :]
            else:
                among = places if k % 3 else np.arange(len(content))
                for place in rng.choice(among, 1 + k % 3):
                    damaged[place] = int(rng.integers(256)) if k % 2 else 255
            path.write_bytes(damaged)
            began = time.process_time()
            try:
                opened += read_all(path) > 0
            except InputError as error:
                assert str(path.parent) in str(error)  # noqa: PT017
            # What this process took, not what others on the machine did.
            assert time.process_time() - began < 1
            assert path.read_bytes() == damaged
    # Not one that is still read, or all of them, would mean that nothing was tried.
    assert 0 < opened < count
