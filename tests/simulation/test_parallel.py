"""Worker processes: low priority, sharing, and their end with their parent or on an exception."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from labapp.simulation.parallel import (
    NICE,
    in_parallel,
    low_priority,
    shared_processes,
)
from tests.waiting import PATIENCE_S, wait_until

BUSY = """
import sys, time
from labapp.simulation.parallel import in_parallel
if __name__ == "__main__":
    in_parallel(time.sleep, [600, 600], "asleep", lambda *_: print(flush=True), workers=2)
"""

ENDED = """
import contextlib, multiprocessing
from labapp.simulation.parallel import processes
if __name__ == "__main__":
    for _ in range(10):
        with contextlib.suppress(InterruptedError), processes(2) as pool:
            told = [pool.submit(bytes, 20_000_000) for _ in range(20)]
            told[0].result()
            raise InterruptedError
        assert not multiprocessing.active_children()
"""


def test_workers_have_low_priority_and_one_thread() -> None:
    niceness = os.nice(0)
    with low_priority():
        assert in_parallel(os.nice, [0, 0, 0], workers=2) == [min(niceness + NICE, 19)] * 3
    assert in_parallel(os.nice, [0, 0], workers=2) == [niceness] * 2
    assert in_parallel(os.getenv, ["OMP_NUM_THREADS"] * 2, workers=2) == ["1", "1"]


def process(_: int) -> int:
    time.sleep(0.01)
    return os.getpid()


def test_shared_processes_are_reused_and_end() -> None:
    with shared_processes(2):
        first, second = (set(in_parallel(process, range(20), workers=2)) for _ in range(2))
        assert len(first | second) <= 2
        assert os.getpid() not in first
    assert not multiprocessing.active_children()
    assert first.isdisjoint(in_parallel(process, range(20), workers=2))


def test_exception_in_progress_ends_shared_processes() -> None:
    def stop(_what: str, done: int, _total: int) -> None:
        if multiprocessing.active_children():
            raise InterruptedError(done)

    with pytest.raises(InterruptedError), shared_processes(2):
        in_parallel(time.sleep, [600, 600], "asleep", stop, workers=2)
    assert not multiprocessing.active_children()


def test_exception_in_progress_ends_processes() -> None:
    def stop(_what: str, done: int, _total: int) -> None:
        if multiprocessing.active_children():
            raise InterruptedError(done)

    with pytest.raises(InterruptedError):
        in_parallel(time.sleep, [600, 600], "asleep", stop, workers=2)
    assert not multiprocessing.active_children()


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "busy.py"
    program.write_text(BUSY, "utf-8")
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE) as running:
        assert running.stdout is not None
        while len(workers := spawned(running.pid)) < 2:
            assert running.stdout.readline()
        running.send_signal(signal.SIGKILL)
    wait_until(lambda: not any(is_running(pid) for pid in workers))


def stat(pid: int) -> list[str]:
    """Return state, parent … of a process from Linux's ``/proc``; empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def is_running(pid: int) -> bool:
    return stat(pid)[:1] not in ([], ["Z"])


def spawned(parent: int) -> list[int]:
    """Return the ids of started workers which a process has spawned."""
    pids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
    return [
        pid
        for pid in pids
        if stat(pid)[1:2] == [str(parent)]
        and b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
        and Path(f"/proc/{pid}/task").is_dir()
        and len(list(Path(f"/proc/{pid}/task").iterdir())) > 1  # one thread watches the parent
    ]


@pytest.mark.slow
def test_ending_a_worker_that_sends_much_data_does_not_block(tmp_path: Path) -> None:
    """Results are larger than a pipe's buffer: each worker is ended while it sends one."""
    program = tmp_path / "ended.py"
    program.write_text(ENDED, "utf-8")
    subprocess.run([sys.executable, program], timeout=PATIENCE_S, check=True)
