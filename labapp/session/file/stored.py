"""Names of classes and fields in session files (docs/session-file.md).

A class or a field can be renamed in the program without a change of the files: this module defines
its permanent name there. `tests/session/data/stored_names.json` has every name ever written; a test
fails if one can no longer be read, or a new one is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from labapp.core.calibration.board_calibration import MOST_PICTURES, BoardCalibration
from labapp.core.calibration.boards import FEWEST_CORNERS, Board, BoardCorners
from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.geometry.coordinates import ImageCalibration, Lens, RadialDistortion
from labapp.core.geometry.line_pattern import LinePattern, LineRays
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints, RigUncertainty
from labapp.core.images import dots, find_dots, threshold_dots
from labapp.core.lines.correction import LineCorrection
from labapp.core.lines.detection.find_lines import LightLine
from labapp.core.lines.detection.numbering import LinesSeen
from labapp.core.lines.frame import LineFeatures, LineFrame
from labapp.core.lines.metal import PoolEdges
from labapp.core.lines.surface import LineSurface
from labapp.core.lines.track import TrackedLine
from labapp.core.match import Match, Trial
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.pipeline import Measurement, Settings
from labapp.core.recording.residual_check import ResidualSuspect, SetupVerdict
from labapp.core.rows import find_lattice, lattice, lattice_growth, row_search
from labapp.core.rows.correction import Correction
from labapp.core.schemes import SCHEMES, algorithm_names
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.measures import Measures
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.run.limits import Limits
from labapp.session.record import (
    BenchCheckRecord,
    BenchEntries,
    CrossPicture,
    LaserEntries,
    LaserReadings,
    MirrorEntry,
    MirrorPicture,
    PlanePicture,
    Record,
    Recording,
)
from labapp.session.signals import Signals

LARGEST_PX = 1e6
"""Limit of the coordinates of a calibration, px and mm."""


@dataclass(frozen=True)
class Stored:
    """Storage of the instances of a class."""

    kind: Any
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Names of fields in files → in the class, where these differ."""
    retired: Collection[str] = ()
    """Names of fields in files of earlier versions that are ignored."""
    shapes: Mapping[str, str] = field(default_factory=dict)
    """Shape of every array; equal letters are equal lengths."""
    fits: Callable[[Any], bool] = lambda _: True
    """Whether the fields of a value are consistent."""

    def names(self) -> dict[str, str]:
        """Return the names of all fields, in files → in the class."""
        in_files = {ours: theirs for theirs, ours in self.renamed.items()}
        names = (each.name for each in fields(self.kind))
        return {in_files.get(name, name): name for name in names}


def _scheme_is_known(value: Any) -> bool:
    if value.scheme not in SCHEMES:
        raise ValueError(f"it was written by a labapp with other schemes: {value.scheme!r}")
    return True


def _choices_are_known(value: Any) -> bool:
    return _scheme_is_known(value) and value.algorithm in algorithm_names()


def _measurement_fits(value: Any) -> bool:
    count = 0 if value.dots is None else len(value.dots)
    match, found = value.match, value.reconstruction
    return (
        _scheme_is_known(value)
        and (value.lattice is None or len(value.lattice.row) == count)
        and (match is None or _all_within(match.dot, 0, count - 1))
        and (match is None or found is None or np.array_equal(match.ray, found.ray))
    )


def _match_fits(value: Any) -> bool:
    return _all_within(value.ray[:, 0], 1, value.ray_states.shape[0]) and _all_within(
        value.ray[:, 1], 1, value.ray_states.shape[1]
    )


def _spline_fits(value: Any) -> bool:
    knots = (value.basis.x_knots, value.basis.y_knots)
    return (
        min(value.basis.shape) > 0
        and len(value.coefficients) == value.basis.count
        and all(np.isfinite(each).all() and (np.diff(each) > 0).all() for each in knots)
    )


def _corners_fit(value: Any) -> bool:
    """Whether the corners are those of the board, and not on a line in the picture."""
    return (
        len(value.index) > 2
        and _all_within(value.index, 0, len(value.board.corners_mm) - 1)
        and _all_within(value.image_px, -LARGEST_PX, LARGEST_PX)
        and all(
            np.linalg.matrix_rank(places - places.mean(axis=0)) == 2
            for places in (value.plane_mm, value.image_px)
        )
    )


def _plane_fits(value: Any) -> bool:
    """Whether the points and marks of a calibration determine a map."""
    numbers = (*value.origin_px, *value.x_axis_px, *value.z_axis_px, *value.sigma_px)
    lengths = (value.x_axis_mm, value.z_axis_mm, *(one for mark in value.marks for one in mark))
    return _all_within(np.array([*numbers, *lengths]), -LARGEST_PX, LARGEST_PX) and bool(
        np.isfinite(value.image_calibration.matrix).all()
    )


def _boards_fit(value: Any) -> bool:
    return bool(
        1 <= len(value.seen) <= MOST_PICTURES
        and min(value.size_px) > 1
        and all(len(one.index) >= FEWEST_CORNERS for one in value.seen)
    )


def _lines_fit(value: Any) -> bool:
    """Whether each line has points, and a surface belongs to the lines that are not folded."""
    lines, surface = value.seen.lines, value.surface
    count = sum(not one.folded for one in lines)
    return all(len(one.image_px) > 1 for one in lines) and (
        surface is None
        or (
            len(surface.numbers) == count
            and len(surface.point_mm) > 0
            and len(surface.covariance) == len(surface.surface.coefficients)
        )
    )


def _line_correction_fits(value: Any) -> bool:
    lines = value.seen.lines
    return len(value.number) == len(lines) and all(len(one.image_px) > 1 for one in lines)


def _line_surface_fits(value: Any) -> bool:
    count = value.surface.basis.count
    others = value.renumbered
    return len(value.covariance) == count and (not len(others) or others.shape[1] == count)


def _all_within(numbers: Any, least: float, most: float) -> bool:
    return bool(((numbers >= least) & (numbers <= most)).all())


STORED = {
    # The bench and its calibrations
    "Laser": Stored(Laser),
    "DotPattern": Stored(DotPattern),
    "LinePattern": Stored(LinePattern),
    "LineRays": Stored(LineRays),
    "Electrode": Stored(Electrode),
    "ImagingPlane": Stored(ImagingPlane, shapes={"origin_mm": "3", "x_axis": "3", "z_axis": "3"}),
    "Rig": Stored(Rig),
    "RigUncertainty": Stored(RigUncertainty, shapes={"covariance": "q q"}),
    "AxisPoints": Stored(AxisPoints),
    "ImageCalibration": Stored(ImageCalibration, shapes={"matrix": "3 3"}),
    "Lens": Stored(Lens),
    "RadialDistortion": Stored(RadialDistortion, shapes={"matrix": "3 3", "half_mm": "2"}),
    "CrossPicture": Stored(CrossPicture, fits=lambda value: len(value.places_px) == 6),
    "LaserEntries": Stored(LaserEntries),
    "LaserReadings": Stored(LaserReadings),
    "LaserCalibration": Stored(LaserCalibration),
    "PlanePicture": Stored(PlanePicture),
    "BenchEntries": Stored(BenchEntries),
    "MirrorEntry": Stored(MirrorEntry),
    "PlaneCalibration": Stored(PlaneCalibration, fits=_plane_fits),
    "BoardCalibration": Stored(BoardCalibration, fits=_boards_fit),
    "BoardCorners": Stored(
        BoardCorners, shapes={"index": "n", "image_px": "n 2"}, fits=_corners_fit
    ),
    "Board": Stored(Board, fits=lambda value: value.is_possible),
    "MirrorPicture": Stored(
        MirrorPicture,
        shapes=dict.fromkeys(("ray", "dot_px", "computed_px", "residual_mm"), "n 2"),
        fits=lambda value: (
            value.kind in ("plate", "cap", "ball")
            and len(value.independent) in (0, len(value.measured))
        ),
    ),
    "BenchCheckRecord": Stored(
        BenchCheckRecord,
        shapes=dict.fromkeys(("before", "before_sigma", "after", "after_sigma"), "q"),
        fits=lambda value: len(value.quantities) == len(value.before),
    ),
    # The experiment
    "Record": Stored(Record),
    "Recording": Stored(Recording),
    "Limits": Stored(Limits),
    "Signals": Stored(
        Signals, shapes=dict.fromkeys(("time_s", "current_a", "voltage_v", "wire_m_min"), "n")
    ),
    # Settings
    "Settings": Stored(Settings, fits=_choices_are_known),
    "DotSettings": Stored(find_dots.DotSettings),
    "BandPassSettings": Stored(dots.BandPassSettings),
    "BlockThresholdSettings": Stored(threshold_dots.BlockThresholdSettings),
    "WaveletSettings": Stored(threshold_dots.WaveletSettings),
    "LatticeSettings": Stored(find_lattice.LatticeSettings),
    "GrowSettings": Stored(lattice_growth.GrowSettings),
    "RowSearchSettings": Stored(row_search.RowSearchSettings),
    "MaskRowsSettings": Stored(row_search.MaskRowsSettings),
    "MatchSettings": Stored(MatchSettings),
    **{one.settings: Stored(one.settings_class) for one in SCHEMES.values() if one.settings},
    # Results
    "Dots": Stored(
        dots.Dots,
        shapes=dict.fromkeys(
            ("u_px", "v_px", "u_sigma_px", "v_sigma_px", "size_px", "peak", "snr"), "n"
        ),
    ),
    "Lattice": Stored(lattice.Lattice, shapes={"row": "n", "column": "n"}),
    "Correction": Stored(Correction),
    "Trial": Stored(Trial),
    "Match": Stored(
        Match,
        renamed={"witness": "ray_states"},
        shapes={
            "dot": "n",
            "ray": "n 2",
            "reflected": "n 2",
            "plane_mm": "n 2",
            "plane_covariance_mm2": "n 2 2",
            "ray_states": "rows columns",
        },
        fits=_match_fits,
    ),
    "SplineBasis": Stored(SplineBasis, shapes={"x_knots": "x", "y_knots": "y"}),
    "SplineSurface": Stored(SplineSurface, shapes={"coefficients": "n"}, fits=_spline_fits),
    "Boundary": Stored(Boundary, shapes={"center_mm": "2", "theta_deg": "m", "points_mm": "m 3"}),
    "Reconstruction": Stored(
        Reconstruction,
        retired=("variants",),
        fits=_scheme_is_known,
        shapes={
            "ray": "n 2",
            "points_mm": "n 3",
            "residual_mm": "n 2",
            "sigma_mm": "n",
            "size_sigma": "9",
            "size_sigma_level": "9",
            "size_sigma_setup": "9",
        },
    ),
    "Measures": Stored(Measures),
    "Measurement": Stored(Measurement, fits=_measurement_fits),
    "LineFrame": Stored(LineFrame, fits=_lines_fit),
    "PoolEdges": Stored(
        PoolEdges, shapes={"line": "n", "side": "n", "point_mm": "n 2", "sigma_mm": "n"}
    ),
    "LineCorrection": Stored(LineCorrection, shapes={"number": "k"}, fits=_line_correction_fits),
    "TrackedLine": Stored(TrackedLine, shapes={"u_px": "n", "v_px": "n"}),
    "LineFeatures": Stored(LineFeatures),
    "LinesSeen": Stored(LinesSeen),
    "LightLine": Stored(
        LightLine,
        shapes={
            "image_px": "n 2",
            "tangent": "n 2",
            "sigma_px": "n",
            "curvature": "n",
            "ends_px": "2 2",
            "cut": "2",
        },
    ),
    "LineSurface": Stored(
        LineSurface,
        shapes={"covariance": "p p", "numbers": "k", "point_mm": "n 3", "renumbered": "q r"},
        fits=_line_surface_fits,
    ),
    "SetupVerdict": Stored(SetupVerdict),
    "Suspect": Stored(ResidualSuspect),
}
"""Classes in a session, by their names there."""

NAMES = {stored.kind: name for name, stored in STORED.items()}
