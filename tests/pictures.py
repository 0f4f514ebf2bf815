"""Pictures that are held against kept ones, with a tolerance.

`RENEW` set in the environment keeps what is drawn now: look at it before it is committed.
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
"""A pixel this many levels away in a channel is another one; edges drawn otherwise are nearer."""


@dataclass(frozen=True)
class Away:
    """How far a picture is from another.

    Parameters
    ----------
    mean
        Mean difference of a channel, levels of 255.
    share
        Pixels that are `FAR` away, as a share of all.
    """

    mean: float
    share: float

    def within(self, tolerance: Away) -> bool:
        """Whether it is nearer than a tolerance in both ways."""
        return self.mean <= tolerance.mean and self.share <= tolerance.share


def difference(one: PixelArray, other: PixelArray) -> PixelArray:
    """Absolute difference, shape (height, width, 3)."""
    return np.abs(one.astype(int) - other.astype(int))


def away(one: PixelArray, other: PixelArray) -> Away:
    """How far two pictures, each of shape (height, width, 3), R, G, B, are from each other."""
    apart = difference(one, other)
    return Away(float(apart.mean()), float((apart.max(axis=2) >= FAR).mean()))


def check_picture(picture: PixelArray, kept: Path, tolerance: Away, out: Path) -> None:
    """Fail if a picture is not as the kept one; it and the difference are written to ``out``."""
    if os.environ.get(RENEW):
        cv2.imwrite(str(kept), picture[..., ::-1])
    assert kept.is_file(), f"{kept} is missing"
    reference = cv2.imread(str(kept), cv2.IMREAD_COLOR_RGB)
    actual, apart = out / kept.name, out / f"{kept.stem}-difference.png"
    cv2.imwrite(str(actual), picture[..., ::-1])
    if reference.shape != picture.shape:
        pytest.fail(f"{actual} is {picture.shape}, {kept} is {reference.shape}")
    found = away(picture, reference)
    if not found.within(tolerance):
        shown = np.clip(2 * difference(picture, reference), 0, 255).astype(np.uint8)
        cv2.imwrite(str(apart), shown[..., ::-1])
        pytest.fail(f"{actual} is {found} from {kept}, more than {tolerance}: see {apart}")
