"""The error analysis of chapter 8, part by part, and the error budget of a set-up.

A part consists of tables and pictures by file name: the command writes them, the window shows them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from labapp.errors import InputError
from labapp.studies import SCHEME_NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from labapp.config.setup import Setup
    from labapp.core.geometry.rig import Rig
    from labapp.simulation.parallel import Progress
    from labapp.simulation.pools import Pool
    from labapp.studies.error_analysis import ErrorSurvey
    from labapp.studies.tables import Table

PARTS = ("CE", "LE", "ME", "measurement", "images", "parameters")
"""Parts of the analysis."""

TABLES = {
    **dict.fromkeys(("CE", "LE", "ME"), ("errors", "are", "errors_by_cap")),
    "measurement": ("measurement_error",),
    "images": ("image_processing_error",),
    "parameters": ("parameter_deviation",),
}
"""Names of the tables of each part."""

FIGURES = {"CE": (6, 7), "LE": (8, 9), "ME": (10, 11)}
"""Numbers of the figures in chapter 8 that show errors and ARE."""


@dataclass(frozen=True)
class AnalysisOptions:
    """Options of the error analysis of chapter 8."""

    parts: tuple[str, ...] = PARTS
    """Some of `PARTS`."""
    schemes: tuple[str, ...] = SCHEME_NAMES
    step: float = 2.0
    """Step between places of the laser, degrees and mm (LE, ME)."""
    frames: int = 3
    """Frames rendered of each surface (measurement, images)."""
    draws: int = 400
    """Monte Carlo draws of the calibration (parameters)."""
    picture: str = "png"


@dataclass(frozen=True)
class AnalysisPart:
    """Result of a part of the analysis."""

    tables: tuple[Table, ...]
    pictures: Mapping[str, bytes]
    """File name → content."""
    printed: tuple[Table, ...]
    """Tables to print: the short and complete ones."""

    @property
    def files(self) -> dict[str, bytes]:
        """All files: name → content."""
        return {
            **{f"{table.name}.csv": table.csv().encode() for table in self.tables},
            **{f"{table.name}.md": table.markdown().encode() for table in self.tables},
            **self.pictures,
        }


def analyze_errors(
    options: AnalysisOptions, progress: Progress | None = None
) -> Iterator[AnalysisPart]:
    """Compute the chosen parts, one after the other.

    CE, LE and ME share their tables, which grow with each. ``progress`` may raise to stop.
    """
    yield from _surveys(options, progress)
    for name, part in (
        ("measurement", _measurement),
        ("images", _images),
        ("parameters", _parameters),
    ):
        if name in options.parts:
            yield part(options, progress)


def _surveys(options: AnalysisOptions, progress: Progress | None) -> Iterator[AnalysisPart]:
    from labapp.studies import error_analysis, pictures

    done: list[ErrorSurvey] = []
    kinds = [kind for kind in FIGURES if kind in options.parts]
    for kind in kinds:
        found = error_analysis.survey(kind, options.schemes, options.step, progress=progress)
        done.append(found)
        short = (error_analysis.error_table(done), error_analysis.are_table(done))
        errors, ares = FIGURES[kind]
        drawn = {
            f"figure_8_{errors}_{kind}": pictures.error_picture(found),
            f"figure_8_{ares}_{kind}_are": pictures.are_picture(found),
        }
        tables = (*short, error_analysis.cap_table(done))
        yield AnalysisPart(
            tables, drawn_files(drawn, options.picture), short if kind == kinds[-1] else ()
        )


def _measurement(options: AnalysisOptions, progress: Progress | None) -> AnalysisPart:
    from labapp.studies import image_error, pictures

    found = image_error.frame_errors(
        [image_error.TACK],
        image_error.TACK_RIG,
        options.frames,
        schemes=options.schemes,
        progress=progress,
    )
    frame = image_error.rendered(image_error.TACK, image_error.TACK_RIG, 0)
    drawn = {"figure_8_2_thumb_tack": pictures.frame_picture(frame)}
    table = image_error.thumb_tack_table(found[0], options.schemes)
    return AnalysisPart((table,), drawn_files(drawn, options.picture), (table,))


def _images(options: AnalysisOptions, progress: Progress | None) -> AnalysisPart:
    from labapp.simulation.pools import caps_8_3_1
    from labapp.studies import image_error

    caps = caps_8_3_1()
    found = image_error.frame_errors(
        caps,
        image_error.BENCH,
        options.frames,
        schemes=options.schemes,
        progress=progress,
    )
    table = image_error.image_error_table(caps, found, options.schemes)
    return AnalysisPart((table,), {}, (table,))


def _parameters(options: AnalysisOptions, progress: Progress | None) -> AnalysisPart:
    import numpy as np

    from labapp.core.geometry.uncertainty import QUANTITIES
    from labapp.simulation.pools import spherical_cap
    from labapp.studies import image_error, pictures
    from labapp.studies import parameter_deviation as deviation

    found, drawn = {}, {}
    for surface, height in (("convex", 0.3), ("concave", -0.3)):
        known = image_error.exactly_seen(spherical_cap(6.0, height), image_error.BENCH)
        for scheme in options.schemes:
            found[surface, scheme] = deviation.parameter_deviation(
                known, scheme, draws=options.draws, progress=progress
            )
        uncertain = np.flatnonzero(known.uncertainty.sigma)
        names = [QUANTITIES[k].name for k in uncertain]
        values = {
            str(one): 100 * np.abs(found[surface, one].contribution[uncertain, 0])
            for one in options.schemes
        }
        label = f"standard uncertainty of the height, {surface} 6 mm × 0.3 mm (%)"
        drawn[f"parameter_deviation_{surface}"] = pictures.bars_picture(names, values, label)
    table = deviation.deviation_table(found)
    return AnalysisPart((table,), drawn_files(drawn, options.picture), (table,))


def drawn_files(figures: Mapping[str, Figure], kind: str) -> dict[str, bytes]:
    """Pictures by file name, PNG or SVG."""
    from labapp.studies.plotting import as_bytes

    return {f"{name}.{kind}": as_bytes(figure, kind) for name, figure in figures.items()}


# --- the budget of a set-up -----------------------------------------------------------------------


def analyze_budget(
    setup: Setup | None, pool: Pool, progress: Progress | None = None
) -> AnalysisPart:
    """Compute the predicted and simulated error budget of a set-up for a kind of pool.

    Parameters
    ----------
    setup
        The set-up. None: that of §8.3.1 with a 4″ plane and the uncertainties
        `parameter_deviation.NOMINAL`.
    pool
        The kind of pool: see `expected_pool`.
    progress
        May raise to stop.

    Raises
    ------
    InputError
        If the pattern of the set-up consists of lines, or no such pool gives a surface.
    """
    import numpy as np

    from labapp.studies.pictures import bars_picture
    from labapp.studies.predicted_budget import budget_table, predicted_budget

    if setup is not None and setup.line_rig is not None:
        raise InputError("the error budget", "pattern", "lines", "a pattern of dots")
    found = predicted_budget(_rig(setup), pool, progress)
    if found.empty:
        foot = pool.footprint
        length = foot.head_mm + foot.tail_mm
        size = f"{foot.width_mm:g} × {length:g} × {pool.peak_mm:g} mm"
        right = f"a larger pool: none of {len(found.random)} pools like it gives a surface"
        raise InputError("the expected pool", "size", size, right)
    table = budget_table(found)
    names, *columns = zip(*table.rows, strict=True)
    predicted, simulated = (np.array(column, float) for column in columns)  # None becomes NaN
    values = {"predicted": predicted, "simulated": simulated}
    label = f"standard uncertainty of the height, fit (% of {abs(pool.peak_mm):g} mm)"
    drawn = {table.name: bars_picture(names, values, label)}
    return AnalysisPart((table,), drawn_files(drawn, "png"), (table,))


def _rig(setup: Setup | None) -> Rig:
    """The rig of a set-up with uncertainty, or else that of chapter 8."""
    from labapp.studies.image_error import BENCH, VIEW, axes_of
    from labapp.studies.parameter_deviation import nominal

    if setup is None or setup.rig.uncertainty is None:
        return replace(BENCH, uncertainty=nominal(axes_of(VIEW)))
    return setup.rig


def expected_pool(width: float, length: float, height: float) -> Pool:
    """Ellipsoidal pool of a width, length and height, mm; a concave pool has a negative height.

    Raises
    ------
    InputError
        If no pool can have this size.
    """
    from labapp.simulation.pools import ellipsoidal_cap

    for name, value, low in (("width", width, 1), ("length", length, 1), ("height", height, 0.01)):
        if not low <= abs(value) <= 30 or (low == 1 and value < 0):
            expected = f"{low} to 30 mm" + " or the same below 0" * (name == "height")
            raise InputError("the expected pool", name, value, expected)
    try:
        return ellipsoidal_cap(width, length, height)
    except ValueError as error:
        raise InputError(
            "the expected pool", "height", height, f"a possible pool: {error}"
        ) from error
