"""The level of a surface, found from Python for tests."""

from __future__ import annotations

import numpy as np

from labapp.core.surface.kernels import level_kernels
from labapp.core.surface.level import Level
from labapp.core.values import FloatArray, IntArray


def find_level(
    height: FloatArray,
    slope: FloatArray,
    y_mm: FloatArray,
    ray_states: IntArray,
    spacing_mm: FloatArray,
    rear: tuple[int, float | None] = (1, None),
    about: tuple[float, int, float] = (0.0, 1, np.nan),
    missing: float = 0.0,
) -> Level:
    """Find the level (`level_kernels.find_level`); a drop of None is found along with it.

    The laser is infinitely far above.
    """
    head_sign, drop_mm = rear
    landing = np.stack([0 * y_mm, y_mm, 0 * y_mm], axis=-1)
    bench = np.array([head_sign, 0.0, 0.0, np.inf])
    from_level = np.array([*about, np.nan if drop_mm is None else drop_mm], float)
    seen = height, slope, landing, ray_states, spacing_mm
    return Level.of(level_kernels.find_level(*seen, bench, from_level, missing))
