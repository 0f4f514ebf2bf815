"""The camera: its view of the imaging plane and the distortion of its lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.values import FloatArray

ROUNDS = 200
"""At most, of the fixed-point iteration that removes a distortion."""

BLOCK = 1 << 14
"""Points of one iteration: few enough to stay in the processor's cache."""


@dataclass(frozen=True)
class Lens:
    """Brown-Conrady distortion, radial and tangential, with OpenCV's signs and order.

    With x, y measured from the centre of the picture in focal lengths, and r² = x² + y²:
    ``x′ = x·(1 + k₁r² + k₂r⁴ + k₃r⁶) + 2p₁xy + p₂(r² + 2x²)``, and
    ``y′ = y·(1 + k₁r² + k₂r⁴ + k₃r⁶) + p₁(r² + 2y²) + 2p₂xy``.
    """

    focal_px: float
    """Focal length in pixels."""
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    """Coefficients; k₁ < 0 gives barrel distortion."""

    def _radial(self, r2: FloatArray) -> FloatArray:
        return np.asarray(1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3)))

    def _tangential(
        self, x: FloatArray, y: FloatArray, r2: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        return (
            2 * self.p1 * x * y + self.p2 * (r2 + 2 * x**2),
            self.p1 * (r2 + 2 * y**2) + 2 * self.p2 * x * y,
        )

    @property
    def _reach2(self) -> float:
        """Largest r² up to which the distorted radius increases with the true one."""
        turns = np.roots([7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        return min((float(t.real) for t in turns if t.real > 0 and t.imag == 0), default=np.inf)

    def distort(self, straight_px: FloatArray) -> FloatArray:
        """Distort undistorted points, given from the picture's centre, shape (…, 2), px.

        NaN for points so far out that the coefficients would fold them back into the picture.
        """
        xy = straight_px / self.focal_px
        x, y = xy[..., 0], xy[..., 1]
        r2 = x**2 + y**2
        seen = xy * self._radial(r2)[..., None] + np.stack(self._tangential(x, y, r2), axis=-1)
        return np.asarray(np.where((r2 < self._reach2)[..., None], seen * self.focal_px, np.nan))

    def straighten(self, seen_px: FloatArray) -> FloatArray:
        """Remove the distortion: the inverse of `distort`, shape (…, 2), px."""
        seen = np.reshape(seen_px, (-1, 2)) / self.focal_px
        xy = np.empty_like(seen)
        for start in range(0, len(seen), BLOCK):
            xy[start : start + BLOCK] = self._straightened(seen[start : start + BLOCK])
        return np.asarray(xy.reshape(np.shape(seen_px)) * self.focal_px)

    def _straightened(self, seen: FloatArray) -> FloatArray:
        # Coordinate by coordinate: NumPy is slow along an axis of length 2.
        seen_x, seen_y = np.ascontiguousarray(seen.T)
        if self.p1 == 0 and self.p2 == 0:
            return seen * self._shortening(seen_x**2 + seen_y**2)[..., None]
        x, y = seen_x, seen_y
        with np.errstate(all="ignore"):
            for _ in range(ROUNDS):
                r2 = x**2 + y**2
                before, radial = (x, y), self._radial(r2)
                aside_x, aside_y = self._tangential(x, y, r2)
                x, y = (seen_x - aside_x) / radial, (seen_y - aside_y) / radial
                if max(_largest(x - before[0]), _largest(y - before[1])) <= 1e-13:
                    break
        return np.stack([x, y], axis=-1)

    def _shortening(self, seen2: FloatArray) -> FloatArray:
        """Ratio of the true to the distorted radius, by radial terms alone, for squares of it."""
        ratio = np.ones_like(seen2)
        with np.errstate(all="ignore"):
            for _ in range(ROUNDS):
                before, ratio = ratio, 1.0 / self._radial(seen2 * ratio**2)
                if _largest(ratio - before) <= 1e-13:
                    break
        return ratio


def _largest(change: FloatArray) -> float:
    """Largest absolute value, NaN ignored."""
    return float(np.fmax.reduce(np.abs(change), initial=0.0))


@dataclass(frozen=True)
class CameraView:
    """The camera's view of the imaging plane: O′, one point on each axis, and the picture size.

    The points are those of the set-up file's ``image_calibration``, so that the file can be filled
    in from here. The camera is far away and perpendicular to the plane: apart from the distortion
    of the lens, the map is affine.

    Raises
    ------
    ValueError
        If the lens would fold the picture.
    """

    origin_px: tuple[float, float]
    x_axis_px: tuple[float, float]
    x_axis_mm: float
    z_axis_px: tuple[float, float]
    z_axis_mm: float
    """(u, v) of O′; (u, v), px, and X′ or Z′, mm, of a point on O′X′ and of one on O′Z′."""
    width_px: int = 480
    height_px: int = 640
    lens: Lens | None = None
    """Lens that distorts the picture; the three points are undistorted. None: no distortion."""

    def __post_init__(self) -> None:
        if self.lens is None:
            return
        corners = np.array([[u, v] for u in (0, self.width_px) for v in (0, self.height_px)], float)
        if not np.allclose(self.to_image(self.to_plane(corners)), corners, rtol=0, atol=1e-3):
            raise ValueError("the lens distortion folds the picture")

    @classmethod
    def rolled(
        cls,
        origin_px: tuple[float, float] = (44.0, 590.0),
        px_per_mm: float = 5.67,
        roll_deg: float = 0.0,
        x_axis_mm: float = 69.85,
        z_axis_mm: float = 31.75,
    ) -> CameraView:
        """Build the view of a camera that is rotated counter-clockwise about its axis."""
        roll = np.radians(roll_deg)
        x_step = px_per_mm * x_axis_mm * np.array([np.cos(roll), -np.sin(roll)])
        z_step = px_per_mm * z_axis_mm * np.array([-np.sin(roll), -np.cos(roll)])
        u, v = origin_px
        return cls(
            origin_px=origin_px,
            x_axis_px=(u + float(x_step[0]), v + float(x_step[1])),
            x_axis_mm=x_axis_mm,
            z_axis_px=(u + float(z_step[0]), v + float(z_step[1])),
            z_axis_mm=z_axis_mm,
        )

    @property
    def px_per_mm(self) -> FloatArray:
        """∂(u, v)/∂(X′, Z′), shape (2, 2), px/mm."""
        origin = np.array(self.origin_px)
        return np.stack(
            [
                (np.array(self.x_axis_px) - origin) / self.x_axis_mm,
                (np.array(self.z_axis_px) - origin) / self.z_axis_mm,
            ],
            axis=-1,
        )

    @property
    def _middle_px(self) -> FloatArray:
        return np.array([self.width_px - 1, self.height_px - 1]) / 2

    def to_image(self, plane_mm: FloatArray) -> FloatArray:
        """IPCS (X′, Z′), shape (…, 2), mm, to (u, v), shape (…, 2), px; NaN if never seen."""
        straight = np.asarray(plane_mm @ self.px_per_mm.T + np.array(self.origin_px))
        if self.lens is None:
            return straight
        return self._middle_px + self.lens.distort(straight - self._middle_px)

    def to_plane(self, image_px: FloatArray) -> FloatArray:
        """(u, v), shape (…, 2), px, to IPCS (X′, Z′), shape (…, 2), mm."""
        if self.lens is not None:
            image_px = self._middle_px + self.lens.straighten(image_px - self._middle_px)
        return np.asarray((image_px - np.array(self.origin_px)) @ np.linalg.inv(self.px_per_mm).T)
