"""Set-up: the record of the experiment, the safety list, and the bench."""

from labapp.gui.pages.setup.view import SetupPage

__all__ = ["SetupPage"]
