"""Simulated recordings, sessions and cameras, and measurements of them."""
