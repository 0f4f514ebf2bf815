from __future__ import annotations

import sys
from pathlib import Path

import pytest

from labapp.cli import window
from tests.conftest import Run

COMMANDS = ("demo", "session")


@pytest.mark.parametrize(
    ("arguments", "wanted"),
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
def test_when_the_app_is_wanted(arguments: list[str], wanted: bool):
    assert window.asks_for_app(arguments, COMMANDS) == wanted


def test_a_file_that_is_there_is_opened_whatever_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()
    assert window.asks_for_app(["frames"], COMMANDS)


def test_without_a_display_it_says_what_to_do(labapp: Run):
    code, out, err = labapp()
    assert (code, out) == (2, "")
    assert "DISPLAY" in err
    assert "labapp --help" in err


def test_a_file_that_is_not_there_is_named(labapp: Run, tmp_path: Path):
    code, _, err = labapp(tmp_path / "gone.labsession")
    assert code == 2
    assert "gone.labsession" in err
    assert "does not exist" in err


def test_without_what_windows_need_it_says_what_to_install(
    labapp: Run, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "labapp.gui.app", None)
    code, _, err = labapp()
    assert code == 2
    assert "pip install 'labapp[gui]'" in err
    assert "Traceback" not in err


def test_a_word_that_is_no_command_is_none(labapp: Run):
    code, _, err = labapp("reconstrukt")
    assert code == 2
    assert "No such command" in err


def test_the_demo_tells_how_to_see_it_where_there_is_no_display(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    window.show_in_app(Path("demo results/gtaw.labsession"))
    assert "labapp 'demo results/gtaw.labsession'" in capsys.readouterr().out
