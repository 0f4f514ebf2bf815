"""A study on Dask's workers: the same bytes, and what is said where something is missing."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest

from labapp import Study
from labapp.errors import InputError
from tests.run.study.kill import bytes_of

pytestmark = [
    pytest.mark.slow,
    # Sockets that Dask leaves to the garbage collector when it ends.
    pytest.mark.filterwarnings("default::ResourceWarning"),
    pytest.mark.filterwarnings("default::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("default::DeprecationWarning"),
]


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A program of Dask that runs meanwhile."""
    program = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield program
    finally:
        program.kill()
        program.wait()


@contextmanager
def cluster(workers: int, *options: str) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and separate workers, over TCP on this machine."""
    with closing(socket.socket()) as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    with ExitStack() as stack:
        here = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        stack.enter_context(started("scheduler", *here))
        each = ["worker", address, "--nthreads", "1", "--no-dashboard", *options]
        programs = [stack.enter_context(started(*each)) for _ in range(workers)]
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            with closing(socket.socket()) as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.2)
        yield address, programs


def test_workers_of_a_cluster_and_this_process_give_the_same_bytes(
    study_file: Path, tmp_path: Path
) -> None:
    here = Study(study_file, tmp_path / "here")
    expected = [one.state for one in here.run(0)]
    there = Study(study_file, tmp_path / "there")
    with cluster(2) as (address, _):
        assert [one.state for one in there.run(scheduler=address)] == expected
    assert bytes_of(there.folder) == bytes_of(here.folder)
    assert len(bytes_of(here.folder)) == 2


def test_a_worker_that_is_killed_costs_its_task_only(study_file: Path, tmp_path: Path) -> None:
    study = Study(study_file, tmp_path / "there")
    killed: list[bool] = []

    with cluster(2) as (address, programs):

        def kill(now: object) -> None:
            if not killed:
                killed.append(True)
                programs[0].kill()

        states = [one.state for one in study.run(scheduler=address, progress=kill)]
    assert killed
    assert states == ["done", "done", "failed", "failed", "failed"]


def test_a_scheduler_that_is_not_there_is_named(
    study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labapp.run.study.workers.TIMEOUT_S", 0.5)
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(InputError):
            Study(study_file).run(scheduler=address)
