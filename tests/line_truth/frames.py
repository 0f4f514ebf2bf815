"""Simulated line patterns: reflected lines as light on the imaging plane (§3.2.1).

The forward model of the dots traces each line as a dense row of rays. Their light is added up where
they land, so that a line is bright where the pool focuses the light and faint where it spreads it;
folds, crossings and ends follow from the rays alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter

from labapp.core.geometry.line_pattern import LineRig
from labapp.core.geometry.rig import DotPattern, Rig
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import PoolSurface, trace
from labapp.simulation.pools import egg
from labapp.simulation.render import Look, Picture, arc_glow, expose, speckle_field
from labapp.simulation.torch import Torch

RAYS_A_LINE = 321
FINER = 20
"""Number of points between two traced rays at which light is added."""

EDGE = 2.0
"""Rays are traced at the centre of a line and this many standard deviations on either side; light
is added at points between them."""

PLATE_MM = 60.0, 30.0, 30.0, 0.0
"""Width, head, rear and height of the solid metal around the pool, mm."""

HALF_WIDTH, LEAST_ACROSS, APART_PX = 2.5, 11, 1.5
"""Half width of a line, standard deviations; least number of points across it at which light is
added; and their largest distance, px: farther apart than the blur is wide, they are stripes."""


@dataclass(frozen=True)
class _DenseLines(DotPattern):
    """Rays along lines as rows of a dot pattern, for `forward.trace`."""

    line_tangents: FloatArray = field(default_factory=lambda: np.zeros((1, 1, 2)))

    @property
    def tangents(self) -> FloatArray:
        """Tangents of the rays to the beam axis, shape (rows, columns, 2)."""
        return self.line_tangents


@dataclass(frozen=True)
class LineLook:
    """Appearance of a frame of lines.

    Parameters
    ----------
    light
        Background, glow, speckle, blur and noise of the frame; its values for dots are not used.
    line_peak
        Grey levels of the ridge of a line of median brightness above the background.
    sigma_mm
        Standard deviation of the blur across a line from diffraction and from scattering in the
        plane, mm.
    beam_fraction
        Standard deviation of a line's light across the line, as a fraction of the interline angle.
    fringes
        Brightness of the diffraction fringes outside the outermost lines, from the inside outwards,
        relative to a line.
    gaps
        Number of gaps in the lines: oxides on the pool hide the light (§3.2.2).
    gap_mm
        Largest width of an oxide on the pool, mm.
    metal
        Light reflected by the solid metal relative to a flat pool: 0 on mild steel (Fig. 3-10 a),
        while stainless steel reflects straight lines beside the pool (Fig. 3-10 b).
    """

    light: Look = field(default_factory=Look)
    line_peak: float = 55.0
    sigma_mm: float = 0.25
    beam_fraction: float = 0.045
    fringes: tuple[float, ...] = (0.18, 0.08)
    gaps: int = 0
    gap_mm: float = 0.3
    metal: float = 0.0


@dataclass(frozen=True)
class TrueLine(ReadOnlyArrays):
    """The ground truth of a reflected line.

    Parameters
    ----------
    number
        Number of the line, from 1.
    fan
        Fan angle of its visible rays, rad, shape (n,).
    image_px
        (u, v) of these rays, shape (n, 2), px.
    point_mm
        Reflection points of these rays, shape (n, 3), mm.
    """

    number: int
    fan: FloatArray
    image_px: FloatArray
    point_mm: FloatArray


@dataclass(frozen=True)
class LineFrame(ReadOnlyArrays):
    """A rendered frame of lines and its ground truth.

    Parameters
    ----------
    image
        Shape (height, width), 8 bit, or 16 if the look has more than 8 bits.
    lines
        Each visible line; a line in parts has one entry.
    light_px
        Light of lines and fringes without background and noise, shape (height, width).
    """

    image: Picture
    lines: tuple[TrueLine, ...]
    light_px: FloatArray


def render_lines(
    pool: PoolSurface | None,
    rig: LineRig,
    view: CameraView,
    look: LineLook,
    rng: np.random.Generator,
    torch: Torch | None = None,
    gain: float | None = None,
) -> LineFrame:
    """Render one frame of a line pattern.

    Parameters
    ----------
    pool
        The reflecting pool. None: solid metal, that is no line.
    rig, view, look
        The bench, the camera's view of the plane, and the appearance of the frame.
    rng
        Source of all random numbers.
    torch
        The torch that blocks rays. None: all rays above the rig's electrode tip are blocked.
    gain
        Grey levels for the light of a line on a flat mirror. None: set such that the lines have
        `LineLook.line_peak`, as an operator would do.
    """
    shape = view.height_px, view.width_px
    light, lines = np.zeros(shape), tuple[TrueLine, ...]()
    if pool is not None:
        light, lines = _line_light(pool, rig, view, look, rng, torch)
        usual = _usual_ridge(light, lines)
        light = light * (look.line_peak / usual if gain is None and usual else gain or 0.0)
    grains = speckle_field(shape, look.light.speckle, rng)
    seen = gaussian_filter(light * grains, look.light.blur_px)
    image = expose(seen + arc_glow(shape, look.light), look.light, rng)
    return LineFrame(image, lines, light)


def _line_light(
    pool: PoolSurface,
    rig: LineRig,
    view: CameraView,
    look: LineLook,
    rng: np.random.Generator,
    torch: Torch | None,
) -> tuple[FloatArray, tuple[TrueLine, ...]]:
    """Light of all lines and fringes (the ridge on a flat mirror is about 1) and visible lines."""
    pattern, fringes = rig.pattern, np.asarray(look.fringes)
    beside = np.arange(1, len(fringes) + 1)
    number = np.concatenate([1 - beside, np.arange(1, pattern.count + 1), pattern.count + beside])
    bright = np.concatenate([fringes, np.ones(pattern.count), fringes])
    nodes = np.array([-EDGE, 0.0, EDGE])
    fan = np.linspace(-pattern.half_fan, pattern.half_fan, RAYS_A_LINE)
    across = number[:, None] + look.beam_fraction * nodes
    tangents = pattern.tangents(across.reshape(-1, 1), fan)
    dense = _DenseLines(len(tangents), RAYS_A_LINE, 1.0, absent=frozenset(), line_tangents=tangents)
    seen = trace(pool, Rig(rig.laser, dense, rig.electrode, rig.imaging_plane), torch)
    form = len(number), len(nodes), RAYS_A_LINE
    if look.metal:
        flat = trace(egg(*PLATE_MM), Rig(rig.laser, dense, rig.electrode, rig.imaging_plane), torch)
        on_metal = view.to_image(flat.plane_mm).reshape(*form, 2)
        plate = (flat.visible & ~seen.hit).reshape(form)
    image = view.to_image(seen.plane_mm).reshape(*form, 2)
    points = seen.point_mm.reshape(*form, 3)[:, 1]
    middle, size = image[:, 1], np.array([view.width_px, view.height_px])
    shows: BoolArray = seen.visible.reshape(form)[:, 1] & ~_gaps(points, look, rng)
    light = np.zeros((view.height_px, view.width_px))
    for n in range(form[0]):
        left, right = (_filled(image[n, side] - middle[n]) for side in (0, 2))
        across, weights = _points_across((right - left)[shows[n]])
        for place, weight in zip(across / EDGE, weights, strict=True):
            # The parabola through the three rays across the line.
            off = place * (place - 1) / 2 * left + place * (place + 1) / 2 * right
            _add_light(light, middle[n] + off, shows[n], bright[n] * weight)
        if look.metal:
            shift = (on_metal[n, 2] - on_metal[n, 0]) / 2
            for place, weight in zip(across / EDGE, weights, strict=True):
                share = bright[n] * weight * look.metal
                _add_light(light, on_metal[n, 1] + place * shift, plate[n, 1], share)
    sigma_px = look.sigma_mm * float(np.sqrt(abs(np.linalg.det(view.px_per_mm))))
    light = gaussian_filter(light, sigma_px)
    visible: BoolArray = shows & ((middle >= 0) & (middle <= size - 1)).all(axis=-1)
    lines = tuple(
        TrueLine(int(number[n]), fan[on], middle[n, on], points[n, on])
        for n in range(form[0])
        if 1 <= number[n] <= pattern.count and (on := visible[n]).any()
    )
    return light, lines


def _points_across(spread_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points across a line, standard deviations, and their shares of its light, each shape (m,).

    ``spread_px``: from one traced edge of the line to the other, at its rays, shape (n, 2).
    """
    widest = float(np.linalg.norm(spread_px, axis=-1).max(initial=0.0)) * HALF_WIDTH / EDGE
    across = np.linspace(-HALF_WIDTH, HALF_WIDTH, max(LEAST_ACROSS, 1 + int(widest / APART_PX)))
    weights = np.exp(-(across**2) / 2)
    return across, weights / weights.sum()


def _add_light(light: FloatArray, image_px: FloatArray, shows: BoolArray, weight: float) -> None:
    """Add the light of a row of rays, shape (n, 2), px, to its four nearest pixels each."""
    height, width = light.shape
    step = (np.arange(FINER) + 0.5) / FINER
    pair = shows[:-1] & shows[1:]
    start, on = image_px[:-1][pair], np.diff(image_px, axis=0)[pair]
    place = (start[:, None] + step[None, :, None] * on[:, None]).reshape(-1, 2)
    place = place[np.isfinite(place).all(axis=-1)]
    corner = np.floor(place).astype(np.int64)
    share = place - corner
    du, dv = np.array([[0, 0, 1, 1], [0, 1, 0, 1]])[..., None]
    u, v = corner[:, 0] + du, corner[:, 1] + dv
    part = np.abs(1 - du - share[:, 0]) * np.abs(1 - dv - share[:, 1])
    kept = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    flat: IntArray = v[kept] * width + u[kept]
    light += weight * np.bincount(flat, part[kept], light.size).reshape(light.shape)


def _filled(offsets: FloatArray) -> FloatArray:
    """Offsets of rays, shape (n, 2), with NaN replaced by the value of the nearest known ray."""
    known = np.flatnonzero(np.isfinite(offsets[:, 0]))
    if not len(known):
        return np.zeros_like(offsets)
    nearest = np.argmin(np.abs(np.arange(len(offsets))[:, None] - known), axis=1)
    return np.asarray(offsets[known[nearest]])


def _gaps(point_mm: FloatArray, look: LineLook, rng: np.random.Generator) -> BoolArray:
    """Rays of each line, shape (lines, rays), hidden by oxides on the pool."""
    hidden: BoolArray = np.zeros(point_mm.shape[:2], bool)
    for _ in range(look.gaps):
        line, ray = rng.integers(0, hidden.shape[0]), rng.integers(0, hidden.shape[1])
        away = np.linalg.norm(point_mm[line] - point_mm[line, ray], axis=-1)
        hidden[line] |= away < rng.uniform(0.3, 1.0) * look.gap_mm / 2
    return hidden


def _usual_ridge(light: FloatArray, lines: tuple[TrueLine, ...]) -> float:
    """Median light on the lines' ridges; 0 if there are no lines."""
    if not lines:
        return 0.0
    u, v = np.rint(np.concatenate([one.image_px for one in lines])).astype(np.int64).T
    return float(np.median(light[v, u]))
