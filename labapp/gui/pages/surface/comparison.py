"""The comparison of two schemes, computed from the session. Without Qt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.pipeline import Measurement, reconstruct
from labapp.core.surface.measures import Measures, measure_surface
from labapp.core.values import CannotMeasure
from labapp.export.rendering.scene import Scene, difference_scene
from labapp.gui.pages.surface.presenter import (
    ERRORS,
    SCHEMES,
    SIZES,
    Options,
    scene,
    with_scheme,
)
from labapp.session.session import Session
from labapp.text import rounded

Row = tuple[str, str, str, str, str]
"""Quantity, value of the first and of the other, first minus other, unit."""


def other_scheme(scheme: str) -> str:
    """Default scheme to compare with: the first in the list of a different kind."""
    made = scheme.partition("-")[0]
    return next(name for name in SCHEMES if name.partition("-")[0] != made)


@dataclass(frozen=True)
class Comparison:
    """A frame reconstructed by two schemes."""

    scenes: tuple[Scene | None, Scene | None]
    """Scenes of the first and the second; None without a surface."""
    words: tuple[str, str]
    """Reasons why there is no surface; empty if there is one."""
    difference: Scene | None
    """Surface of the first, coloured by the difference; None if they do not overlap."""
    rows: tuple[Row, ...]
    """Figures of both and their difference."""
    text: str
    """The comparison in a sentence."""


def compared(
    session: Session, frame: int, schemes: tuple[str, str], options: Options
) -> Comparison:
    """Reconstruct a frame by two schemes and compare the results.

    If both surfaces are coloured by the same quantity, they share one scale.
    """
    found: list[Measurement | None] = []
    words = []
    for scheme in schemes:
        try:
            found.append(by_scheme(session, frame, scheme))
            words.append("")
        except CannotMeasure as answer:
            found.append(None)
            words.append(f"No surface ({answer.status}): {answer.reason}.")
    first, second = found
    base = session.result(frame)
    rig = session.setup.rig if base is None else base.parsed_setup.rig
    measures = [each.measures for each in (first, second) if each and each.measures]
    limits = None
    if measures:
        limits = min(each.depth_mm for each in measures), max(each.height_mm for each in measures)
    scenes = [None if each is None else scene(each, rig, options, limits, None) for each in found]
    scenes = _with_one_range(scenes)
    rows: tuple[Row, ...] = ()
    difference, message = None, "There are no two surfaces to compare."
    if first and second and first.measures and second.measures:
        assert first.reconstruction is not None
        assert second.reconstruction is not None
        plain = difference_scene(first.reconstruction, second.reconstruction)
        rows = compared_rows(first.measures, second.measures)
        names = [SCHEMES[scheme].title for scheme in schemes]
        message = f"{names[0]} minus {names[1]}, from the same dots: "
        if len(plain.values):
            difference = replace(
                plain, exaggeration=options.exaggeration, contours=options.contours
            )
            largest = float(np.abs(plain.values).max())
            message += f"the heights differ by {largest:.3f} mm at most."
        else:
            message += "the two surfaces do not overlap."
    return Comparison((scenes[0], scenes[1]), (words[0], words[1]), difference, rows, message)


def _with_one_range(scenes: list[Scene | None]) -> list[Scene | None]:
    """Scenes with a common range of colours if they show the same quantity."""
    drawn = [each for each in scenes if each is not None]
    if len({each.label for each in drawn}) != 1:
        return scenes
    limits = min(each.limits[0] for each in drawn), max(each.limits[1] for each in drawn)
    return [None if each is None else replace(each, limits=limits) for each in scenes]


def by_scheme(session: Session, frame: int, scheme: str) -> Measurement:
    """Measurement by a scheme with the current match of a frame; the session is not changed.

    A stored result of the scheme is used if it is not stale.

    Raises
    ------
    CannotMeasure
        If the frame has no match, or the scheme finds no surface.
    InputError
        If the stored data are damaged.
    """
    kept = session.result(frame, scheme)
    if kept is not None and not kept.stale and kept.measurement.reconstruction is not None:
        return kept.measurement
    base = session.result(frame)
    if base is None or base.measurement.match is None:
        raise CannotMeasure("no-match", f"frame {frame} has no matched dots: measure it first")
    match, rig = base.measurement.match, base.parsed_setup.rig
    chosen = with_scheme(base.settings, scheme)
    reconstruction = reconstruct(match, rig, chosen)
    return replace(
        base.measurement,
        status="ok",
        reason="",
        scheme=chosen.scheme,
        reconstruction=reconstruction,
        measures=measure_surface(reconstruction, match, rig),
    )


def compared_rows(one: Measures, other: Measures) -> tuple[Row, ...]:
    """Sizes and errors of both, and the first minus the other, as texts.

    The larger ± determines the digits of both.
    """
    rows = []
    for name, value, of_sigma, unit, _ in SIZES:
        sigmas = [getattr(each, of_sigma) for each in (one, other)]
        rows.append(_row(name, [getattr(each, value) for each in (one, other)], sigmas, unit))
    for name, value, _ in ERRORS:
        values = [getattr(each, value) for each in (one, other)]
        if value != "own_are_mm" or np.isfinite(values).any():
            rows.append(_row(name, values, [], "mm"))
    return tuple(rows)


def _row(name: str, values: list[float], sigmas: list[float], unit: str) -> Row:
    largest = max((sigma for sigma in sigmas if np.isfinite(sigma)), default=None)
    decimals = 3 if sigmas else 4
    first, second, difference = (
        rounded(number, largest, decimals)[0] for number in (*values, values[0] - values[1])
    )
    texts = [
        f"{text} ± {rounded(value, sigma)[1]}" if np.isfinite(sigma) and sigma > 0 else text
        for text, value, sigma in zip(
            (first, second), values, sigmas or [np.nan, np.nan], strict=True
        )
    ]
    return name, texts[0], texts[1], difference, unit
