"""Lens distortion, and a homography for each picture, from pictures of known points on a plane.

Each picture has its own homography; all share one lens with Brown and Conrady's coefficients
k₁, k₂, p₁, p₂ about the middle of the picture. One picture from any direction is therefore enough;
further pictures improve the fit. The focal length cannot be determined from pictures of planes
perpendicular to the axis, and it only scales the coefficients. It is set to the longer side of the
picture. A lens axis off the middle is, to first order, equivalent to tangential distortion and
perspective, which are free.

A distortion term is included if noise alone is unlikely to reduce the residuals as much (F-test).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from labapp.core.calibration.boards import BoardCorners
from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.values import FloatArray, ReadOnlyArrays

LARGEST_CHANCE = 0.001
"""Significance level of the F-test: a term is left out if its p-value is larger."""

LEAST_SIGMA_PX = 0.02
"""Lower limit of a corner's standard uncertainty, however small the residuals are, px."""

TERMS = ("k1", "p1", "p2", "k2")
"""Coefficients in the order of the parameters."""

LEAST_COVERED = 0.35
"""Terms beyond k₁ are fitted only if the points span at least this share of the picture."""

GROUPS = (("k1",), ("p1", "p2"), ("k2",))
"""Terms that are included together."""


@dataclass(frozen=True)
class LensFit(ReadOnlyArrays):
    """A lens and homographies fitted to m pictures.

    Parameters
    ----------
    size_px
        Width and height of the pictures.
    terms
        Distortion terms in the fit, a subset of `TERMS`.
    parameters
        8 entries of each homography, in units of the picture's and the plane's size, then the
        coefficients of ``terms``, shape (8m + t,).
    covariance
        Covariance of the parameters, shape (8m + t, 8m + t), from the residuals.
    frames
        Middle and size of each picture's points on its plane, shape (m, 3), mm.
    residuals_px
        Computed minus measured position of each point, all pictures, shape (n, 2), px.
    chances
        p-value (F-test) of each term that is left out, by its name.
    """

    size_px: tuple[int, int]
    terms: tuple[str, ...]
    parameters: FloatArray
    covariance: FloatArray
    frames: FloatArray
    residuals_px: FloatArray
    chances: dict[str, float]

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals along either axis, px."""
        return float(np.sqrt(np.mean(self.residuals_px**2)))

    @property
    def sigma_px(self) -> float:
        """Standard uncertainty of a position along either axis, from the residuals, px."""
        spare = max(self.residuals_px.size - len(self.parameters), 1)
        return max(float(np.sqrt(np.sum(self.residuals_px**2) / spare)), LEAST_SIGMA_PX)

    @cached_property
    def lens(self) -> Lens | None:
        """The lens; None if no distortion is detected."""
        if not self.terms:
            return None
        return _lens(self.size_px, _coefficients(self.terms, self.parameters))

    def calibration(self) -> ImageCalibration:
        """Image calibration of the first picture."""
        x, z, size = self.frames[0].tolist()
        to_unit = np.array([[1.0, 0.0, -x], [0.0, 1.0, -z], [0.0, 0.0, size]]) / size
        focal, middle = _scale(self.size_px), _middle(self.size_px)
        to_px = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
        unit = np.append(self.parameters[:8], 1.0).reshape(3, 3)
        matrix = np.asarray(np.linalg.inv(to_px @ unit @ to_unit), np.float64)
        return ImageCalibration(matrix / matrix[2, 2], self.lens)

    def covariance_px2(self, plane_mm: FloatArray) -> FloatArray:
        """Covariance of the positions in the first picture of (X, Z), shape (n, 2), mm.

        Its shape is (2n, 2n), px².
        """
        unit = (plane_mm - self.frames[0, :2]) / self.frames[0, 2]
        coefficients = _coefficients(self.terms, self.parameters)
        _, by_plane, by_term = _seen(unit, self.parameters[:8], coefficients, _scale(self.size_px))
        slopes = np.zeros((2 * len(plane_mm), len(self.parameters)))
        slopes[:, :8] = by_plane
        chosen = [TERMS.index(term) for term in self.terms]
        slopes[:, len(self.parameters) - len(chosen) :] = by_term[:, chosen]
        return np.asarray(slopes @ self.covariance @ slopes.T)

    def distortion_percent(self) -> tuple[float, float]:
        """Radial distortion in the picture's corner, % of its distance to the middle, and its ±."""
        corner = float(np.hypot(*_middle(self.size_px))) / _scale(self.size_px)
        powers = {"k1": corner**2, "k2": corner**4}
        of = np.array([100.0 * powers.get(term, 0.0) for term in self.terms])
        count = len(self.terms)
        first = len(self.parameters) - count
        variance = of @ self.covariance[first:, first:] @ of
        return float(of @ self.parameters[first:]), float(np.sqrt(variance))


def fit_lens(views: Sequence[BoardCorners], size_px: tuple[int, int]) -> LensFit:
    """Fit a lens, with the significant distortion terms, and a homography to each picture.

    Parameters
    ----------
    views
        Corners seen in each picture: at least 5 that span the plane, at least 12 in total.
    size_px
        Width and height of the pictures.

    Raises
    ------
    ValueError
        If the points of a picture do not span its plane.
    """
    best = fit_terms(views, size_px, ())
    left = list(GROUPS if covered(views, size_px) >= LEAST_COVERED else GROUPS[:1])
    while True:
        # k₂ without k₁ would only extrapolate beyond the outermost corners.
        open_to = [group for group in left if group != ("k2",) or "k1" in best.terms]
        tried = [(group, fit_terms(views, size_px, (*best.terms, *group))) for group in open_to]
        chances = [_chance(best, larger) for _, larger in tried]
        known = {
            term: chance
            for (group, _), chance in zip(tried, chances, strict=True)
            for term in group
        }
        if not tried or min(chances) > LARGEST_CHANCE:
            return replace(best, chances=known)
        group, best = tried[int(np.argmin(chances))]
        left.remove(group)


def covered(views: Sequence[BoardCorners], size_px: tuple[int, int]) -> float:
    """Share of the picture spanned by the points of all pictures together (convex hull)."""
    from scipy.spatial import ConvexHull

    places = np.concatenate([view.image_px for view in views])
    return float(ConvexHull(places).volume) / (size_px[0] * size_px[1])


def fit_terms(
    views: Sequence[BoardCorners], size_px: tuple[int, int], terms: Sequence[str]
) -> LensFit:
    """Fit a lens with given distortion terms, see `fit_lens`."""
    from scipy.optimize import least_squares

    terms = tuple(term for term in TERMS if term in terms)
    chosen, focal = [TERMS.index(term) for term in terms], _scale(size_px)
    frames = np.array([_frame(view.plane_mm) for view in views])
    units = [
        (view.plane_mm - frame[:2]) / frame[2] for view, frame in zip(views, frames, strict=True)
    ]
    places = [(view.image_px - _middle(size_px)) / focal for view in views]
    first = np.concatenate(
        [
            *(_homography(unit, place) for unit, place in zip(units, places, strict=True)),
            np.zeros(len(chosen)),
        ]
    )

    def parts(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        coefficients = _coefficients(terms, parameters)
        off, slopes = [], []
        for k, (unit, place) in enumerate(zip(units, places, strict=True)):
            seen, by_plane, by_term = _seen(
                unit, parameters[8 * k : 8 * k + 8], coefficients, focal
            )
            rows = np.zeros((len(by_plane), len(parameters)))
            rows[:, 8 * k : 8 * k + 8] = by_plane
            rows[:, len(parameters) - len(chosen) :] = by_term[:, chosen]
            off.append(((seen - place) * focal).ravel())
            slopes.append(rows)
        return np.concatenate(off), np.concatenate(slopes)

    found = least_squares(
        lambda at: parts(at)[0], first, jac=lambda at: parts(at)[1], method="lm", x_scale="jac"
    )
    off, slopes = parts(found.x)
    fit = LensFit(
        size_px=size_px,
        terms=terms,
        parameters=found.x,
        covariance=np.asarray(np.linalg.inv(slopes.T @ slopes), np.float64),
        frames=frames,
        residuals_px=off.reshape(-1, 2),
        chances={},
    )
    return replace(fit, covariance=fit.covariance * fit.sigma_px**2)


def _chance(smaller: LensFit, larger: LensFit) -> float:
    """p-value of the additional terms of the larger fit (F-test)."""
    from scipy.special import fdtrc

    more = len(larger.terms) - len(smaller.terms)
    left = float(np.sum(larger.residuals_px**2))
    gain = float(np.sum(smaller.residuals_px**2)) - left
    spare = max(larger.residuals_px.size - len(larger.parameters), 1)
    variance = max(left / spare, LEAST_SIGMA_PX**2)
    return float(fdtrc(more, spare, max(gain, 0.0) / more / variance))


def _seen(
    unit: FloatArray, homography: FloatArray, coefficients: FloatArray, focal: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Image positions from the middle over the focal length, shape (n, 2), and derivatives.

    The derivatives w.r.t. the homography, shape (2n, 8), and k₁, p₁, p₂, k₂, shape (2n, 4), are
    in px.
    """
    ones = np.column_stack([unit, np.ones(len(unit))])
    *place, weight = np.append(homography, 1.0).reshape(3, 3) @ ones.T
    x, y = place / weight
    k1, p1, p2, k2 = coefficients
    # OpenCV projects points in space, here at unit distance before an unmoved camera.
    camera, still = np.diag([focal, focal, 1.0]), np.zeros(3)
    points = np.column_stack([x, y, np.ones(len(x))])
    lens = np.array([k1, k2, p1, p2])
    found: tuple[FloatArray, FloatArray] = cv2.projectPoints(  # type: ignore[assignment]
        points, still, still, camera, lens
    )
    image_px, slopes = found
    by_place = slopes[:, 3:5].reshape(-1, 2, 2)  # w.r.t. the shift, which is that of x and y
    straight = np.zeros((2, 8, len(x)))
    straight[0, :3] = straight[1, 3:6] = ones.T
    straight[:, 6:] = -np.stack([x, y])[:, None] * ones.T[:2]
    by_plane = np.einsum("nij,jkn->nik", by_place, straight / weight)
    by_term = slopes[:, [10, 12, 13, 11]]
    return image_px.reshape(-1, 2) / focal, by_plane.reshape(-1, 8), by_term


def _homography(unit: FloatArray, place: FloatArray) -> FloatArray:
    """First 8 entries of the homography from units of the plane to those of the picture (DLT)."""
    ones, zeros = np.column_stack([unit, np.ones(len(unit))]), np.zeros((len(unit), 3))
    equations = np.concatenate(
        [
            np.column_stack([ones, zeros, -place[:, :1] * ones]),
            np.column_stack([zeros, ones, -place[:, 1:] * ones]),
        ]
    )
    size, axes = np.linalg.svd(equations)[1:]
    if size[7] < 1e-9 * size[0] or abs(axes[8, 8]) < 1e-9:
        raise ValueError("the places do not span the plane")
    return np.asarray(axes[8, :8] / axes[8, 8])


def _frame(plane_mm: FloatArray) -> FloatArray:
    middle = (plane_mm.min(axis=0) + plane_mm.max(axis=0)) / 2.0
    return np.append(middle, max(float(np.abs(plane_mm - middle).max()), 1e-9))


def _coefficients(terms: Sequence[str], parameters: FloatArray) -> FloatArray:
    """Return k₁, p₁, p₂, k₂; terms that are not fitted are 0."""
    found = np.zeros(len(TERMS))
    found[[TERMS.index(term) for term in terms]] = parameters[len(parameters) - len(terms) :]
    return found


def _lens(size_px: tuple[int, int], coefficients: FloatArray) -> Lens:
    focal, (u, v) = _scale(size_px), _middle(size_px).tolist()
    k1, p1, p2, k2 = coefficients.tolist()
    return Lens((focal, focal), (u, v), (k1, k2, p1, p2, 0.0))


def _scale(size_px: tuple[int, int]) -> float:
    return float(max(size_px))


def _middle(size_px: tuple[int, int]) -> FloatArray:
    return (np.array(size_px, float) - 1.0) / 2.0
