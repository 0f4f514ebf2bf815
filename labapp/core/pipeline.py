"""Measure a frame: the steps of the measurement in order.

1. `tuned_dots`, or `find_dots` for another detector: the reflected dots of the frame (§5.2.1).
2. `find_lattice`: their rows and columns in the picture, as far as they can be determined (§5.2.2).
   A frame that is not matched keeps them, numbered as on the imaging plane (`number_on_plane`).
3. `match_rays`: which ray made which dot (§4.2.2); then rows and columns are those of the rays.
4. `fit.fit_surface`, or `reconstruct` for another scheme: the pool's surface (ch. 6, 7).
5. `fit.bound_and_measure`, or `measure_surface` for another scheme: its size and reflection errors
   (Eq. 6-3 … 6-8); with fit also its boundary.

If the operator corrected the frame, the corrected dots and rows replace the results of steps 1
and 2. With a prior from the previous frame, dots are matched to the predicted dots (`track`),
which needs no rows; the other steps are the same.

A line pattern is measured differently (`measure_lines`): its points do not identify their rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.line_pattern import LineRig, line_rig
from labapp.core.geometry.rig import Rig
from labapp.core.images.band_pass import quick_dots, tuned_dots
from labapp.core.images.dots import Dots, Image
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.images.peaks import DetectorTuning
from labapp.core.images.visibility import glare
from labapp.core.lines.correction import LineCorrection
from labapp.core.lines.frame import LineFrame, measure_lines
from labapp.core.match import Candidate, Match, RowsOpen
from labapp.core.matching.checks.unexplained import NOTHING_EXPLAINS
from labapp.core.matching.corrected_rows import lattice_of_corrected, match_corrected
from labapp.core.matching.match_rays import lattice_of_match, match_rays
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import Observation
from labapp.core.rows.correction import Correction
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice import Lattice, number_on_plane
from labapp.core.schemes import SCHEMES, ers, fit, irs, modal, zonal
from labapp.core.surface import measures
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import CannotMeasure

if TYPE_CHECKING:  # the module compiles: it is loaded where a frame is measured
    from labapp.core.sequence.prior import Prior

OnStep = Callable[[str], None]
"""Called with the name of a completed step, see `measure`."""

FrameCorrection = Correction | LineCorrection
"""The operator's correction of a frame: dots and rows, or the lines of a line pattern."""


@dataclass(frozen=True)
class Settings:
    """Settings of a measurement.

    Parameters
    ----------
    scheme
        One of `SCHEMES`.
    algorithm
        Algorithm of the scheme, for IRS ``opa``, ``epa-r``, ``epa-c`` or ``epa-rc``. Overrides
        that in the scheme's settings; for one that the scheme does not have, it uses its first.
    correspondence
        ``auto``, or the orientation to use (`match.Orientation`). Overrides that of ``match``.
    dots, lattice, match
        Settings of steps 1 to 3.
    fit, ers, irs, zonal, modal
        Settings of the schemes; only those of ``scheme`` are used.
    """

    scheme: str = "fit"
    algorithm: str = "opa"
    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    dots: DotSettings = field(default_factory=DotSettings)
    lattice: LatticeSettings = field(default_factory=LatticeSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    ers: ers.ErsSettings = field(default_factory=ers.ErsSettings)
    irs: irs.IrsSettings = field(default_factory=irs.IrsSettings)
    zonal: zonal.ZonalSettings = field(default_factory=zonal.ZonalSettings)
    modal: modal.ModalSettings = field(default_factory=modal.ModalSettings)


@dataclass(frozen=True, repr=False)
class Measurement:
    """Results of the completed steps for one frame.

    Parameters
    ----------
    status
        ``ok``, or one word for the reason that there is no surface.
    reason
        The reason in one sentence; empty if the status is ``ok``.
    scheme
        Scheme requested.
    dots, lattice, match, reconstruction, measures
        Results of steps 1 to 5; None from the first step that failed. The lattice may also be None
        if no step failed, because rays can be identified without it.
    correction
        The operator's dots and rows, or lines; None if they were detected automatically.
    setup_status
        Reliability of the set-up (`RigUncertainty.status`); empty if it is exact.
    lines
        Results for a line pattern; None for a dot pattern, whose results are the fields above.
    """

    status: str
    reason: str
    scheme: str
    dots: Dots | None = None
    lattice: Lattice | None = None
    match: Match | None = None
    reconstruction: Reconstruction | None = None
    measures: measures.Measures | None = None
    correction: FrameCorrection | None = None
    setup_status: str = ""
    lines: LineFrame | None = None

    def __repr__(self) -> str:
        return f"<labapp measurement: {self.summary}>"

    @property
    def summary(self) -> str:
        """Status and scheme, and the height or the reason that there is none."""
        words = [self.status, self.scheme]
        if self.measures is not None:
            words.append(self.measures.summary)
        elif self.reason:
            words.append(self.reason)
        return ", ".join(words)


@dataclass(frozen=True, kw_only=True, repr=False)
class OpenMeasurement(Measurement):
    """An ``ambiguous-rows`` frame, whose rows other frames of the recording may determine."""

    candidates: tuple[Candidate, ...]

    @property
    def refused(self) -> Measurement:
        """The measurement without the candidates."""
        return Measurement(**{each.name: getattr(self, each.name) for each in fields(Measurement)})

    def decided(self, match: Match, rig: Rig, settings: Settings) -> Measurement:
        """Complete the measurement with the match of one of the candidates."""
        assert self.dots is not None
        lattice = lattice_of_match(match, rig, len(self.dots))
        result = replace(self.refused, status="ok", reason="", lattice=lattice, match=match)
        try:
            return _by_scheme(result, match, rig, settings)
        except CannotMeasure as why:
            return replace(result, status=why.status, reason=why.reason)


def setup_status(rig: Rig) -> str:
    """Reliability of a rig (`Measurement`)."""
    return "" if rig.uncertainty is None else rig.uncertainty.status


def measure(
    image: Image,
    bench: Bench,
    settings: Settings,
    prior: Prior | None = None,
    correction: FrameCorrection | None = None,
    on_step: OnStep = lambda _: None,
    dots: Dots | None = None,
) -> tuple[Measurement, Prior | None]:
    """Measure the pool in a frame. A bad frame raises no error: the status gives the reason.

    Parameters
    ----------
    image
        Grey frame, shape (height, width), any real type.
    bench
        Bench on which the frame was recorded.
    settings
        See `Settings`.
    prior
        Prior from the previous frame: dots are then matched to the dots that it predicts. If the
        prediction fails, the status is ``track-lost`` or another that is not ``ok``.
        None: the frame is measured independently.
    correction
        The operator's dots and rows, or lines, which are used instead of automatic detection; of
        the image only the shape and the glare (`images.visibility.glare`) are then used. Ignored
        if it is for the other kind of pattern.
    on_step
        Called when a step of an uncorrected frame is completed, with its name: ``dots``; with fit
        also ``surface``, when rays and surface are known, and ``measures``.
    dots
        The frame's dots if they have been found with the tuning of the prior (`quick_dots`).

    Returns
    -------
    measurement, prior
        The results, and the prior for the next frame; None if there is no surface that can be
        tracked.
    """
    result = Measurement(
        "ok", "", settings.scheme, correction=correction, setup_status=setup_status(bench.rig)
    )
    if (lines_rig := line_rig(bench.rig)) is not None:
        return _with_lines(result, image, lines_rig, bench), None
    rig, match_settings = bench.rig, replace(settings.match, correspondence=settings.correspondence)
    frame_shape, previous = (image.shape[0], image.shape[1]), None
    tracked, tuning, initial = None, None, None
    try:
        if isinstance(correction, Correction):
            dots, lattice = correction.dots, correction.lattice
            result = replace(result, dots=dots, lattice=lattice)
            observed = _observed(image, dots, bench, None)
            match, initial = match_corrected(observed, lattice, match_settings)
            lattice = lattice_of_corrected(match, rig, lattice)
        elif prior is not None:
            from labapp.core.sequence.tracking import track

            if dots is None:
                dots = _dots_by_tuning(image, prior.tuning, settings.dots)
            result = replace(result, dots=dots)
            on_step("dots")
            tracked = track(prior, _observed(image, dots, bench, prior.tuning), match_settings)
            match, previous = tracked.match, prior.carried_over()
            lattice = lattice_of_match(match, rig, len(dots))
        else:
            dots, tuning = _dots_and_tuning(image, settings.dots)
            on_step("dots")
            found, no_rows = _lattice_or_why(dots, frame_shape, settings.lattice)
            numbered = found and number_on_plane(found, dots, bench.calibration)
            result = replace(result, dots=dots, lattice=numbered)
            observed = _observed(image, dots, bench, tuning)
            match, initial = _match_or_why(observed, numbered, no_rows, match_settings)
            lattice = lattice_of_match(match, rig, len(dots))
        result = replace(result, match=match, lattice=lattice)
        if settings.scheme != "fit":
            return _by_scheme(result, match, rig, settings), None
        pool = tracked.pool if tracked else fit.fit_surface(match, rig, settings.fit, initial)
        on_step("surface")
        reconstruction, measured = fit.bound_and_measure(match, pool, rig, previous)
    except CannotMeasure as why:
        return _refused(result, why), None
    on_step("measures")
    result = replace(result, reconstruction=reconstruction, measures=measured)
    if prior is not None and tracked is not None:
        return result, prior.after(tracked, reconstruction, measured)
    from labapp.core.sequence.prior import Prior

    if tuning is None:
        return result, None
    return result, Prior.of(bench, tuning, match, pool, reconstruction, measured)


def _observed(image: Image, dots: Dots, bench: Bench, tuning: DetectorTuning | None) -> Observation:
    """The dots on the imaging plane, and where the frame hides others."""
    shape = image.shape[0], image.shape[1]
    return Observation.of(dots, bench, shape, glare(image, dots, tuning))


def _by_scheme(result: Measurement, match: Match, rig: Rig, settings: Settings) -> Measurement:
    """Add surface and measures from the match alone; also for fit, when other frames decided it."""
    made = reconstruct(match, rig, settings)
    measured = measures.measure_surface(made, match, rig)
    return replace(result, reconstruction=made, measures=measured)


def _with_lines(result: Measurement, image: Image, rig: LineRig, bench: Bench) -> Measurement:
    """Measure a frame of a line pattern."""
    by_hand = result.correction if isinstance(result.correction, LineCorrection) else None
    found = measure_lines(image, rig, bench.calibration, by_hand)
    return replace(result, status=found.status, reason=found.reason, lines=found)


def _dots_and_tuning(image: Image, settings: DotSettings) -> tuple[Dots, DetectorTuning | None]:
    """Find the dots, and the default detector's tuning for the following frames."""
    if settings.method == "band-pass":
        return tuned_dots(image, settings.band_pass)
    return find_dots(image, settings), None


def _dots_by_tuning(image: Image, tuning: DetectorTuning, settings: DotSettings) -> Dots:
    """Find the dots with the tuning of a previous frame, which must have the same size."""
    if image.shape != tuning.noise.shape:
        from labapp.core.sequence.tracking import TrackLost

        raise TrackLost("the frame differs in size from the previous frame")
    return quick_dots(image, tuning, settings.band_pass)


def start_correction(measurement: Measurement) -> Correction:
    """Return the frame's correction, or a new one made from the detected dots and rows.

    A new one has a reference only if the frame was matched: without a match, a conspicuous hole in
    the rows is only a candidate.

    Parameters
    ----------
    measurement
        Measurement of the frame.
    """
    if isinstance(measurement.correction, Correction):
        return measurement.correction
    lattice = measurement.lattice
    if lattice is not None and measurement.match is None:
        lattice = replace(lattice, reference=None)
    return Correction.of(measurement.dots, lattice)


def reconstruct(match: Match, rig: Rig, settings: Settings) -> Reconstruction:
    """Reconstruct the surface by the scheme of the settings.

    Raises
    ------
    CannotMeasure
        If the scheme finds no surface.
    """
    scheme = SCHEMES[settings.scheme]
    options: Any = getattr(settings, scheme.name) if scheme.settings else None
    if scheme.algorithms:
        options = replace(options, algorithm=scheme.algorithm(settings.algorithm))
    return scheme.reconstruct(match, rig, options)


def _refused(result: Measurement, why: CannotMeasure) -> Measurement:
    """Measurement of a frame without a surface.

    An `OpenMeasurement` if other frames may decide its rows and the operator has not set them.
    """
    result = replace(result, status=why.status, reason=why.reason)
    if isinstance(why, RowsOpen) and result.correction is None:
        return OpenMeasurement(**vars(result), candidates=why.candidates)
    return result


def _match_or_why(
    observed: Observation,
    lattice: Lattice | None,
    no_lattice: CannotMeasure | None,
    settings: MatchSettings,
) -> tuple[Match, SplineSurface]:
    """Match the rays (`match_rays`); if nothing explains the dots, give the error of the rows."""
    try:
        return match_rays(observed, lattice, settings)
    except CannotMeasure as why:
        nothing = why.reason == NOTHING_EXPLAINS
        raise (no_lattice if no_lattice and nothing else why) from None


def _lattice_or_why(
    dots: Dots, frame_shape: tuple[int, int], settings: LatticeSettings
) -> tuple[Lattice | None, CannotMeasure | None]:
    """Find rows and columns, or the error: the rays may still be identified without them."""
    try:
        return find_lattice(dots, frame_shape, settings), None
    except CannotMeasure as why:
        return None, why
