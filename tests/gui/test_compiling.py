"""Code that is compiled at first use is compiled in another process."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pytestqt.qtbot import QtBot

import labapp
from labapp.core import compiled
from labapp.gui import compiling
from labapp.gui.app import FirstUse
from labapp.gui.shell.window import MainWindow
from labapp.gui.tasks import Cancelled, Control

PACKAGE = Path(labapp.__file__).parent


def test_every_compiled_module_is_listed():
    compiled = r"^from labapp\.core\.compiled import .*\b(compiled|inner)"
    modules = {
        ".".join(("labapp", *file.relative_to(PACKAGE).with_suffix("").parts))
        for file in PACKAGE.rglob("*.py")
        if re.search(compiled, file.read_text(), re.M)
    }
    assert modules == set(compiling.COMPILED)


def test_modules_missing_from_the_cache_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compiled._config, "CACHE_DIR", str(tmp_path))
    assert compiling.not_compiled() == list(compiling.COMPILED)
    name = compiling.COMPILED[0]
    file = PACKAGE.joinpath(*name.split(".")[1:]).with_suffix(".py")
    (compiled._folder() / compiled._digest(name, file)).mkdir(parents=True)
    assert compiling.not_compiled() == list(compiling.COMPILED)[1:]


@pytest.mark.slow
def test_window_shows_compiling_and_compiles_nothing_itself(window: MainWindow, qtbot: QtBot):
    first_use = FirstUse(window.workspace.tasks, window)
    first_use.found.emit(["labapp.text"])
    assert "compiling" in window.status_line.title.text()
    qtbot.waitUntil(lambda: not compiled.MAY_COMPILE.is_set())
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert compiled.MAY_COMPILE.is_set()


@pytest.mark.slow
def test_cancelling_ends_the_compiling_process():
    control = Control()
    control.cancelled.set()
    with pytest.raises(Cancelled):
        compiling.compile_aside(["labapp.text"], control)
    assert compiled.MAY_COMPILE.is_set()
