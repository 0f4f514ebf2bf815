"""The pages of the steps of the guided procedure."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from labapp.gui.shell.steps import STEPS

if TYPE_CHECKING:
    from labapp.gui.pages.page import Page
    from labapp.gui.workspace import Workspace


def _maker(key: str, name: str) -> Callable[[Workspace], Page]:
    """A function that creates a step's page; its module is imported on first use."""

    def make(workspace: Workspace) -> Page:
        page: Page = getattr(importlib.import_module(f"{__name__}.{key}"), name)(workspace)
        return page

    return make


PAGES: Mapping[str, Callable[[Workspace], Page]] = {
    step.key: _maker(step.key, step.page) for step in STEPS
}
"""Functions that create the pages, by the keys of the steps."""
