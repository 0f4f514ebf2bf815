"""Rendering of surfaces and frames: pictures, films and the 3-D view."""
