"""What every test shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from labapp import cli
from labapp.session import log

# The same examples every time, and no verdict that depends on how busy the machine is.
settings.register_profile("labapp", derandomize=True, deadline=None)
settings.load_profile("labapp")

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep the log out of the home folder; start each test without its handler."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    logger = log.start_log()
    for handler in list(logger.handlers):
        handler.close()
        logger.removeHandler(handler)
    return tmp_path / "state"


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
