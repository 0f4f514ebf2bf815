"""`labapp session …`: an experiment in one file."""

from labapp.cli.session.commands import app

__all__ = ["app"]
