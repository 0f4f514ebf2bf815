"""Sub-pixel position of an inner board corner, from a model fitted to the grey levels.

Two edges cross: the light is ``m + c·erf(a/w)·erf(b/w)``, with a and b the distances from the edges
and w the camera's blur. For white noise the least-squares fit is nearly optimal. OpenCV's
`cornerSubPix` uses the picture's gradients; its error in a dim picture is three times as large.
"""

from __future__ import annotations

import numpy as np
import scipy

from labapp.core.values import FloatArray

ROUNDS = 12
"""Maximum number of Gauss–Newton steps; the fit has converged by then, or does not converge."""

CONVERGED = 1e-6
"""The fit has converged if no parameter (px, rad, grey levels) changes by more."""

FIRST_BLUR_PX, LEAST_BLUR_PX = 1.2, 0.3
"""Initial and least blur, px."""

LEAST_CONTRAST = 4.0
"""Least ratio of a corner's contrast to the residual scatter; below, it is no corner or hidden."""


def fit_corner(grey: FloatArray, place_px: FloatArray, radius_px: float) -> FloatArray | None:
    """Return the position of a corner, shape (2,), px; None if there is none.

    Parameters
    ----------
    grey
        Grey levels, shape (rows, columns).
    place_px
        Initial (u, v), accurate to about a pixel, shape (2,), px.
    radius_px
        Radius around it within which the picture shows only this corner, px.
    """
    reach = int(np.ceil(radius_px))
    u0, v0 = np.rint(place_px).astype(int).tolist()
    rows, columns = grey.shape
    if not (reach <= u0 < columns - reach and reach <= v0 < rows - reach):
        return None
    window = grey[v0 - reach : v0 + reach + 1, u0 - reach : u0 + reach + 1]
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    within = np.hypot(u, v) <= radius_px
    u, v, light = u[within], v[within], window[within]
    fitted = _first(u, v, light)
    for _ in range(ROUNDS):
        model, slopes = _model(fitted, u, v)
        step = np.linalg.lstsq(slopes, light - model, rcond=None)[0]
        step[2:4] = np.clip(step[2:4], -0.3, 0.3)
        step[:2] = np.clip(step[:2], -1.0, 1.0)
        fitted = fitted + step
        fitted[4] = max(fitted[4], LEAST_BLUR_PX)
        if np.hypot(*fitted[:2]) > radius_px / 2 or not np.isfinite(fitted).all():
            return None
        if np.abs(step).max() < CONVERGED:
            break
    left = float(np.std(light - _model(fitted, u, v)[0]))
    between = abs(float(np.sin(fitted[2] - fitted[3])))
    if abs(fitted[6]) < LEAST_CONTRAST * left or between < 0.5:
        return None
    return np.array([u0, v0]) + fitted[:2]


def _first(u: FloatArray, v: FloatArray, light: FloatArray) -> FloatArray:
    """Initial parameters: u, v, directions of both edges' normals, blur, middle and contrast."""
    middle = float(light.mean())
    # The sign alternates between quadrants: the second moments of the light give the saddle's axes.
    apart = light - middle
    turn = 0.5 * np.arctan2(np.sum(apart * (u * u - v * v)), -2.0 * np.sum(apart * u * v))
    contrast = float(np.quantile(light, 0.9) - np.quantile(light, 0.1)) / 2.0
    inside = np.sum(
        apart * (u * np.cos(turn) + v * np.sin(turn)) * (v * np.cos(turn) - u * np.sin(turn))
    )
    sign = 1.0 if inside >= 0.0 else -1.0
    return np.array([0.0, 0.0, turn, turn + np.pi / 2, FIRST_BLUR_PX, middle, sign * contrast])


def _model(fitted: FloatArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Light at each pixel, shape (n,), and its derivatives w.r.t. the parameters, shape (n, 7)."""
    du, dv = u - fitted[0], v - fitted[1]
    blur, middle, contrast = fitted[4:]
    parts = []
    for angle in fitted[2:4]:
        cos, sin = np.cos(angle), np.sin(angle)
        across = (du * cos + dv * sin) / blur
        slope = 2.0 / np.sqrt(np.pi) * np.exp(-(across**2)) / blur
        parts.append((scipy.special.erf(across), slope, across, cos, sin, dv * cos - du * sin))
    (one, one_slope, at_one, cos1, sin1, along1), (two, two_slope, at_two, cos2, sin2, along2) = (
        parts
    )
    by_one, by_two = contrast * two * one_slope, contrast * one * two_slope
    slopes = [
        -(by_one * cos1 + by_two * cos2),
        -(by_one * sin1 + by_two * sin2),
        by_one * along1,
        by_two * along2,
        -(by_one * at_one + by_two * at_two),
        np.ones_like(u),
        one * two,
    ]
    return middle + contrast * one * two, np.stack(slopes, axis=-1)
