"""Pool surfaces of known shape: caps, ellipsoids, eggs and disturbances (§4.2.1.2, §7.3).

Every pool is ``z = f(x, y)`` inside a closed boundary and undefined (NaN) outside it, with exact
gradients up to the boundary. The boundary lies at z = 0 unless the pool has a `LowRear`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.polynomial import Chebyshev
from scipy import special

from labapp.core.values import BoolArray, FloatArray


@dataclass(frozen=True)
class PoolSize:
    """True size of a pool, mm."""

    width_mm: float
    length_mm: float
    """Extent of the boundary along X and along Y."""
    height_mm: float
    depth_mm: float
    """Largest and smallest z, including the boundary."""
    peak_mm: tuple[float, float]
    bottom_mm: tuple[float, float]
    """(x, y) of the largest and of the smallest z."""


@dataclass(frozen=True)
class Footprint:
    """An egg-shaped area with head and tail of different length; an ellipse if they are equal.

    The coordinates are ``p = x/(width/2)`` and ``q(y)``, the fractional linear map that takes the
    end of the tail to −1, the widest point to 0 and the end of the head to 1; the boundary is
    p² + q² = 1. The map is smooth, so that no line across the pool has a kink in its curvature.
    """

    width_mm: float
    """Largest width, at the centre."""
    head_mm: float
    tail_mm: float
    """Distance from the centre to the boundary along +Y and along −Y."""
    center_mm: tuple[float, float] = (0.0, 0.0)
    """Point where the pool is widest, (x, y) in the UCS."""

    def place(self, x_mm: FloatArray, y_mm: FloatArray) -> Place:
        """Convert points (x, y), arrays of one shape, to coordinates of the footprint."""
        half = self.width_mm / 2
        slope = (1 / self.tail_mm + 1 / self.head_mm) / 2
        skew = (1 / self.tail_mm - 1 / self.head_mm) / 2
        dx = np.asarray(x_mm, float) - self.center_mm[0]
        dy = np.asarray(y_mm, float) - self.center_mm[1]
        # The map's pole is more than two lengths away, clearly outside.
        dy = np.minimum(np.maximum(dy, -2 * self.tail_mm), 2 * self.head_mm)
        below = 1 + skew * dy
        p, q = dx / half, slope * dy / below
        return Place(
            x_mm=dx, y_mm=dy, p=p, q=q, p_x=1 / half, slope=slope, below=below, rho2=p**2 + q**2
        )


@dataclass(frozen=True)
class Place:
    """Points in the coordinates of a footprint.

    ``x_mm, y_mm`` from its centre, ``p`` and ``q`` across and along it (±1 at its ends), their
    derivatives ``p_x`` = dp/dx and ``q_y`` = dq/dy = slope/below², and ``rho2`` = p² + q², 1 at the
    boundary.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    p: FloatArray
    q: FloatArray
    p_x: float
    slope: float
    below: FloatArray
    rho2: FloatArray

    @property
    def q_y(self) -> FloatArray:
        """dq/dy."""
        return np.asarray(self.slope / self.below**2)

    def gradient(self, by_p: FloatArray, by_q: FloatArray) -> FloatArray:
        """(∂/∂x, ∂/∂y), shape (…, 2), of a function whose ∂/∂p and ∂/∂q are given."""
        return np.stack(np.broadcast_arrays(by_p * self.p_x, by_q * self.q_y), axis=-1)


class Term(Protocol):
    """A disturbance added to a cap."""

    def height(self, place: Place) -> FloatArray:
        """Height that it adds, mm."""
        ...

    def gradient(self, place: Place) -> FloatArray:
        """Gradient that it adds, shape (…, 2)."""
        ...


@runtime_checkable
class MovingTerm(Term, Protocol):
    """A disturbance that changes with time."""

    def after(self, seconds: float) -> Term:
        """The same disturbance ``seconds`` later."""
        ...


@dataclass(frozen=True)
class Dent:
    """A Gaussian dip, as under the torch; multiplied by 1 − ρ² to keep the boundary at z = 0."""

    depth_mm: float
    radius_mm: float
    """Depth and standard deviation of the dip."""
    offset_mm: tuple[float, float] = (0.0, 0.0)
    """(x, y) of the dip from the pool's centre."""

    def _dip(self, place: Place) -> tuple[FloatArray, FloatArray, FloatArray]:
        x = (place.x_mm - self.offset_mm[0]) / self.radius_mm
        y = (place.y_mm - self.offset_mm[1]) / self.radius_mm
        return -self.depth_mm * np.exp(-(x**2 + y**2) / 2), x, y

    def height(self, place: Place) -> FloatArray:
        """Height that it adds, mm."""
        return self._dip(place)[0] * (1 - place.rho2)

    def gradient(self, place: Place) -> FloatArray:
        """Gradient that it adds, shape (…, 2)."""
        dip, x, y = self._dip(place)
        inner = np.stack([-x * dip, -y * dip], axis=-1) / self.radius_mm
        return inner * (1 - place.rho2)[..., None] + place.gradient(
            -2 * place.p * dip, -2 * place.q * dip
        )


@dataclass(frozen=True)
class LowRear:
    """A tail that sinks smoothly to ``drop_mm`` below the work piece at its end (§7.2).

    ``towards`` is −1 for a tail at −Y, +1 for one at +Y.
    """

    drop_mm: float
    towards: int = -1

    def height(self, place: Place) -> FloatArray:
        """Height that it adds, mm."""
        return -self.drop_mm * np.maximum(self.towards * place.q, 0) ** 3

    def gradient(self, place: Place) -> FloatArray:
        """Gradient that it adds, shape (…, 2)."""
        return place.gradient(
            np.zeros_like(place.q),
            -3 * self.towards * self.drop_mm * np.maximum(self.towards * place.q, 0) ** 2,
        )


@dataclass(frozen=True)
class Wave:
    """A mode of a round membrane, mapped onto the footprint: zero at the boundary.

    ``amplitude · J_m(j_mn·ρ) · cos(m(φ − φ₀)) · cos(ωt)`` stands, ``… cos(m(φ − φ₀) − ωt)`` travels
    round; ρ and φ are polar coordinates in (p, q), j_mn is the n-th zero of the Bessel function
    J_m.

    Raises
    ------
    ValueError
        If there is no such mode, or a round mode is to travel.
    """

    mode: tuple[int, int]
    """(m, n): number of nodal diameters and of nodal circles including the boundary; weld pools
    show (0, 1), (1, 1), (2, 1) and (0, 2).
    """
    amplitude_mm: float
    """Largest height that the mode adds."""
    frequency_hz: float = 0.0
    time_s: float = 0.0
    """ω/2π, and the time t."""
    travelling: bool = False
    """Whether the wave travels round, counter-clockwise seen from above, instead of standing."""
    turned_deg: float = 0.0
    """φ₀, from +X counter-clockwise."""
    phase_deg: float = 0.0
    """Phase added to ωt."""
    damping_per_s: float = 0.0
    """γ: the amplitude falls as exp(−γt)."""

    def __post_init__(self) -> None:
        if self.mode[0] < 0 or self.mode[1] < 1:
            raise ValueError("a mode (m, n) must have m ≥ 0 and n ≥ 1")
        if self.travelling and self.mode[0] == 0:
            raise ValueError("a mode (0, n) is rotationally symmetric: it cannot travel")

    @cached_property
    def _radial(self) -> tuple[Chebyshev, Chebyshev]:
        """J_m(j_mn·ρ)/ρᵐ as a function of ρ², exact to rounding, and its derivative.

        It is smooth at the centre, where ρ and φ are not, and faster than the Bessel function.
        """
        m, n = self.mode
        zero = float(special.jn_zeros(m, n)[-1])

        def exact(rho2: FloatArray) -> FloatArray:
            rho = np.sqrt(rho2)
            return np.asarray(special.jv(m, zero * rho) / rho**m)

        radial = Chebyshev.interpolate(exact, 20 + 4 * n, domain=[0.0, 1.0])
        return radial, radial.deriv()

    @cached_property
    def _weight(self) -> complex:
        """Factor of the complex mode, mm; the real part of the product is the height."""
        m = self.mode[0]
        largest = special.jv(m, special.jnp_zeros(m, 1)[0]) if m else 1.0
        swing = 2 * np.pi * self.frequency_hz * self.time_s + np.radians(self.phase_deg)
        run = np.exp(-1j * swing) if self.travelling else np.cos(swing)
        turn = np.exp(-1j * m * np.radians(self.turned_deg))
        size = self.amplitude_mm * np.exp(-self.damping_per_s * self.time_s)
        return complex(size / largest * turn * run)

    def height(self, place: Place) -> FloatArray:
        """Height that it adds, mm."""
        radial = self._radial[0](np.minimum(place.rho2, 1))
        if not self.mode[0]:
            return np.asarray(self._weight.real * radial)
        run = place.p + 1j * place.q
        return np.asarray((self._weight * radial * run ** self.mode[0]).real)

    def gradient(self, place: Place) -> FloatArray:
        """Gradient that it adds, shape (…, 2)."""
        m = self.mode[0]
        radial, derivative = (part(np.minimum(place.rho2, 1)) for part in self._radial)
        run = place.p + 1j * place.q
        outward = 2 * self._weight * derivative * run**m
        around = m * self._weight * radial * run ** max(m - 1, 0)
        return place.gradient(
            (outward * place.p + around).real, (outward * place.q + 1j * around).real
        )

    def after(self, seconds: float) -> Wave:
        """The same wave ``seconds`` later."""
        return replace(self, time_s=self.time_s + seconds)


@dataclass(frozen=True)
class Pool:
    """A cap with an egg-shaped, elliptic or round footprint, and disturbances on it.

    The cap is ``peak · (√(1 − κρ²) − √(1 − κ)) / (1 − √(1 − κ))``: part of an ellipsoid if head
    and tail are equal, part of a sphere if the footprint is round. By default κ (`fullness`) is
    that of a sphere of the pool's width; 0 is a paraboloid, 1 half an ellipsoid.

    Raises
    ------
    ValueError
        If a length is not positive, the cap would overhang, or `fullness` is out of range.
    """

    footprint: Footprint
    peak_mm: float
    """z of the undisturbed cap at the centre, negative for a concave pool."""
    terms: tuple[Term, ...] = ()
    """Disturbances, which are added up."""
    fullness: float | None = None
    """κ, 0 ≤ κ < 1."""

    def __post_init__(self) -> None:
        foot = self.footprint
        if min(foot.width_mm, foot.head_mm, foot.tail_mm) <= 0:
            raise ValueError("a pool's width, head and tail must be positive")
        if self.fullness is None and abs(self.peak_mm) >= foot.width_mm / 2:
            raise ValueError("a cap must be lower than half its width: its sides would overhang")
        if self.fullness is not None and not 0 <= self.fullness < 1:
            raise ValueError("fullness must be from 0 up to, but not including, 1")

    def scaled(self, width: float, length: float, height: float) -> Pool:
        """Return the pool with its sizes multiplied; disturbances are unchanged."""
        foot = replace(
            self.footprint,
            width_mm=self.footprint.width_mm * width,
            head_mm=self.footprint.head_mm * length,
            tail_mm=self.footprint.tail_mm * length,
        )
        return replace(self, footprint=foot, peak_mm=self.peak_mm * height)

    @property
    def _kappa(self) -> float:
        if self.fullness is not None:
            return self.fullness
        half, height = self.footprint.width_mm / 2, abs(self.peak_mm)
        return (2 * height * half / (half**2 + height**2)) ** 2

    def inside(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Whether (x, y) is within the boundary."""
        return np.asarray(self.footprint.place(x_mm, y_mm).rho2 <= 1)

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm; NaN outside the boundary."""
        place = self.footprint.place(x_mm, y_mm)
        kappa = self._kappa
        # √(1 − κρ²) − √(1 − κ), over its value at ρ = 0, in a form that also holds for κ → 0.
        rim = np.sqrt(1 - kappa)
        root = np.sqrt(np.maximum(1 - kappa * place.rho2, 0))
        z = self.peak_mm * (1 - place.rho2) * (1 + rim) / (root + rim)
        for term in self.terms:
            z = z + term.height(place)
        return np.where(place.rho2 <= 1, z, np.nan)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2); NaN outside the boundary."""
        place = self.footprint.place(x_mm, y_mm)
        kappa = self._kappa
        root = np.sqrt(np.maximum(1 - kappa * place.rho2, 1 - kappa))
        slope = -self.peak_mm * (1 + np.sqrt(1 - kappa)) / root
        gradient = place.gradient(slope * place.p, slope * place.q)
        for term in self.terms:
            gradient = gradient + term.gradient(place)
        return np.where((place.rho2 <= 1)[..., None], gradient, np.nan)

    @cached_property
    def size(self) -> PoolSize:
        """True size; the peak is searched on successively finer grids, to about 1e-6 mm."""
        foot = self.footprint
        middle = np.array([0.0, (foot.head_mm - foot.tail_mm) / 2]) + foot.center_mm
        extent = np.array([foot.width_mm, foot.head_mm + foot.tail_mm])
        if self.terms:
            return size_of(self.height, self.boundary_mm(), middle, extent)
        # The extremes of an undisturbed cap are its centre and its boundary.
        ends = np.vstack([[*foot.center_mm, self.peak_mm], self.boundary_mm()]).tolist()
        x, y, top = max(ends, key=lambda end: float(end[2]))
        u, v, bottom = min(ends, key=lambda end: float(end[2]))
        width, length = extent.tolist()
        return PoolSize(width, length, top, bottom, (x, y), (u, v))

    def after(self, seconds: float) -> Pool:
        """The same pool ``seconds`` later; itself if nothing on it oscillates."""
        if not any(isinstance(term, MovingTerm) for term in self.terms):
            return self
        terms = tuple(
            term.after(seconds) if isinstance(term, MovingTerm) else term for term in self.terms
        )
        return replace(self, terms=terms)

    def boundary_mm(self, count: int = 720) -> FloatArray:
        """Points of the boundary at equal steps of angle in (p, q), shape (count, 3), mm."""
        foot = self.footprint
        angle = 2 * np.pi * np.arange(count) / count
        # Slightly inside, so that rounding does not put a point outside, where z is NaN.
        p, q = (1 - 1e-12) * np.cos(angle), (1 - 1e-12) * np.sin(angle)
        slope = (1 / foot.tail_mm + 1 / foot.head_mm) / 2
        skew = (1 / foot.tail_mm - 1 / foot.head_mm) / 2
        x = foot.center_mm[0] + p * foot.width_mm / 2
        y = foot.center_mm[1] + q / (slope - skew * q)
        return np.stack([x, y, self.height(x, y)], axis=-1)


def size_of(
    height: Callable[[FloatArray, FloatArray], FloatArray],
    rim_mm: FloatArray,
    middle_mm: FloatArray,
    extent_mm: FloatArray,
) -> PoolSize:
    """Find the size of a pool.

    Parameters
    ----------
    height
        Function that returns z at (x, y), mm; NaN outside the boundary.
    rim_mm
        Points of the boundary, shape (n, 3), mm.
    middle_mm, extent_mm
        Centre (x, y) and sides along X and Y of the boundary's bounding box.
    """
    high, peak = _largest(height, rim_mm, middle_mm, extent_mm / 2, 1.0)
    low, bottom = _largest(height, rim_mm, middle_mm, extent_mm / 2, -1.0)
    width, length = map(float, extent_mm)
    return PoolSize(width, length, high, -low, peak, bottom)


def _largest(
    height: Callable[[FloatArray, FloatArray], FloatArray],
    rim: FloatArray,
    middle: FloatArray,
    reach: FloatArray,
    sign: float,
) -> tuple[float, tuple[float, float]]:
    """Largest sign × z, including the boundary, and its (x, y)."""
    best = int(np.argmax(sign * rim[:, 2]))
    value, at = float(sign * rim[best, 2]), (float(rim[best, 0]), float(rim[best, 1]))
    for _ in range(6):
        x, y = np.meshgrid(*(middle[:, None] + reach[:, None] * np.linspace(-1, 1, 61)))
        z = np.nan_to_num(sign * height(x, y), nan=-np.inf)
        index = np.unravel_index(np.argmax(z), z.shape)
        middle, reach = np.array([x[index], y[index]]), reach / 12
        if z[index] > value + 1e-12:
            value, at = float(z[index]), (float(x[index]), float(y[index]))
    return value, at


def spherical_cap(
    diameter_mm: float, peak_mm: float, center_mm: tuple[float, float] = (0.0, 0.0)
) -> Pool:
    """Part of a sphere, the simulated pool of Fig. 4-10; concave if ``peak_mm`` is negative."""
    return Pool(Footprint(diameter_mm, diameter_mm / 2, diameter_mm / 2, center_mm), peak_mm)


def ellipsoidal_cap(
    width_mm: float,
    length_mm: float,
    peak_mm: float,
    center_mm: tuple[float, float] = (0.0, 0.0),
) -> Pool:
    """Part of an ellipsoid, with different length and width."""
    return Pool(Footprint(width_mm, length_mm / 2, length_mm / 2, center_mm), peak_mm)


def egg(
    width_mm: float,
    head_mm: float,
    tail_mm: float,
    peak_mm: float,
    center_mm: tuple[float, float] = (0.0, 0.0),
    terms: tuple[Term, ...] = (),
) -> Pool:
    """Build the pool of a moving torch: a short head at +Y, a long tail at −Y."""
    return Pool(Footprint(width_mm, head_mm, tail_mm, center_mm), peak_mm, terms)


def caps_8_3_1() -> tuple[Pool, ...]:
    """Build the 28 caps of §8.3.1: B = 5, 5.5 … 8 mm, D = B/20 and B/10, convex and concave."""
    return tuple(
        spherical_cap(float(diameter), sign * float(diameter) / ratio)
        for sign in (1, -1)
        for ratio in (20, 10)
        for diameter in np.arange(5.0, 8.01, 0.5)
    )
