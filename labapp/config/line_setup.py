"""The setup file of a bench with a line pattern: ``[pattern] kind = "lines"``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import tomlkit

from labapp.config.setup import A_SETUP, parse_setup
from labapp.config.toml_keys import Rule, between, check_keys, parse_toml, read_text, shown
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.line_pattern import LinePattern, LineRig
from labapp.core.pipeline import setup_status
from labapp.errors import InputError

KIND = "lines"

LINE_PATTERN = {
    "kind": Rule(f'"{KIND}"', lambda value: value == KIND),
    "count": Rule(
        "a whole number from 1 to 99", lambda value: type(value) is int and 1 <= value <= 99
    ),
    "interline_angle_deg": between(0, 45, "degrees"),
    "fan_angle_deg": between(0, 90, "degrees"),
    "rotation_deg": between(-90, 90, "degrees", required=False),
}
"""Keys of ``[pattern]``."""

STAND_IN = {"rows": 3, "columns": 3, "inter_beam_angle_deg": 1e-3}
"""A dot pattern with which all other sections of the file are checked."""


@dataclass(frozen=True)
class LineSetup:
    """A valid setup with a line pattern."""

    rig: LineRig
    """Laser, line pattern, electrode, imaging plane."""
    calibration: ImageCalibration
    """Pixel ↔ imaging plane."""
    text: str
    """The file as it was read, for the record."""
    setup_status: str
    """How far it can be relied on (`RigUncertainty.status`)."""


def read_line_setup(path: str | os.PathLike[str]) -> LineSetup:
    """Read and check a setup file with a line pattern.

    Raises
    ------
    InputError
        If the file cannot be read, its pattern is none of lines, or anything in it is unknown,
        missing or impossible; all that was found is reported together.
    """
    path = Path(path)
    text = read_text(path, A_SETUP)
    pattern = parse_toml(text, path, A_SETUP).get("pattern")
    if isinstance(pattern, dict) and pattern.get("kind", "square") != KIND:
        kind = shown(pattern.get("kind", "square"))
        right = f'"{KIND}"; dots are measured by labapp reconstruct'
        raise InputError(path, "pattern.kind", kind, right)
    problems = check_keys(path, "pattern", pattern, LINE_PATTERN)
    if problems and not isinstance(pattern, dict):
        raise InputError.gather(problems)
    assert isinstance(pattern, dict)
    document = tomlkit.parse(text)
    document["pattern"] = dict(STAND_IN)
    try:
        others = parse_setup(tomlkit.dumps(document), path)
    except InputError as error:
        problems += error.problems
    if problems:
        raise InputError.gather(problems)
    lines = LinePattern(**{key: value for key, value in pattern.items() if key != "kind"})
    half = (lines.count - 1) / 2 * lines.interline_angle_deg
    if half >= others.rig.laser.projection_angle_deg:
        allowed = f"a number below {others.rig.laser.projection_angle_deg / half:.3g} times this"
        raise InputError(path, "pattern.interline_angle_deg", lines.interline_angle_deg, allowed)
    rig = others.rig
    line_rig = LineRig(rig.laser, lines, rig.electrode, rig.imaging_plane)
    return LineSetup(line_rig, others.calibration, text, setup_status(rig))
