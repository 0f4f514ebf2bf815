"""What every test shares."""

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

# The same examples every time, and no verdict that depends on how busy the machine is.
settings.register_profile("labapp", derandomize=True, deadline=None)
settings.load_profile("labapp")

# Programs with a home of their own need not compile for themselves what is kept in the user's.
os.environ.setdefault("NUMBA_CACHE_DIR", platformdirs.user_cache_dir("labapp", appauthor=False))

Run = Callable[..., tuple[int, str, str]]

HEEDING = """
import signal, sys
from labapp.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
main(sys.argv[1:])
"""
"""The program for ``python -c``: it heeds Ctrl-C also where tests are run in the background."""


def lacks(words: str) -> None:
    """Skip a test that cannot be run here; where everything has to be there, fail."""
    if os.environ.get("CI") or os.environ.get("LABAPP_SKIP_NOTHING"):
        pytest.fail(words, pytrace=False)
    pytest.skip(words)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes long is begun first: at the end a worker would wait for it."""
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
"""Files of which one worker runs all tests: what these share takes long to make."""


class Scheduling(LoadScopeScheduling):
    """Give a worker the next test, or all tests of a file that shares."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return file if file.endswith(SHARING) else nodeid


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling:
    """Return the scheduling of the tests in several workers."""
    return Scheduling(config, log)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown() -> None:
    """Let the system have what was freed: glibc keeps some hundred megabytes in pieces."""
    if sys.platform == "linux":
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("xvfb") and shutil.which("Xvfb") is None:
        lacks("Xvfb is not installed")


@pytest.fixture(scope="session")
def opengl() -> None:
    """Let only what can draw in 3-D off-screen go on."""
    from labapp.export.rendering.drawing import can_draw

    if not can_draw():
        lacks("nothing can be drawn in 3-D here")


@pytest.fixture
def port() -> Iterator[int]:
    """A free port that nobody takes meanwhile: it is bound, though not listened at."""
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", 0))
        yield held.getsockname()[1]


@pytest.fixture
def little_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adviser's quick search finds less, in a tenth of the time."""
    from labapp.studies.adviser import search as adviser

    little = adviser.Effort(grid=(1, 1, 2), pools=(2, 2, 3), steps=1, finalists=1, sweep=2)
    monkeypatch.setattr(adviser, "QUICK", little)


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
        with pytest.raises(SystemExit) as ended:
            cli.main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert isinstance(ended.value.code, int)
        return ended.value.code, out, err

    return start
