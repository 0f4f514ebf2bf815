"""Affine map and homography fitted to the marks of the target, and the choice between them.

§5.1.2 uses three points: an affine map. An oblique camera sees the plane in perspective, which
requires more than three marks to detect. The marks lie along two axes only, so a homography has
to be extrapolated to the region of the dots. It is chosen only if its expected error is smaller
*there* (a focused information criterion, Claeskens and Hjort 2003). Perspective detected along one
axis only is fitted along that axis. The position of a mark is less certain along its axis than
across it, and less certain in dark regions: each coordinate is weighted by its own scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from labapp.core.geometry.coordinates import ImageCalibration, with_ones
from labapp.core.values import FloatArray, ReadOnlyArrays

Model = Literal["three points", "affine", "homography"]
"""Map from pixels to the plane: the dissertation's three points, or a fit to all marks."""

FEWEST_ON_AXIS, FEWEST_MARKS = 4, 9
"""Least number of marks on each axis, O′ included, and in total, for a homography."""

LARGEST_CHANCE = 0.001
"""Significance level of the F-test: perspective is rejected if its p-value is larger."""

WHAT_MATTERS_MM = 0.5
"""The operator is warned if the map's error in the region of the dots may be larger."""

AFFINE = (0, 1, 2, 3, 4, 5)
PERSPECTIVE = ((6,), (7,), (6, 7))
"""Free matrix entries, row by row: of an affine map; of perspective along X′, Z′ and both."""

HELP = "set the camera square, or use more marks"
UNKNOWN_PERSPECTIVE = f"how obliquely the camera looks is not known: {HELP}"

FIELD = 1.5
"""Dots land within the square from O′ whose side is this many times the longer axis."""

LEAST_SIGMA_PX = 0.02
"""Lower limit of a mark's standard uncertainty, however small the residuals are, px."""

ROUNDS = 5
"""Iterations of fitting and estimating the scatter; they have converged by then."""


@dataclass(frozen=True)
class MarkFit(ReadOnlyArrays):
    """Map from the imaging plane to the picture, fitted to marks.

    Parameters
    ----------
    matrix
        Shape (3, 3): (X′, Z′, 1) in mm to homogeneous (u, v, 1) in px; its last entry is 1.
    free
        Matrix entries, counted row by row, that were fitted; the others are those of an affine map.
    covariance
        Covariance of these entries, from the residuals.
    residual_px, residual_mm
        Computed minus measured position of each mark, shape (n, 2).
    left_out_px
        Leave-one-out residual of each mark, to first order, shape (n, 2), px.
    spare
        Residual degrees of freedom of each mark along and across its axis, shape (n, 2).
    variance
        Variance of the residuals, relative to that expected from the marks' scatter.
    """

    matrix: FloatArray
    free: tuple[int, ...]
    covariance: FloatArray
    residual_px: FloatArray
    residual_mm: FloatArray
    left_out_px: FloatArray
    spare: FloatArray
    variance: float

    @property
    def calibration(self) -> ImageCalibration:
        """Map from the picture to the imaging plane."""
        return _calibration(self.matrix)

    def covariance_px2(self, plane_mm: FloatArray) -> FloatArray:
        """Covariance of the image positions u, v, u, v, … of (X′, Z′), shape (n, 2), px²."""
        rows = _jacobian(self.matrix, plane_mm)[:, self.free]
        return np.asarray(rows @ self.covariance @ rows.T)


@dataclass(frozen=True)
class MarkFits:
    """Both fits to the same marks, and the one with the smaller error in the region of the dots.

    Parameters
    ----------
    affine, homography
        The fits; None for a homography that the marks do not determine.
    whole
        The homography with perspective along both axes, even if a simpler one is used: it gives
        the uncertainty left by the marks; None if there are too few marks.
    corner_mm
        X′ = Z′ of the far corner of the region of the dots, mm.
    best
        The better model.
    reason
        Reason for the choice, in a sentence.
    """

    affine: MarkFit
    homography: MarkFit | None
    whole: MarkFit | None
    corner_mm: float
    best: Model
    reason: str

    def of(self, model: Model) -> MarkFit:
        """Return the fit of a model.

        Raises
        ------
        ValueError
            If these marks do not determine it.
        """
        fit = {"affine": self.affine, "homography": self.homography}.get(model)
        if fit is None:
            raise ValueError(f"these marks give no {model}")
        return fit

    @property
    def field_mm(self) -> FloatArray:
        """Grid of points (X′, Z′) over the region of the dots, shape (n, 2), mm."""
        return _field(self.corner_mm)

    def covariance_px2(self, used: ImageCalibration, plane_mm: FloatArray) -> FloatArray:
        """Covariance of a map's errors at (X′, Z′), shape (n, 2), as u, v, u, v, …, px².

        The true map is that of `bound_mm`. A map with less perspective scatters less, but marks
        that do not show a perspective do not show that there is none.

        Raises
        ------
        ValueError
            If there are too few marks.
        """
        if self.whole is None:
            raise ValueError(self.reason)
        off = used.to_image(plane_mm) - self.whole.calibration.to_image(plane_mm)
        own = self.whole.covariance_px2(plane_mm)
        return np.asarray(self._student**2 * own + np.outer(off, off))

    @property
    def _student(self) -> float:
        """Student's factor: the scatter along an axis is estimated from few residuals."""
        assert self.whole is not None
        return float(scipy.special.stdtrit(self.whole.spare[:, 0].sum(), 0.975) / 1.96)

    def bound_mm(self, used: ImageCalibration) -> float:
        """95 % bound of a map's error at the far corner, mm; NaN if unknown.

        The true map is taken to be a homography with perspective along both axes, with the
        covariance of its fit. Its full uncertainty counts, whichever map is used.
        """
        if self.whole is None:
            return float("nan")
        corner = np.full((1, 2), self.corner_mm)
        seen = self.whole.calibration.to_image(corner)
        slope = used.jacobian(seen)[0]
        off = (used.to_plane(seen) - corner)[0]
        covariance = self._student**2 * slope @ self.whole.covariance_px2(corner) @ slope.T
        # |off + noise|² is approximated by c·χ²(n) of equal mean and variance (Satterthwaite 1946).
        mean = off @ off + np.trace(covariance)
        spread = 2 * np.sum(covariance**2) + 4 * off @ covariance @ off
        n = 2 * mean**2 / max(spread, 1e-300)
        quantile = scipy.special.chdtri(n, 0.05) / n if n < 1e6 else 1.0
        return float(np.sqrt(mean * quantile))

    def bound_words(self, used: ImageCalibration) -> tuple[str, ...]:
        """Return text on the map's possible error in the region of the dots, and on remedies."""
        bound, whole = self.bound_mm(used), self.whole
        if whole is None:
            return (UNKNOWN_PERSPECTIVE,)
        corner = f"{self.corner_mm:.0f}, {self.corner_mm:.0f} mm"
        bound_text = f"± {bound:.2g} mm at the plate's far corner (X′, Z′ = {corner}; 95 %)"
        if bound <= WHAT_MATTERS_MM:
            return (bound_text,)
        if self.best == "homography" and bound > 1.5 * self.bound_mm(
            self.of("homography").calibration
        ):
            return bound_text, "the homography would leave less: the marks show perspective"
        on_x, on_z = np.diag(whole.covariance)[list(PERSPECTIVE[-1])]
        axis, way = ("O′Z′", "up or down") if on_z > on_x else ("O′X′", "from the side")
        return (
            f"if the camera looks {way}, the marks on {axis} cannot tell: at the plate's far "
            f"corner (X′, Z′ = {corner}) the map may then be {bound:.2g} mm off (95 %); {HELP}",
        )


def root_mean_square(offsets: FloatArray) -> float:
    """Root mean square of the lengths of offsets, shape (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=-1))))


def fit_marks(
    plane_mm: FloatArray, image_px: FloatArray, noise: FloatArray | None = None
) -> MarkFits:
    """Fit an affine map and a homography to marks by least squares in the picture.

    Parameters
    ----------
    plane_mm, image_px
        (X′, Z′), mm, and (u, v), px, of at least 4 marks on the two axes, shape (n, 2).
    noise
        Noise of the picture at each mark, shape (n,), in any unit; a mark's scatter is taken to be
        proportional to it.

    Raises
    ------
    ValueError
        If the marks do not span the plane.
    """
    plane_mm, image_px = np.asarray(plane_mm, float), np.asarray(image_px, float)
    if len(plane_mm) < 4 or np.linalg.matrix_rank(plane_mm - plane_mm.mean(axis=0)) < 2:
        raise ValueError("at least 4 marks that span the plane are needed")
    noise = np.ones(len(plane_mm)) if noise is None else noise
    noise = np.clip(noise / max(float(np.median(noise)), 1e-12), 0.2, 5.0)
    alike = np.eye(2) / LEAST_SIGMA_PX / noise[:, None, None]
    affine = _fit(plane_mm, image_px, AFFINE, alike)
    on_x, on_z = (int(np.sum(plane_mm[:, axis] == 0.0)) for axis in (1, 0))
    if min(on_x, on_z) < FEWEST_ON_AXIS or len(plane_mm) < FEWEST_MARKS:
        reason = (
            f"{on_x} marks on O′X′ and {on_z} on O′Z′, O′ included, are too few to show "
            f"perspective: {FEWEST_ON_AXIS} on each and {FEWEST_MARKS} in all are needed"
        )
        corner = FIELD * float(np.abs(plane_mm).max())
        return MarkFits(affine, None, None, corner, "affine", reason)
    whiten = _by_scatter(plane_mm, image_px, noise, affine)
    affine, *fits = (_fit(plane_mm, image_px, AFFINE + more, whiten) for more in ((), *PERSPECTIVE))
    return _chosen(affine, fits, float(np.abs(plane_mm).max()))


def _by_scatter(
    plane_mm: FloatArray, image_px: FloatArray, noise: FloatArray, affine: MarkFit
) -> FloatArray:
    """Matrices that give each mark's residual along and across its axis, in σ, shape (n, 2, 2)."""
    on_x = plane_mm[:, 1:] == 0.0
    along = np.where(on_x, affine.matrix[:2, 0], affine.matrix[:2, 1])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turn = np.stack([along, along[:, ::-1] * [-1.0, 1.0]], axis=1)
    # The dot at O′ has no end along an axis: it scatters as little as the bars do across theirs.
    is_along = np.stack([plane_mm.any(axis=1), np.zeros(len(plane_mm), bool)], axis=1)
    noises = np.stack([noise, noise], axis=1)
    sigma = LEAST_SIGMA_PX * noises
    for _ in range(ROUNDS):
        fit = _fit(plane_mm, image_px, AFFINE + PERSPECTIVE[-1], turn / sigma[..., None])
        squares = (np.einsum("nij,nj->ni", turn, fit.residual_px) / noises) ** 2
        for kind in (is_along, ~is_along):
            scatter = squares[kind].sum() / fit.spare[kind].sum()
            sigma[kind] = max(float(np.sqrt(scatter)), LEAST_SIGMA_PX) * noises[kind]
    return np.asarray(turn / sigma[..., None])


def _chosen(affine: MarkFit, fits: list[MarkFit], axis_mm: float) -> MarkFits:
    """Choose the perspective terms, then between the affine map and the homography."""
    k = int(np.argmin([fit.variance for fit in fits[:2]]))
    if _gains(fits[k], fits[2], axis_mm):
        k = 2
    homography, chance = fits[k], _chance(affine, fits[k])
    affine_error, error = _expected_errors_mm(affine, homography, axis_mm)
    here = f"dots are expected to be {affine_error:.2g} mm off without it, {error:.2g} mm with it"
    best: Model = "affine"
    if _gains(affine, homography, axis_mm):
        best = "homography"
        along = ("along X′", "along Z′", "along both axes")[k]
        reason = f"The plane is seen in perspective {along}: {here}"
    elif chance > LARGEST_CHANCE:
        reason = f"No perspective is seen: noise alone gains as much in {chance:.0%} of pictures"
    else:
        reason = f"There is perspective, but the marks determine it too poorly: {here}"
    return MarkFits(
        affine=affine,
        homography=homography,
        whole=fits[2],
        corner_mm=FIELD * axis_mm,
        best=best,
        reason=reason,
    )


def _chance(smaller: MarkFit, larger: MarkFit) -> float:
    """p-value of the additional entries of the larger fit (F-test)."""
    more, spare = len(larger.free) - len(smaller.free), float(larger.spare.sum())
    gain = smaller.variance * (spare + more) - larger.variance * spare
    return float(scipy.special.fdtrc(more, spare, max(gain, 0.0) / more / larger.variance))


def _gains(smaller: MarkFit, larger: MarkFit, axis_mm: float) -> bool:
    """Whether the larger fit is significantly better and its error at the dots is smaller."""
    before, after = _expected_errors_mm(smaller, larger, axis_mm)
    return _chance(smaller, larger) <= LARGEST_CHANCE and after < before


def _expected_errors_mm(smaller: MarkFit, larger: MarkFit, axis_mm: float) -> tuple[float, float]:
    """RMS error of two fits in the region of the dots, if the larger is unbiased."""
    field = _field(FIELD * axis_mm)
    seen = larger.calibration.to_image(field)
    mm2_per_px2 = np.abs(np.linalg.det(larger.calibration.jacobian(seen)))

    def spread(fit: MarkFit) -> float:
        # The same noise for both: the residuals of a wrong map also contain its bias.
        noise = np.diag(fit.covariance_px2(field)).reshape(-1, 2).sum(axis=1) / fit.variance
        return float(np.mean(noise * mm2_per_px2)) * larger.variance

    apart = root_mean_square(smaller.calibration.to_plane(seen) - field)
    # The variance of the difference of nested fits is the difference of their variances (Hausman).
    bias = max(apart**2 - (spread(larger) - spread(smaller)), 0.0)
    return float(np.sqrt(bias + spread(smaller))), float(np.sqrt(spread(larger)))


def _fit(
    plane_mm: FloatArray, image_px: FloatArray, free: tuple[int, ...], whiten: FloatArray
) -> MarkFit:
    """Fit some entries of the matrix by least squares of the whitened residuals in the picture."""
    # Lengths of about 1 keep the equations well conditioned.
    size = np.abs(plane_mm).max()
    plane = plane_mm / size
    matrix = np.eye(3)
    matrix[:2] = np.linalg.lstsq(with_ones(plane), image_px, rcond=None)[0].T

    def off(step: FloatArray) -> FloatArray:
        residual = _seen(_with(matrix, free, step), plane) - image_px
        return np.asarray(np.einsum("nij,nj->ni", whiten, residual).ravel())

    def slopes(step: FloatArray) -> FloatArray:
        by_mark = _jacobian(_with(matrix, free, step), plane)[:, free]
        return np.asarray((whiten @ by_mark.reshape(-1, 2, len(free))).reshape(-1, len(free)))

    # Imported here to keep the program's start fast.
    from scipy.optimize import least_squares

    found = least_squares(off, np.zeros(len(free)), jac=slopes, method="lm", x_scale="jac")
    rows, weighted = slopes(found.x), off(found.x)
    matrix = _with(matrix, free, found.x)
    inverse = np.asarray(np.linalg.inv(rows.T @ rows), np.float64)
    by_mark = rows.reshape(-1, 2, len(free))
    leverage = by_mark @ inverse @ np.swapaxes(by_mark, 1, 2)
    kept = np.eye(2) - leverage
    left_out = np.linalg.solve(kept, weighted.reshape(-1, 2, 1))
    # Scatter that was estimated is not certain to be more than it is: never below 1.
    variance = max(float(weighted @ weighted) / max(len(weighted) - len(free), 1), 1.0)
    residual = _seen(matrix, plane) - image_px
    matrix = np.asarray(matrix @ np.diag([1 / size, 1 / size, 1.0]))
    unit = np.array([1, 1, size, 1, 1, size, 1, 1])[list(free)] / size
    return MarkFit(
        matrix=matrix,
        free=free,
        covariance=inverse * np.outer(unit, unit) * variance,
        residual_px=residual,
        residual_mm=plane_mm - _calibration(matrix).to_plane(image_px),
        left_out_px=np.linalg.solve(whiten, left_out)[..., 0],
        spare=np.diagonal(kept, axis1=1, axis2=2),
        variance=variance,
    )


def _field(corner_mm: float) -> FloatArray:
    across = np.linspace(0.0, corner_mm, 6)
    return np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)


def _calibration(matrix: FloatArray) -> ImageCalibration:
    return ImageCalibration(np.asarray(np.linalg.inv(matrix), np.float64))


def _seen(matrix: FloatArray, plane: FloatArray) -> FloatArray:
    projected = with_ones(plane) @ matrix.T
    return np.asarray(projected[:, :2] / projected[:, 2:])


def _jacobian(matrix: FloatArray, plane: FloatArray) -> FloatArray:
    """∂(u, v)/∂(the first 8 entries of the matrix), shape (2n, 8)."""
    ones = with_ones(plane)
    seen, weight = _seen(matrix, plane), ones @ matrix[2]
    rows = np.zeros((len(plane), 2, 8))
    rows[:, 0, :3] = rows[:, 1, 3:6] = ones
    rows[:, :, 6:] = -seen[:, :, None] * plane[:, None, :]
    return np.asarray((rows / weight[:, None, None]).reshape(-1, 8))


def _with(matrix: FloatArray, free: tuple[int, ...], step: FloatArray) -> FloatArray:
    """Return the matrix with a step added to some entries, counted row by row."""
    flat = matrix.ravel().copy()
    flat[list(free)] += step
    return flat.reshape(3, 3)
