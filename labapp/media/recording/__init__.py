"""Recordings that are made: what a camera gives, on the disk."""
