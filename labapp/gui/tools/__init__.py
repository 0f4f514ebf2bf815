"""Tools: windows beside the main one, each with a view and a presenter, imported on first use.

A closed tool window is kept, so that its results are there when it is opened again.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

    from labapp.gui.shell.files import Files
    from labapp.gui.tools.tool import ToolWindow

TOOLS = {
    "dynamics": "DynamicsWindow",
    "study": "StudyWindow",
    "simulator": "SimulatorWindow",
    "adviser": "AdviserWindow",
    "analysis": "AnalysisWindow",
}
"""Name of the window class by module."""


def show_tool(key: str, sessions: Files, window: QWidget) -> ToolWindow:
    """Show the window of a tool; it is created on first use."""
    from PySide6.QtWidgets import QDialog

    tool: ToolWindow | None = window.findChild(QDialog, f"tool-{key}")  # type: ignore[assignment]
    if tool is None:
        kind: type[ToolWindow] = getattr(importlib.import_module(f"{__name__}.{key}"), TOOLS[key])
        tool = kind(sessions, window)
    tool.open_beside()
    return tool
