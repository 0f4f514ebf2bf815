"""Data of the imaging-plane page: O′ and the axes, found or placed by hand, and their ±."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.config.setup_text import image_calibration_of, lens_of
from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.calibration.imaging_plane import Calibration
from labapp.core.calibration.mark_fit import Model, root_mean_square
from labapp.core.calibration.plane_calibration import (
    ANGLE_TOLERANCE_DEG,
    SCALE_TOLERANCE,
    X_UNITS,
    Z_UNITS,
    PlaneCalibration,
)
from labapp.core.values import FloatArray
from labapp.gui.digits import ResultRow, round_factor
from labapp.gui.pages.kept_picture import KeptPicture
from labapp.media import GreyImage
from labapp.session.calibrations import calibrations_in_use
from labapp.session.file.blobs import fingerprint
from labapp.session.file.stored import LARGEST_PX
from labapp.session.record import PlanePicture
from labapp.session.session import Session
from labapp.simulation.calibration.target import Target
from labapp.text import capitalized

POINTS = ("O′", "O′X′", "O′Z′")
"""Names of the three points: the origin, and the centres of the two bars."""

HAND_SIGMA_PX = 0.5
"""Standard uncertainty of a point placed by hand, px."""

UNPLACED = LARGEST_PX
"""Standard uncertainty of a point not yet placed: it may be anywhere."""

UNIT_MM = Target().unit_mm

Place = tuple[float, float]


def first_points(shape: tuple[int, int], unit_mm: float) -> PlaneCalibration:
    """Initial points, if nothing is found, in a picture of shape (rows, columns)."""
    rows, columns = shape
    side = 0.8 * min(rows, columns)
    u, v = 0.1 * columns, 0.9 * rows
    x_arm, z_arm = (sum(units) / 2 for units in (X_UNITS, Z_UNITS))
    return PlaneCalibration(
        origin_px=(u, v),
        x_axis_px=(u + x_arm / X_UNITS[1] * side, v),
        x_axis_mm=x_arm * unit_mm,
        z_axis_px=(u, v - z_arm / X_UNITS[1] * side),
        z_axis_mm=z_arm * unit_mm,
        sigma_px=(UNPLACED, UNPLACED, UNPLACED),
        threshold=0.0,
    )


def moved(found: PlaneCalibration, point: int, place: Place) -> PlaneCalibration:
    """The three-point calibration with one point placed by hand."""
    sigma = list(found.sigma_px)
    sigma[point] = HAND_SIGMA_PX
    of_point = {("origin_px", "x_axis_px", "z_axis_px")[point]: place}
    return replace(
        found,
        sigma_px=(sigma[0], sigma[1], sigma[2]),
        marks=(),
        model="three points",
        **of_point,  # type: ignore[arg-type]
    )


def with_unit(found: Calibration, unit_mm: float) -> Calibration:
    """The same points on a target of another unit; a board is unchanged."""
    if isinstance(found, BoardCalibration):
        return found
    x_mm = sum(X_UNITS) / 2 * unit_mm
    return found.with_scale(x_mm / found.x_axis_mm)


def places(found: Calibration) -> tuple[Place, Place, Place]:
    """Positions of the three points, px."""
    if isinstance(found, BoardCalibration):
        origin, on_x, on_z = (_place(point) for point in found.points_px)
        return origin, on_x, on_z
    return found.origin_px, found.x_axis_px, found.z_axis_px


@dataclass(frozen=True)
class PlaneResult:
    """Result of the points and marks."""

    rows: tuple[ResultRow, ...] = ()
    """Scales and angle with ±, and the residuals."""
    why_not: str = ""
    """Reason why they cannot be used; empty if they can."""
    warnings: tuple[str, ...] = ()
    """Warnings for the operator."""


def entries(session: Session) -> PlanePicture | None:
    """Points that are not applied yet; without any, those of the calibration in use."""
    return session.plane_entries or session.plane_calibration


def stored(
    found: Calibration, unit_mm: float, pictures: Sequence[KeptPicture]
) -> PlanePicture | None:
    """A calibration as a session stores it; None if it is no calibration at present."""
    try:
        _ = found.image_calibration
    except ValueError:  # its three points lie on one line
        return None
    first, *further = (picture.sha256 for picture in pictures)
    return PlanePicture(unit_mm, found, first, tuple(further))


def enter(session: Session, entered: PlanePicture) -> None:
    """Store points until they are applied, unless they are in use."""
    is_in_use = fingerprint(entered) == fingerprint(session.plane_calibration)
    session.set_entries("plane", None if is_in_use else entered)


def pictures(session: Session, found: PlanePicture) -> tuple[KeptPicture, ...]:
    """The pictures of a stored calibration; raises `InputError` if one is damaged."""
    keys = found.picture_sha256, *found.further_sha256
    return tuple(KeptPicture("picture", session.picture(key), key) for key in keys)


def result(found: Calibration | None) -> PlaneResult:
    """Scales, angle and their ± of a calibration, and its problems."""
    if found is None:
        return PlaneResult(why_not="Load a picture of the target or of a board first")
    if isinstance(found, BoardCalibration):
        return PlaneResult((*_scale_rows(found), *_board_rows(found)))
    try:
        _ = found.image_calibration
    except ValueError as error:
        return PlaneResult(why_not=str(error))
    waiting = [
        name for name, sigma in zip(POINTS, found.sigma_px, strict=True) if sigma == UNPLACED
    ]
    if waiting:
        are = "it is" if len(waiting) == 1 else "they are"
        return PlaneResult(why_not=f"Drag {' and '.join(waiting)} to where {are} in the picture")
    rows = _scale_rows(found) + _residual_rows(found)
    rows += [
        ResultRow(name, f"{u:.1f}, {v:.1f}", unit="px", note=f"± {sigma:.2f} px each way")
        for name, (u, v), sigma in zip(POINTS, places(found), found.sigma_px, strict=True)
    ]
    (along_x, along_z), angle = found.px_per_mm, found.angle_deg
    warnings = []
    if abs(along_x / along_z - 1) > SCALE_TOLERANCE:
        warnings.append("The scales differ more than is plausible for a camera facing the plane")
    if abs(angle - 90) > ANGLE_TOLERANCE_DEG:
        warnings.append(f"The axes are {angle:.0f}° apart, which should be about 90°")
    return PlaneResult(tuple(rows), "", tuple(warnings))


def _scale_rows(found: Calibration) -> list[ResultRow]:
    values = (*found.px_per_mm, found.angle_deg)
    sigmas = found.scales_and_angle_sigma.tolist()
    units = (("Scale along O′X′", "px/mm"), ("Scale along O′Z′", "px/mm"), ("Angle", "°"))
    return [
        ResultRow(name, value, sigma, unit)
        for (name, unit), value, sigma in zip(units, values, sigmas, strict=True)
    ]


def _board_rows(found: BoardCalibration) -> list[ResultRow]:
    """Lens and residual of a board, and the error of positions."""
    value, sigma = found.distortion_percent
    seen = f"{len(found.seen[0].index)} of {len(found.board.corners_mm)}"
    worst = float(np.hypot(*found.fit.residuals_px.T).max())
    pictures = f"Over the corners of {len(found.seen)} pictures; worst {worst:.2f} px"
    of_way = "In the picture's corner, of the way from its middle"
    of_way += "" if found.fit.lens else ": none is seen, and none is used"
    in_corners = "Standard uncertainty of a place on the plane in the picture's corners"
    return [
        ResultRow("Board", found.board.name, note=str(found.board)),
        ResultRow("Corners found", seen, note=f"{found.left_out} left out"),
        ResultRow("Distortion", value, sigma, "%", note=of_way),
        ResultRow("Residual", found.fit.rms_px, None, "px", 3, pictures),
        ResultRow("± in the corners", found.corner_sigma_mm, None, "mm", 3, in_corners),
    ]


def _residual_rows(found: PlaneCalibration) -> list[ResultRow]:
    """Residuals of each fit at the marks, and the fit in use."""
    fits = found.fits
    if fits is None:
        return []
    rows = []
    for name, fit in (("Affine", fits.affine), ("Homography", fits.homography)):
        if fit is not None:
            worst = float(np.hypot(*fit.residual_px.T).max())
            left_out, mm = root_mean_square(fit.left_out_px), root_mean_square(fit.residual_mm)
            note = (
                f"Residual, root mean square over {len(found.marks)} marks: {mm:.4f} mm on the "
                f"plane; worst {worst:.2f} px; of a mark that is left out of the fit "
                f"{left_out:.3f} px"
            )
            value = root_mean_square(fit.residual_px)
            rows.append(ResultRow(f"{name} residual", value, None, "px", 3, note))
    return rows


def choices(found: Calibration | None) -> tuple[tuple[Model, str], ...]:
    """The possible models and their names; the better fit is marked."""
    if isinstance(found, BoardCalibration):
        lens = "Homography, no lens" if found.fit.lens is None else "Lens and homography"
        return (("homography", lens),)
    if found is None or found.fits is None:
        return (("three points", "Three points"),)
    best = found.fits.best
    named: list[tuple[Model, str]] = [("affine", "Affine")]
    if found.fits.homography is not None:
        named.append(("homography", "Homography"))
    models = [(model, f"{words} (proposed)" if model == best else words) for model, words in named]
    return (*models, ("three points", "Three points"))


def why(found: Calibration | None) -> str:
    """Reason why the model is proposed."""
    if isinstance(found, BoardCalibration):
        return f"Not determined: {'; '.join(found.undetermined())}."
    if found is None or UNPLACED in found.sigma_px:
        return ""
    if found.fits is None:
        return "Only the three points are used: tick marks were not found, or points were moved"
    sentences = (found.fits.reason, *map(capitalized, found.bound_words()))
    return "\n".join(f"{words}." for words in sentences)


@dataclass(frozen=True)
class ResidualMap:
    """Residuals of the marks, enlarged."""

    begin_px: FloatArray
    end_px: FloatArray
    """Ends of arrows from the marks towards their modelled positions, shape (n, 2), px."""
    share: FloatArray
    """Lengths relative to the longest, shape (n,), 0 … 1."""
    words: str
    """Text of the enlargement and the longest residual."""


def residual_map(found: Calibration | None, height_px: int) -> ResidualMap | None:
    """Residuals of the model as arrows, enlarged for a picture of this height."""
    if isinstance(found, BoardCalibration):
        begin, residual = found.seen[0].image_px, found.residual_px
    elif found is None or found.fits is None or found.model == "three points":
        return None
    else:
        residual = found.fits.of(found.model).residual_px
        begin = np.array(found.marks)[:, 2:4]
    length = np.hypot(*residual.T)
    longest = max(float(length.max()), 1e-9)
    times = round_factor(0.1 * height_px / longest)  # at most a tenth of the picture
    words = f"Arrows: residuals × {times:g}, the longest {longest:.2f} px"
    return ResidualMap(begin, begin + times * residual, length / longest, words)


def size_warnings(session: Session, picture: GreyImage | None) -> tuple[str, ...]:
    """Warning if frames of the session have another size than a picture, else empty."""
    recording = session.recording
    if picture is None or recording is None:
        return ()
    (rows, columns), frame = picture.shape, (recording.rows, recording.columns)
    if (rows, columns) == frame:
        return ()
    return (
        f"The picture has {columns}×{rows} px, and frames have {frame[1]}×{frame[0]} px: "
        "they cannot be measured with it",
    )


def is_in_use(session: Session, found: Calibration | None) -> bool:
    """Whether the set-up contains this calibration."""
    kept = session.plane_calibration
    is_kept = kept is not None and fingerprint(kept.found) == fingerprint(found)
    return is_kept and calibrations_in_use(session)[1]


def in_use(session: Session) -> tuple[ResultRow, ...]:
    """Scales and angle of the image calibration in the set-up."""
    names = (("Scale along X′", "px/mm"), ("Scale along Z′", "px/mm"), ("Angle", "°"))
    values, sigmas = [np.nan] * 3, [None] * 3
    kept = session.plane_calibration if calibrations_in_use(session)[1] else None
    keys = tomllib.loads(session.setup_text).get("image_calibration", {})
    try:
        calibration = image_calibration_of(keys, lens_of(session.setup_text))
    except (TypeError, ValueError, KeyError):
        pass  # it is missing or wrong; the set-up page shows the reason
    else:
        x_mm, z_mm = (kept.found.x_axis_mm, kept.found.z_axis_mm) if kept else (1.0, 1.0)
        points = calibration.to_image(np.array([[0.0, 0.0], [x_mm, 0.0], [0.0, z_mm]]))
        origin, on_x, on_z = (_place(point) for point in points)
        shown = PlaneCalibration(origin, on_x, x_mm, on_z, z_mm, (0.0, 0.0, 0.0), 0.0)
        values = [*shown.px_per_mm, shown.angle_deg]
        sigmas = kept.found.scales_and_angle_sigma.tolist() if kept else sigmas
    note = "From this session's calibration" if kept else "As entered"
    return tuple(
        ResultRow(name, value, sigma, unit, 4 if unit == "px/mm" else 3, note)
        for (name, unit), value, sigma in zip(names, values, sigmas, strict=True)
    )


def axes(found: Calibration, unit_mm: float) -> tuple[FloatArray, FloatArray]:
    """Expected positions of the axes and their unit marks in the picture.

    Returns
    -------
    tuple
        Ends of the axes, shape (3, 2): O′X′'s end, O′, O′Z′'s end; and the unit marks, shape
        (n, 2); px.
    """
    if isinstance(found, BoardCalibration):
        ends = np.array([[found.x_axis_mm, 0.0], [0.0, 0.0], [0.0, found.z_axis_mm]])
        seen = found.image_calibration.to_image(found.board.corners_mm)
        return found.image_calibration.to_image(ends), seen
    x_end, z_end = X_UNITS[1], Z_UNITS[1]
    line = np.array([[x_end, 0.0], [0.0, 0.0], [0.0, z_end]]) * unit_mm
    marks = [(n, 0) for n in range(1, int(x_end) + 1)]
    marks += [(0, n) for n in range(1, int(z_end) + 1)]
    calibration = found.image_calibration
    return calibration.to_image(line), calibration.to_image(np.array(marks, float) * unit_mm)


def _place(point: FloatArray) -> Place:
    return float(point[0]), float(point[1])
