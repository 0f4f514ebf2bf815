"""Frame → Measurement: the steps of the measurement, in order, and nothing else.

1. `find_dots`: the reflected dots of the frame (§5.2.1).
2. `find_lattice`: their rows and columns in the picture, as far as they can be told (§5.2.2).
3. `match_rays`: which ray made which dot (§4.2.2); then rows and columns are those of the rays.
4. `reconstruct`: the pool's surface and boundary, by the scheme that is chosen (ch. 6, 7).
5. `measure_surface`: its size and the reflection errors (Eq. 6-3 … 6-8).

Of a frame that the operator has corrected, his dots and rows take the place of steps 1 and 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.images.dots import Dots, Image
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.match import Match
from labapp.core.matching.corrected_rows import lattice_of_corrected, match_corrected
from labapp.core.matching.correspondence import lattice_of_match, match_rays
from labapp.core.matching.decision import NOTHING_EXPLAINS, MatchSettings
from labapp.core.rows.correction import Correction
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
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
        Of IRS: ``opa``, ``epa-r``, ``epa-c`` or ``epa-rc``. It goes before that of ``irs``.
    correspondence
        ``auto``, or the orientation to use (`match.Orientation`). It goes before that of ``match``.
    dots, lattice, match
        Settings of steps 1 to 3.
    fit, ers, irs
        Settings of the schemes; only those of ``scheme`` count.
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
    """The results of the steps for one frame, as far as they went.

    Parameters
    ----------
    status
        ``ok``, or one word for why there is no surface.
    reason
        The same in a sentence; empty if all went well.
    scheme
        Which scheme was asked for.
    dots, lattice, match, reconstruction, measures
        Results of steps 1 to 5; None from the step on that could not be done. The lattice may be
        None before that, too: rays can be told without.
    correction
        The operator's dots and rows; None if they are as they were found.
    setup_status
        How far the set-up can be relied on (`RigUncertainty.status`); empty where it is exact.
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
    setup_status: str = ""


def setup_status(rig: Rig) -> str:
    """How far a rig can be relied on (`Measurement`)."""
    return "" if rig.uncertainty is None else rig.uncertainty.status


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
        The frame's dots and rows as the operator has them; they are measured in place of what would
        be found, and of the image only the shape counts.
    """
    result = Measurement(
        "ok", "", settings.scheme, correction=correction, setup_status=setup_status(rig)
    )
    height, width = image.shape
    match_settings = replace(settings.match, correspondence=settings.correspondence)
    bench = (rig, calibration, (height, width), match_settings)
    try:
        if correction is None:
            dots = find_dots(image, settings.dots)
            result = replace(result, dots=dots)
            lattice, no_lattice = _lattice_or_why(dots, (height, width), settings.lattice)
            result = replace(result, lattice=lattice)
            try:
                match = match_rays(dots, lattice, *bench)
            except CannotMeasure as why:
                nothing = why.reason == NOTHING_EXPLAINS
                raise (no_lattice if no_lattice and nothing else why) from None
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
    except CannotMeasure as why:
        return replace(result, status=why.status, reason=why.reason)


def start_correction(measurement: Measurement) -> Correction:
    """The correction that a frame was measured with, or one that begins with what was found.

    The latter has a reference only where the frame was matched: a hole that stands out among the
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


def _lattice_or_why(
    dots: Dots, frame_shape: tuple[int, int], settings: LatticeSettings
) -> tuple[Lattice | None, CannotMeasure | None]:
    """Rows and columns, or why there are none: the optics may still tell the rays."""
    try:
        return find_lattice(dots, frame_shape, settings), None
    except CannotMeasure as why:
        return None, why
