"""Step 8: export of results."""

from labapp.gui.pages.export.page import ExportPage

__all__ = ["ExportPage"]
