"""Step 5: the dots of a frame, their rows, and how they are corrected by hand."""

from labapp.gui.pages.dots.view import DotsPage

__all__ = ["DotsPage"]
