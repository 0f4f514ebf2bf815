"""Step 7: changes of the pool over the recording."""

from labapp.gui.pages.trends.page import TrendsPage

__all__ = ["TrendsPage"]
