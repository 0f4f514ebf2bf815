"""What every step shares: array types, frozen values, and the answer "cannot be measured"."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class CannotMeasure(Exception):
    """A frame has no answer, and this says why.

    Parameters
    ----------
    status
        One word with hyphens, as it goes into ``measures.csv``: ``no-dots``, ``no-reference``,
        ``ambiguous-rows``, ``too-few-dots``, …
    reason
        One sentence for the operator.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(f"{status}: {reason}")
        self.status = status
        self.reason = reason


def freeze(value: Any) -> None:
    """Make every array field of a dataclass instance read-only (call from ``__post_init__``)."""
    fields = vars(value)
    for name, item in fields.items():
        if isinstance(item, np.ndarray) and item.flags.writeable:
            view = fields[name] = item.view()
            view.flags.writeable = False


def median(values: FloatArray) -> float:
    """Median of finite numbers, shape (n,), NaN of none: `np.median` without its checks.

    They take longer than a hundred numbers do.
    """
    if not len(values):
        return float("nan")
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1].tolist()
    return float((low + high) / 2)
