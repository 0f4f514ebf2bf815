"""Detection of implausible set-up values: most are errors of the unit or by a factor of two.

A surface absorbs most errors of a set-up, so that residuals do not reveal a laser distance that is
ten times too large or an electrode height in centimetres. The limits are wide: the dissertation's
benches and those that the adviser proposes are well within them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from labapp.core.geometry.line_pattern import line_rig
from labapp.core.geometry.optics import intersect_imaging_plane
from labapp.core.geometry.perturbation import quantity_values
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import INDEX

Range = tuple[float, float]

USUAL: dict[str, tuple[Range, str]] = {
    "laser.projection_angle_deg": ((15.0, 75.0), "°"),
    "laser.distance_mm": ((15.0, 150.0), "mm"),
    "electrode.height_mm": ((1.0, 20.0), "mm"),
    "imaging_plane.distance_mm": ((15.0, 250.0), "mm"),
    "imaging_plane.width_mm": ((25.0, 300.0), "mm"),
    "imaging_plane.height_mm": ((25.0, 300.0), "mm"),
}
"""Usual range and unit of values, by their keys in the setup file."""

NO_TORCH_MM = 100.0
"""Electrode heights of at least this mean that there is no torch."""

USUAL_FAN_DEG = 8.0, 25.0
"""Usual angle between a dot pattern's first and last ray; half and twice 13.9° lie outside."""

USUAL_SHARE = 0.09, 1.5
"""Usual coordinates of the image calibration's points on the axes, as fractions of the plane."""

BESIDE = 0.5
"""Largest distance outside the imaging plane, as a fraction of its size, at which the beam lands
after reflection by a level work piece."""


def implausible_values(rig: Rig) -> tuple[str, ...]:
    """Describe the unusual values of a rig, each with its key, value and usual range.

    Empty if the rig is exact or was checked against a known mirror.
    """
    if rig.uncertainty is None or rig.uncertainty.checked:
        return ()
    return tuple(_implausible(rig))


def _implausible(rig: Rig) -> Iterator[str]:
    plane, quantities = rig.imaging_plane, quantity_values(rig)
    value = {key: float(quantities[index]) for key, index in INDEX.items()} | {
        "electrode.height_mm": rig.electrode.height_mm,
        "imaging_plane.width_mm": plane.width_mm,
        "imaging_plane.height_mm": plane.height_mm,
    }
    for key, ((low, high), unit) in USUAL.items():
        no_torch = key == "electrode.height_mm" and value[key] >= NO_TORCH_MM
        if not low <= value[key] <= high and not no_torch:
            yield f"{key} is {value[key]:g} {unit}, usual are {low:g} to {high:g} {unit}"
    if line_rig(rig) is None:
        fan_deg = 2 * float(np.degrees(np.arctan(np.nanmax(np.abs(rig.pattern.tangents)))))
        low, high = USUAL_FAN_DEG
        if not low <= fan_deg <= high:
            key, usual = "pattern.inter_beam_angle_deg", f"usual are {low:g} to {high:g}°"
            yield f"{key} is {value[key]:g}°, which makes a fan of {fan_deg:.3g}°, {usual}"
    for axis, size in (("x", plane.width_mm), ("z", plane.height_mm)):
        key = f"image_calibration.{axis}_axis_mm"
        low, high = (share * size for share in USUAL_SHARE)
        if not low <= abs(value[key]) <= high:
            usual = f"usual are {low:.3g} to {high:.3g} mm on such a plane"
            yield f"{key} is {value[key]:g} mm, {usual}"
    yield from _beam_beside(rig)


def _beam_beside(rig: Rig) -> Iterator[str]:
    """Report where the beam lands if that is far outside the imaging plane."""
    plane, laser = rig.imaging_plane, rig.laser
    aim = np.array([laser.aim_x_mm, laser.aim_y_mm, 0.0])
    lands = intersect_imaging_plane(aim, laser.axes[0] * [1.0, 1.0, -1.0], plane)
    size = np.array([plane.width_mm, plane.height_mm])
    if np.all((lands >= -BESIDE * size) & (lands <= (1 + BESIDE) * size)):
        return
    where = "never reaches it"
    if np.isfinite(lands).all():
        where = f"lands at X′ {lands[0]:.0f}, Z′ {lands[1]:.0f} mm"
    yield (
        f"imaging_plane: the beam, reflected by a level work piece, {where}; look at s_mm, h_mm, "
        f"distance_mm and the laser's angle (the plane is {size[0]:g} × {size[1]:g} mm)"
    )
