"""Damage a recording in many ways: only `InputError` may be raised, and quickly."""

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
"""Limit of additional memory to read a damaged file of a few kilobytes."""


@contextmanager
def limited_memory() -> Iterator[None]:
    """Make an allocation of a gigabyte fail."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def read_all(path: Path) -> int:
    """Number of frames that can be read."""
    count = 0
    with open_source(path) as source:
        for index in range(min(len(source), 50)):
            try:
                frame = source.frame(index)
            except InputError:
                continue
            assert frame.image.shape == source.shape
            count += 1
    return count


def survives_damage(path: Path, count: int, head: int, seed: int) -> None:
    """Change bytes (most in the first or last ``head``) or truncate, ``count`` times."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    ends = np.r_[: min(head, len(content)), max(0, len(content) - head) : len(content)]
    readable = 0
    with limited_memory():
        for k in range(count):
            damaged = bytearray(content)
            if k % 10 == 9:
                del damaged[int(rng.integers(1, len(content))) :]
            else:
                among = ends if k % 3 else np.arange(len(content))
                for index in rng.choice(among, 1 + k % 3):
                    damaged[index] = int(rng.integers(256)) if k % 2 else 255
            path.write_bytes(damaged)
            began = time.process_time()
            try:
                readable += read_all(path) > 0
            except InputError as error:
                assert str(path.parent) in str(error)  # noqa: PT017
            # The time of this process only, because the machine may be busy.
            assert time.process_time() - began < 1
            assert path.read_bytes() == damaged
    # If none or all of the files can be read, the test is not meaningful.
    assert 0 < readable < count
