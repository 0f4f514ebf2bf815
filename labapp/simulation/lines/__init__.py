"""Frames and recordings of line patterns (§3.2, §3.3)."""
