"""The setup file (TOML): rig and image calibration."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit
from tomlkit.items import Table

from labapp.config.bench_check import (
    check_values,
    checked_covariance,
    same_setup,
    section_contradictions,
    semidefinite,
    unchecked_values,
)
from labapp.config.ray_file import text_with_rays
from labapp.config.setup_keys import OPTIONAL, SECTIONS, THREE_POINTS, rules_for
from labapp.config.setup_text import frame_px_of, image_calibration_of, incomplete_lens
from labapp.config.toml_keys import (
    check_keys,
    parse_toml,
    read_text,
    shown,
    unknown_key,
)
from labapp.config.view_check import view_problems
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.geometry.line_pattern import KIND as LINES
from labapp.core.geometry.line_pattern import LinePattern, LineRays, LineRig, line_rig
from labapp.core.geometry.plausibility import implausible_values
from labapp.core.geometry.rig import POSE, DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import (
    CALIBRATED,
    ENDINGS,
    AxisPoints,
    RigUncertainty,
    covariance_of,
)
from labapp.errors import InputError, os_errors_as_input, parser_words
from labapp.files import write_atomically

if TYPE_CHECKING:  # see `labapp.config.bench_check`
    from labapp.core.bench_check.check import BenchCheck

A_SETUP = "a setup file (TOML, UTF-8)"


@dataclass(frozen=True)
class Setup:
    """A valid setup."""

    rig: Rig
    """Laser, pattern, electrode, imaging plane; a line pattern as `LineRays`."""
    calibration: ImageCalibration
    """Conversion between pixels and imaging plane."""
    text: str
    """The file as read, for the record."""
    check_date: str = ""
    """Date of the check against a known mirror, ISO 8601; empty if the bench was not checked or has
    changed since.
    """

    @functools.cached_property
    def bench(self) -> Bench:
        """Rig and calibration as used by the measurement."""
        return Bench(self.rig, self.calibration)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Values that are unusual for a bench, one clause each (`implausible_values`)."""
        return implausible_values(self.rig)

    def require_size(self, shape: tuple[int, ...], name: str) -> None:
        """Raise `InputError` if the calibration picture has another size, (rows, columns)."""
        calibrated = self._frame_px
        height, width = shape
        if calibrated is not None and calibrated != (width, height):
            wanted = "{}×{} px, the size of the calibration picture (frame_px in the set-up): "
            advice = "calibrate the imaging plane with a picture of the same size as the frames"
            raise InputError(
                name, "size", f"{width}×{height} px", wanted.format(*calibrated) + advice
            )

    @functools.cached_property
    def _frame_px(self) -> tuple[int, int] | None:
        return frame_px_of(self.text)

    @property
    def line_rig(self) -> LineRig | None:
        """The rig of a line pattern; None for a dot pattern."""
        return line_rig(self.rig)


def read_setup(path: str | os.PathLike[str], lines: bool = False) -> Setup:
    """Read and check a setup file; see `parse_setup`.

    Raises
    ------
    InputError
        If the file cannot be read or anything in it is unknown, missing or impossible; all problems
        are reported together (`InputError.problems`).
    """
    return parse_setup(read_setup_text(path), Path(path), lines)


def read_setup_text(path: str | os.PathLike[str]) -> str:
    """Read the text of a setup file and insert the rays of the table that it names.

    Raises
    ------
    InputError
        If the file or the table cannot be read.
    """
    path = Path(path)
    text = read_text(path, A_SETUP)
    return text_with_rays(text, path, parse_toml(text, path, A_SETUP))


@functools.lru_cache(maxsize=64)
def parse_setup(text: str, path: str | os.PathLike[str], lines: bool = False) -> Setup:
    """Check a setup that was read from ``path``; see `read_setup`.

    Parameters
    ----------
    lines
        Whether a line pattern is accepted, too: for callers that handle both or measure neither.
    """
    path = Path(path)
    values = parse_toml(text, path, A_SETUP)
    pattern = values.get("pattern")
    if isinstance(pattern, dict) and pattern.get("kind") == LINES and not lines:
        right = "a dot pattern; lines are measured by labapp lines"
        raise InputError(path, "pattern.kind", '"lines"', right)
    problems = [
        *(unknown_key(path, key, SECTIONS) for key in values if key not in SECTIONS),
        *(
            problem
            for section in SECTIONS
            if section in values or section not in OPTIONAL
            for problem in check_keys(
                path, section, values.get(section), rules_for(section, values.get(section))
            )
        ),
    ]
    # Values are compared with each other only if each is valid.
    problems = problems or [*_contradictions(path, values), *section_contradictions(path, values)]
    if problems:
        raise InputError.gather([_of_either_form(problem) for problem in problems])
    calibration = _calibration(values)
    rig = _rig(values, calibration)
    checked = rig.uncertainty is not None and rig.uncertainty.checked
    return Setup(rig, calibration, text, values["bench_check"]["date"] if checked else "")


def _of_either_form(problem: InputError) -> InputError:
    """Problem of a key of the three points beside a homography, which replaces them."""
    section, _, key = problem.field.partition(".")
    if section != "image_calibration" or key not in THREE_POINTS or problem.value != "unknown key":
        return problem
    expected = "homography or the keys of the three points, not both"
    return InputError(problem.source, problem.field, problem.value, expected)


def update_setup(
    path: str | os.PathLike[str],
    values: Mapping[str, Mapping[str, object]],
    *,
    complete: bool = False,
) -> None:
    """Set keys of a setup file; everything else, including comments, is left unchanged.

    The file and missing sections are created.

    Parameters
    ----------
    values
        Section → key → value; None removes the key.
    complete
        Whether the changed set-up must be valid. Otherwise only the given values must be: read the
        file back to find what is still missing or wrong.

    Raises
    ------
    InputError
        If the file exists and is not TOML, cannot be written, or would not be valid. The file is
        unchanged then.
    """
    path = Path(path)
    text = updated_setup(read_text(path, A_SETUP) if path.exists() else "", path, values)
    try:
        parse_setup(text_with_rays(text, path, parse_toml(text, path, A_SETUP)), path)
    except InputError as error:
        given = {f"{section}.{key}" for section, keys in values.items() for key in keys}
        wrong = [one for one in error.problems if complete or one.field in given]
        if wrong:
            raise InputError.gather(wrong) from error
    with os_errors_as_input(path, "file", "a file that can be written"):
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(13, "write-protected")
        write_atomically(path, text.encode())


def updated_setup(
    text: str, path: str | os.PathLike[str], values: Mapping[str, Mapping[str, object]]
) -> str:
    """Text of a setup with keys set; ``path`` is for errors. See `update_setup`.

    If a calibrated value is changed without its standard uncertainty, the uncertainty is removed:
    it applies only to the value found by the calibration.
    """
    document = _parsed(text, path)
    for section, keys in values.items():
        if section not in document:
            document.add(section, tomlkit.table())
        table = document[section]
        if not isinstance(table, Table):
            raise InputError(path, section, shown(table), f"a table: [{section}]")
        for key, value in keys.items():
            if table.get(key) == value:
                continue
            if f"{section}.{key}" in _CALIBRATED_KEYS:
                for known in (f"{key}_sigma", *_SHARED.get(section, ())):
                    if known in table and known not in keys:
                        table.remove(known)
            if value is not None:
                table[key] = value
            elif key in table:
                table.remove(key)
    return tomlkit.dumps(document)


_CALIBRATED_KEYS = frozenset(key.partition("[")[0] for key in CALIBRATED)
_SHARED = {
    "laser": ("angle_distance_correlation",),
    "image_calibration": ("points_covariance_px2", "frame_px"),
}


def checked_setup(text: str, path: str | os.PathLike[str], check: BenchCheck, date: str) -> str:
    """Enter the results of a bench check into the text of a setup file; ``path`` is for errors.

    Raises
    ------
    InputError
        If the text is not a valid setup, differs from the setup of the check, or a quantity has
        become impossible.
    """
    if not same_setup(check.before, parse_setup(text, Path(path)).rig):
        changed = "changed since the check of the pictures"
        raise InputError(path, "set-up", changed, "the set-up of the check: check it again")
    values = parse_toml(text, Path(path), A_SETUP)
    made = updated_setup(text, path, _keeping_sigmas(check_values(check, values, date), values))
    parse_setup(made, Path(path))
    return made


def unchecked_setup(text: str, path: str | os.PathLike[str]) -> str:
    """Text of a setup file from before its bench check, keeping the changes made since.

    A new check starts from it; otherwise the pictures of the earlier check would count twice.

    Raises
    ------
    InputError
        If the text is not a valid setup.
    """
    parse_setup(text, Path(path))
    now = parse_toml(text, Path(path), A_SETUP)
    values = unchecked_values(now)
    if not values:
        return text
    del values["bench_check"]
    document = _parsed(text, path)
    document.pop("bench_check", None)
    return updated_setup(tomlkit.dumps(document), path, _keeping_sigmas(values, now))


def _keeping_sigmas(
    values: Mapping[str, Mapping[str, object]], now: Mapping[str, Any]
) -> dict[str, dict[str, object]]:
    """Values to set, with the uncertainties in the file, which apply again without the check."""
    return {
        section: {
            key: value
            for key, value in now.get(section, {}).items()
            if key.endswith(ENDINGS) or key == "frame_px"
        }
        | dict(keys)
        for section, keys in values.items()
    }


def _parsed(text: str, path: str | os.PathLike[str]) -> tomlkit.TOMLDocument:
    """Text as a document that keeps comments; ``path`` is for the error."""
    try:
        return tomlkit.parse(text)
    except (tomlkit.exceptions.TOMLKitError, ValueError, RecursionError) as error:
        raise InputError(path, "syntax", parser_words(error), A_SETUP) from error


def pattern_values(pattern: DotPattern) -> dict[str, object]:
    """Keys of a pattern in a setup file: key → value."""
    assert pattern.absent is not None
    values: dict[str, object] = {
        "rows": pattern.rows,
        "columns": pattern.columns,
        "inter_beam_angle_deg": pattern.inter_beam_angle_deg,
        "absent": [list(ray) for ray in sorted(pattern.absent)],
    }
    if pattern.rotation_deg:
        values["rotation_deg"] = pattern.rotation_deg
    if pattern.measured:
        i, j = pattern.center_ray
        values["rays"] = [[i + row, j + column, *to] for row, column, *to in pattern.measured]
    return values if pattern.kind == DotPattern.kind else values | {"kind": pattern.kind}


def dot_pattern(keys: Mapping[str, Any]) -> DotPattern:
    """Pattern of the keys of a setup file; inverse of `pattern_values`."""
    given = _without_sigmas(keys)
    absent, rays = given.pop("absent", None), given.pop("rays", [])
    pattern = DotPattern(**given)
    i, j = pattern.center_ray
    return replace(
        pattern,
        absent=None if absent is None else frozenset((i, j) for i, j in absent),
        measured=tuple((row - i, column - j, aside, up) for row, column, aside, up in rays),
    )


def _pattern(keys: Mapping[str, Any]) -> DotPattern:
    if keys.get("kind") != LINES:
        return dot_pattern(keys)
    return LineRays.of(LinePattern(**{key: value for key, value in keys.items() if key != "kind"}))


def _contradictions(path: Path, values: dict[str, Any]) -> list[InputError]:
    """Problems of values that are each valid but contradict each other."""
    pattern, angle = values["pattern"], values["laser"]["projection_angle_deg"]
    of_pattern = _steep_lines if pattern.get("kind") == LINES else _steep_rays
    problems = of_pattern(path, pattern, angle)
    plane = values["imaging_plane"]
    if plane.get("glass_mm", 0.0) >= plane["distance_mm"]:
        expected = f"a number below the plane's distance, {plane['distance_mm']:g} (mm)"
        glass = plane["glass_mm"]
        problems.append(InputError(path, "imaging_plane.glass_mm", glass, expected))
    if incomplete := incomplete_lens(path, values.get("camera_lens", {})):
        return problems + incomplete
    try:
        calibration = _calibration(values)
    except ValueError as error:
        problems.append(
            InputError(path, "image_calibration", error, "three points that span the plane")
        )
    else:
        problems += view_problems(path, values, calibration)
    return problems


def _steep_rays(path: Path, pattern: dict[str, Any], angle: float) -> list[InputError]:
    """Find problems of a dot pattern: rays that it does not have, and too large a fan."""
    rows, columns = pattern["rows"], pattern["columns"]
    step = pattern["inter_beam_angle_deg"]
    problems = _rays_beyond(path, pattern)
    steps = max(rows, columns) - 1
    if steps * step >= 90:
        problems.append(
            InputError(
                path,
                "pattern.inter_beam_angle_deg",
                step,
                f"a number below {90 / steps:.4g} (degrees), so that the fan stays below 90",
            )
        )
    elif (rows - 1) / 2 * step >= angle:
        problems.append(
            InputError(
                path,
                "laser.projection_angle_deg",
                angle,
                f"a number above half the fan, {(rows - 1) / 2 * step:.4g} (degrees): "
                "rays above that never reach the work piece",
            )
        )
    return problems


def _steep_lines(path: Path, pattern: dict[str, Any], angle: float) -> list[InputError]:
    """Find lines that never reach the work piece."""
    step = pattern["interline_angle_deg"]
    half = (pattern["count"] - 1) / 2 * step
    if half < angle:
        return []
    allowed = f"a number below {angle / half:.3g} times this"
    return [InputError(path, "pattern.interline_angle_deg", step, allowed)]


def _rays_beyond(path: Path, pattern: dict[str, Any]) -> list[InputError]:
    """Find named rays beyond the pattern's rows and columns, and a pattern without any ray."""
    rows, columns = pattern["rows"], pattern["columns"]
    problems = [
        InputError(
            path, f"pattern.{key}", [i, j], f"rays [row, column] from [1, 1] to [{rows}, {columns}]"
        )
        for key in ("absent", "rays")
        for i, j, *_ in pattern.get(key, [])
        if not (1 <= i <= rows and 1 <= j <= columns)
    ]
    if not problems and len(dot_pattern(pattern).absent_rays) == rows * columns:
        expected = "at least one ray of the pattern that is there"
        problems.append(InputError(path, "pattern.absent", "every ray", expected))
    return problems


def _rig(values: dict[str, Any], calibration: ImageCalibration) -> Rig:
    plane, points = values["imaging_plane"], values["image_calibration"]
    x_mm, z_mm = points.get("points_mm", [plane["width_mm"] / 2, plane["height_mm"] / 2])
    axes = AxisPoints(calibration, points.get("x_axis_mm", x_mm), points.get("z_axis_mm", z_mm))
    given = {
        f"{section}.{key}": sigma for section in values for key, sigma in values[section].items()
    }
    has_glass = plane.get("glass_mm", 0.0) > 0.0
    of_points = points.get("points_covariance_px2")
    covariance, assumed = covariance_of(
        given,
        values["laser"].get("angle_distance_correlation", 0.0),
        None if of_points is None else semidefinite(np.array(of_points, float)),
        has_glass=has_glass,
    )
    covariance, checked = checked_covariance(values, covariance)
    return Rig(
        Laser(**_without_sigmas(values["laser"])),
        _pattern(values["pattern"]),
        Electrode(**values["electrode"]),
        _imaging_plane(plane),
        RigUncertainty(axes, covariance, frozenset() if checked else assumed, checked),
        **values.get("torch", {}),
    )


def _without_sigmas(keys: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in keys.items() if not key.endswith(ENDINGS)}


def _imaging_plane(keys: Mapping[str, Any]) -> ImagingPlane:
    others = {name: value for name, value in _without_sigmas(keys).items() if name not in POSE}
    plane = ImagingPlane(np.zeros(3), **others)
    return plane.with_pose([keys.get(name, 0.0) for name in POSE])


def _calibration(values: dict[str, Any]) -> ImageCalibration:
    lens_keys, plane = _without_sigmas(values.get("camera_lens", {})), values["imaging_plane"]
    percent = lens_keys.pop("distortion_percent", 0.0)
    half = np.array([plane["width_mm"], plane["height_mm"]]) / 2
    lens = Lens(**{key: tuple(pair) for key, pair in lens_keys.items()}) if lens_keys else None
    return image_calibration_of(values["image_calibration"], lens).with_distortion(percent, half)
