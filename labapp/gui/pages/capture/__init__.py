"""Step 4: the recording or camera that provides the frames."""

from labapp.gui.pages.capture.page import CapturePage

__all__ = ["CapturePage"]
