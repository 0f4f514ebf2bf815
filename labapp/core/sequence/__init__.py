"""Sequences of frames: tracking from frame to frame, and means over frames."""
