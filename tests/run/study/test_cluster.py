"""A study on Dask's workers: equal files, and errors where something is missing."""

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
    # Dask leaves sockets to the garbage collector when it ends.
    pytest.mark.filterwarnings("default::ResourceWarning"),
    pytest.mark.filterwarnings("default::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("default::DeprecationWarning"),
]


@contextmanager
def dask_program(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program of Dask for the duration of the context."""
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
    """Run a scheduler and separate workers, over TCP on this machine."""
    with closing(socket.socket()) as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    with ExitStack() as stack:
        options_of_scheduler = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        stack.enter_context(dask_program("scheduler", *options_of_scheduler))
        command = ["worker", address, "--nthreads", "1", "--no-dashboard", *options]
        programs = [stack.enter_context(dask_program(*command)) for _ in range(workers)]
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            with closing(socket.socket()) as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.2)
        yield address, programs


def test_cluster_and_single_process_give_equal_files(study_file: Path, tmp_path: Path) -> None:
    local = Study(study_file, tmp_path / "here")
    expected = [recording.state for recording in local.run(0)]
    distributed = Study(study_file, tmp_path / "there")
    with cluster(2) as (address, _):
        assert [recording.state for recording in distributed.run(scheduler=address)] == expected
    assert bytes_of(distributed.folder) == bytes_of(local.folder)
    assert len(bytes_of(local.folder)) == 2


def test_killed_worker_does_not_stop_the_study(study_file: Path, tmp_path: Path) -> None:
    study = Study(study_file, tmp_path / "there")
    killed: list[bool] = []

    with cluster(2) as (address, programs):

        def kill(_progress: object) -> None:
            if not killed:
                killed.append(True)
                programs[0].kill()

        states = [recording.state for recording in study.run(scheduler=address, progress=kill)]
    assert killed
    assert states == ["done", "done", "failed", "failed", "failed"]


def test_unreachable_scheduler_is_reported(
    study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labapp.run.study.workers.TIMEOUT_S", 0.5)
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(InputError):
            Study(study_file).run(scheduler=address)
