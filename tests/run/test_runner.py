"""A run: every sink gets every result, and whoever stops it stops what measures."""

from __future__ import annotations

from collections.abc import Generator, Iterable

import pytest

from labapp.core.pipeline import Measurement
from labapp.export.frame_result import FrameResult
from labapp.run.runner import run


class Plain:
    """Measures nothing, and notes which frames it came to and whether it was closed."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.is_closed = False

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        try:
            for number in frames:
                self.begun.append(number)
                yield FrameResult(number, None, Measurement("no-dots", "it is dark", "fit"))
        finally:
            self.is_closed = True


@pytest.fixture
def measurer() -> Plain:
    return Plain()


def test_every_sink_has_a_result_before_it_is_given_out(measurer: Plain) -> None:
    first: list[FrameResult] = []
    second: list[tuple[FrameResult, bool]] = []
    sinks = [first.append, lambda result: second.append((result, result is first[-1]))]
    for result in run([4, 2, 7], measurer, sinks):
        assert first[-1] is result
        assert second[-1] == (result, True)
    assert [result.frame for result in first] == [4, 2, 7]
    assert len(second) == 3
    assert measurer.is_closed


def test_what_a_sink_raises_ends_the_run(measurer: Plain) -> None:
    told: list[int] = []

    def full(result: FrameResult) -> None:
        if result.frame == 1:
            raise OSError("the disk is full")

    running = run(range(5), measurer, [full, lambda result: told.append(result.frame)])
    assert next(running).frame == 0
    with pytest.raises(OSError, match="full") as raised:
        next(running)
    assert (told, measurer.begun, measurer.is_closed) == ([0], [0, 1], True)
    assert raised.value.args == ("the disk is full",)


def test_a_run_that_is_closed_measures_no_more(measurer: Plain) -> None:
    told: list[FrameResult] = []
    running = run(range(5), measurer, [told.append])
    next(running)
    running.close()
    assert (len(told), measurer.begun, measurer.is_closed) == (1, [0], True)
