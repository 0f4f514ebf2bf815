"""Frames measured one after the other: of a recording, or while a camera is live."""
