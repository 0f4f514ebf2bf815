"""A run: every sink gets every result, and closing the run closes the measurer."""

from __future__ import annotations

from collections.abc import Generator, Iterable

import pytest

from labapp.core.pipeline import Measurement
from labapp.export.frame_result import FrameResult
from labapp.run.runner import run


class FakeMeasurer:
    """A measurer that only records the started frames, and whether it was closed."""

    def __init__(self) -> None:
        self.started: list[int] = []
        self.is_closed = False

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        try:
            for number in frames:
                self.started.append(number)
                yield FrameResult(number, None, Measurement("no-dots", "it is dark", "fit"))
        finally:
            self.is_closed = True


@pytest.fixture
def measurer() -> FakeMeasurer:
    return FakeMeasurer()


def test_every_sink_gets_a_result_before_the_caller(measurer: FakeMeasurer) -> None:
    first: list[FrameResult] = []
    second: list[tuple[FrameResult, bool]] = []
    sinks = [first.append, lambda result: second.append((result, result is first[-1]))]
    for result in run([4, 2, 7], measurer, sinks):
        assert first[-1] is result
        assert second[-1] == (result, True)
    assert [result.frame for result in first] == [4, 2, 7]
    assert len(second) == 3
    assert measurer.is_closed


def test_exception_of_a_sink_ends_the_run(measurer: FakeMeasurer) -> None:
    frames: list[int] = []

    def fail_at_frame_1(result: FrameResult) -> None:
        if result.frame == 1:
            raise OSError("the disk is full")

    results = run(range(5), measurer, [fail_at_frame_1, lambda result: frames.append(result.frame)])
    assert next(results).frame == 0
    with pytest.raises(OSError, match="full") as raised:
        next(results)
    assert (frames, measurer.started, measurer.is_closed) == ([0], [0, 1], True)
    assert raised.value.args == ("the disk is full",)


def test_closed_run_measures_no_further_frames(measurer: FakeMeasurer) -> None:
    received: list[FrameResult] = []
    results = run(range(5), measurer, [received.append])
    next(results)
    results.close()
    assert (len(received), measurer.started, measurer.is_closed) == (1, [0], True)
