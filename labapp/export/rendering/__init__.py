"""Surfaces and frames as pictures, as a film and in the 3-D view."""
