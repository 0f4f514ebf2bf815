"""Recording of camera frames to disk."""
