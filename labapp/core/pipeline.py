"""Frame → Measurement: the seven steps of the measurement, in order, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.images.dots import Dots, Image
from labapp.core.match import Match
from labapp.core.matching.corrected_rows import lattice_of_corrected, match_corrected
from labapp.core.matching.correspondence import lattice_of_match, match_rays
from labapp.core.matching.decision import MatchSettings
from labapp.core.rows.correction import Correction
from labapp.core.rows.detection import DotSettings, LatticeSettings, find_dots, find_lattice
from labapp.core.rows.lattice import Lattice
from labapp.core.schemes import SCHEMES, ers, irs
from labapp.core.surface import measures
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import CannotMeasure


@dataclass(frozen=True)
class Settings:
    """Everything that can be chosen about a measurement.

    Parameters
    ----------
    scheme
        One of `SCHEMES`.
    algorithm
        Of IRS: ``opa``, ``epa-r``, ``epa-c`` or ``epa-rc``.
    correspondence
        ``auto``, or the one to use.
    dots, lattice, match, fit, ers, irs
        Settings of the single steps.
    """

    scheme: str = "fit"
    algorithm: irs.Algorithm = "opa"
    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    dots: DotSettings = field(default_factory=DotSettings)
    lattice: LatticeSettings = field(default_factory=LatticeSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    ers: ers.ErsSettings = field(default_factory=ers.ErsSettings)
    irs: irs.IrsSettings = field(default_factory=irs.IrsSettings)


@dataclass(frozen=True)
class Measurement:
    """What one frame gave, as far as it went.

    Parameters
    ----------
    status
        ``ok``, or one word for why there is no surface.
    reason
        The same in a sentence; empty if all went well.
    scheme
        Which scheme was asked for.
    dots, lattice, match, reconstruction, measures
        The steps' results; None from the step on that could not be done.
    correction
        What the operator put right; None if dots and rows are as they were found.
    """

    status: str
    reason: str
    scheme: str
    dots: Dots | None = None
    lattice: Lattice | None = None
    match: Match | None = None
    reconstruction: Reconstruction | None = None
    measures: measures.Measures | None = None
    correction: Correction | None = None


def measure(
    image: Image,
    rig: Rig,
    calibration: ImageCalibration,
    settings: Settings,
    correction: Correction | None = None,
) -> Measurement:
    """Measure the pool that a frame shows. Never raises for a bad frame: the status says why.

    Parameters
    ----------
    image
        Grey frame, shape (height, width), any real type.
    rig, calibration
        The bench, and how the camera sees the imaging plane.
    settings
        See `Settings`.
    correction
        The frame's dots and rows as the operator left them; they are measured in place of what
        would be found, and of the image only the shape counts.
    """
    result = Measurement("ok", "", settings.scheme, correction=correction)
    height, width = image.shape
    chosen = replace(settings.match, correspondence=settings.correspondence)
    bench = (rig, calibration, (height, width), chosen)
    try:
        if correction is None:
            dots = find_dots(image, settings.dots)
            result = replace(result, dots=dots)
            lattice, doubt = _lattice(dots, (height, width), settings.lattice)
            result = replace(result, lattice=lattice)
            try:
                match = match_rays(dots, lattice, *bench)
            except CannotMeasure as answer:
                raise (doubt if doubt and answer.status == "no-match" else answer) from None
            lattice = lattice_of_match(match, rig, len(dots))
        else:
            dots, given = correction.dots, correction.lattice
            result = replace(result, dots=dots, lattice=given)
            match = match_corrected(dots, given, *bench)
            lattice = lattice_of_corrected(match, rig, given)
        result = replace(result, match=match, lattice=lattice)
        reconstruction = reconstruct(match, rig, settings)
        size = measures.measure_surface(reconstruction, match, rig)
        return replace(result, reconstruction=reconstruction, measures=size)
    except CannotMeasure as answer:
        return replace(result, status=answer.status, reason=answer.reason)


def start_correction(measurement: Measurement) -> Correction:
    """Return the correction that a frame was measured with, or one of what was found in it.

    A reference is taken over only where the frame was matched: a hole that stands out among the
    rows is no more than a candidate until the rays agree.
    """
    if measurement.correction is not None:
        return measurement.correction
    lattice = measurement.lattice
    if lattice is not None and measurement.match is None:
        lattice = replace(lattice, reference=None)
    return Correction.of(measurement.dots, lattice)


def reconstruct(match: Match, rig: Rig, settings: Settings) -> Reconstruction:
    """Reconstruct the surface by the scheme that the settings name.

    Raises
    ------
    CannotMeasure
        If the scheme finds no surface.
    """
    scheme = SCHEMES[settings.scheme]
    own: Any = getattr(settings, scheme.name) if scheme.settings else None
    if scheme.algorithms:
        own = replace(own, algorithm=settings.algorithm)
    return scheme.reconstruct(match, rig, own)


def _lattice(
    dots: Dots, frame_shape: tuple[int, int], settings: LatticeSettings
) -> tuple[Lattice | None, CannotMeasure | None]:
    """Rows and columns, or why there are none: the optics may still tell the rays."""
    try:
        return find_lattice(dots, frame_shape, settings), None
    except CannotMeasure as answer:
        return None, answer
