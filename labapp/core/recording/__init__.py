"""Frames of one recording: tracking from frame to frame, row vote and check of the set-up."""
