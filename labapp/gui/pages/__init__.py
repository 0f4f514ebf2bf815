"""The steps of the guided way, one page each."""

from __future__ import annotations

from labapp.gui.pages.capture import CapturePage
from labapp.gui.pages.dots import DotsPage
from labapp.gui.pages.export import ExportPage
from labapp.gui.pages.laser import LaserPage
from labapp.gui.pages.page import Page
from labapp.gui.pages.plane import PlanePage
from labapp.gui.pages.setup import SetupPage
from labapp.gui.pages.surface import SurfacePage
from labapp.gui.pages.trends import TrendsPage

PAGES: tuple[type[Page], ...] = (
    SetupPage,
    LaserPage,
    PlanePage,
    CapturePage,
    DotsPage,
    SurfacePage,
    TrendsPage,
    ExportPage,
)
"""In the order of `steps.STEPS`; a step without a page is not shown."""
