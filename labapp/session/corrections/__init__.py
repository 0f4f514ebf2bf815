"""Corrections by hand: from a file, and carried on to later frames."""
