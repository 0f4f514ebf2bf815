"""Types shared by all steps: arrays, read-only dataclasses, and the error of a failed frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class CannotMeasure(Exception):
    """Error raised if a frame cannot be measured.

    Parameters
    ----------
    status
        One hyphenated word, as written to ``measures.csv``: ``no-dots``, ``no-reference``,
        ``ambiguous-rows``, ``too-few-dots``, …
    reason
        One sentence for the operator.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(f"{status}: {reason}")
        self.status = status
        self.reason = reason


class ReadOnlyArrays:
    """Base class of dataclasses whose array fields are read-only."""

    def __post_init__(self) -> None:
        fields = vars(self)
        for name, item in fields.items():
            if isinstance(item, np.ndarray) and item.flags.writeable:
                view = fields[name] = item[...]
                view.setflags(write=False)

    def __repr__(self) -> str:
        # For dataclasses with ``repr=False``: shapes instead of a thousand numbers.
        parts = [
            f"{name}=<{item.shape}>" if isinstance(item, np.ndarray) else f"{name}={item!r}"
            for name, item in vars(self).items()
        ]
        return f"{type(self).__name__}({', '.join(parts)})"


def robust_sigma(residuals: npt.ArrayLike) -> float:
    """Standard deviation of normal residuals about 0, by their median size: outliers hardly count.

    The median size of normal deviates is their standard deviation over 1.4826.
    """
    return 1.4826 * median(np.abs(residuals).ravel())


def median(values: FloatArray) -> float:
    """Median of an array, shape (n,); NaN if it is empty or has a NaN. Faster than `np.median`."""
    count = len(values)
    if not count:
        return float("nan")
    low, high, last = (count - 1) // 2, count // 2, count - 1
    ordered = np.partition(values, (low, high, last))  # NaN comes last
    return float("nan" if np.isnan(ordered[last]) else (ordered[low] + ordered[high]) / 2)


def rms(values: FloatArray) -> float:
    """Root mean square of the values of an array, of any shape."""
    return float(np.sqrt(np.mean(values**2)))
