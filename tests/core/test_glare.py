"""Saturated light hides dots: rays whose dots would land in it are not known to be dark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration, Lens
from labapp.core.images.peaks import DetectorTuning
from labapp.core.images.visibility import GLARE_CELL_PX, glare
from labapp.core.matching.hypothesis import USUAL_FIT, paths_of
from labapp.core.matching.observation import Observation, try_fit
from labapp.core.matching.ray_classes import classify_rays
from labapp.core.pipeline import Settings, measure
from labapp.core.values import FloatArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import egg
from labapp.simulation.render import GreyImage, Look, render
from tests.benchmarks.rendered import ON_ITS_DOT_PX, draw_view
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, see, true_labels

SHAPE = (240, 320)
DOTS = see(egg(5.4, 2.6, 3.0, 0.27), np.random.default_rng(3), sigma_px=0.05)


def far_from(center: tuple[float, float], shape: tuple[int, int] = SHAPE) -> FloatArray:
    """Distance of each pixel from a place (u, v), px."""
    v, u = np.indices(shape)
    return np.hypot(u - center[0], v - center[1])


def test_glare_is_saturated_light_and_what_is_near() -> None:
    image = np.where(far_from((100, 80)) < 30, 255, 20).astype(np.uint8)
    places = glare(image, DOTS.dots)
    cells = np.zeros(SHAPE, bool)
    for u, v in places.astype(int) - GLARE_CELL_PX // 2 + 1:
        cells[v : v + GLARE_CELL_PX, u : u + GLARE_CELL_PX] = True
    size = float(np.median(DOTS.dots.size_px))
    assert cells[far_from((100, 80)) < 30 + 4 * size].all()
    assert not cells[far_from((100, 80)) > 30 + 8 * size + 2 * GLARE_CELL_PX].any()


@pytest.mark.parametrize("level", [0, 255], ids=["black", "white"])
def test_blank_frame_has_no_glare(level: int) -> None:
    assert len(glare(np.full(SHAPE, level, np.uint8), DOTS.dots)) == 0


def test_saturated_dots_are_no_glare() -> None:
    image = np.full(SHAPE, 20, np.uint8)
    for center in ((100, 80), (140, 80), (100, 120)):
        image[far_from(center) < 4] = 255
    assert len(glare(image, DOTS.dots)) == 0


def test_noise_hides_dots_where_many_would_not_be_found() -> None:
    noise = np.where(np.arange(SHAPE[1]) < 160, 1.0, 100.0) * np.ones(SHAPE)
    tuning = DetectorTuning(2.0, noise.astype(np.float32), 6.0, 1.0)
    places = glare(np.zeros(SHAPE, np.uint8), DOTS.dots, tuning)
    assert len(places) == 20 * 30
    assert places[:, 0].min() > 160


def observation(glare_px: FloatArray, lens: Lens | None = None) -> Observation:
    """Return the dots with glare at places of the frame, seen through a lens."""
    bench = Bench(BENCH_RIG, ImageCalibration(BENCH_VIEW.matrix, lens))
    straight = Observation.of(DOTS.dots, Bench(BENCH_RIG, BENCH_VIEW), FRAME_SHAPE)
    given = Observation.of(DOTS.dots, bench, FRAME_SHAPE, glare_px)
    return replace(given, plane_mm=straight.plane_mm)


LENS = Lens((900.0, 900.0), (FRAME_SHAPE[1] / 2, FRAME_SHAPE[0] / 2), (-0.2, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("lens", [None, LENS], ids=["straight", "distorting"])
def test_rays_whose_dots_would_land_in_glare_are_unknown(lens: Lens | None) -> None:
    labels = true_labels(DOTS)
    usual = observation(np.zeros((0, 2)), lens)
    pool = try_fit(usual, labels, USUAL_FIT)
    assert pool is not None
    paths = paths_of(usual, pool)
    states = classify_rays(usual, labels, paths).ray_states.ravel()
    inner = ((paths.plane_mm > 20) & (paths.plane_mm < 80)).all(axis=1)
    hidden = np.flatnonzero((states < 0) & inner)[0]
    at = usual.bench.calibration.to_image(paths.plane_mm[hidden])
    found = classify_rays(observation(at[None], lens), labels, paths).ray_states.ravel()
    near = np.linalg.norm(paths.plane_mm - paths.plane_mm[hidden], axis=1) < 8.0
    assert found[hidden] == 0
    np.testing.assert_array_equal(found[~near], states[~near])


def with_glare(image: GreyImage, center: FloatArray, radius: float) -> GreyImage:
    """Add a saturated reflection with a halo to a frame."""
    light = 500.0 / (1 + (far_from((center[0], center[1]), image.shape) / radius) ** 8)
    return np.clip(image + light, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_pool_is_measured_if_glare_hides_a_part_of_its_rim(seed: int) -> None:
    """Rays that seemed to have missed the pool there contradicted every boundary."""
    rng, pool = np.random.default_rng(seed), egg(6.0, 3.0, 3.6, 0.25)
    view = draw_view(rng)
    frame = render(trace(pool, BENCH_RIG), view, Look(), rng)
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    bench = Bench(BENCH_RIG, ImageCalibration.from_three_points(*axes))
    shown = frame.dot_px[frame.shown]
    outermost = shown[np.linalg.norm(shown - shown.mean(axis=0), axis=1).argmax()]
    radius = 4 * float(np.sort(np.linalg.norm(shown - outermost, axis=1))[1])
    measured, _ = measure(with_glare(frame.image, outermost, radius), bench, Settings())
    assert measured.status == "ok"
    match, dots, size = measured.match, measured.dots, measured.measures
    assert match is not None
    assert dots is not None
    assert size is not None
    true_px = np.where(frame.shown[..., None], frame.dot_px, np.nan)[tuple(match.ray.T - 1)]
    off_px = np.linalg.norm(dots.image_px[match.dot] - true_px, axis=1)
    assert (off_px < ON_ITS_DOT_PX).all()
    assert abs(size.height_mm - pool.size.height_mm) < 3 * size.height_sigma_mm
