"""The complete workflow in one process: every module, a session up to export, every page and tool.

    python way.py FOLDER

It ends with a traceback if something fails. With `sitecustomize` (in this folder) on PYTHONPATH it
runs as on another system.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import labapp
from labapp.bundled import bundled
from labapp.cli import main

FRAMES = 2
PATIENCE_S = 300.0


def import_all() -> None:
    """Import every module."""
    for module in pkgutil.walk_packages(labapp.__path__, "labapp."):
        if module.name != "labapp.__main__":
            importlib.import_module(module.name)


def run(*arguments: object) -> None:
    """Call a command, which must exit with code 0."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert ended.value.code == 0, arguments


def measure(folder: Path) -> Path:
    """Simulate, record, measure and export by commands; return the session."""
    from labapp.export.rendering.drawing import can_draw

    simulated, session = folder / "egg", folder / "egg.labsession"
    setup, recording = simulated / "setup.toml", simulated / "recording.avi"
    export = ("session", "export", session, "--out", folder / "results")
    pictures = "frames,trends,surfaces,film" if can_draw() else "frames,trends"
    run("cameras")
    for frames in (1, FRAMES):  # the second replaces the first
        egg = bundled("resources/simulations/egg.toml")
        run("simulate", egg, "--out", simulated, "--frames", frames)
    run("session", "new", folder / "recorded.labsession", "--setup", setup)
    record = ("record", f"simulated:{recording}", "--seconds", "0.1")
    run(*record, "--session", folder / "recorded.labsession")
    run("session", "new", session, "--setup", setup)
    run("session", "import", session, recording)
    run("session", "measure", session, "--frames", ":1")
    run(*export, "--hdf5", "--report", "--pictures", pictures, "--size", "320x320")
    run(*export)
    run("session", "verify", session)
    run("session", "info", session)
    return session


def show(session: Path, folder: Path) -> tuple[str, ...]:
    """Show every page and tool of the app; return the pages."""
    from labapp.gui.app import open_window, start_app
    from labapp.gui.preferences import Preferences, read_preferences
    from labapp.gui.shell.steps import STEPS
    from labapp.gui.tools import TOOLS, show_tool

    app = start_app()

    def until(what: str, holds: Callable[[], bool]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < end_s, what
            app.processEvents()
            time.sleep(0.005)

    file = folder / "preferences.json"
    with open_window(app, Preferences(), file) as window:
        window.files.open(session)
        for key in (step.key for step in STEPS):
            window.show_step(key)
            until(key, lambda: not window.workspace.tasks.active)
            assert window.page is not None
            assert window.page.key == key
        window.workspace.foot_switches.look()
        until("foot switches", lambda: window.workspace.foot_switches.found is not None)
        window.do("measure")
        until("measured", lambda: not window.workspace.tasks.active)
        for key in TOOLS:  # some start calculations of minutes
            until(key, show_tool(key, window.files, window).isVisible)
        problems = [text for text in window.log_panel.texts() if "▲" in text]
        assert not problems, problems
        window.close()
    assert not read_preferences(file)[1]
    return tuple(window.pages)


def run_all() -> None:
    """Run the complete workflow, and print its steps."""
    from labapp import system

    folder = Path(sys.argv[1])
    folder.mkdir(exist_ok=True)
    import_all()
    print(f"{system.sys.platform}: every module is imported")
    session = measure(folder)
    print("pages:", *sorted(show(session, folder)))
    sys.stdout.flush()
    os._exit(0)  # as in the window tests: VTK can crash at shutdown


if __name__ == "__main__":
    run_all()
