"""The version of labapp."""

from __future__ import annotations

VERSION = "1.0.0"
