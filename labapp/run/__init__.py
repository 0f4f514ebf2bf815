"""Measuring sequences of frames: of a recording, or of a live camera."""
