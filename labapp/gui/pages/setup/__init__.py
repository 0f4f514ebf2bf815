"""Set-up: the experiment's record, the safety list, and what is bolted to the bench."""

from labapp.gui.pages.setup.view import SetupPage

__all__ = ["SetupPage"]
