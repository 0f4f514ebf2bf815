"""Tilted planes, and planes behind a flat folding mirror (§9.2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.folding import FoldingMirror, image_sigma
from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.core.pipeline import Settings, measure
from labapp.core.schemes import fit
from labapp.core.surface.measures import measure_surface
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import FloatArray
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg
from labapp.studies.image_error import BENCH, VIEW, axes_of, rendered

POOL = egg(6.0, 2.7, 3.4, 0.3)

# The mirror is inclined at 45° and reflects the light up to a level sheet of paper.
MIRROR = FoldingMirror(np.array([0.0, -30.0, 20.0]), np.array([0.0, 2.0, 2.0]))
LEVEL = ImagingPlane.of_angles(np.array([-50.8, -52.0, 45.0]), (90.0, 0.0, 0.0))


def folded_paths(rig: Rig, plane: ImagingPlane, mirror: FoldingMirror) -> FloatArray:
    """Return the dots (X′, Z′) of rays reflected to a plane by a mirror, (rows, columns, 2)."""
    reflections = trace(POOL, rig)
    unit = mirror.normal / np.linalg.norm(mirror.normal)
    start, direction = reflections.point_mm, reflections.reflected
    t = ((mirror.point_mm - start) @ unit) / (direction @ unit)
    on_mirror = start + np.where(t > 0, t, np.nan)[..., None] * direction
    folded = direction - 2 * (direction @ unit)[..., None] * unit
    normal = np.cross(plane.x_axis, plane.z_axis)
    u = ((plane.origin_mm - on_mirror) @ normal) / (folded @ normal)
    place = on_mirror + np.where(u > 0, u, np.nan)[..., None] * folded - plane.origin_mm
    return np.where(
        reflections.hit[..., None],
        np.stack([place @ plane.x_axis, place @ plane.z_axis], -1),
        np.nan,
    )


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.3), (-0.4, -1.0, -0.2), (0.5, 0.5, 0.0)])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (12.0, -9.0, 170.0)])
def test_pool_is_measured_via_a_mirror(
    normal: tuple[float, float, float], angles: tuple[float, float, float]
) -> None:
    mirror = FoldingMirror(np.array([0.0, -25.0, 15.0]), np.array(normal))
    turned = ImagingPlane.of_angles(np.zeros(3), angles)
    middle = turned.to_universal(np.array([50.8, 50.8]))
    paper = mirror.image_of(replace(turned, origin_mm=np.array([0.0, -50.0, 50.8]) - middle))
    rig = replace(BENCH, imaging_plane=mirror.image_of(paper))
    match = exact_match(trace(POOL, rig))
    true = folded_paths(rig, paper, mirror)[tuple(match.ray.T - 1)]
    assert len(match.ray) > 60
    np.testing.assert_allclose(match.plane_mm, true, atol=1e-9)
    reconstruction = fit.reconstruct(match, rig, FitSettings())
    sizes = measure_surface(reconstruction, match, rig)
    assert sizes.height_mm == pytest.approx(POOL.size.height_mm, rel=0.02)
    assert sizes.width_mm == pytest.approx(6.0, rel=0.02)


def test_mirror_at_45_degrees_turns_a_level_plane_upright() -> None:
    image = MIRROR.image_of(LEVEL)
    np.testing.assert_allclose(image.pose, [55, 50.8, 42, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (30.0, -20.0, 170.0), (-50.0, 120.0, -95.0)])
def test_pose_has_the_angles_of_its_plane(angles: tuple[float, float, float]) -> None:
    plane = ImagingPlane.of_angles(np.array([-4.0, -30.0, 5.0]), angles)
    np.testing.assert_allclose(plane.pose, [30, 4, 5, *angles], atol=1e-9)
    again = plane.with_pose(MIRROR.image_of(MIRROR.image_of(plane)).pose)
    np.testing.assert_allclose(again.pose_mm, plane.pose_mm, atol=1e-9)


@pytest.mark.parametrize("angles", [(90.0, 0.0, 0.0), (90.0, 40.0, 0.0), (-90.0, 10.0, 30.0)])
def test_level_plane_has_angles(angles: tuple[float, float, float]) -> None:
    plane = ImagingPlane.of_angles(np.zeros(3), angles)
    again = ImagingPlane.of_angles(np.zeros(3), plane.angles_deg)
    np.testing.assert_allclose(again.pose_mm[:4], plane.pose_mm[:4], atol=1e-9)


def test_mirror_uncertainty_doubles_in_the_image() -> None:
    zero, known = np.zeros(6), np.zeros(3)
    np.testing.assert_allclose(image_sigma(LEVEL, MIRROR, zero, known), 0)
    tilted = image_sigma(LEVEL, MIRROR, zero, np.array([0.0, 0.5, 0.5]))
    assert tilted[3] == pytest.approx(1.0, rel=0.01)  # pitch
    shifted = image_sigma(LEVEL, MIRROR, zero, np.array([0.5, 0.0, 0.0]))
    np.testing.assert_allclose(np.linalg.norm(shifted[:3]), 1.0, rtol=1e-3)
    from_plane = image_sigma(LEVEL, MIRROR, np.array([0.1, 0.2, 0.3, 0, 0, 0]), known)
    # A mirror at 45° exchanges the vertical and the longitudinal direction.
    np.testing.assert_allclose(from_plane[:3], [0.3, 0.2, 0.1], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("pitch_deg", [30.0, -30.0])
def test_frames_on_a_plane_tilted_by_30_degrees(pitch_deg: float) -> None:
    upright = BENCH.imaging_plane
    tilted = ImagingPlane.of_angles(upright.origin_mm, (pitch_deg, 0.0, 0.0))
    shift = upright.to_universal(np.array([50.8, 45.0])) - tilted.to_universal(
        np.array([50.8, 45.0])
    )
    tilted = replace(tilted, origin_mm=tilted.origin_mm + shift)
    rig = replace(BENCH, imaging_plane=tilted)
    frame = rendered(POOL, rig, 0)
    result = measure(frame.image, Bench(rig, axes_of(VIEW).calibration), Settings())[0]
    assert result.status == "ok", result.reason
    assert result.match is not None
    assert result.measures is not None
    true_px = frame.dot_px[tuple(result.match.ray.T - 1)]
    assert result.dots is not None
    assert np.linalg.norm(result.dots.image_px[result.match.dot] - true_px, axis=-1).max() < 2
    assert result.measures.height_mm == pytest.approx(POOL.size.height_mm, rel=0.03)
    assert result.measures.width_mm == pytest.approx(6.0, rel=0.03)


@pytest.mark.slow
def test_camera_may_view_the_back_of_the_paper() -> None:
    frame = rendered(POOL, BENCH, 0)
    last = frame.image.shape[1] - 1
    points = [(last - u, v) for u, v in (VIEW.origin_px, VIEW.x_axis_px, VIEW.z_axis_px)]
    calibration = ImageCalibration.from_three_points(
        points[0], points[1], VIEW.x_axis_mm, points[2], VIEW.z_axis_mm
    )
    mirrored = np.ascontiguousarray(frame.image[:, ::-1])
    result = measure(mirrored, Bench(BENCH, calibration), Settings())[0]
    assert result.status == "ok", result.reason
    assert result.measures is not None
    assert result.measures.height_mm == pytest.approx(POOL.size.height_mm, rel=0.03)
