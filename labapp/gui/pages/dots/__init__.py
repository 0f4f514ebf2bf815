"""Step 5: the dots of a frame, their rows, and the hand that puts them right."""

from labapp.gui.pages.dots.view import DotsPage

__all__ = ["DotsPage"]
