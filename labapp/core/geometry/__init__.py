"""Geometry of the bench: laser, rays, imaging plane, and coordinate systems."""
