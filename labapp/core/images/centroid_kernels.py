"""Inner loops over the light of each dot, compiled for the processor (docs/adr/0018).

Arrays may be read-only, and of any layout but for pictures.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled_for as _compiled_for
from labapp.core.compiled import inner as _inner
from labapp.core.images.dots import Grey, Picture
from labapp.core.values import FloatArray, IntArray

_grey = types.Array(types.float32, 2, "C", readonly=True)
_byte = types.Array(types.uint8, 2, "C", readonly=True)
_ints = types.Array(types.int64, 1, "A", readonly=True)


@_inner
def _mirrored(at: int, count: int) -> int:
    """A pixel's number where a picture goes on beyond its edge as in a mirror."""
    at %= 2 * count
    return 2 * count - 1 - at if at >= count else at


@_compiled_for(*((own, _ints, _ints, _grey, _grey) for own in (_grey, _byte)))
def finest(image: Picture, u: IntArray, v: IntArray, narrow: Grey, wide: Grey) -> FloatArray:
    """Largest difference of two filters among nine pixels round each (`band_pass._nine`)."""
    side, made = narrow.shape[1], np.empty(len(u))
    column, across = np.empty(side, np.float32), np.empty((6, side), np.float32)
    filters = np.concatenate((narrow, wide))
    for k in range(len(u)):
        across[:] = 0.0
        for x in range(side):
            at_x = _mirrored(u[k] + x - side // 2, image.shape[1])
            for y in range(side):
                column[y] = image[_mirrored(v[k] + y - side // 2, image.shape[0]), at_x]
            for j in range(6):
                weight, own = filters[j, x], across[j]
                for y in range(side):
                    own[y] += weight * column[y]
        most = np.float32(-np.inf)
        for i in range(3):
            for j in range(3):
                value = np.float32(0.0)
                for y in range(side):
                    value += narrow[i, y] * across[j, y] - wide[i, y] * across[3 + j, y]
                most = max(most, value)
        made[k] = most
    return made
