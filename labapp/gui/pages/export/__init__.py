"""Step 8: what leaves the session."""

from labapp.gui.pages.export.page import ExportPage

__all__ = ["ExportPage"]
