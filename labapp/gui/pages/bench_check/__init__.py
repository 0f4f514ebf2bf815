"""Bench check: pictures of known mirrors, and the set-up adjusted to them."""

from labapp.gui.pages.bench_check.view import BenchCheckPage

__all__ = ["BenchCheckPage"]
