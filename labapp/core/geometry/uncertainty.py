"""Uncertainty of a bench: its geometric quantities and their covariance (JCGM 100).

Reflections alone do not reveal a wrong set-up, so its uncertainty is propagated to the ± of every
result (`core.surface.setup_uncertainty`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.values import FloatArray, ReadOnlyArrays


@dataclass(frozen=True)
class Quantity:
    """An uncertain quantity of the bench.

    Parameters
    ----------
    key
        ``section.key`` of the setup file; ``[u]`` or ``[v]`` follows for a point in the picture.
    assumed
        Standard uncertainty assumed if none is given: tape, protractor and reading of the picture.
    """

    key: str
    name: str
    unit: str
    assumed: float

    @property
    def sigma_key(self) -> str:
        """``section.key`` of its standard uncertainty in the setup file."""
        return f"{self.key.partition('[')[0]}_sigma"


def _point(key: str, name: str) -> tuple[Quantity, Quantity]:
    u, v = (Quantity(f"image_calibration.{key}[{at}]", f"{name}, {at}", "px", 0.3) for at in "uv")
    return u, v


ENDINGS = ("_sigma", "_correlation", "_covariance_px2")
"""Endings of the keys of a setup file that give the uncertainty of others."""

QUANTITIES = (
    Quantity("laser.projection_angle_deg", "laser, projection angle", "°", 0.5),
    Quantity("laser.distance_mm", "laser, distance", "mm", 0.5),
    Quantity("laser.azimuth_deg", "laser, azimuth", "°", 0.5),
    Quantity("laser.aim_x_mm", "laser, aim along X", "mm", 0.5),
    Quantity("laser.aim_y_mm", "laser, aim along Y", "mm", 0.5),
    Quantity("pattern.inter_beam_angle_deg", "pattern, inter-beam angle", "°", 0.004),
    Quantity("pattern.rotation_deg", "pattern, rotation", "°", 1.0),
    Quantity("imaging_plane.distance_mm", "imaging plane, distance", "mm", 0.5),
    Quantity("imaging_plane.s_mm", "imaging plane, s", "mm", 0.5),
    Quantity("imaging_plane.h_mm", "imaging plane, h", "mm", 0.5),
    Quantity("imaging_plane.pitch_deg", "imaging plane, pitch", "°", 0.5),
    Quantity("imaging_plane.yaw_deg", "imaging plane, yaw", "°", 0.5),
    Quantity("imaging_plane.roll_deg", "imaging plane, roll", "°", 0.5),
    *_point("origin_px", "image calibration, O′"),
    *_point("x_axis_px", "image calibration, point on O′X′"),
    *_point("z_axis_px", "image calibration, point on O′Z′"),
    Quantity("camera_lens.distortion_percent", "lens, distortion in the plane's corner", "%", 0.5),
    Quantity("imaging_plane.glass_mm", "glass, thickness", "mm", 0.1),
    Quantity("imaging_plane.glass_index", "glass, refractive index", "", 0.02),
    Quantity(
        "image_calibration.x_axis_mm", "image calibration, X′ of the point on O′X′", "mm", 0.1
    ),
    Quantity(
        "image_calibration.z_axis_mm", "image calibration, Z′ of the point on O′Z′", "mm", 0.1
    ),
)
"""All quantities, in the order of vectors and matrices; later versions append new ones."""

INDEX = {quantity.key: k for k, quantity in enumerate(QUANTITIES)}

FIRST = 20
"""Number of quantities in the first version; files of that version assume the others exact."""

GLASS = frozenset({"imaging_plane.glass_mm", "imaging_plane.glass_index"})
"""Keys of the quantities that are exact for a plane without glass."""

CALIBRATED = frozenset(
    one.key
    for one in QUANTITIES
    if (one.key.startswith("image_calibration.") and one.key.endswith("]"))
    or one.key in ("laser.projection_angle_deg", "laser.distance_mm")
)
"""Keys of the quantities that steps 2 and 3 calibrate (Appendix I, §5.1)."""

POINTS = [k for key, k in INDEX.items() if key.endswith("]")]
"""Indices of u and v of O′ and of the points on O′X′ and O′Z′."""

ANGLE, DISTANCE = INDEX["laser.projection_angle_deg"], INDEX["laser.distance_mm"]


@dataclass(frozen=True)
class AxisPoints:
    """Image calibration and the positions of its points on the axes (§5.1).

    Parameters
    ----------
    calibration
        Pixel ↔ imaging plane.
    x_mm, z_mm
        X′ of the point on O′X′, Z′ of that on O′Z′.
    """

    calibration: ImageCalibration
    x_mm: float
    z_mm: float


@dataclass(frozen=True)
class RigUncertainty(ReadOnlyArrays):
    """Uncertainty of a rig and its image calibration.

    Parameters
    ----------
    axes
        The image calibration and its points.
    covariance
        Covariance of `QUANTITIES`, shape (q, q), in the squares of their units. If smaller, the
        remaining quantities are exact.
    assumed
        Keys of the quantities whose uncertainty was not given.
    checked
        Whether the bench was adjusted to a known mirror and has not changed since.
    """

    axes: AxisPoints
    covariance: FloatArray
    assumed: frozenset[str] = frozenset()
    checked: bool = False

    def __post_init__(self) -> None:
        later = len(QUANTITIES) - len(self.covariance)
        if later:
            object.__setattr__(self, "covariance", np.pad(self.covariance, (0, later)))
        super().__post_init__()

    @property
    def sigma(self) -> FloatArray:
        """Standard uncertainty of each of `QUANTITIES`, shape (q,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def sigma_by_key(self) -> dict[str, float]:
        """Standard uncertainty by `Quantity.sigma_key`; for a point the rms of u and v."""
        keys = [one.sigma_key for one in QUANTITIES]
        variance = dict.fromkeys(keys, 0.0)
        for key, sigma in zip(keys, self.sigma.tolist(), strict=True):
            variance[key] += sigma**2 / keys.count(key)
        return {key: float(np.sqrt(value)) for key, value in variance.items()}

    @property
    def status(self) -> str:
        """Reliability of the set-up.

        ``checked``; ``calibrated`` if the uncertainties of laser and image calibration are given;
        otherwise ``entered``.
        """
        if self.checked:
            return "checked"
        return "entered" if self.assumed & CALIBRATED else "calibrated"

    @property
    def correlation(self) -> FloatArray:
        """Correlation of `QUANTITIES`, shape (q, q); 0 for exact quantities."""
        sigma = np.where(self.sigma > 0.0, self.sigma, 1.0)
        return np.asarray(self.covariance / np.outer(sigma, sigma))

    @cached_property
    def root(self) -> FloatArray:
        """Lower Cholesky factor R of the covariance, shape (q, q): R·n for normal deviates n.

        The column of an exact quantity is 0.
        """
        root, uncertain = np.zeros_like(self.covariance), np.flatnonzero(self.sigma)
        some = np.ix_(uncertain, uncertain)
        correlation = self.correlation[some] + 1e-12 * np.eye(len(uncertain))  # ±1 is singular
        root[some] = self.sigma[uncertain, None] * np.linalg.cholesky(correlation)
        return root

    def combined(self, changes: FloatArray) -> FloatArray:
        """Standard uncertainty, shape (m,), from the changes per σ of each quantity, (m, q)."""
        variance = np.einsum("mp,pq,mq->m", changes, self.correlation, changes)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def covariance_of(
    given: Mapping[str, float],
    laser_correlation: float = 0.0,
    points_covariance_px2: FloatArray | None = None,
    *,
    has_glass: bool = False,
) -> tuple[FloatArray, frozenset[str]]:
    """Return the covariance of `QUANTITIES`, (q, q), and the keys with an assumed uncertainty.

    Parameters
    ----------
    given
        Standard uncertainties by `Quantity.sigma_key`, in their units.
    laser_correlation
        Correlation of projection angle and distance, which Appendix I derives from the same
        lengths.
    points_covariance_px2
        Covariance of u and v of O′ and of the points on O′X′ and O′Z′, found in the same picture,
        shape (6, 6). The block of each point is scaled to the point's given standard uncertainty.
        None: uncorrelated, with equal uncertainties along u and v.
    has_glass
        Whether there is glass on the imaging plane; without it, its quantities are exact.
    """
    exact = frozenset() if has_glass else GLASS
    usual = [0.0 if one.key in exact else one.assumed for one in QUANTITIES]
    sigma = np.array([given.get(o.sigma_key, s) for o, s in zip(QUANTITIES, usual, strict=True)])
    covariance = np.diag(sigma**2)
    if points_covariance_px2 is not None:
        scale = sigma[POINTS] / np.repeat(point_sigma_px(points_covariance_px2), 2)
        covariance[np.ix_(POINTS, POINTS)] = points_covariance_px2 * np.outer(scale, scale)
    shared = laser_correlation * sigma[ANGLE] * sigma[DISTANCE]
    covariance[ANGLE, DISTANCE] = covariance[DISTANCE, ANGLE] = shared
    lacking = frozenset(one.key for one in QUANTITIES if one.sigma_key not in given)
    return covariance, lacking - exact


def point_sigma_px(covariance_px2: FloatArray) -> FloatArray:
    """Standard uncertainty per axis of n points from their covariance, (2n, 2n); shape (n,)."""
    return np.asarray(np.sqrt(np.diag(covariance_px2).reshape(-1, 2).mean(axis=1)))
