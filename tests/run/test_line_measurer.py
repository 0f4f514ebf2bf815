"""A followed line, with frames classified by current pulse, some at a time."""

from __future__ import annotations

import numpy as np
import pytest

from labapp.config.setup import parse_setup
from labapp.core.pipeline import Settings
from labapp.media import Frame
from labapp.run import line_measurer
from labapp.run.line_measurer import LineMeasurer
from tests.setups import FIVE_LINES

ONE_LINE = FIVE_LINES.replace("count = 5", "count = 1")

AT_ONCE = 60


@pytest.fixture(autouse=True)
def few_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_measurer, "CLASSIFIED_AT_ONCE", AT_ONCE)


def read(number: int) -> Frame:
    """Read one of the frames: each second one is outshone by a pulse."""
    v, u = np.mgrid[:60, :120]
    light = 20 + 60 * np.exp(-((v - 30 - (u - 60) ** 2 / 400) ** 2) / 8)
    light += np.random.default_rng(number).normal(size=light.shape) + 100 * (number % 2)
    return Frame(number, number / 1000, light.astype(np.uint8))


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("over", [-30, 0, 1, 2, 45])
def test_pulses_are_found_in_the_last_frames_too(first: int, over: int) -> None:
    follower = LineMeasurer(read, parse_setup(ONE_LINE, "setup", lines=True), Settings())
    numbers = range(first, first + AT_ONCE + over)
    results = list(follower(numbers))
    assert [result.frame for result in results] == list(numbers)
    expected = ["pulse" if number % 2 else "followed" for number in numbers]
    assert [result.measurement.status for result in results] == expected


def test_frames_that_are_held_at_once_are_limited() -> None:
    reads = list[int]()

    def counted(number: int) -> Frame:
        reads.append(number)
        return read(number)

    follower = LineMeasurer(counted, parse_setup(ONE_LINE, "setup", lines=True), Settings())
    results = follower(range(3 * AT_ONCE + 1))
    most = 0
    for done, _ in enumerate(results):
        most = max(most, len(reads) - done)
    assert most <= AT_ONCE
    assert reads == list(range(3 * AT_ONCE + 1))
