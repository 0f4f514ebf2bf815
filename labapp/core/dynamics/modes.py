"""Modes of an oscillating pool: Bessel modes mapped to its outline, and POD of its surfaces.

Every surface is sampled at the nodes of a unit disk: ρ = 1 is its own boundary; ρ and φ are polar
coordinates in (x/half width, y/half length) about the middle of the boundary, with ρ scaled by the
boundary's distance in the direction φ. For an ellipse this map is affine and preserves the modes of
a circular membrane, J_m(j_mn·ρ)·cos m(φ − φ₀), which approximate those of a pool pinned at its rim.
Modes (0, 1), (1, 1), (2, 1) and (0, 2) are observed in dot patterns of GTA weld pools ("Oscillation
Modes of Weld Pool in Stationary GTA Welding Using Structure Laser Method", Chin. J. Mech. Eng. 34
(2021); K. Zhang et al., Weld. J. 96 (2017) 143-s).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import special

from labapp.core.dynamics.oscillation import Oscillation, fit_oscillations
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.surface import Surface
from labapp.core.values import ComplexArray, FloatArray, IntArray, ReadOnlyArrays

MODES = ((0, 1), (1, 1), (2, 1), (0, 2))
"""(m, n): number of nodal diameters, and of nodal circles including the boundary."""

RINGS, SPOKES = 12, 32

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(RINGS)
RING_WEIGHT = _WEIGHT / 2
"""Weight of each ring in a mean along a radius, shape (RINGS,)."""

RHO = np.repeat((_NODE + 1) / 2, SPOKES)
PHI = np.tile(2 * np.pi * np.arange(SPOKES) / SPOKES, RINGS)
"""The nodes of the unit disk, shape (k,): rings outwards, counter-clockwise from +X."""

DISK_WEIGHT = RHO * np.repeat(RING_WEIGHT, SPOKES) * 2 * np.pi / SPOKES
"""Area represented by each node on the unit disk, shape (k,); the sum is π."""

POD_MODES = 4


@dataclass(frozen=True)
class SurfaceSeries(ReadOnlyArrays):
    """Surfaces of n frames at the same k nodes of the unit disk.

    Parameters
    ----------
    frame, time_s
        Frame numbers and times, shape (n,), ascending; s.
    height_mm
        Heights at the nodes, shape (n, k).
    nodes_mm
        Positions (x, y) of the nodes for the mean outline, shape (k, 2).
    area_mm2
        Area represented by each node on it, shape (k,).
    """

    frame: IntArray
    time_s: FloatArray
    height_mm: FloatArray
    nodes_mm: FloatArray
    area_mm2: FloatArray

    @classmethod
    def of(cls, surfaces: Iterable[tuple[int, float, Surface, Boundary]]) -> SurfaceSeries:
        """Sample surfaces at the nodes.

        Parameters
        ----------
        surfaces
            Number, time (s), surface and boundary of each frame. The surface must be defined
            everywhere within the boundary.
        """
        frames, times, heights, places = [], [], [], []
        for frame, time_s, surface, boundary in surfaces:
            place = disk_nodes(boundary)
            frames.append(frame)
            times.append(time_s)
            heights.append(surface.height(place[:, 0], place[:, 1]))
            places.append(place)
        nodes = np.mean(places, axis=0) if places else np.zeros((len(RHO), 2))
        return cls(
            np.array(frames, np.int64),
            np.array(times, float),
            np.array(heights).reshape(-1, len(RHO)),
            nodes,
            _areas(nodes),
        )

    @property
    def mean_mm(self) -> FloatArray:
        """Mean height at each node, shape (k,)."""
        return np.asarray(self.height_mm.mean(axis=0))


@dataclass(frozen=True)
class ModeCourse(ReadOnlyArrays):
    """Time series of one mode; n frames, c shapes (two for a mode with nodal diameters).

    Parameters
    ----------
    name
        ``(m, n)``, or ``POD 1`` …
    shape
        Height at the nodes per mm of coefficient, shape (c, k); largest absolute value 1.
    coefficient_mm
        Coefficients, shape (n, c).
    share
        Share of the surfaces' variance, weighted by area.
    oscillations
        Damped sinusoids in the coefficients, the strongest first; empty if none is significant.
    nodal_diameters
        m; 0 for a POD mode.
    scale_sigma
        Relative standard uncertainty of all heights due to the set-up.
    """

    name: str
    shape: FloatArray
    coefficient_mm: FloatArray
    share: float
    oscillations: tuple[Oscillation, ...]
    nodal_diameters: int = 0
    scale_sigma: float = 0.0

    @property
    def figures(self) -> dict[str, tuple[float, float]]:
        """Quantities of the strongest oscillation by name, each with its standard uncertainty.

        ``amplitude_mm`` is the largest height at the first frame; ``phase_deg`` the phase of its
        cosine there; ``damping_per_s`` the decay rate γ; ``direction_deg`` the direction of the
        crest, counter-clockwise from +X; ``turning`` ranges from −1 (clockwise travelling wave)
        through 0 (standing wave) to 1 (counter-clockwise).
        """
        if not self.oscillations:
            return {}
        one = self.oscillations[0]
        value, sigma = one.quantities(_swing)
        sigma[0] = np.hypot(sigma[0], value[0] * self.scale_sigma)
        # Reversing the direction and shifting the phase by half a period changes nothing.
        halves = np.floor(value[2] / 180)
        value[1] = (value[1] + 180 * halves + 180) % 360 - 180
        value[2] -= 180 * halves
        value[2], sigma[2] = (x / max(self.nodal_diameters, 1) for x in (value[2], sigma[2]))
        names = ("amplitude_mm", "phase_deg", "direction_deg", "turning")
        swing = dict(zip(names, zip(value.tolist(), sigma.tolist(), strict=True), strict=True))
        if len(one.amplitude) < 2:
            del swing["direction_deg"], swing["turning"]
        return {
            "frequency_hz": (one.frequency_hz, one.frequency_sigma_hz),
            "damping_per_s": (one.damping_per_s, one.damping_sigma_per_s),
            **swing,
        }


def disk_nodes(boundary: Boundary) -> FloatArray:
    """Positions (x, y) of the unit disk's nodes within a boundary, shape (k, 2), mm."""
    outline = boundary.points_mm[:, :2]
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    half = np.ptp(outline, axis=0) / 2
    p, q = ((outline - middle) / half).T
    angle, radius = np.arctan2(q, p), np.hypot(p, q)
    order = np.argsort(angle)
    reach = np.interp(PHI, angle[order], radius[order], period=2 * np.pi)
    along = RHO * reach * (1 - 1e-9)
    return np.asarray(middle + half * np.column_stack([along * np.cos(PHI), along * np.sin(PHI)]))


def bessel_shapes(mode: tuple[int, int]) -> FloatArray:
    """Shapes of a mode at the nodes, largest value 1, (c, k): one if m = 0, else cos and sin."""
    m, n = mode
    radial = special.jv(m, special.jn_zeros(m, n)[-1] * RHO)
    largest = special.jv(m, special.jnp_zeros(m, 1)[0]) if m else 1.0
    around = [np.cos(m * PHI), np.sin(m * PHI)] if m else [np.ones_like(PHI)]
    return np.stack([radial * one / largest for one in around])


def bessel_modes(
    series: SurfaceSeries,
    scale_sigma: float = 0.0,
    band_hz: tuple[float, float] | None = None,
) -> tuple[ModeCourse, ...]:
    """Fit the `MODES` to the surfaces by least squares, weighted by area on the unit disk.

    Parameters
    ----------
    scale_sigma
        Relative standard uncertainty of heights due to the set-up, common to all frames; it is
        added to the noise in the ± of amplitudes.
    band_hz
        See `fit_oscillations`.
    """
    shapes = [bessel_shapes(mode) for mode in MODES]
    stacked = np.vstack(shapes)
    gram = (stacked * DISK_WEIGHT) @ stacked.T
    moving = series.height_mm - series.mean_mm
    weights = np.asarray(np.linalg.solve(gram, (stacked * DISK_WEIGHT) @ moving.T).T, float)
    total = max(float(np.sum(moving**2 @ series.area_mm2)), 1e-30)
    found, begin = [], 0
    for mode, shape in zip(MODES, shapes, strict=True):
        own = weights[:, begin : begin + len(shape)]
        begin += len(shape)
        share = float(np.sum((own @ shape) ** 2 @ series.area_mm2)) / total
        swings = fit_oscillations(series.time_s, own, band_hz=band_hz)
        name = f"({mode[0]}, {mode[1]})"
        found.append(ModeCourse(name, shape, own, share, swings, mode[0], scale_sigma))
    return tuple(found)


def pod_modes(
    series: SurfaceSeries,
    scale_sigma: float = 0.0,
    band_hz: tuple[float, float] | None = None,
) -> tuple[ModeCourse, ...]:
    """Proper orthogonal decomposition: the shapes with the largest share of the variance.

    Singular vectors of the heights minus their mean, weighted by area on the mean outline
    (Sirovich 1987). Parameters as in `bessel_modes`; at most `POD_MODES` are returned.
    """
    root = np.sqrt(series.area_mm2)
    moving: FloatArray = (series.height_mm - series.mean_mm) * root
    energy, vectors = np.linalg.eigh(moving.T @ moving)
    found = []
    for k in range(1, min(POD_MODES, len(moving) - 1) + 1):
        shape = vectors[:, -k] / root
        largest = shape[np.argmax(np.abs(shape))]
        course: FloatArray = (moving @ vectors[:, -k:][:, :1]) * largest
        one = ModeCourse(
            name=f"POD {k}",
            shape=np.atleast_2d(shape / largest),
            coefficient_mm=course,
            share=float(energy[-k] / max(energy.sum(), 1e-30)),
            oscillations=fit_oscillations(series.time_s, course, band_hz=band_hz),
            scale_sigma=scale_sigma,
        )
        found.append(one)
    return tuple(found)


def _swing(amplitude: ComplexArray) -> FloatArray:
    """Amplitude, phase (deg), m times direction (deg), turning of one or two channels, shape (4,).

    The two form Z = cos part + i·sin part = L·exp(iωτ) + R·exp(−iωτ), with components that rotate
    counter-clockwise and clockwise. The crest is largest, |L| + |R|, when both are aligned.
    """
    if len(amplitude) == 1:
        return np.array([abs(amplitude[0]), np.degrees(np.angle(amplitude[0])), 0.0, 0.0])
    left = (amplitude[0] + 1j * amplitude[1]) / 2
    right = (amplitude[0].conj() + 1j * amplitude[1].conj()) / 2
    largest = abs(left) + abs(right)
    phase = (np.angle(left) - np.angle(right)) / 2
    direction = (np.angle(left) + np.angle(right)) / 2
    turning = (abs(left) - abs(right)) / max(largest, 1e-30)
    return np.array([largest, np.degrees(phase), np.degrees(direction), turning])


def _areas(nodes_mm: FloatArray) -> FloatArray:
    """Area represented by each node at its position in the pool, shape (k,), mm².

    The map from the disk is linear along a spoke. The area is therefore the disk's area times the
    cross product of the spoke and its derivative w.r.t. the angle.
    """
    grid = nodes_mm.reshape(RINGS, SPOKES, 2)
    spoke = (grid[-1] - grid[0]) / (RHO[-1] - RHO[0])
    turned = (np.roll(spoke, -1, axis=0) - np.roll(spoke, 1, axis=0)) / (4 * np.pi / SPOKES)
    cross = spoke[:, 0] * turned[:, 1] - spoke[:, 1] * turned[:, 0]
    return np.asarray(DISK_WEIGHT * np.tile(cross, RINGS))
