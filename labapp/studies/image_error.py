"""Image processing error and measurement error: frames of known surfaces, measured (§8.1, §8.2).

Frames are rendered and go through the whole measurement, beginning with the dots. Exact reflections
of the same surface show the errors of the same scheme with perfect image processing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import AxisPoints
from labapp.core.pipeline import Measurement
from labapp.core.pipeline import measure as measure_frame
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import exact_match
from labapp.simulation.parallel import Progress, in_parallel
from labapp.simulation.pools import Pool, spherical_cap
from labapp.simulation.render import Look, RenderedFrame, render
from labapp.studies import SCHEME_NAMES
from labapp.studies.error_analysis import circle_settings, scheme_errors, trace_once
from labapp.studies.parameter_deviation import KnownPool, nominal
from labapp.studies.tables import Cell, Table
from labapp.text import pluralize

TACK = spherical_cap(9.75, 0.91)
"""The thumb tack of §8.2."""

TACK_RIG = Rig(
    Laser(30.56, 46.4),
    DotPattern(),
    Electrode(5.0),
    ImagingPlane.vertical(40.69, 50.8, 0.0),
)
"""Set-up of the thumb tack. The text gives neither the electrode's height nor O′: the height is
taken from Table 4-1, and the 4″ plane stands on the paper, its centre opposite the torch."""

BENCH = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(5.0),
    ImagingPlane.vertical(50.0, 50.8, 0.0),
)
"""The set-up of §8.3.1 with torch and 4″ plane."""

VIEW = CameraView.rolled((24.0, 500.0), 4.7, x_axis_mm=50.8, z_axis_mm=50.8)
VIEW = replace(VIEW, width_px=526, height_px=526)
"""A camera that sees the whole plane."""

LOOK = Look(dot_peak=60.0)

WRONG_PX = 3.0
"""A dot farther than this from the true dot of its ray has the wrong ray."""

TACK_TEXT = {"irs": (0.1777, 0.014903, 0.220807), "ers": (0.0912, 0.014903, 0.18815)}
"""Height error, diameter error, and ARE in mm, from §8.2."""


@dataclass(frozen=True)
class FrameErrors(ReadOnlyArrays):
    """Results for one rendered frame by each of s schemes."""

    status: str
    errors: FloatArray
    """Relative errors of height (or depth) and diameter, signed, and ARE in mm, shape (s, 3); NaN
    without a surface.
    """
    exact: FloatArray
    """The same for exact reflections, shape (s, 3)."""
    off_px: FloatArray
    """Distance of each matched dot from its true position, shape (n,)."""
    missed: int
    """Number of visible dots without a ray."""

    @property
    def wrong(self) -> int:
        """Number of dots with a wrong ray."""
        return int((self.off_px > WRONG_PX).sum())


def axes_of(view: CameraView) -> AxisPoints:
    """The image calibration of a view, by the three points of §5.1."""
    calibration = ImageCalibration.from_three_points(
        view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm
    )
    return AxisPoints(calibration, view.x_axis_mm, view.z_axis_mm)


def exactly_seen(cap: Pool, rig: Rig) -> KnownPool:
    """A known pool with its dots at their true positions; those that miss the plane are lost."""
    return KnownPool(cap, exact_match(trace_once(cap, rig)), rig, nominal(axes_of(VIEW)))


def frame_errors(
    caps: Sequence[Pool],
    rig: Rig,
    frames: int,
    *,
    schemes: Sequence[str] = SCHEME_NAMES,
    progress: Progress | None = None,
    workers: int | None = None,
) -> list[list[FrameErrors]]:
    """Measure rendered frames of known surfaces by every scheme: errors of each frame of each."""
    tasks = [(cap, rig, k, tuple(schemes)) for cap in caps for k in range(frames)]
    found = in_parallel(_frame_errors, tasks, "frames", progress, workers)
    return [found[n * frames : (n + 1) * frames] for n in range(len(caps))]


def rendered(cap: Pool, rig: Rig, number: int) -> RenderedFrame:
    """Render one of the frames of a known surface; it is the same at each call."""
    seed = [round(1000 * cap.footprint.width_mm), round(1000 * abs(cap.peak_mm)), number]
    return render(trace_once(cap, rig), VIEW, LOOK, np.random.default_rng(seed))


def _frame_errors(task: tuple[Pool, Rig, int, tuple[str, ...]]) -> FrameErrors:
    cap, rig, number, schemes = task
    known = exactly_seen(cap, rig)
    exact = np.array([_sizes(known, scheme) for scheme in schemes])
    frame = rendered(cap, rig, number)
    bench = Bench(rig, known.uncertainty.axes.calibration)
    seen, _ = measure_frame(frame.image, bench, circle_settings(schemes[-1]))
    off, missed = _off(seen, frame)
    errors = np.full_like(exact, np.nan)
    if seen.match is not None:
        as_seen = replace(known, match=seen.match)
        errors = np.array([_sizes(as_seen, scheme) for scheme in schemes])
    return FrameErrors(seen.status, errors, exact, off, missed)


def _sizes(known: KnownPool, scheme: str) -> FloatArray:
    try:
        return np.array(scheme_errors(known.match, known.rig, known.cap, scheme))
    except CannotMeasure:
        return np.full(3, np.nan)


def _off(seen: Measurement, frame: RenderedFrame) -> tuple[FloatArray, int]:
    """Distance of the matched dots from the truth, px, and number of visible dots without a ray."""
    if seen.match is None or seen.dots is None:
        return np.zeros(0), int(frame.shown.sum())
    found = seen.dots.image_px[seen.match.dot]
    true = frame.dot_px[tuple(seen.match.ray.T - 1)]
    off = np.nan_to_num(np.linalg.norm(found - true, axis=-1), nan=np.inf)
    return off, int(frame.shown.sum()) - int((off <= WRONG_PX).sum())


def thumb_tack_table(frames: Sequence[FrameErrors], schemes: Sequence[str] = SCHEME_NAMES) -> Table:
    """Measurement error of §8.2: exact reflections, rendered frames, and values of the text."""
    rows = []
    for k, scheme in enumerate(schemes):
        exact = np.abs(frames[0].exact[k])
        each = np.abs([frame.errors[k] for frame in frames])
        published = TACK_TEXT.get(scheme, (None,) * 3)
        for name, n, unit in (("height", 0, 100), ("diameter", 1, 100), ("ARE", 2, 1)):
            known = each[np.isfinite(each[:, n]), n] * unit
            text = published[n]
            row: dict[str, Cell] = {
                "scheme": scheme,
                "error": f"{name}, {'%' if unit == 100 else 'mm'}",
                "exact": float(unit * exact[n]),
                "frames_mean": float(known.mean()) if len(known) else None,
                "frames_worst": float(known.max()) if len(known) else None,
                "frames_measured": len(known),
                "text": None if text is None else unit * text,
            }
            rows.append(row)
    return Table.of(
        "measurement_error",
        f"Measurement error on the thumb tack of §8.2: exact reflections, and "
        f"{pluralize(len(frames), 'frame')}",
        rows,
    )


def image_error_table(
    caps: Sequence[Pool],
    found: Sequence[Sequence[FrameErrors]],
    schemes: Sequence[str] = SCHEME_NAMES,
) -> Table:
    """Image processing error: difference between rendered frames and exact reflections; dots."""
    rows = []
    for surface, sign in (("convex", 1), ("concave", -1)):
        frames = [
            frame
            for cap, each in zip(caps, found, strict=True)
            if cap.peak_mm * sign > 0
            for frame in each
        ]
        if not frames:
            continue
        off = np.concatenate([frame.off_px for frame in frames])
        right = off[off <= WRONG_PX]
        dots: dict[str, Cell] = {
            "dot_rms_px": float(np.sqrt(np.mean(right**2))) if len(right) else None,
            "dots_missed": int(sum(frame.missed for frame in frames)),
            "labels_wrong": int(sum(frame.wrong for frame in frames)),
        }
        for k, scheme in enumerate(schemes):
            added = 100 * np.abs([frame.errors[k] - frame.exact[k] for frame in frames])
            known = added[np.isfinite(added[:, 0])]
            sizes = {
                f"{size}_{what}_pct": float(of(known[:, n])) if len(known) else None
                for n, size in enumerate(("height", "diameter"))
                for what, of in (("mean", np.mean), ("worst", np.max))
            }
            counts = {"frames": len(frames), "measured": len(known)}
            rows.append({"surface": surface, "scheme": scheme, **counts, **sizes, **dots})
    return Table.of(
        "image_processing_error",
        "Image processing error on the caps of §8.3.1: what rendered frames add, %; dots",
        rows,
    )
