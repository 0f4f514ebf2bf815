"""Recordings of line patterns: a penetration run (Fig. 3-11 … 3-14), pulsed GMAW (§3.3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from labapp.core.geometry.line_pattern import LineRig
from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import Pool, Wave, egg
from labapp.simulation.render import Picture, expose, speckle_field
from tests.line_truth.frames import LineLook, render_lines

PHASES_A_PERIOD = 72

PHASES = ("no-pool", "growing", "concave", "flattening", "convex")
"""States of the run in order: up to point A, AB, BC, CD, DE of Fig. 3-11."""


@dataclass(frozen=True)
class RunFrame:
    """A frame of a run.

    Parameters
    ----------
    pool
        The pool; None before there is one.
    state
        One of `PHASES`.
    """

    pool: Pool | None
    state: str


def penetration_run(frames: int, rng: np.random.Generator) -> tuple[RunFrame, ...]:
    """Draw a run like that of Fig. 3-11: the pool grows to full penetration, then becomes convex.

    From A to B the pool grows and is concave; from B to C it does not change; from C to D it
    shrinks faster and its surface rises; from D to E it is convex and small, so that an outer line
    is lost. It oscillates slightly all the time (Fig. 3-12).

    Parameters
    ----------
    frames
        Number of frames.
    rng
        Source of the sizes and of the ends of the phases.
    """
    shares = np.array([0.08, 0.2, 0.26, 0.18, 0.28]) * rng.uniform(0.85, 1.15, 5)
    ends = np.rint(np.cumsum(shares / shares.sum()) * frames).astype(int)
    large, small = rng.uniform(5.8, 6.6), rng.uniform(4.2, 4.8)
    deep, high = rng.uniform(-0.3, -0.2), rng.uniform(0.16, 0.24)
    phase_deg = rng.uniform(0, 360)
    made = []
    for k in range(frames):
        phase = int(np.searchsorted(ends, k, side="right"))
        start = 0 if phase == 0 else int(ends[phase - 1])
        part = (k + 0.5 - start) / (ends[phase] - start)
        if phase == 0:
            made.append(RunFrame(None, PHASES[0]))
            continue
        grown = part if phase == 1 else 1.0
        changed = (0.0, 0.0, 0.0, part, 1.0)[phase]
        width = (2.2 + (large - 2.2) * grown) * (1 - changed) + small * changed
        height = deep * grown * (1 - changed) + high * changed
        head = width * (0.46 * (1 - changed) + 0.31 * changed)
        wave = Wave((1, 1), 0.004 * grown, turned_deg=90.0, phase_deg=phase_deg + 67.0 * k)
        made.append(RunFrame(egg(width, head, 0.5 * width, height, terms=(wave,)), PHASES[phase]))
    return tuple(made)


@dataclass(frozen=True)
class GmawLook:
    """Disturbances of frames of pulsed GMAW (§3.3, Fig. 3-20).

    Parameters
    ----------
    frame_rate_hz, exposure_s
        Frame rate and exposure time of the high-speed camera.
    pulse_hz, duty
        Frequency and duty cycle of the current pulses.
    pulse_light, base_light
        Grey levels of the arc's light on the plane during the pulse and between pulses.
    flicker
        Relative standard deviation of the arc's light.
    spatter
        Mean number of drops that fly through a frame.
    glare
        Share of frames without a pulse in which a droplet or a bridge lights part of the plane.
    """

    frame_rate_hz: float = 1500.0
    exposure_s: float = 1e-4
    pulse_hz: float = 120.0
    duty: float = 0.4
    pulse_light: float = 170.0
    base_light: float = 22.0
    flicker: float = 0.08
    spatter: float = 0.7
    glare: float = 0.04


@dataclass(frozen=True)
class GmawFrame(ReadOnlyArrays):
    """A frame of GMAW and its ground truth.

    Parameters
    ----------
    image
        Shape (height, width), 8 bit.
    on
        Whether the pulse is on for more than half of the exposure.
    line_px
        (u, v) of the reflected line, shape (n, 2), px, whether it is visible or not.
    """

    image: Picture
    on: bool
    line_px: FloatArray


def gmaw_run(
    frames: int,
    rig: LineRig,
    view: CameraView,
    rng: np.random.Generator,
    *,
    oscillation_hz: float = 34.0,
    amplitude_mm: float = 0.06,
    look: GmawLook | None = None,
    lines: LineLook | None = None,
) -> Iterator[GmawFrame]:
    """Render a recording of one line on a steep oscillating pool with pulses, spatter and glare.

    The pool's oscillation is rendered at `PHASES_A_PERIOD` phases; a frame shows the nearest one.
    """
    look = look or GmawLook()
    lines = lines or LineLook(fringes=(), line_peak=60.0, sigma_mm=0.3)
    pool = egg(9.0, 5.0, 6.0, 2.0)
    phases = 360.0 * np.arange(PHASES_A_PERIOD) / PHASES_A_PERIOD
    swung = [
        replace(pool, terms=(Wave((1, 1), amplitude_mm, turned_deg=90.0, phase_deg=float(phase)),))
        for phase in phases
    ]
    drawn = [render_lines(one, rig, view, lines, np.random.default_rng(0)) for one in swung]
    first, shape = rng.uniform(0, 1, 2), (view.height_px, view.width_px)
    v, u = np.mgrid[: shape[0], : shape[1]]
    for k in range(frames):
        time_s = k / look.frame_rate_hz
        phase = round((oscillation_hz * time_s + first[0]) * PHASES_A_PERIOD) % PHASES_A_PERIOD
        true = drawn[phase]
        share = _pulse_share(time_s * look.pulse_hz + first[1], look)
        flicker = max(1.0 + look.flicker * rng.normal(), 0.3)
        arc = (look.base_light + (look.pulse_light - look.base_light) * share) * flicker
        glow = np.exp(-(((u / shape[1] - 0.5) / 0.9) ** 2 + ((v / shape[0] - 1.0) / 1.0) ** 2))
        light = arc * (0.35 + 0.65 * glow)
        if share < 0.5 and rng.random() < look.glare:
            middle, size = rng.random(2) * shape, rng.uniform(0.08, 0.25) * shape[1]
            away = (v - middle[0]) ** 2 + (u - middle[1]) ** 2
            light = light + rng.uniform(40, 160) * np.exp(-away / (2 * size**2))
        light = light + _spatter(shape, rng.poisson(look.spatter), rng)
        grains = speckle_field(shape, lines.light.speckle, rng)
        seen = gaussian_filter(true.light_px * grains, lines.light.blur_px) + light
        path = np.concatenate([one.image_px for one in true.lines])
        yield GmawFrame(expose(seen, lines.light, rng), bool(share > 0.5), path)


def _pulse_share(periods: float, look: GmawLook) -> float:
    """Share of an exposure in which the pulse is on; ``periods`` is the time of its middle."""
    half = look.exposure_s * look.pulse_hz / 2
    moments = periods + np.linspace(-half, half, 33)
    return float(np.mean(moments % 1.0 < look.duty))


def _spatter(shape: tuple[int, int], count: int, rng: np.random.Generator) -> FloatArray:
    """Streaks of bright drops, shape ``shape``."""
    light = np.zeros(shape, np.float32)
    for _ in range(count):
        start = rng.random(2) * shape[::-1]
        step = rng.normal(0, 12, 2)
        width, bright = int(rng.integers(2, 7)), float(rng.uniform(60, 250))
        ends = [tuple(np.rint(place).astype(int).tolist()) for place in (start, start + step)]
        cv2.line(light, ends[0], ends[1], bright, width)
    return np.asarray(gaussian_filter(light, 1.0), float)
