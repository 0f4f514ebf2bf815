"""Frame → Measurement: the steps of the measurement, in order, and nothing else.

1. `find_dots`: the reflected dots of the frame (§5.2.1).
2. `find_lattice`: their rows and columns in the picture, as far as they can be determined (§5.2.2).
3. `match_rays`: which ray made which dot (§4.2.2); then rows and columns are those of the rays.
4. `reconstruct`: the pool's surface and boundary, by the scheme that is chosen (ch. 6, 7).
5. `measure_surface`: its size and the reflection errors (Eq. 6-3 … 6-8).

Of a frame that the operator has corrected, his dots and rows take the place of steps 1 and 2. With
a prior, what the frame before left, dots have the rays of those that it predicts there (`follow`),
and no rows are needed for it: the other steps are the same.

A line pattern has steps of its own (`measure_lines`): its points do not say which ray made them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.line_pattern import LineRig, line_rig
from labapp.core.geometry.rig import Rig
from labapp.core.images.band_pass import DetectorTuning, quick_dots, tuned_dots
from labapp.core.images.dots import Dots, Image
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.lines.correction import LineCorrection
from labapp.core.lines.frame import LineFrame, LineMeasureSettings, measure_lines
from labapp.core.match import Candidate, Match, RowsOpen
from labapp.core.matching.corrected_rows import lattice_of_corrected, match_corrected
from labapp.core.matching.correspondence import lattice_of_match, match_rays
from labapp.core.matching.decision import NOTHING_EXPLAINS, MatchSettings
from labapp.core.matching.observation import Observation
from labapp.core.rows.correction import Correction
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice import Lattice
from labapp.core.schemes import SCHEMES, ers, fit, irs, modal, zonal
from labapp.core.surface import measures
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import CannotMeasure

if TYPE_CHECKING:  # the module compiles: it is loaded where a frame is measured
    from labapp.core.sequence.prior import Prior

OnStep = Callable[[str], None]
"""Called with the name of a step that is done."""

ByHand = Correction | LineCorrection
"""A frame as the operator has it: dots and rows, or the lines of a line pattern."""


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
    fit, ers, irs, zonal, modal
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
    zonal: zonal.ZonalSettings = field(default_factory=zonal.ZonalSettings)
    modal: modal.ModalSettings = field(default_factory=modal.ModalSettings)


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
        Scheme requested.
    dots, lattice, match, reconstruction, measures
        Results of steps 1 to 5; None from the step on that could not be done. The lattice may be
        None before that, too: rays can be identified without it.
    correction
        The operator's dots and rows, or lines; None if they are as they were found.
    setup_status
        How far the set-up can be relied on (`RigUncertainty.status`); empty where it is exact.
    lines
        What the lines of a line pattern gave; None where the pattern is one of dots, which have all
        that is above.
    """

    status: str
    reason: str
    scheme: str
    dots: Dots | None = None
    lattice: Lattice | None = None
    match: Match | None = None
    reconstruction: Reconstruction | None = None
    measures: measures.Measures | None = None
    correction: ByHand | None = None
    setup_status: str = ""
    lines: LineFrame | None = None


@dataclass(frozen=True, kw_only=True)
class OpenMeasurement(Measurement):
    """An ``ambiguous-rows`` frame, of which other frames of the recording may decide the rows.

    Parameters
    ----------
    candidates
        The matches that are open.
    """

    candidates: tuple[Candidate, ...]

    @property
    def refused(self) -> Measurement:
        """The measurement by itself."""
        return Measurement(**{each.name: getattr(self, each.name) for each in fields(Measurement)})

    def decided(self, match: Match, rig: Rig, settings: Settings) -> Measurement:
        """The measurement with the match of one of the candidates, by the scheme of the settings.

        Parameters
        ----------
        match, rig, settings
            That match, the bench, and how the frame is measured.
        """
        assert self.dots is not None
        lattice = lattice_of_match(match, rig, len(self.dots))
        result = replace(self.refused, status="ok", reason="", lattice=lattice, match=match)
        try:
            return _by_scheme(result, match, rig, settings)
        except CannotMeasure as why:
            return replace(result, status=why.status, reason=why.reason)


def setup_status(rig: Rig) -> str:
    """How far a rig can be relied on (`Measurement`)."""
    return "" if rig.uncertainty is None else rig.uncertainty.status


def measure(
    image: Image,
    bench: Bench,
    settings: Settings,
    prior: Prior | None = None,
    correction: ByHand | None = None,
    on_step: OnStep = lambda _: None,
) -> tuple[Measurement, Prior | None]:
    """Measure the pool that a frame shows. Never raises for a bad frame: the status says why.

    Parameters
    ----------
    image
        Grey frame, shape (height, width), any real type.
    bench
        Bench that the frame was recorded on.
    settings
        See `Settings`.
    prior
        What the frame before left to this one: then dots get their rays where it predicts them, and
        the status is ``track-lost``, or another that is not ``ok``, where it does not lead here.
        None: the frame is measured by itself.
    correction
        The frame's dots and rows, or lines, as the operator has them; they are measured in place of
        what would be found, and of the image only the shape counts. One of the other kind of
        pattern is not used.
    on_step
        Called with the name of each step when it is done: dots, match, measures.

    Returns
    -------
    measurement, prior
        The results; what they leave to the next frame, None where there is no surface that can be
        followed.
    """
    result = Measurement(
        "ok", "", settings.scheme, correction=correction, setup_status=setup_status(bench.rig)
    )
    if (lines_rig := line_rig(bench.rig)) is not None:
        return _with_lines(result, image, lines_rig, bench), None
    rig, match_settings = bench.rig, replace(settings.match, correspondence=settings.correspondence)
    frame_shape, known = (image.shape[0], image.shape[1]), None
    followed, tuning, initial = None, None, None
    try:
        if isinstance(correction, Correction):
            dots, lattice = correction.dots, correction.lattice
            result = replace(result, dots=dots, lattice=lattice)
            match, initial = match_corrected(dots, lattice, bench, frame_shape, match_settings)
            lattice = lattice_of_corrected(match, rig, lattice)
        elif prior is not None:
            from labapp.core.sequence.following import follow

            dots = quick_dots(_as_before(image, prior), prior.tuning, settings.dots.band_pass)
            result = replace(result, dots=dots)
            on_step("dots")
            observed = Observation.of(dots, bench, frame_shape)
            followed = follow(prior, observed, settings.fit, match_settings)
            match, known = followed.match, prior.known(followed.lit)
            lattice = lattice_of_match(match, rig, len(dots))
        else:
            dots, tuning = _dots_and_tuning(image, settings.dots)
            on_step("dots")
            found_lattice, no_lattice = _lattice_or_why(dots, frame_shape, settings.lattice)
            result = replace(result, dots=dots, lattice=found_lattice)
            match, initial = _match_or_why(
                dots, found_lattice, no_lattice, bench, frame_shape, match_settings
            )
            lattice = lattice_of_match(match, rig, len(dots))
        result = replace(result, match=match, lattice=lattice)
        if settings.scheme != "fit":
            return _by_scheme(result, match, rig, settings), None
        pool = followed.pool if followed else fit.solve(match, rig, settings.fit, initial)
        on_step("match")
        reconstruction, sizes = fit.complete(match, pool, rig, settings.fit, known)
    except CannotMeasure as why:
        return _refused(result, why), None
    on_step("measures")
    result = replace(result, reconstruction=reconstruction, measures=sizes)
    if prior is not None and followed is not None:
        return result, prior.followed_by(followed, reconstruction, sizes)
    from labapp.core.sequence.prior import Prior

    if tuning is None or rig.pattern.marker is None:
        return result, None
    return result, Prior.of(bench, tuning, match, pool, reconstruction, sizes)


def _by_scheme(result: Measurement, match: Match, rig: Rig, settings: Settings) -> Measurement:
    """The result with the surface of a scheme that needs no more than the match."""
    made = reconstruct(match, rig, settings)
    size = measures.measure_surface(made, match, rig)
    return replace(result, reconstruction=made, measures=size)


def _with_lines(result: Measurement, image: Image, rig: LineRig, bench: Bench) -> Measurement:
    """The result of a frame of a line pattern."""
    by_hand = result.correction if isinstance(result.correction, LineCorrection) else None
    found = measure_lines(image, rig, bench.calibration, LineMeasureSettings(), by_hand)
    return replace(result, status=found.status, reason=found.reason, lines=found)


def _as_before(image: Image, prior: Prior) -> Image:
    """The image, which must have the size of the one before."""
    if image.shape != prior.tuning.noise.shape:
        from labapp.core.sequence.following import TrackLost

        raise TrackLost("the frame has another size than the one before")
    return image


def _dots_and_tuning(image: Image, settings: DotSettings) -> tuple[Dots, DetectorTuning | None]:
    """The dots, and what the default detector was tuned to, for the frames after this one."""
    if settings.method == "band-pass":
        return tuned_dots(image, settings.band_pass)
    return find_dots(image, settings), None


def start_correction(measurement: Measurement) -> Correction:
    """The correction that a frame was measured with, or one that begins with what was found.

    The latter has a reference only where the frame was matched: a hole that stands out among the
    rows is no more than a candidate until the rays agree.
    """
    if isinstance(measurement.correction, Correction):
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


def _refused(result: Measurement, why: CannotMeasure) -> Measurement:
    """The measurement of a frame without an answer; rows that an operator gave stay refused."""
    result = replace(result, status=why.status, reason=why.reason)
    if isinstance(why, RowsOpen) and result.correction is None:
        return OpenMeasurement(**vars(result), candidates=why.candidates)
    return result


def _match_or_why(
    dots: Dots,
    lattice: Lattice | None,
    no_lattice: CannotMeasure | None,
    bench: Bench,
    frame_shape: tuple[int, int],
    settings: MatchSettings,
) -> tuple[Match, SplineSurface]:
    """The match (`match_rays`); where nothing explains the dots, why there are no rows."""
    try:
        return match_rays(dots, lattice, bench, frame_shape, settings)
    except CannotMeasure as why:
        nothing = why.reason == NOTHING_EXPLAINS
        raise (no_lattice if no_lattice and nothing else why) from None


def _lattice_or_why(
    dots: Dots, frame_shape: tuple[int, int], settings: LatticeSettings
) -> tuple[Lattice | None, CannotMeasure | None]:
    """Rows and columns, or why there are none: the optics may still identify the rays."""
    try:
        return find_lattice(dots, frame_shape, settings), None
    except CannotMeasure as why:
        return None, why
