"""Frames that follow each other: each measured from the one before."""
