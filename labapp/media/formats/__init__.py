"""Readers of recordings: one module for each format, and what they share."""
