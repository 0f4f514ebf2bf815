"""Response of the dots to the quantities of a set-up that the pool's surface cannot absorb.

Most of the displacement of the dots due to a quantity is equivalent to a change of the surface. As
a dot has two coordinates and a surface one height, the rest is not the gradient of any surface (it
has a curl), and is known even if the surface is not. The stiffness of the fit is not included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from labapp.core.geometry.optics import (
    intersect_imaging_plane,
    project_rays,
    reflect,
    surface_normal,
)
from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

SHARE = 0.1
"""Step of the finite differences by quantities, as a share of the assumed uncertainty."""

STEP = 1e-4
"""Step of the finite differences along rays, mm, and by slopes."""

NEWTON_STEPS = 8
"""Newton steps from the landing point of a ray on the work piece to the surface."""

CLOSED = 1e-6
"""Eigenvalues below this share of the largest are rounding errors: their modes are not absorbed."""


@dataclass(frozen=True)
class DotResponse(ReadOnlyArrays):
    """Response of m rays' dots on the imaging plane, X′ and Z′ interleaved, for one surface.

    Parameters
    ----------
    absorbed
        Orthonormal basis of the displacements that changes of the surface cause, shape (2m, a).
    by_quantity
        Derivative of computed minus captured dots by each of `QUANTITIES`, without the absorbed
        part, shape (2m, q), mm per unit.
    by_lens_center
        The same, up to the sign, for a distortion of 1 % in the plane's corner whose centre is 1 mm
        off the centre of the plane, along X′ and Z′, shape (2m, 2), mm.
    """

    absorbed: FloatArray
    by_quantity: FloatArray
    by_lens_center: FloatArray

    def unabsorbed(self, dots: FloatArray) -> FloatArray:
        """Part of dot displacements, shape (m, 2), that no surface explains, shape (2m,)."""
        return _without(self.absorbed, dots.ravel())

    @property
    def freedom(self) -> int:
        """Number of degrees of freedom that are not absorbed."""
        count, absorbed = self.absorbed.shape
        return int(count - absorbed)


def dot_responses(
    rig: Rig, surfaces: Sequence[SplineSurface], ray: IntArray
) -> tuple[BoolArray, list[DotResponse]]:
    """Compute the response for each of several surfaces.

    Parameters
    ----------
    rig
        The rig, with its uncertainty.
    surfaces
        Surfaces of a recording's frames.
    ray
        Rays (i, j), counted from 1, shape (n, 2).

    Returns
    -------
    known, responses
        Which rays meet all surfaces and the plane, shape (n,); the responses of these m.
    """
    by_bench = _by_bench(rig, surfaces, ray)
    changes = [(_by_spline(rig, one, ray), *by) for one, by in zip(surfaces, by_bench, strict=True)]
    known = np.isfinite(np.concatenate(sum(changes, ()), axis=-1)).all(axis=(1, 2))
    return np.asarray(known), [_response(*(by[known] for by in one)) for one in changes]


def _response(
    by_spline: FloatArray, by_quantity: FloatArray, by_lens_center: FloatArray
) -> DotResponse:
    count = 2 * len(by_spline)
    rows = by_spline.reshape(count, -1)
    square, basis = np.linalg.eigh(rows @ rows.T)
    absorbed = basis[:, square > CLOSED * np.max(square, initial=0.0)]
    return DotResponse(
        absorbed=absorbed,
        by_quantity=_without(absorbed, by_quantity.reshape(count, -1)),
        by_lens_center=_without(absorbed, by_lens_center.reshape(count, -1)),
    )


def _without(absorbed: FloatArray, moved: FloatArray) -> FloatArray:
    return np.asarray(moved - absorbed @ (absorbed.T @ moved))


def _by_bench(
    rig: Rig, surfaces: Sequence[SplineSurface], ray: IntArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Derivatives of each surface's dots by each quantity, (n, 2, q), and by the lens's centre."""
    from labapp.core.surface.kernels import ray_kernels

    assert rig.uncertainty is not None
    axes, at = rig.uncertainty.axes, tuple(ray.T - 1)

    def computed(bench: Rig) -> FloatArray:
        rays = project_rays(bench.laser, bench.pattern)
        directions, landing = rays.directions[at], rays.landing_mm[at]
        plane = bench.imaging_plane.pose_mm
        met = (
            ray_kernels.intersect_and_reflect(
                one.basis.grid, one.coefficients, directions, landing, NEWTON_STEPS, plane
            )
            for one in surfaces
        )
        return np.stack([dots for _, _, dots in met])

    dots, changes = computed(rig), []
    for k, one in enumerate(QUANTITIES):
        step = SHARE * one.assumed
        more, less = (
            computed(moved_rig(rig, offset)) - moved_dots(dots, rig, axes, offset)
            for offset in (way * step * np.eye(len(QUANTITIES))[k] for way in (1.0, -1.0))
        )
        changes.append((more - less) / (2.0 * step))
    by_quantity = np.stack(changes, axis=-1)
    return [
        (by, _by_lens_center(one, rig.imaging_plane))
        for by, one in zip(by_quantity, dots, strict=True)
    ]


def _by_lens_center(plane_mm: FloatArray, plane: ImagingPlane) -> FloatArray:
    """Displacement of dots, shape (n, 2, 2), see `DotResponse.by_lens_center`."""
    half = np.array([plane.width_mm, plane.height_mm]) / 2
    out = plane_mm - half
    square = np.sum(out**2, axis=-1)[:, None, None]
    outer = out[:, :, None] * out[:, None]
    return np.asarray((square * np.eye(2) + 2.0 * outer) / 100.0 / np.sum(half**2))


def _by_spline(rig: Rig, surface: SplineSurface, ray: IntArray) -> FloatArray:
    """Derivatives of the computed dots by each spline coefficient of a surface, shape (n, 2, p)."""
    from labapp.core.surface.kernels import solver_kernels

    rays, at = project_rays(rig.laser, rig.pattern), tuple(ray.T - 1)
    direction = rays.directions[at]
    point, _ = solver_kernels.newton_along_rays(
        surface.basis.grid, surface.coefficients, direction, rays.landing_mm[at], NEWTON_STEPS
    )
    x, y = point[:, 0], point[:, 1]
    slope = surface.gradient(x, y)

    def dots(along: float, aside: tuple[float, float]) -> FloatArray:
        """Dots of points moved along their rays, with changed slopes."""
        moved = point + along * direction
        tilt = surface.gradient(moved[:, 0], moved[:, 1]) + np.array(aside)
        to = reflect(direction, surface_normal(tilt))
        return intersect_imaging_plane(moved, to, rig.imaging_plane)

    def change(of: Callable[[float], FloatArray]) -> FloatArray:
        return (of(STEP) - of(-STEP)) / (2.0 * STEP)

    by_x = change(lambda step: dots(0.0, (step, 0.0)))
    by_y = change(lambda step: dots(0.0, (0.0, step)))
    by_way = change(partial(dots, aside=(0.0, 0.0)))
    descent = np.vecdot(slope, direction[:, :2]) - direction[:, 2]
    sinking = -surface.basis.matrix(x, y) / descent[:, None]
    return np.asarray(
        by_x[..., None] * surface.basis.matrix(x, y, 1)[:, None]
        + by_y[..., None] * surface.basis.matrix(x, y, 0, 1)[:, None]
        + by_way[..., None] * sinking[:, None]
    )
