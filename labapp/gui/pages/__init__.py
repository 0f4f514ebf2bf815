"""The pages of the steps of the guided procedure."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from labapp.gui.pages.page import Page
    from labapp.gui.shell.steps import Step
    from labapp.gui.workspace import Workspace


def make_page(step: Step, workspace: Workspace) -> Page:
    """Create the page of a step; its module is imported on first use."""
    module = importlib.import_module(f"{__name__}.{step.key}.page")
    page: Page = getattr(module, step.page)(workspace)
    return page
