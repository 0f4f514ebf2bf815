"""Measurement error on an object of known size in place of the pool (§8.2).

Its boundary is a circle, for the schemes with a boundary model (§8.2.1).
"""

from __future__ import annotations

import math

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.simulation.pools import Pool, spherical_cap
from labapp.studies import SCHEME_NAMES
from labapp.studies.error_analysis import scheme_errors
from labapp.studies.tables import Cell, Table

LARGEST_MM = 30.0


def known_cap(diameter_mm: float, height_mm: float) -> Pool:
    """Spherical cap of a diameter and a height, mm; a concave cap has a negative height.

    Raises
    ------
    InputError
        If no cap can have this size.
    """
    if not 1.0 <= diameter_mm <= LARGEST_MM:
        raise InputError("--known-object", "diameter", diameter_mm, f"1 to {LARGEST_MM:g} mm")
    if not 0.01 <= abs(height_mm) <= diameter_mm / 4:
        expected = f"0.01 to {diameter_mm / 4:g} mm, a quarter of the diameter; negative if concave"
        raise InputError("--known-object", "height", height_mm, expected)
    return spherical_cap(diameter_mm, height_mm)


def known_object_table(match: Match, rig: Rig, cap: Pool) -> Table:
    """Measurement error ME by every scheme (Eq. 8-1), as in §8.2.2 for the thumb tack.

    Parameters
    ----------
    match, rig
        The object's dots with their rays, and the bench.
    cap
        The true object (`known_cap`).

    Returns
    -------
    Table
        One row per scheme; empty cells if it finds no surface.
    """
    rows: list[dict[str, Cell]] = []
    diameter_mm, height_mm = cap.footprint.width_mm, cap.peak_mm
    for scheme in SCHEME_NAMES:
        status, height, diameter, are_mm = "ok", math.nan, math.nan, math.nan
        try:
            height, diameter, are_mm = scheme_errors(match, rig, cap, scheme)
        except CannotMeasure as why:
            status = why.status
        rows.append(
            {
                "scheme": scheme,
                "status": status,
                "diameter_mm": diameter_mm * (1 + diameter),
                "diameter_error_pct": 100 * abs(diameter),
                "height_mm": height_mm * (1 + height),
                "height_error_pct": 100 * abs(height),
                "are_mm": are_mm,
            }
        )
    return Table.of(
        "section_8_2_known_object",
        f"Measurement error on an object of diameter {diameter_mm:g} and height {height_mm:g} mm "
        "(§8.2, circle model)",
        rows,
    )
