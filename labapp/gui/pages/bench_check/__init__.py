"""Bench check: pictures of known mirrors, and the set-up adjusted to them."""
