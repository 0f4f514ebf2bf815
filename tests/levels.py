"""The level of a surface, found from Python for tests."""

from __future__ import annotations

import numpy as np

from labapp.core.surface.kernels import level_kernels
from labapp.core.surface.level import Level
from labapp.core.values import FloatArray, IntArray


def find_level(
    height: FloatArray,
    slope: FloatArray,
    y: FloatArray,
    ray_states: IntArray,
    spacing_mm: FloatArray,
    rear: tuple[int, float | None] = (1, None),
    about: tuple[float, int, float] = (0.0, 1, np.nan),
    missing: float = 0.0,
) -> Level:
    """Find the level (`level_kernels.find_level`); a drop of None is found along with it."""
    depth = np.array([np.nan if value is None else value for value in rear], float)
    seen = height, slope, y, ray_states, spacing_mm
    return Level.of(level_kernels.find_level(*seen, depth, np.array(about, float), missing))
