"""Data of the surface page for a frame, computed from the session. Without Qt."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.lines.frame import LineFrame
from labapp.core.lines.region import between_lines
from labapp.core.match import Match
from labapp.core.pipeline import Measurement, Settings
from labapp.core.schemes import scheme_words
from labapp.core.surface.measures import Measures, sigma_name
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray
from labapp.export.rendering.heights import Profile
from labapp.export.rendering.scene import Colour, Scene, rays_of, scene_of
from labapp.gui.digits import ResultRow, round_factor
from labapp.session.results.measured import Overview, Result, scheme_name
from labapp.session.session import Session
from labapp.text import HEIGHT_SIGMA_OF, SIGMA_OF, local_time, marked_setup_words, setup_words

SCHEMES = scheme_words()
"""Stored name of a scheme → text for the operator."""

SCHEME_CHOICES = [(name, words.long) for name, words in SCHEMES.items()]

CORRESPONDENCES = {
    "auto": "Automatic",
    "S/S": "S/S: columns and rows as the rays",
    "S/I": "S/I: rows inverse",
    "I/I": "I/I: columns and rows inverse",
}

SIZES = (
    ("Width", "width_mm", "width_sigma_mm", "mm", "Extent of the boundary along X"),
    ("Length", "length_mm", "length_sigma_mm", "mm", "Extent of the boundary along Y"),
    ("Height", "height_mm", "height_sigma_mm", "mm", "Largest z within the boundary"),
    ("Depth", "depth_mm", "depth_sigma_mm", "mm", "Smallest z within the boundary"),
    ("Area", "area_mm2", "area_sigma_mm2", "mm²", "Within the boundary, seen from above"),
    ("Volume", "volume_mm3", "volume_sigma_mm3", "mm³", "Between surface and work piece"),
)
"""Label, names of value and σ in `Measures`, unit, and explanation."""

ERRORS = (
    ("ARE", "are_mm", "Average reflection error: computed from captured dots (Eq. 6-3)"),
    ("MRE", "mre_mm", "Maximum reflection error (Eq. 6-4)"),
    ("ARE-I", "are_inner_mm", "Average reflection error of the inside points"),
    ("MRE-I", "mre_inner_mm", "Maximum reflection error of the inside points"),
    (
        *("Own ARE", "own_are_mm"),
        "ARE of the scheme's own points, as in the dissertation: the boundary is not in it",
    ),
)
"""Label, name in `Measures`, and explanation; the last is shown if the scheme gives it."""

NO_SIGMA = "This scheme gives no ±"

NO_SIGMA_OF_LEVEL = "It is the level of the work piece, which has no ±"


def with_scheme(settings: Settings, name: str) -> Settings:
    """Copy of settings with a scheme, given by its name in `SCHEMES`."""
    scheme, _, algorithm = name.partition("-")
    changed: dict[str, object] = {"scheme": scheme}
    if algorithm:
        changed["algorithm"] = algorithm
    return replace(settings, **changed)  # type: ignore[arg-type]


EITHER_NUMBERS = (
    "The lines can have other numbers, which give the same height: the surface may lie elsewhere "
    "along Y."
)


@dataclass(frozen=True)
class Options:
    """Options of the 3-D view chosen by the operator."""

    colour: Colour = "height"
    points: bool = True
    boundary: bool = True
    contours: bool = False
    work_piece: bool = True
    rays: bool = False
    electrode: bool = True
    same_colours: bool = False
    """Whether all frames share one colour scale."""
    exaggeration: float = 3.0
    """Factor by which heights are exaggerated."""
    section: tuple[float, float] | None = (90.0, 0.0)
    """Angle, degrees, and offset, mm, of the section line; None without one."""


@dataclass(frozen=True)
class SurfaceState:
    """Data shown for one frame."""

    result: Result | None
    """Stored result; None if it was not measured by the scheme."""
    state: Literal["measured", "stale", "failed", "unmeasured"]
    words: str
    """Text of the result, or the reason why there is no surface or it is stale."""
    setup_words: str = ""
    """Text of the reliability of the set-up."""
    provenance: str = ""
    """Frame, scheme, version, time, and whether dots or lines were corrected by hand."""
    sizes: tuple[ResultRow, ...] = ()
    errors: tuple[ResultRow, ...] = ()
    """Rows of the tables; empty without a surface."""
    trials: tuple[ResultRow, ...] = ()
    """The tested correspondences, and their errors."""
    verdict: str = ""
    """Text of how clear the choice among them is."""

    @property
    def reconstruction(self) -> Reconstruction | None:
        """The surface; None if there is none."""
        return None if self.result is None else pool_of(self.result.measurement)


def pool_of(measurement: Measurement) -> Reconstruction | None:
    """Surface of a measurement; for lines that between them, if they determine it."""
    if measurement.lines is None:
        return measurement.reconstruction
    surface = measurement.lines.surface
    return between_lines(surface) if surface is not None and surface.status == "ok" else None


def line_size_rows(found: LineFrame) -> tuple[ResultRow, ...]:
    """Rows of height and width under lines that determine them; otherwise empty."""
    surface = found.surface
    if surface is None or found.status != "ok":
        return ()
    x, y, z = surface.peak_mm.tolist()
    under = f"At X {x:.2f}, Y {y:.2f} mm, under the lines; ± has no part by the set-up"
    between = "Between the ends of the lines; ± has no part by the set-up"
    name = "Height" if z >= 0 else "Depth"
    return (
        ResultRow(name, z, surface.height_sigma_mm, "mm", note=under),
        ResultRow("Width", surface.width_mm, surface.width_sigma_mm, "mm", note=between),
    )


def shown(session: Session, frame: int) -> SurfaceState:
    """Data to show for a frame measured by the scheme of the settings.

    Raises
    ------
    InputError
        If the stored data are damaged.
    """
    if not len(session.frames):
        return SurfaceState(
            None, "unmeasured", "There are no frames yet: import a recording first."
        )
    result = session.result(frame)
    if result is None:
        scheme = SCHEMES[scheme_name(session.settings)].title
        return SurfaceState(None, "unmeasured", f"Frame {frame} is not measured by {scheme} yet.")
    measurement = result.measurement
    if measurement.lines is not None:
        state, words = _state(result)
        sizes = line_size_rows(measurement.lines)
        about = _setup_words(result)
        return SurfaceState(result, state, words, about, provenance(result), sizes)
    return SurfaceState(
        result,
        *_state(result),
        setup_words=_setup_words(result),
        provenance=provenance(result),
        sizes=size_rows(measurement.measures),
        errors=error_rows(measurement.measures),
        trials=trial_rows(measurement.match),
        verdict=verdict(measurement.match),
    )


def _state(result: Result) -> tuple[Literal["measured", "stale", "failed"], str]:
    measurement = result.measurement
    failed = measurement.status != "ok"
    words = "Measured."
    if measurement.status == "profile":
        words = (
            "A profile only: the lines leave a direction of the surface open, so that no height "
            "is given. What the lines show is in step Pattern."
        )
    elif measurement.lines is not None and not failed:
        words = "Measured between the lines; nothing is known of the pool beyond them."
        surface = measurement.lines.surface
        if surface is not None and not surface.numbered:
            words += f" {EITHER_NUMBERS}"
    elif measurement.status == "followed":
        words = "The line is followed, but one line gives no surface. Its motion is in step Trends."
    elif measurement.measures is not None and np.isnan(measurement.measures.width_sigma_mm):
        words = f"Measured. {NO_SIGMA}."
    elif failed:
        reason = f": {measurement.reason}" if measurement.reason else ""
        words = f"No surface ({measurement.status}){reason}."
    if result.stale:
        was = words if failed else "These figures are out of date."
        return "stale", f"{was} Since then {' and '.join(result.stale)}."
    if failed:
        return "failed", words
    return "measured", words


def _setup_words(result: Result) -> str:
    status = result.measurement.setup_status
    if result.stale or result.measurement.status != "ok" or not status:
        return ""
    return marked_setup_words(
        status, setup_words(status, result.parsed_setup.check_date, result.doubt)
    )


def provenance(result: Result) -> str:
    """Origin of a result in one line."""
    marks = "dots" if result.measurement.lines is None else "lines"
    by_hand = result.measurement.correction is not None
    found = f"{marks} {'corrected by hand' if by_hand else 'found automatically'}"
    scheme = SCHEMES[result.scheme].title if result.scheme in SCHEMES else result.scheme
    when = local_time(result.measured)
    return f"Frame {result.frame} · {scheme} · {found} · labapp {result.version} · {when}"


def size_rows(measures: Measures | None) -> tuple[ResultRow, ...]:
    """Rows of width … volume, each with ±; empty without measures."""
    if measures is None:
        return ()
    return tuple(
        ResultRow(
            name,
            getattr(measures, value),
            getattr(measures, of_sigma) or None,
            unit,
            note=f"{note}. {_sigma_words(measures, value, unit)}",
        )
        for name, value, of_sigma, unit, note in SIZES
    )


def _sigma_words(measures: Measures, value: str, unit: str) -> str:
    """Text of the contributions to the ± of a size."""
    total, level, setup = (
        getattr(measures, sigma_name(value, part), np.nan) for part in ("", "level", "setup")
    )
    if not total > 0:  # 0 or unknown
        return NO_SIGMA_OF_LEVEL if np.isfinite(measures.width_sigma_mm) else NO_SIGMA
    if not np.isfinite(setup):
        return f"±: one σ, {HEIGHT_SIGMA_OF}"
    noise = np.sqrt(max(total**2 - np.nan_to_num(level) ** 2 - setup**2, 0.0))
    parts = (("noise", noise), ("level", level), ("set-up", setup))
    sizes = ", ".join(f"{name} {part:.2g}" for name, part in parts)
    return f"±: one σ, {SIGMA_OF} ({sizes} {unit})"


def error_rows(measures: Measures | None) -> tuple[ResultRow, ...]:
    """Rows of ARE … MRE-I, and the scheme's own ARE if it has one; empty without measures."""
    if measures is None:
        return ()
    return tuple(
        ResultRow(name, getattr(measures, value), None, "mm", decimals=4, note=note)
        for name, value, note in ERRORS
        if value != "own_are_mm" or np.isfinite(measures.own_are_mm)
    )


def trial_rows(match: Match | None) -> tuple[ResultRow, ...]:
    """Rows of the tested correspondences and their errors on the imaging plane, best first."""
    if match is None:
        return ()
    return tuple(
        ResultRow(
            f"{trial.orientation} {'✓' if trial.orientation == match.orientation else ''}".strip(),
            trial.residual_mm if np.isfinite(trial.residual_mm) else "no surface",
            None,
            "mm" if np.isfinite(trial.residual_mm) else "",
            note="Root mean square distance of computed from captured dots on the imaging plane",
        )
        for trial in match.trials
    )


def verdict(match: Match | None) -> str:
    """Text of how much better the chosen correspondence is than the next."""
    if match is None:
        return ""
    if not np.isfinite(match.residual_ratio):
        return f"{match.orientation}: no other correspondence gives a surface."
    times = match.residual_ratio
    factor = f"{times:.0f}" if times >= 10 else f"{times:.1f}"
    return f"{match.orientation}: the next best is {factor} times as far off."


def height_limits(seen: Overview) -> tuple[float, float] | None:
    """Lowest and highest height of all frames, mm; None if there are none."""
    low, high = seen.measures["depth_mm"], seen.measures["height_mm"]
    known = np.isfinite(low) & np.isfinite(high)
    if not known.any() or high[known].max() <= low[known].min():
        return None
    return float(low[known].min()), float(high[known].max())


def scene(
    measurement: Measurement,
    rig: Rig,
    options: Options,
    limits: tuple[float, float] | None,
    cut: Profile | None,
    stale: bool = False,
) -> Scene | None:
    """Scene of a measurement for the 3-D view; None without a surface.

    Parameters
    ----------
    limits
        Colour scale that all frames share, mm; None: that of this frame.
    cut
        Section to mark on the surface; None for none.
    stale
        Whether the measurement is out of date, which saved pictures say, too.
    """
    reconstruction, match = pool_of(measurement), measurement.match
    if reconstruction is None:
        return None
    made = scene_of(reconstruction, options.colour, limits if options.colour == "height" else None)
    lines = dict(made.lines_mm) if options.boundary else {}
    if cut is not None:
        known = np.isfinite(cut.height_mm)
        lines["section"] = np.column_stack([cut.place_mm[known], cut.height_mm[known]])
    return replace(
        made,
        points_mm=made.points_mm if options.points else made.points_mm[:0],
        lines_mm=lines,
        rays_mm=rays_of(reconstruction, match, rig) if options.rays and match else {},
        electrode=options.electrode,
        contours=options.contours,
        plate_mm=made.plate_mm if options.work_piece else made.plate_mm[:0],
        exaggeration=options.exaggeration,
        stamp="out of date" if stale else "",
    )


def reflected_dots(measurement: Measurement) -> tuple[FloatArray, FloatArray] | None:
    """Captured and computed dots on the imaging plane (X′, Z′), each of shape (n, 2), mm.

    NaN where the surface computes none.
    """
    match, reconstruction = measurement.match, measurement.reconstruction
    if match is None or reconstruction is None:
        return None
    return match.plane_mm, match.plane_mm + reconstruction.residual_mm


def error_scale(captured: FloatArray, computed: FloatArray) -> float:
    """Enlargement of drawn errors at which the longest fills a tenth of the picture."""
    if not len(captured):
        return 1.0
    longest = float(np.fmax.reduce(np.linalg.norm(computed - captured, axis=1), initial=0.0))
    wanted = 0.1 * float(np.ptp(captured, axis=0).max()) / max(longest, 1e-9)
    return round_factor(min(max(wanted, 1.0), 1000.0))
