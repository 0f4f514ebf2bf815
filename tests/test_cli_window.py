from __future__ import annotations

import re
import sys
from importlib.abc import MetaPathFinder
from pathlib import Path

import pytest

from labapp.cli import window
from tests.conftest import Run

COMMANDS = ("demo", "session")

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], True),
        (["run.labsession"], True),
        (["run.avi"], True),
        (["folder/of/images"], True),
        (["demo"], False),
        (["session"], False),
        (["reconstrukt"], False),
        (["--help"], False),
        (["-h"], False),
        (["run.avi", "other.avi"], False),
        (["demo", "--out", "x"], False),
    ],
)
def test_arguments_that_open_the_app(arguments: list[str], expected: bool):
    assert window.asks_for_app(arguments, lambda: COMMANDS) == expected


def test_existing_path_is_opened_whatever_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()
    assert window.asks_for_app(["frames"], lambda: COMMANDS)


def test_missing_display_is_reported_with_a_hint(labapp: Run):
    code, out, err = labapp()
    assert (code, out) == (2, "")
    assert "DISPLAY" in err
    assert "labapp --help" in err


def test_missing_file_is_named(labapp: Run, tmp_path: Path):
    code, _, err = labapp(tmp_path / "gone.labsession")
    assert code == 2
    assert "gone.labsession" in err
    assert "does not exist" in err


def test_missing_gui_packages_are_reported_with_the_remedy(
    labapp: Run, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "labapp.gui.app", None)
    code, _, err = labapp()
    assert code == 2
    assert "pip install 'labapp[gui]'" in err
    assert "Traceback" not in err


def test_missing_system_libraries_are_named(labapp: Run, monkeypatch: pytest.MonkeyPatch):
    class WithoutLibrary(MetaPathFinder):
        def find_spec(self, name: str, *_: object) -> None:
            if name == "labapp.gui.app":
                raise ImportError("libEGL.so.1: cannot open shared object file")

    monkeypatch.delitem(sys.modules, "labapp.gui.app", raising=False)
    monkeypatch.setattr(sys, "meta_path", [WithoutLibrary(), *sys.meta_path])
    code, _, err = labapp()
    assert code == 2
    assert "libEGL.so.1" in err
    assert "apt install libegl1" in err


def test_system_libraries_are_those_that_run_installs():
    packages = re.search(r"packages='([^']*)'", (ROOT / "run").read_text("utf-8"))
    assert packages is not None
    assert {*window.LIBRARIES.split(), "ca-certificates"} == {*packages[1].split()}


def test_unknown_command_is_rejected(labapp: Run):
    code, _, err = labapp("reconstrukt")
    assert code == 2
    assert "No such command" in err


def test_demo_prints_the_command_without_a_display(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    window.show_in_app(Path("demo results/gtaw.labsession"))
    assert "labapp 'demo results/gtaw.labsession'" in capsys.readouterr().out
