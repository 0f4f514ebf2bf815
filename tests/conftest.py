"""What every test shares."""

from __future__ import annotations

from hypothesis import settings

# The same examples every time, and no verdict that depends on how busy the machine is.
settings.register_profile("labapp", derandomize=True, deadline=None)
settings.load_profile("labapp")
