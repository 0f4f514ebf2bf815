"""Step 4: where the frames come from."""

from labapp.gui.pages.capture.page import CapturePage

__all__ = ["CapturePage"]
