"""The forward model: the rays that a pool reflects, and where they meet the imaging plane.

Derived from the geometry alone (laser of §4.2.2.2, blocking of §4.2.1), in vectors, for the rays
of the rig's pattern, without any of the measuring code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.optimize.elementwise import find_root
from scipy.spatial.transform import Rotation

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match, Orientation
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.simulation.pools import PoolSize
from labapp.simulation.torch import Torch, YozTorch

SAMPLES = 256
"""Steps along a ray between the highest and the lowest point of the pool."""

SLACK_MM = 0.05
"""Distance above and below the pool at which the search along a ray begins and ends."""

CLEAR_MM = 1e-6
"""A ray no deeper than this below the surface does not hit it: rounding on a flat pool."""

TOGETHER = 16
"""Steps of all rays that are computed at a time: few enough to stay in the processor's cache."""


class PoolSurface(Protocol):
    """A pool surface for ray tracing: z = f(x, y), NaN outside the boundary."""

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm; NaN outside the boundary."""
        ...

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        ...

    @property
    def size(self) -> PoolSize:
        """True size; ray tracing needs the highest and the lowest point."""
        ...


@dataclass(frozen=True)
class Reflections(ReadOnlyArrays):
    """The path of every ray of the pattern; ray (i, j) is at ``[i - 1, j - 1]``."""

    absent: BoolArray
    """The pattern has no such ray (the centre), shape (rows, columns)."""
    hit: BoolArray
    """The ray meets the pool, shape (rows, columns). An absent ray is traced like any other."""
    incident_blocked: BoolArray
    reflected_blocked: BoolArray
    """The torch blocks the incident or the reflected ray, shape (rows, columns)."""
    hits_again: BoolArray
    """The reflected ray meets the pool a second time, shape (rows, columns). It is not traced
    further: it lights no dot where one is searched for.
    """
    on_plane: BoolArray
    """The reflected ray meets the imaging plane within its edges, shape (rows, columns)."""
    point_mm: FloatArray
    """Reflection point, UCS, shape (rows, columns, 3), mm; NaN without one."""
    incident: FloatArray
    reflected: FloatArray
    """Unit directions, shape (rows, columns, 3); the reflected direction is NaN without a hit."""
    plane_mm: FloatArray
    """Point where the reflected ray meets the plane, ignoring its edges, IPCS (X′, Z′), shape
    (rows, columns, 2), mm; NaN if it does not meet it.
    """

    @property
    def lit(self) -> BoolArray:
        """The ray exists and meets the pool; `visible` tells whether its dot shows."""
        return np.asarray(self.hit & ~self.absent)

    @property
    def blocked(self) -> BoolArray:
        """The torch blocks the ray before or after the pool."""
        return np.asarray(self.incident_blocked | self.reflected_blocked)

    @property
    def visible(self) -> BoolArray:
        """A dot shows on the imaging plane."""
        return np.asarray(self.lit & ~self.blocked & ~self.hits_again & self.on_plane)


def trace(pool: PoolSurface, rig: Rig, torch: Torch | None = None) -> Reflections:
    """Trace every ray from the laser via the pool to the imaging plane.

    Outside the pool's boundary is the work piece at z = 0, which scatters: a ray that meets it
    first is not `lit`.

    Parameters
    ----------
    torch
        The torch that blocks rays. None: all rays above the rig's electrode tip are blocked
        (`YozTorch`).
    """
    source, incident = _rays(rig)
    point, hit = _first_hit(pool, source, incident)
    slope = pool.gradient(point[..., 0], point[..., 1])
    normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    reflected = incident - 2 * np.sum(incident * normal, axis=-1, keepdims=True) * normal
    plane = _on_imaging_plane(point, reflected, rig)
    limit = (rig.imaging_plane.width_mm, rig.imaging_plane.height_mm)
    torch = torch or YozTorch(rig.electrode.height_mm)
    incident_blocked, reflected_blocked = torch.hides(point, incident, reflected)
    hits_again = np.zeros(hit.shape, bool)
    hits_again[hit] = _hits_again(pool, point[hit], reflected[hit])
    return Reflections(
        absent=rig.pattern.is_absent,
        hit=hit,
        incident_blocked=incident_blocked,
        reflected_blocked=reflected_blocked,
        hits_again=hits_again,
        on_plane=np.asarray(((plane >= 0) & (plane <= limit)).all(axis=-1)),
        point_mm=point,
        incident=incident,
        reflected=reflected,
        plane_mm=plane,
    )


def exact_match(
    reflections: Reflections,
    orientation: Orientation | None = None,
    sigma_mm: float = 0.0,
    rng: np.random.Generator | None = None,
) -> Match:
    """Build the Match that a perfect detector would pass to a reconstruction scheme.

    Parameters
    ----------
    orientation
        The match's correspondence. None: that of the traced dots.
    sigma_mm
        Standard deviation of the normal noise added to every dot along X′ and along Z′, mm. The
        match's covariance is its square, with at least 1 µm so that it can be inverted.
    rng
        Source of the noise; needed when ``sigma_mm`` is not 0.

    Raises
    ------
    ValueError
        If there is noise but no ``rng``.
    """
    visible = reflections.visible
    ray = np.argwhere(visible) + 1
    plane = reflections.plane_mm[visible]
    if sigma_mm > 0:
        if rng is None:
            raise ValueError("the noise requires a random generator")
        plane = plane + rng.normal(0.0, sigma_mm, plane.shape)
    if orientation is None:
        orientation = seen_orientation(reflections)
    ray_states = np.where(visible, 1, np.where(~reflections.hit, -1, 0))
    ray_states[reflections.absent] = 0
    return Match(
        orientation=orientation,
        dot=np.arange(len(ray)),
        ray=ray,
        reflected=_reflected_numbers(ray, orientation),
        plane_mm=plane,
        plane_covariance_mm2=np.tile(max(sigma_mm, 1e-3) ** 2 * np.eye(2), (len(ray), 1, 1)),
        ray_states=ray_states,
    )


def seen_orientation(reflections: Reflections) -> Orientation:
    """Find the correspondence from the order of most neighbouring dots on the plane."""
    dots = np.where(reflections.visible[..., None], reflections.plane_mm, np.nan)
    across = np.sign(np.diff(dots[..., 0], axis=1))
    upward = np.sign(np.diff(dots[..., 1], axis=0))
    if np.nansum(upward) >= 0:
        return "S/S"
    return "S/I" if np.nansum(across) >= 0 else "I/I"


def _rays(rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Laser position, shape (3,), and unit ray directions, shape (rows, columns, 3)."""
    laser, pattern = rig.laser, rig.pattern
    # A source that shines along +Z with X to its right is first tilted, then rotated about Z.
    leaned = Rotation.from_euler("X", 90.0 + laser.projection_angle_deg, degrees=True)
    placed = Rotation.from_euler("Z", laser.azimuth_deg, degrees=True) * leaned
    # Row 1 is the topmost of the fan at the laser, so it lands farthest away, at the tail.
    fan = np.ones((pattern.rows, pattern.columns, 3))
    fan[..., :2] = replace(pattern, rotation_deg=0.0).tangents
    turned = Rotation.from_euler("Z", pattern.rotation_deg, degrees=True)
    fan = turned.apply(fan.reshape(-1, 3))
    direction = placed.apply(fan).reshape(pattern.rows, pattern.columns, 3)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    aim = np.array([laser.aim_x_mm, laser.aim_y_mm, 0.0])
    return aim - laser.distance_mm * placed.apply([0.0, 0.0, 1.0]), direction


def _first_hit(
    pool: PoolSurface, source: FloatArray, direction: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """First point of each ray on the pool, NaN if it does not hit it first, and whether it does.

    The rays are sampled from above the pool to below it, and the crossing is searched within the
    first step that goes below the surface. Where a low rear leaves a step between the pool and the
    work piece, a ray can meet the step; that is not a reflection point either.
    """

    def above(t: FloatArray, *along: FloatArray) -> FloatArray:
        x, y, z = (start + t * part for start, part in zip(source, along, strict=True))
        ground = pool.height(x, y)
        return np.asarray(z - np.where(np.isnan(ground), 0.0, ground))

    size = pool.size
    # Ray parameter t at horizontal levels from above the highest to below the lowest point.
    levels = np.linspace(
        max(size.height_mm, 0) + SLACK_MM, min(size.depth_mm, 0) - SLACK_MM, SAMPLES
    )
    falls = direction[..., 2] < 0
    down = np.where(falls, direction[..., 2], -1.0)
    steps = (levels[:, None, None] - source[2]) / down
    along = np.moveaxis(direction, -1, 0)
    parts = (slice(first, first + TOGETHER) for first in range(0, SAMPLES, TOGETHER))
    under = np.concatenate([above(steps[part], *along) <= 0 for part in parts])
    first = np.maximum(np.argmax(under, axis=0), 1)
    far = np.take_along_axis(steps, first[None], axis=0)[0]
    near = np.take_along_axis(steps, first[None] - 1, axis=0)[0]
    meets = falls & under.any(axis=0)
    within = near[meets], far[meets]
    far[meets] = find_root(above, within, args=tuple(along[:, meets])).x
    point = source + far[..., None] * direction
    ground = pool.height(point[..., 0], point[..., 1])
    hit = meets & (np.abs(point[..., 2] - ground) < 1e-9)
    return np.where(hit[..., None], point, np.nan), np.asarray(hit)


def _hits_again(pool: PoolSurface, point: FloatArray, direction: FloatArray) -> BoolArray:
    """Whether rays that leave the pool at points along unit vectors, (n, 3), meet it again.

    They are sampled until they are above its highest point or beyond its extent.
    """
    size = pool.size
    rise, run = direction[..., 2], np.hypot(direction[..., 0], direction[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        up = np.where(rise > 0, (size.height_mm - point[..., 2]) / rise, np.inf)
        away = np.hypot(size.width_mm, size.length_mm) / run
    # Starts at the first step: at its start the ray is on the surface, to rounding.
    share, reach = np.arange(1, SAMPLES + 1) / SAMPLES, np.minimum(up, away)
    met = np.zeros(rise.shape, bool)
    for first in range(0, SAMPLES, TOGETHER):
        t = reach * share[first : first + TOGETHER, None]
        x, y, z = (point[..., n] + t * direction[..., n] for n in range(3))
        met |= (pool.height(x, y) - z > CLEAR_MM).any(axis=0)
    return met


def _on_imaging_plane(point: FloatArray, direction: FloatArray, rig: Rig) -> FloatArray:
    """Points where the reflected rays meet the plane, (X′, Z′), shape (…, 2), mm; NaN if none.

    If there is glass on the plane, the rays are refracted at its face by Snell's law for vectors.
    """
    plane = rig.imaging_plane
    if not plane.glass_mm:
        return _meet(np.asarray(plane.origin_mm), point, direction, rig)[0]
    inwards = np.cross(plane.x_axis, plane.z_axis)
    inwards *= np.sign(np.nanmean((plane.origin_mm - point) @ inwards))
    face, t = _meet(plane.origin_mm - plane.glass_mm * inwards, point, direction, rig)
    cosine = direction @ inwards
    ratio = 1.0 / plane.glass_index
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
    refracted = ratio * direction + (root - ratio * cosine)[..., None] * inwards
    entered = np.where(np.isfinite(face[..., :1]), point + t[..., None] * direction, np.nan)
    return _meet(np.asarray(plane.origin_mm), entered, refracted, rig)[0]


def _meet(
    origin: FloatArray, point: FloatArray, direction: FloatArray, rig: Rig
) -> tuple[FloatArray, FloatArray]:
    """Points where rays meet a plane parallel to the imaging plane, (X′, Z′), and t.

    Solves ``O + X′·x + Z′·z = P + t·d`` for X′, Z′ and t, ray by ray.
    """
    plane = rig.imaging_plane
    axes = np.stack([plane.x_axis, plane.z_axis], axis=-1)
    system = np.concatenate(
        [np.broadcast_to(axes, (*point.shape[:-1], 3, 2)), -direction[..., None]], axis=-1
    )
    with np.errstate(invalid="ignore"):
        meets = np.abs(np.linalg.det(system)) > 1e-12
    solution = np.full(point.shape, np.nan)
    offset = point - origin
    solution[meets] = np.linalg.solve(system[meets], offset[meets][..., None])[..., 0]
    return np.where(solution[..., 2:] > 0, solution[..., :2], np.nan), solution[..., 2]


def _reflected_numbers(ray: IntArray, orientation: Orientation) -> IntArray:
    """(k, t), shape (n, 2), counted from 1 at the lowest row and the leftmost column."""
    if len(ray) == 0:
        return ray.copy()
    column_order, row_order = orientation.split("/")
    number = np.empty_like(ray)
    for axis, order in ((0, row_order), (1, column_order)):
        line = ray[:, axis]
        number[:, axis] = line - line.min() + 1 if order == "S" else line.max() - line + 1
    return number
