"""Fixtures and hooks of all tests."""

from __future__ import annotations

import ctypes
import os
import shutil
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import platformdirs
import pytest
from hypothesis import settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

from labapp import cli, log

# The same examples in every run, and no failure that depends on the load of the machine.
settings.register_profile("labapp", derandomize=True, deadline=None)
settings.load_profile("labapp")

# Programs with another home folder use the user's cache of compiled functions.
os.environ.setdefault("NUMBA_CACHE_DIR", platformdirs.user_cache_dir("labapp", appauthor=False))

Run = Callable[..., tuple[int, str, str]]

INTERRUPTIBLE = """
import signal, sys
from labapp.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
main(sys.argv[1:])
"""
"""The program for ``python -c``: it reacts to Ctrl-C even if the tests run in the background."""


def skip_or_fail(reason: str) -> None:
    """Skip a test that cannot run on this machine, or fail where nothing may be skipped."""
    if os.environ.get("CI") or os.environ.get("LABAPP_SKIP_NOTHING"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start slow tests first; otherwise other workers would wait for them at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


SHARING = (
    "core/test_board_calibration.py",
    "core/test_correspondence.py",
    "core/test_pipeline.py",
    "core/test_quality.py",
    "core/test_warm.py",
    "export/test_penetration.py",
    "pages/test_bench_check.py",
    "session/test_line_sessions.py",
    "session/test_report.py",
    "study/test_study.py",
    "simulated/test_glass_and_travel.py",
    "simulated/test_simulate.py",
    "test_adviser.py",
    "test_api.py",
    "test_cli_session.py",
    "test_cli_simulate.py",
    "test_error_analysis.py",
    "test_measurers.py",
    "test_tools_study.py",
    "test_tour.py",
    "test_wheel.py",
)
"""Files whose tests are all run by one worker, because their fixtures take long."""


class Scheduling(LoadScopeScheduling):
    """Assign single tests to the workers, but all tests of a file in `SHARING` to one."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return file if file.endswith(SHARING) else nodeid


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling:
    """Return the scheduler of the tests for several workers."""
    return Scheduling(config, log)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown() -> None:
    """Return freed memory to the system; glibc keeps some hundred megabytes in fragments."""
    if sys.platform == "linux":
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("xvfb") and shutil.which("Xvfb") is None:
        skip_or_fail("Xvfb is not installed")


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip the test if 3-D drawing off-screen is not possible."""
    from labapp.export.rendering.drawing import can_draw

    if not can_draw():
        skip_or_fail("nothing can be drawn in 3-D here")


@pytest.fixture
def port() -> Iterator[int]:
    """Return a free port, which stays reserved: it is bound, but nothing listens on it."""
    with socket.socket() as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(("127.0.0.1", 0))
        yield bound.getsockname()[1]


@pytest.fixture
def little_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the quick search of the adviser to a tenth of its time."""
    from labapp.studies.adviser import search as adviser

    reduced = adviser.Effort(grid=(1, 1, 2), pools=(2, 2, 3), steps=1, finalists=1, sweep=2)
    monkeypatch.setattr(adviser, "QUICK", reduced)


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Keep log and drafts out of the home folder; start and end each test without its handler."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    _end_log()
    yield tmp_path / "state"
    _end_log()


def _end_log() -> None:
    logger = log.start_log()
    for handler in list(logger.handlers):
        handler.close()
        logger.removeHandler(handler)


@pytest.fixture
def labapp(capfd: pytest.CaptureFixture[str], state: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command line without a display: (arguments) -> (exit code, stdout, stderr)."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)

    def start(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as caught:
            cli.main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert isinstance(caught.value.code, int)
        return caught.value.code, out, err

    return start
