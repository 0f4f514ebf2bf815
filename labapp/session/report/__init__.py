"""The report of a session as PDF: set-up, calibrations, results, error budget, corrections."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np
import scipy

from labapp.config.setup import Setup
from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.errors import InputError
from labapp.media.base import format_frame_rate
from labapp.session.calibrations import calibrations_in_use
from labapp.session.checklist import ticked
from labapp.session.contents import SessionContents
from labapp.session.report import data, figures
from labapp.session.report.data import ReportData, number, with_unit
from labapp.session.report.layout import Story
from labapp.session.report.results import (
    add_budget,
    add_corrections,
    add_example,
    add_results,
)
from labapp.version import VERSION


def report_pdf(
    session: SessionContents,
    scheme: str | None = None,
    frames: Sequence[int] | None = None,
    now: datetime.datetime | None = None,
    progress: Callable[[int], None] | None = None,
) -> bytes:
    """Return a report on a session as PDF, A4; sections without content say so.

    Parameters
    ----------
    scheme
        Scheme of the results; None: that of the settings.
    frames
        Frames to report; None: all frames of the session.
    now
        Date of the report; None: the present time. The same session, libraries and date give the
        same bytes.
    progress
        Called with the number of frames done; may raise to stop.

    Raises
    ------
    InputError
        If the session does not have a requested frame, or is damaged.
    """
    now = now or datetime.datetime.now().astimezone()
    report = ReportData.of(session, scheme, frames, progress)
    title = session.record.title or session.path.stem
    story = Story()
    _experiment(story, report, title)
    _set_up(story, report)
    _laser(story, report)
    _plane(story, report)
    _bench_check(story, report)
    add_results(story, report)
    add_example(story, report)
    add_budget(story, report)
    add_corrections(story, report)
    name = session.path.name
    header = name if title == session.path.stem else f"{title}  ·  {name}"
    made = f"labapp {VERSION}, {now:%Y-%m-%d %H:%M}"
    return story.pdf(header, made, title)


def _experiment(story: Story, report: ReportData, title: str) -> None:
    session, record = report.session, report.session.record
    story.title(title)
    story.text(
        "Three-dimensional surface of a weld pool, measured from a reflected laser dot matrix."
    )
    story.heading("1  Experiment")
    size = (record.expected_width_mm, record.expected_length_mm, record.expected_height_mm)
    expected = " × ".join("?" if part is None else f"{part:.6g}" for part in size)
    before = len(story.flowables)
    story.listing(
        [
            ("operator", record.operator),
            ("material", record.material),
            ("thickness", with_unit(record.thickness_mm, "mm")),
            ("current", with_unit(record.current_a, "A")),
            ("voltage", with_unit(record.voltage_v, "V")),
            ("travel speed", with_unit(record.travel_speed_mm_s, "mm/s")),
            ("shielding gas", record.gas),
            ("gas flow", with_unit(record.gas_flow_l_min, "l/min")),
            (
                "expected pool",
                "" if size == (None, None, None) else f"{expected} mm (width × length × height)",
            ),
            ("notes", record.notes),
        ]
    )
    if len(story.flowables) == before:
        story.text("Nothing was noted about the experiment.")
    if record.safety:
        story.part("Safety and preparation")
        story.listing([(time.replace("T", " "), item) for item, time in ticked(record)])
    else:
        story.text("No item of the checklists was ticked.")
    story.part("Recording")
    _recording(story, session)
    story.part("Measured by")
    versions = sorted({line.version for line in report.lines if line.version})
    story.listing(
        [
            ("session file", session.path.name),
            ("scheme", report.scheme),
            ("measured with", ", ".join(f"labapp {v}" for v in versions) or "nothing measured yet"),
            (
                "reported with",
                f"labapp {VERSION}, Python {platform.python_version()}, "
                f"NumPy {np.__version__}, SciPy {scipy.__version__}, OpenCV {cv2.__version__}",
            ),
        ]
    )
    changed = data.settings_cells(session.settings)
    if len(changed) > 1:
        story.table("Settings that differ from the defaults.", changed, "lll", (0.5, 0.25, 0.25))
    else:
        story.text("All settings are the defaults.")


def _recording(story: Story, session: SessionContents) -> None:
    recording = session.recording
    if recording is None:
        story.text("No recording was imported.")
        return
    start, stop, step = recording.selected
    used = f"{len(session.frames)} of {recording.frames}: {start} to {stop - 1}"
    rate = recording.frame_rate_hz
    source = "given at import" if recording.rate_is_given else "the recording's own"
    exact = "yes, checked at import" if recording.frame_exact else "no"
    story.listing(
        [
            ("file", recording.path),
            ("content", recording.description),
            ("size", f"{recording.size} bytes"),
            ("SHA-256", recording.sha256),
            ("frames used", used + (f", in steps of {step}" if step > 1 else "")),
            ("frame rate", "unknown" if rate is None else f"{format_frame_rate(rate)} ({source})"),
            ("frame-exact", exact),
            ("kept in the session", "yes, lossless" if recording.embedded else "no"),
            ("imported", recording.imported.replace("T", " ")),
            *(("warning", warning) for warning in recording.warnings),
        ]
    )
    if (missing := session.missing_recording) is not None:
        story.text(
            f"The recording is missing ({missing.name}): the results are valid, but its frames "
            "cannot be shown."
        )


def _set_up(story: Story, report: ReportData) -> None:
    story.heading("2  Set-up")
    if report.setup is None:
        story.text("The set-up is not complete:")
        rows = [
            [problem.field, str(problem.value), problem.expected] for problem in report.problems
        ]
        story.table(
            "What is missing or wrong in the set-up.",
            [["key", "found", "expected"], *rows],
            "lll",
            (0.35, 0.15, 0.5),
        )
        return
    story.table(
        "The rig. UCS: origin on the work piece under the electrode's tip, Y along the welding "
        "direction, Z up.",
        data.rig_cells(report.setup, report.session.setup_status),
        "llr",
        (0.22, 0.48, 0.3),
    )
    story.figure(
        "The rig from the side, to scale: the rays of the central column, reflected from a pool of "
        "the mean measured size, else of the expected one. The width of the torch is not to scale.",
        figures.side_view(report.setup.rig, _pool_size(report)),
    )


def _pool_size(report: ReportData) -> tuple[float, float, float]:
    """Return width, length, height of the pool for the side view, mm: measured, else expected."""
    values = partial(data.values, report.lines)
    width, length = values("width_mm"), values("length_mm")
    if len(length):
        height, depth = values("height_mm").mean(), values("depth_mm").mean()
        return float(width.mean()), float(length.mean()), float(max(height, depth, key=abs))
    return report.session.record.expected_size_mm


def _laser(story: Story, report: ReportData) -> None:
    story.heading("3  Calibrations")
    story.part("Laser (Appendix I)")
    readings = report.session.laser_calibration
    if readings is None:
        story.text("Not calibrated in this session: values were given.")
        return
    found = readings.found
    rows = []
    for name, lengths in (
        ("l₁, towards the laser", readings.l1_mm),
        ("l₂, away from it", readings.l2_mm),
        ("l₃, across", readings.l3_mm),
    ):
        spread = float(np.std(lengths, ddof=1)) if len(lengths) > 1 else None
        shown = ", ".join(f"{length:.6g}" for length in lengths)
        rows.append([name, shown, number(float(np.mean(lengths)), 3), number(spread, 3)])
    story.table(
        f"Half lengths of the cross as read, mm; fan angle {readings.fan_angle_deg:.6g}°. Spread: "
        "standard deviation of the readings.",
        [["length", "readings", "mean", "spread"], *rows],
        "llrr",
        (0.25, 0.45, 0.15, 0.15),
    )
    story.listing(
        [
            ("projection angle", f"{found.angle_deg:.3f} ± {found.angle_sigma_deg:.3f} °"),
            ("distance", f"{found.distance_mm:.3f} ± {found.distance_sigma_mm:.3f} mm"),
            ("height", f"{found.height_mm:.3f} ± {found.height_sigma_mm:.3f} mm"),
            ("horizontal", f"{found.horizontal_mm:.3f} ± {found.horizontal_sigma_mm:.3f} mm"),
            ("l₁ that follows", f"{found.expected_l1_mm:.3f} mm"),
            *(("warning", warning) for warning in found.warnings),
        ]
    )
    if report.setup is not None and not calibrations_in_use(report.session)[0]:
        story.text(_changed("The rig's laser", report.setup))


def _changed(what: str, setup: Setup) -> str:
    by = "adjusted by the bench check" if setup.check_date else "changed"
    return f"{what} was {by} after this calibration: other values are in use."


def _plane(story: Story, report: ReportData) -> None:
    story.part("Imaging plane (§5.1)")
    plane = report.session.plane_calibration
    if plane is None:
        story.text("Not calibrated in this session: values were given.")
        return
    found = plane.found
    is_board = isinstance(found, BoardCalibration)
    if isinstance(found, BoardCalibration):
        points, sigmas = found.points_px.tolist(), found.points_sigma_px
    else:
        points = [list(place) for place in (found.origin_px, found.x_axis_px, found.z_axis_px)]
        sigmas = found.sigma_px
    on_axis = "last corner" if is_board else "middle of the bar"
    places = ("0, 0", f"{found.x_axis_mm:.6g}, 0", f"0, {found.z_axis_mm:.6g}")
    rows = [
        [name, where, number(u, 2), number(v, 2), number(sigma, 2)]
        for name, where, (u, v), sigma in zip(
            ("O′", f"{on_axis} on O′X′", f"{on_axis} on O′Z′"),
            places,
            points,
            sigmas,
            strict=True,
        )
    ]
    along_x, along_z = found.px_per_mm
    x_sigma, z_sigma, angle_sigma = found.scales_and_angle_sigma
    unit = "a square of the board" if is_board else "a unit of the axes"
    story.table(
        f"Points found in the calibration picture; {unit} is {plane.unit_mm:.6g} mm. "
        f"Scale {along_x:.4f} ± {x_sigma:.4f} px/mm along O′X′, "
        f"{along_z:.4f} ± {z_sigma:.4f} px/mm along O′Z′; "
        f"{found.angle_deg:.3f} ± {angle_sigma:.3f}° between them.",
        [["point", "X′, Z′ (mm)", "u (px)", "v (px)", "± (px)"], *rows],
        "llrrr",
        (0.36, 0.22, 0.14, 0.14, 0.14),
    )
    if isinstance(found, BoardCalibration) or found.fits is not None:
        story.text("; ".join(" ".join(line.split()) for line in found.fit_lines()) + ".")
    setup = report.setup
    _, in_use = calibrations_in_use(report.session)
    if setup is not None and (setup.calibration.distortion_percent or not in_use):
        story.text(_changed("The image calibration", setup))
    try:
        picture = report.session.picture(plane.picture_sha256)
    except InputError as error:
        story.text(f"The calibration picture cannot be shown: it is {error.value}.")
        return
    story.figure(
        "The calibration picture with O′ and both axes as found.",
        figures.target_picture(picture, points),
    )


def _bench_check(story: Story, report: ReportData) -> None:
    story.part("Bench check")
    check = report.session.bench_check
    if check is None:
        story.text("The set-up was not checked against a known mirror in this session.")
        return
    rows = []
    known = (check.before, check.before_sigma, check.after, check.after_sigma)
    for key, *values in zip(check.quantities, *known, strict=True):
        if key in INDEX:
            one = QUANTITIES[INDEX[key]]
            rows.append([f"{one.name} ({one.unit})", *(number(value, 3) for value in values)])
    names = ", ".join(one.name for one in check.pictures)
    story.table(
        f"The set-up before and after it was adjusted on {check.date[:10]} to {names}.",
        [["quantity", "before", "±", "after", "±"], *rows],
        "lrrrr",
        (0.48, 0.13, 0.13, 0.13, 0.13),
    )
    sizes = [
        [one.name, f"{one.kind}, {name}", *(number(value, 3) for value in values)]
        for one in check.pictures
        for name, *values in one.measured
    ]
    story.table(
        "Sizes of the mirrors, measured with the adjusted set-up as if they were unknown; "
        "±: dot noise only.",
        [["picture", "mirror", "known (mm)", "measured (mm)", "± (mm)"], *sizes],
        "llrrr",
        (0.3, 0.22, 0.16, 0.18, 0.14),
    )
    if report.setup is not None and not report.setup.check_date:
        story.text("The set-up was changed after this check: it is not checked.")
