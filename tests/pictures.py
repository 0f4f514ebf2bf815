"""Comparison of pictures with stored references, within a tolerance.

If `RENEW` is set in the environment, the references are replaced: look at them before committing.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

PixelArray = npt.NDArray[np.integer]

RENEW = "LABAPP_RENEW_PICTURES"

FAR = 48
"""Difference of a channel (levels) from which a pixel differs; antialiased edges differ less."""


@dataclass(frozen=True)
class Away:
    """Difference between two pictures.

    Parameters
    ----------
    mean
        Mean difference of a channel, levels of 255.
    share
        Pixels that differ by `FAR` or more, as a share of all.
    """

    mean: float
    share: float

    def within(self, tolerance: Away) -> bool:
        """Whether neither value exceeds that of a tolerance."""
        return self.mean <= tolerance.mean and self.share <= tolerance.share


def difference(one: PixelArray, other: PixelArray) -> PixelArray:
    """Absolute difference, shape (height, width, 3)."""
    return np.abs(one.astype(int) - other.astype(int))


def away(one: PixelArray, other: PixelArray) -> Away:
    """Return the difference of two pictures, each of shape (height, width, 3), R, G, B."""
    differences = difference(one, other)
    return Away(float(differences.mean()), float((differences.max(axis=2) >= FAR).mean()))


def check_picture(picture: PixelArray, expected: Path, tolerance: Away, out: Path) -> None:
    """Fail if a picture differs from its reference; write it and the difference to ``out``."""
    if os.environ.get(RENEW):
        cv2.imwrite(str(expected), picture[..., ::-1])
    assert expected.is_file(), f"{expected} is missing"
    reference = cv2.imread(str(expected), cv2.IMREAD_COLOR_RGB)
    actual, difference_file = (
        out / expected.name,
        out / f"{expected.stem}-difference.png",
    )
    cv2.imwrite(str(actual), picture[..., ::-1])
    if reference.shape != picture.shape:
        pytest.fail(f"{actual} is {picture.shape}, {expected} is {reference.shape}")
    distance = away(picture, reference)
    if not distance.within(tolerance):
        magnified = np.clip(2 * difference(picture, reference), 0, 255).astype(np.uint8)
        cv2.imwrite(str(difference_file), magnified[..., ::-1])
        pytest.fail(
            f"{actual} is {distance} from {expected}, more than {tolerance}: see {difference_file}"
        )
