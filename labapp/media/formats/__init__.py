"""Readers of recordings, one module per format, and shared parts."""
