"""Step 7: how the pool changes over the recording."""

from labapp.gui.pages.trends.page import TrendsPage

__all__ = ["TrendsPage"]
