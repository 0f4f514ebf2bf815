"""Contents of a report as plain values and tables of text, before the layout."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from labapp.config.settings import differences
from labapp.config.setup import Setup
from labapp.core.calibration.seen_axes import scales_and_angle
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.pipeline import Measurement, Settings
from labapp.core.schemes.row_shape import match_row_shapes
from labapp.core.sequence.mean import series_of, sigma_of_mean
from labapp.core.surface.measures import SIZES, Measures, sigma_name
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.export.summary import format_ranges
from labapp.session.contents import SessionContents
from labapp.session.report.layout import Cells
from labapp.session.results.measured import scheme_name
from labapp.studies.measured_budget import Contribution, total
from labapp.text import pluralize

DOUBTFUL_MARGIN = 5.0
"""A frame is doubtful if the residual of another correspondence is within this factor."""

ALL_FRAMES, SOME_FRAMES = 60, 20
"""Most frames that are all listed; of more, the number listed from the start and from the end."""

NUMBER = re.compile(r"\d+(?:\.\d+)?")

UNKNOWN = "–"

STATISTICS = {
    "width_mm": ("width (mm)", 4),
    "length_mm": ("length (mm)", 4),
    "height_mm": ("height (mm)", 4),
    "depth_mm": ("depth (mm)", 4),
    "area_mm2": ("area (mm²)", 3),
    "volume_mm3": ("volume (mm³)", 4),
    "are_mm": ("ARE (mm)", 4),
    "mre_mm": ("MRE (mm)", 4),
}


@dataclass(frozen=True)
class FrameLine:
    """One frame of a report."""

    frame: int
    time_s: float
    """Number, and time or NaN."""
    status: str = ""
    reason: str = ""
    """As in `Measurement`; empty if it was not measured."""
    stale: tuple[str, ...] = ()
    """Reasons why its result is stale, one clause each."""
    corrected: bool = False
    """Whether it was measured with manually corrected dots and rows."""
    doubtful: bool = False
    """Whether another correspondence explains its dots nearly as well."""
    dots: int | None = None
    rows_allow: bool | None = None
    """Whether the shape of the reflected rows allows its correspondence (§7.1); None: unknown."""
    version: str = ""
    """Version of labapp that measured it."""
    measures: Measures | None = None
    """Its sizes; None without a surface."""

    @property
    def counts(self) -> bool:
        """Whether its sizes are included in the means."""
        return self.measures is not None and not self.stale

    @property
    def state(self) -> str:
        """State in the trends: ``measured``, ``doubtful``, ``stale`` …, else the status."""
        if self.stale:
            return "stale"
        if self.measures is None:
            return self.status or "not measured"
        if self.doubtful:
            return "doubtful"
        return "corrected by hand" if self.corrected else "measured"

    def size(self, name: str) -> float:
        """Return one of its measures; NaN without a surface."""
        return float(getattr(self.measures, name, math.nan))


@dataclass(frozen=True)
class ReportData:
    """Session, scheme and frames of a report."""

    session: SessionContents
    scheme: str
    """Name of the scheme of the results."""
    lines: list[FrameLine]
    setup: Setup | None
    """The present setup; None if it is incomplete."""
    problems: tuple[InputError, ...]
    """What is missing or wrong in it."""

    @classmethod
    def of(
        cls,
        session: SessionContents,
        scheme: str | None,
        frames: Sequence[int] | None,
        progress: Callable[[int], None] | None = None,
    ) -> ReportData:
        """Collect the data of a report; parameters as for `report_pdf`."""
        scheme = scheme or scheme_name(session.settings)
        setup: Setup | None = None
        problems: tuple[InputError, ...] = ()
        try:
            setup = session.setup
        except InputError as error:
            problems = error.problems
        lines = frame_lines(session, scheme, frames, progress)
        return cls(session, scheme, lines, setup, problems)


def frame_lines(
    session: SessionContents,
    scheme: str,
    frames: Sequence[int] | None,
    progress: Callable[[int], None] | None = None,
) -> list[FrameLine]:
    """Return one line per frame from its result; a damaged result has the status ``damaged``.

    ``progress`` is called with the number of frames done; it may raise to stop.

    Raises
    ------
    InputError
        If the session does not have a requested frame.
    """
    seen = session.overview(scheme)
    times = dict(zip(seen.frame.tolist(), seen.time_s.tolist(), strict=True))
    numbers = list(times) if frames is None else sorted({int(frame) for frame in frames})
    for number in numbers:
        if number not in times:
            raise InputError(session.path, "frame", number, "frames of the session")
    status = dict(zip(seen.frame.tolist(), seen.status, strict=True))
    lines = []
    for done, number in enumerate(numbers, 1):
        line = FrameLine(number, times[number])
        if status[number]:
            line = _frame_line(session, scheme, number, times[number])
        lines.append(line)
        if progress is not None:
            progress(done)
    return lines


def _frame_line(session: SessionContents, scheme: str, number: int, time_s: float) -> FrameLine:
    try:
        result = session.result(number, scheme)
    except InputError as error:
        return FrameLine(number, time_s, "damaged", f"the result is damaged: {error.value}")
    if result is None:
        return FrameLine(number, time_s)
    found = result.measurement
    return FrameLine(
        frame=number,
        time_s=time_s,
        status=found.status,
        reason=found.reason,
        stale=result.stale,
        corrected=found.correction is not None,
        doubtful=is_doubtful(found),
        dots=None if found.dots is None else len(found.dots),
        rows_allow=None
        if found.match is None
        else match_row_shapes(found.match).allows(found.match.orientation),
        version=result.version,
        measures=found.measures,
    )


def rows_sentence(lines: Iterable[FrameLine]) -> str:
    """State in how many frames the shape of the rows allows the correspondence (§7.1)."""
    checked = [line for line in lines if line.rows_allow is not None]
    if not checked:
        return ""
    others = [line.frame for line in checked if not line.rows_allow]
    words = (
        f"The shape of the reflected rows (§7.1) agrees with the correspondence in "
        f"{len(checked) - len(others)} of {pluralize(len(checked), 'frame')}"
    )
    return f"{words}, not in {format_ranges(others, ' to ', 6)}." if others else f"{words}."


def is_doubtful(measurement: Measurement) -> bool:
    """Whether another correspondence explains the dots nearly as well."""
    return measurement.match is not None and measurement.match.residual_ratio < DOUBTFUL_MARGIN


def representative(lines: Iterable[FrameLine]) -> FrameLine | None:
    """Return the frame whose height is nearest to the median; None if no frame counts.

    For concave pools the depth is compared.
    """
    counted = [line for line in lines if line.counts]
    if not counted:
        return None
    peak = np.array([[line.size("height_mm"), line.size("depth_mm")] for line in counted])
    peak = peak[:, int(np.abs(peak).sum(axis=0).argmax())]
    return counted[int(np.abs(peak - np.median(peak)).argmin())]


def values(lines: Iterable[FrameLine], name: str) -> FloatArray:
    """Return the finite values of a measure over the frames that count, shape (n,)."""
    found = np.array([line.size(name) for line in lines if line.counts])
    return np.asarray(found[np.isfinite(found)], np.float64)


def number(value: float | None, digits: int) -> str:
    """Format a number with fixed decimals, without the sign of −0; a dash if unknown."""
    return UNKNOWN if value is None or not math.isfinite(value) else f"{value:z.{digits}f}"


def with_unit(value: float | None, unit: str) -> str:
    """Format a number with its unit; empty if None."""
    return "" if value is None else f"{value:.6g} {unit}"


def status_cells(lines: Sequence[FrameLine]) -> Cells:
    """Tabulate outcomes with reason, number of frames and frame numbers; those that count first."""
    groups: dict[tuple[str, str], list[FrameLine]] = {}
    for line in lines:
        status, why = _outcome(line)
        # Sentences that differ in numbers only are one reason; the first is shown.
        groups.setdefault((status, NUMBER.sub("#", why)), []).append(line)
    ranked = sorted(groups.items(), key=lambda item: (item[0][0] != "in the mean", item[0]))
    rows = [
        [*_outcome(found[0]), str(len(found)), format_ranges([line.frame for line in found])]
        for _, found in ranked
    ]
    return [["outcome", "why", "frames", "which"], *rows]


def _outcome(line: FrameLine) -> tuple[str, str]:
    if line.stale:
        return "stale, left out", "; ".join(line.stale)
    if not line.status:
        return "not measured", ""
    if line.measures is not None:
        return "in the mean", ""
    return line.status, line.reason


def statistics_cells(lines: Sequence[FrameLine]) -> Cells:
    """Tabulate mean and ±, standard deviation (Eq. 7-2 … 7-4), extremes, range, ± of a frame."""
    rows = []
    series = series_of([line.measures for line in lines if line.counts and line.measures])
    for name, (label, digits) in STATISTICS.items():
        found = values(lines, name)
        if not len(found):
            continue
        figures: list[float] = [found.mean(), sigma_of_mean(name, series), found.std()]
        figures += [found.min(), found.max(), np.ptp(found)]
        sigma = values(lines, sigma_name(name))
        figures.append(np.median(sigma) if len(sigma) else math.nan)
        rows.append([label, str(len(found)), *(number(float(f), digits) for f in figures)])
    head = ["quantity", "frames", "mean", "±", "std. dev.", "least", "largest", "range", "± each"]
    return [head, *rows]


def frame_cells(lines: Sequence[FrameLine]) -> Cells:
    """Tabulate sizes and state of every frame; of more than `ALL_FRAMES` the first and last."""
    head = ["frame", "time (s)", "dots", *("width", "length", "height", "volume", "ARE"), "state"]
    shown = list(lines)
    if len(shown) > ALL_FRAMES:
        shown = [*shown[:SOME_FRAMES], *shown[-SOME_FRAMES:]]
    rows = [
        [
            str(line.frame),
            number(line.time_s, 4),
            UNKNOWN if line.dots is None else str(line.dots),
            *(number(line.size(f"{name}_mm"), 4) for name in ("width", "length", "height")),
            number(line.size("volume_mm3"), 4),
            number(line.size("are_mm"), 4),
            line.state,
        ]
        for line in shown
    ]
    if len(shown) < len(lines):
        left_out = [["…", *[""] * (len(head) - 2), f"{len(lines) - len(shown)} frames"]]
        rows = rows[:SOME_FRAMES] + left_out + rows[SOME_FRAMES:]
    return [head, *rows]


def budget_cells(
    lines: Sequence[FrameLine], contributions: Sequence[Contribution], rig: Rig
) -> Cells:
    """Tabulate the ± from dots and fit, from each quantity of the set-up, and from all together."""
    digits = [STATISTICS[name][1] for name in SIZES]
    noise = np.array([_median_without_setup(lines, name) for name in SIZES])
    rows = [["dots and fit (median)", "", *_row(noise, digits)]]
    rows += [
        [
            f"{one.name}{'*' if one.assumed else ''}",
            f"{one.sigma:.2g} {one.unit}",
            *_row(np.abs(one.change), digits),
        ]
        for one in contributions
    ]
    rows.append(["all together", "", *_row(total(noise, contributions, rig), digits)])
    return [["source", "±", *(STATISTICS[name][0] for name in SIZES)], *rows]


def _median_without_setup(lines: Sequence[FrameLine], name: str) -> float:
    """Return the median ± of a size from noise and level; NaN if there is none."""
    each = np.array(
        [
            [line.size(sigma_name(name, part)) for part in ("", "setup")]
            for line in lines
            if line.counts and math.isfinite(line.size(sigma_name(name)))
        ]
    )
    if not len(each):
        return math.nan
    whole, setup = each.T**2
    return float(np.sqrt(np.median(np.maximum(whole - np.nan_to_num(setup), 0.0))))


def _row(figures: FloatArray, digits: Sequence[int]) -> list[str]:
    return [number(float(f), d) for f, d in zip(figures, digits, strict=True)]


def settings_cells(settings: Settings) -> Cells:
    """Tabulate the settings that differ from the defaults."""
    rows = [
        [name, str(value), str(default)]
        for name, (value, default) in differences(settings, Settings()).items()
    ]
    return [["setting", "value", "default"], *rows]


def rig_cells(setup: Setup, status: str = "") -> Cells:
    """Tabulate the rig and the image calibration, with units and the set-up's status."""
    rig, plane = setup.rig, setup.rig.imaging_plane
    absent = ", ".join(f"({i}, {j})" for i, j in sorted(rig.pattern.absent_rays)[:8])
    x, y, z = plane.origin_mm
    step = 1e-3
    seen = setup.calibration.to_image(step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    origin, (along_x, along_z, angle) = seen[0], scales_and_angle(seen, step, step)
    return [
        ["part", "quantity", "value"],
        ["set-up", "status", status],
        ["laser", "projection angle α", f"{rig.laser.projection_angle_deg:.6g} °"],
        ["", "distance to the origin", f"{rig.laser.distance_mm:.6g} mm"],
        *_unless_zero("azimuth", rig.laser.azimuth_deg, "°"),
        *_unless_zero("aim along X", rig.laser.aim_x_mm, "mm"),
        *_unless_zero("aim along Y", rig.laser.aim_y_mm, "mm"),
        ["dot pattern", "rows × columns", f"{rig.pattern.rows} × {rig.pattern.columns}"],
        ["", "kind", rig.pattern.kind],
        ["", "inter-beam angle β", f"{rig.pattern.inter_beam_angle_deg:.6g} °"],
        *_unless_zero("rotation about the beam axis", rig.pattern.rotation_deg, "°"),
        ["", "absent rays (i, j)", absent + (" …" if len(rig.pattern.absent_rays) > 8 else "")],
        ["electrode", "height of the tip", f"{rig.electrode.height_mm:.6g} mm"],
        ["torch", "moves towards", rig.travel.upper().replace("-", "−")],
        ["imaging plane", "distance D: O′ at Y = −D", f"{-y:.6g} mm"],
        ["", "s: O′ at X = −s", f"{-x:.6g} mm"],
        ["", "h: O′ at Z = h", f"{z:.6g} mm"],
        ["", "width × height", f"{plane.width_mm:.6g} × {plane.height_mm:.6g} mm"],
        *_tilt_rows(plane),
        ["", "glass on the pool's side", _glass(plane)],
        ["image calibration", "O′ in the picture (u, v)", f"{origin[0]:.2f}, {origin[1]:.2f} px"],
        ["", "scale along O′X′", f"{along_x:.4f} px/mm"],
        ["", "scale along O′Z′", f"{along_z:.4f} px/mm"],
        ["", "angle between the axes", f"{angle:.3f} °"],
        *_unless_zero(
            "distortion in the plane's corner", setup.calibration.distortion_percent, "%"
        ),
    ]


def _unless_zero(quantity: str, value: float, unit: str) -> Cells:
    return [["", quantity, f"{value:.4g} {unit}"]] if value else []


def _glass(plane: ImagingPlane) -> str:
    if not plane.glass_mm:
        return "none"
    return f"{plane.glass_mm:.4g} mm, refractive index {plane.glass_index:.4g}"


def _tilt_rows(plane: ImagingPlane) -> Cells:
    if np.abs(plane.angles_deg).max() < 1e-7:
        return [["", "pose", "vertical, square to Y"]]
    angles = ", ".join(f"{angle:.4g} °" for angle in plane.angles_deg)
    return [["", "pitch, yaw, roll", angles]]


def corrections_cells(session: SessionContents, frames: Sequence[int]) -> Cells:
    """Tabulate the corrected frames: dots, manual dots, blocked rows."""
    rows = []
    seen = session.overview()
    corrected = set(seen.frame[seen.corrected].tolist())
    for frame in frames:
        correction = session.correction(frame) if frame in corrected else None
        if correction is not None:
            blocked = sorted(correction.lattice.blocked_rows)
            rows.append(
                [
                    str(frame),
                    str(len(correction.dots)),
                    str(int(correction.manual.sum())),
                    f"blocked rows {', '.join(map(str, blocked))}" if blocked else "",
                ]
            )
    return [["frame", "dots", "manual dots", ""], *rows]
