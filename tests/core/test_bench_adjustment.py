"""Derivatives and minimum of the bench check's adjustment, compared with other methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy

from labapp.core.bench_check.adjustment import ROBUST, Sighting, System, adjust
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import (
    INDEX,
    AxisPoints,
    RigUncertainty,
    covariance_of,
)
from labapp.core.values import FloatArray
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import PoolSurface, trace
from labapp.simulation.pools import spherical_cap
from tests.mirrors import FlatMirror
from tests.simulated_benches import BenchErrors, SimulatedBench, draw_bench

VIEW = CameraView.rolled((0.74, 558.26), 4.7)
CALIBRATION = ImageCalibration.from_three_points(
    VIEW.origin_px, VIEW.x_axis_px, VIEW.x_axis_mm, VIEW.z_axis_px, VIEW.z_axis_mm
)
COVARIANCE, ASSUMED = covariance_of({}, has_glass=True)
RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(500.0),
    replace(ImagingPlane.vertical(50.0, 45.0, 3.0), glass_mm=3.0),
    RigUncertainty(AxisPoints(CALIBRATION, VIEW.x_axis_mm, VIEW.z_axis_mm), COVARIANCE, ASSUMED),
)
MIRRORS: tuple[tuple[Mirror, PoolSurface], ...] = (
    (Plate(), FlatMirror(0.01, 0.001, -0.001)),
    (Cap(9.75, 0.91), spherical_cap(9.75, 0.91, (0.2, -0.1))),
)


def sightings_of(
    mirrors: Sequence[tuple[Mirror, PoolSurface]],
    bench: SimulatedBench,
    rng: np.random.Generator,
    gross_mm: float = 0.0,
) -> list[Sighting]:
    """Return the mirrors' noisy dots, each with its ray; some have a gross error."""
    sightings = []
    for mirror, surface in mirrors:
        reflections = trace(surface, bench.rig)
        ray = np.argwhere(reflections.visible)
        image_px = bench.view.to_image(reflections.plane_mm[reflections.visible])
        dots = CALIBRATION.to_plane(image_px + rng.normal(0, 0.12, image_px.shape))
        dots[::17] += gross_mm
        covariance = np.tile(0.026**2 * np.eye(2), (len(ray), 1, 1))
        sightings.append(Sighting(mirror, ray, dots, covariance))
    return sightings


def system(gross_mm: float = 0.0) -> System:
    """Return the equations of a misaligned bench; some of its dots have a gross error."""
    rng = np.random.default_rng(18)
    bench = draw_bench(RIG, VIEW, BenchErrors(), rng)
    return System.of(RIG, sightings_of(MIRRORS, bench, rng, gross_mm), None)


def test_jacobian_agrees_with_central_differences() -> None:
    equations = system()
    parameters = np.random.default_rng(1).normal(0, 0.5, equations.size)
    parameters[-4:] *= 0.02  # rays still hit the cap
    steps = 1e-3 * np.eye(equations.size)
    central = np.array(
        [
            (equations.residuals(parameters + s) - equations.residuals(parameters - s)) / 2e-3
            for s in steps
        ]
    ).T
    scale = np.abs(central).max(axis=0)
    np.testing.assert_allclose(equations.jacobian(parameters) / scale, central / scale, atol=5e-5)
    assert (scale[np.flatnonzero(equations.factor.any(axis=0))] > 0.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("gross_mm", [0.0, 0.5])
def test_scipy_finds_no_lower_cost(gross_mm: float) -> None:
    equations = system(gross_mm)

    def roots(x: FloatArray) -> FloatArray:
        """Square roots of the terms of the cost, with the residuals' signs."""
        residual = equations.residuals(x)
        loss = 2 * ROBUST**2 * (np.sqrt(1 + residual**2 / ROBUST**2) - 1)
        return np.append(np.copysign(np.sqrt(loss), residual), x)

    minimum = equations.minimise(equations.start(), 1.0, 40)
    reference = scipy.optimize.least_squares(roots, minimum, max_nfev=10)
    assert roots(minimum) @ roots(minimum) == pytest.approx(2 * reference.cost, abs=0.01)
    np.testing.assert_allclose(minimum, reference.x, atol=0.05)


def test_turning_the_plate_between_pictures_cancels_its_wedge() -> None:
    """Reversal method: with a single picture the wedge is attributed to a tilt of the bench."""
    bench, wedge = SimulatedBench(replace(RIG, uncertainty=None), VIEW), np.tan(np.radians(0.15))
    once, turned = ((Plate(), FlatMirror(0.0, 0.0, sign * wedge)) for sign in (1, -1))
    tilts = [INDEX["laser.projection_angle_deg"], INDEX["imaging_plane.pitch_deg"]]
    tilt_offsets = []
    for pictures in ([once], [once, turned]):
        mirrors = [*pictures, MIRRORS[1]]
        adjustment = adjust(RIG, sightings_of(mirrors, bench, np.random.default_rng(5)))
        tilt_offsets.append(np.abs(adjustment.offset[tilts]).max())
    assert tilt_offsets[0] > 0.1
    assert tilt_offsets[1] < 0.3 * tilt_offsets[0]
