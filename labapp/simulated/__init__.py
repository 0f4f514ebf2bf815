"""Recordings, sessions and cameras made by simulation, and what is measured of them."""
