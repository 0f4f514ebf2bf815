"""Modal integration of slopes: least-squares fit of the gradients of polynomials to the slopes.

The method is that of wave-front sensors with Zernike polynomials (Southwell 1980; R. J. Noll, J.
Opt. Soc. Am. 66, 207–211, 1976). The Zernike polynomials up to a radial order span all polynomials
of that degree, so that any other basis gives the same fit; products of Chebyshev polynomials are
used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes.integration import reconstruct_by
from labapp.core.schemes.slopes import ReflectedRays
from labapp.core.surface.boundary import BoundaryModel
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray


@dataclass(frozen=True)
class ModalSettings:
    """Settings of modal integration.

    Parameters
    ----------
    order
        Highest radial order of the Zernike polynomials. It is reduced for few points, so that there
        are at least three slopes for each polynomial.
    loops
        Maximum number of loops; they end when the reflection points have converged.
    boundary
        Boundary model: ``piecewise`` (§6.3.2) or ``circle`` (§8.2.1).
    """

    order: int = 6
    loops: int = 100
    boundary: BoundaryModel = "piecewise"


def reconstruct(match: Match, rig: Rig, settings: ModalSettings) -> Reconstruction:
    """Reconstruct the pool surface by modal integration; `CannotMeasure` as `reconstruct_by`."""

    def integrate(_: ReflectedRays, place: FloatArray, gradient: FloatArray) -> FloatArray:
        return heights(place, gradient, settings.order)

    return reconstruct_by("modal", integrate, match, rig, settings.loops, settings.boundary)


def heights(place: FloatArray, gradient: FloatArray, order: int) -> FloatArray:
    """Heights of the best-fitting polynomial up to a constant, shape (n,), mm.

    Parameters
    ----------
    place, gradient
        (x, y) of n points, mm, and the gradients there, shape (n, 2).
    order
        See `ModalSettings`.
    """
    while order > 1 and 3 * _terms(order) > 2 * len(place):
        order -= 1
    center = (place.min(axis=0) + place.max(axis=0)) / 2
    radius = float(np.linalg.norm(place - center, axis=-1).max())
    x, y = ((place - center) / radius).T
    degree = np.add.outer(np.arange(order + 1), np.arange(order + 1))
    kept = np.flatnonzero((degree <= order) & (degree > 0))
    value_x, value_y = (chebyshev.chebvander(at, order) for at in (x, y))
    slope_x, slope_y = (_slopes(at, order) for at in (x, y))
    basis, by_x, by_y = (
        np.einsum("na,nb->nab", *pair).reshape(len(place), -1)[:, kept]
        for pair in ((value_x, value_y), (slope_x, value_y), (value_x, slope_y))
    )
    coefficients = np.linalg.lstsq(np.vstack([by_x, by_y]), radius * gradient.T.ravel())[0]
    return np.asarray(basis @ coefficients)


def _terms(order: int) -> int:
    """Number of polynomials up to an order, without the constant."""
    return (order + 1) * (order + 2) // 2 - 1


def _slopes(at: FloatArray, order: int) -> FloatArray:
    """Derivatives of the Chebyshev polynomials T₀ … T_order, shape (n, order + 1)."""
    derived = [chebyshev.chebval(at, chebyshev.chebder(one)) for one in np.eye(order + 1)]
    return np.stack(derived, axis=-1)
