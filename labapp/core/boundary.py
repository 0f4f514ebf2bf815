"""The pool's boundary: piecewise polar model, circle, contour (§6.3.2, §8.2.1)."""

from __future__ import annotations

from dataclasses import dataclass

from labapp.core.values import FloatArray, freeze


@dataclass(frozen=True)
class Boundary:
    """A closed boundary around a centre, one point per polar angle.

    Parameters
    ----------
    center_mm
        Origin of the polar coordinates, shape (2,), mm.
    theta_deg
        Polar angle of each point, ascending from −180 (inclusive) to 180 (exclusive), degrees,
        counter-clockwise from +X, shape (m,).
    points_mm
        The points in the UCS, shape (m, 3), mm; not repeated at the end.
    """

    center_mm: FloatArray
    theta_deg: FloatArray
    points_mm: FloatArray

    def __post_init__(self) -> None:
        freeze(self)
