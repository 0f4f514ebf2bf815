"""The steps of the guided way, one page each."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from labapp.gui.shell.steps import STEPS

if TYPE_CHECKING:
    from labapp.gui.pages.page import Page
    from labapp.gui.workspace import Workspace


def _maker(key: str, name: str) -> Callable[[Workspace], Page]:
    """What makes a step's page; its module is loaded with the first: the window is there before."""

    def make(workspace: Workspace) -> Page:
        page: Page = getattr(importlib.import_module(f"{__name__}.{key}"), name)(workspace)
        return page

    return make


PAGES: Mapping[str, Callable[[Workspace], Page]] = {
    step.key: _maker(step.key, step.page) for step in STEPS
}
"""What makes each step's page, by key."""
