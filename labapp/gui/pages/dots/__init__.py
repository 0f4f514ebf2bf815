"""Step 5: the dots of a frame, their rows, and corrections by hand."""

from labapp.gui.pages.dots.view import DotsPage

__all__ = ["DotsPage"]
