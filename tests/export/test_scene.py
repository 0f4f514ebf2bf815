from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from labapp.core.pipeline import Measurement
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.surface import FlatSurface
from labapp.export.rendering import drawing as draws
from labapp.export.rendering import scene as scenes
from labapp.export.rendering.axes import round_ticks
from labapp.export.rendering.heights import between_points, difference_at, profile, sigma_at
from labapp.export.rendering.scene import difference_scene, rays_of, scene_of
from labapp.export.rendering.studio import Studio
from tests.scenes import BENCH_RIG

RADIUS_MM, HEIGHT_MM = 3.0, 0.3


@pytest.fixture
def pool(measured: Measurement) -> Reconstruction:
    """A paraboloid, 0.3 mm high over a circle of 3 mm; ± grows with X."""
    assert measured.reconstruction is not None
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(-2.0, 3.0), np.arange(-2.0, 3.0)))
    z = HEIGHT_MM * (1 - (x**2 + y**2) / RADIUS_MM**2)
    return replace(
        measured.reconstruction,
        ray=np.column_stack([np.repeat(np.arange(5), 5) + 8, np.tile(np.arange(5), 5) + 8]),
        points_mm=np.column_stack([x, y, z]),
        residual_mm=np.column_stack([0.01 * x, 0.02 * y]),
        sigma_mm=0.002 + 0.0005 * x,
    )


# --- heights -------------------------------------------------------------------------------------


def test_sigma_is_linear_between_points_and_nearest_outside(pool: Reconstruction) -> None:
    sigma = sigma_at(pool, np.array([0.5, -1.25, 2.9, -2.9]), np.array([0.5, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(sigma, [0.00225, 0.001375, 0.003, 0.001], atol=1e-12)


def test_scheme_without_sigma_has_none_in_the_scene(pool: Reconstruction) -> None:
    without = replace(pool, sigma_mm=np.full(25, np.nan))
    assert np.isnan(sigma_at(without, np.zeros(2), np.zeros(2))).all()
    assert scene_of(without, "sigma").label == "height (mm)"


def test_difference_is_limited_to_the_overlap(pool: Reconstruction) -> None:
    smaller = replace(pool.boundary, points_mm=pool.boundary.points_mm * [0.5, 0.5, 1.0])
    other = replace(pool, surface=FlatSurface(0.1), boundary=smaller)
    difference = difference_at(pool, other, np.array([0.0, 1.0, 2.0]), np.zeros(3))
    np.testing.assert_allclose(difference, [0.2, 0.3 * (1 - 1 / 9) - 0.1, np.nan])


@pytest.mark.parametrize("scale", [1, 1e3, 1e6])
def test_number_of_nodes_is_limited_for_huge_surfaces(pool: Reconstruction, scale: float) -> None:
    """An untrusted session may contain a huge surface."""
    boundary = replace(pool.boundary, points_mm=pool.boundary.points_mm * scale)
    vertices, _ = scenes._mesh(replace(pool, boundary=boundary))
    assert 1000 < len(vertices) < 1_000_000


@pytest.mark.parametrize("angle_deg", [0.0, 37.0, 90.0, 180.0, -60.0])
def test_section_ends_at_the_boundary(pool: Reconstruction, angle_deg: float) -> None:
    cut = profile(pool, angle_deg, 1.5)
    half = np.sqrt(RADIUS_MM**2 - 1.5**2)
    # The boundary is a polygon of 72 corners: its sides are within 0.003 mm of the circle.
    np.testing.assert_allclose(cut.edge_mm[:, 0], [-half, half], atol=0.006)
    known = np.isfinite(cut.height_mm)
    assert known.sum() > 0.98 * len(known)
    radius = np.hypot(*cut.place_mm[known].T)
    np.testing.assert_allclose(cut.height_mm[known], HEIGHT_MM * (1 - radius**2 / 9), atol=1e-12)
    offset_mm = cut.place_mm @ [-np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))]
    np.testing.assert_allclose(offset_mm, 1.5)
    assert np.isfinite(cut.sigma_mm[known]).all()


def test_section_outside_the_pool_is_empty(pool: Reconstruction) -> None:
    cut = profile(pool, 0.0, 5.0)
    assert len(cut.edge_mm) == 0
    assert np.isnan(cut.height_mm).all()


# --- scene ---------------------------------------------------------------------------------------


def test_rays_lead_from_the_laser_to_the_computed_dots(pool: Reconstruction) -> None:
    class Matched:
        plane_mm = np.column_stack([np.linspace(20, 70, 25), np.linspace(5, 60, 25)])

    matched: Any = Matched()
    shifted = replace(pool, residual_mm=np.full((25, 2), 0.5))
    rays = rays_of(shifted, matched, BENCH_RIG)
    targets = {
        "incident": np.tile(BENCH_RIG.laser.position_mm, (25, 1)),
        "reflected": BENCH_RIG.imaging_plane.to_universal(Matched.plane_mm + 0.5),
    }
    for name, target in targets.items():
        start, end = rays[name][:, 0], rays[name][:, 1]
        np.testing.assert_array_equal(start, pool.points_mm)
        np.testing.assert_allclose(np.linalg.norm(end - start, axis=1), scenes.RAY_MM)
        deviation = np.cross(end - start, target - start)
        np.testing.assert_allclose(deviation, 0, atol=1e-9)


def test_colours_of_a_difference_are_symmetric(pool: Reconstruction) -> None:
    other = replace(pool, surface=FlatSurface(0.05))
    scene = difference_scene(pool, other)
    assert scene.colour_map == scenes.DIFFERENCE_MAP
    assert scene.limits == pytest.approx((-0.25, 0.25))
    np.testing.assert_allclose(scene.values, scene.vertices_mm[:, 2] - 0.05, atol=1e-9)
    assert scene.values.min() == pytest.approx(-0.05, abs=1e-6)


def shifted_pool(pool: Reconstruction) -> Reconstruction:
    """The same pool shifted by 10 mm along X; it does not overlap the first."""
    shift_mm = np.array([10.0, 0.0, 0.0])
    boundary = pool.boundary
    moved = replace(
        boundary,
        center_mm=boundary.center_mm + shift_mm[:2],
        points_mm=boundary.points_mm + shift_mm,
    )
    return replace(pool, boundary=moved)


def test_scene_of_surfaces_without_overlap_is_empty(pool: Reconstruction) -> None:
    scene = difference_scene(pool, shifted_pool(pool))
    assert len(scene.vertices_mm) == len(scene.triangles) == len(scene.values) == 0


def test_unknown_parts_of_a_surface_are_not_drawn(pool: Reconstruction) -> None:
    class Holed(FlatSurface):
        def height(self, x_mm: Any, y_mm: Any) -> Any:
            return np.where(np.hypot(x_mm - 1, y_mm) < 0.5, np.nan, 0.2)

    scene = scene_of(replace(pool, surface=Holed()))
    assert np.isfinite(scene.vertices_mm).all()
    centres = scene.vertices_mm[scene.triangles].mean(axis=1)
    assert np.hypot(centres[:, 0] - 1, centres[:, 1]).min() > 0.35


def test_normals_are_perpendicular_to_the_surface_and_point_up(pool: Reconstruction) -> None:
    scene = scene_of(pool)
    normals = draws._normals(scene.vertices_mm, scene.triangles)
    # Nodes at the rim have facets on one side only.
    inner = np.hypot(*scene.vertices_mm[:, :2].T) < 2.5
    x, y = scene.vertices_mm[inner, :2].T
    true = np.column_stack([2 * HEIGHT_MM / 9 * x, 2 * HEIGHT_MM / 9 * y, np.ones(len(x))])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[inner], true, atol=0.01)


# --- picture -------------------------------------------------------------------------------------


@pytest.fixture
def plotter(opengl: None) -> Any:
    import pyvista

    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[480, 360])
    yield plotter
    plotter.close()


def screenshot(plotter: Any) -> np.ndarray:
    plotter.render()
    return np.asarray(plotter.screenshot(return_img=True)).astype(int)


def pixels_of_colour(picture: np.ndarray, colour: str) -> int:
    """Number of pixels with approximately a given colour."""
    rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return int((np.abs(picture - rgb).max(axis=2) < 40).sum())


def test_peak_is_yellow_and_the_rim_violet(plotter: Any, pool: Reconstruction) -> None:
    draws.build_scene(plotter, scene_of(pool)).look("top")
    picture = screenshot(plotter)
    bar = 400  # the colour scale is to the right of it
    rows, columns = np.nonzero((picture[:, :bar].max(axis=2) - picture[:, :bar].min(axis=2)) > 60)
    across, down = int(columns.mean()), int(rows.mean())
    red, green, blue = picture[down, across + 6]
    assert red > 150
    assert green > 150
    assert blue < 110
    red, green, blue = picture[down, columns.min() + 8]
    assert max(red, green) < 130
    assert blue > 60


def test_parts_are_shown_and_hidden_with_the_scene(plotter: Any, pool: Reconstruction) -> None:
    rays = {"incident": np.stack([pool.points_mm, pool.points_mm + np.array([0, 1, 1])], axis=1)}
    line = np.column_stack([np.linspace(-3, 3, 50), np.zeros(50), np.full(50, 0.35)])
    plain = replace(scene_of(pool), points_mm=np.empty((0, 3)))
    full = replace(plain, rays_mm=rays, lines_mm={**plain.lines_mm, "section": line})
    drawing = draws.build_scene(plotter, plain)
    before = screenshot(plotter)
    drawing.update(full)
    between = screenshot(plotter)
    drawing.update(plain)
    after = screenshot(plotter)
    for colour in (draws.COLOURS["incident"], draws.COLOURS["section"]):
        assert pixels_of_colour(before, colour) < 20
        assert pixels_of_colour(between, colour) > 100
    np.testing.assert_array_equal(after, before)


def test_frame_replaces_another(plotter: Any, pool: Reconstruction) -> None:
    """The actors are reused, and the picture equals that of a new drawing."""
    flat = scene_of(replace(pool, surface=FlatSurface(0.21)), limits=(0.0, 0.3))
    drawing = draws.build_scene(plotter, scene_of(pool, limits=(0.0, 0.3)))
    first, actors = screenshot(plotter), list(plotter.renderer.actors)
    drawing.update(flat)
    assert list(plotter.renderer.actors) == actors
    updated = screenshot(plotter)
    assert (updated != first).any(axis=2).mean() > 0.05
    plotter.clear()
    draws.build_scene(plotter, flat)
    np.testing.assert_allclose(screenshot(plotter), updated, atol=2)


def test_axis_labels_follow_a_scene_under_the_same_camera(
    plotter: Any, pool: Reconstruction
) -> None:
    """The picture equals that of a new drawing, although unchanged labels are kept."""
    first = scene_of(pool)
    high = replace(first, exaggeration=2 * first.exaggeration)
    wide = replace(first, within_mm=np.array([[-9.0, -9.0, 0.0], [9.0, 9.0, 0.5]]))
    for other in (high, wide):
        plotter.clear()
        drawing = draws.build_scene(plotter, first)
        screenshot(plotter)
        camera, depths = drawing.camera, plotter.camera.clipping_range
        drawing.update(other)
        updated = screenshot(plotter)
        plotter.clear()
        draws.build_scene(plotter, other).camera = camera
        plotter.camera.clipping_range = depths
        np.testing.assert_allclose(screenshot(plotter), updated, atol=2)


def test_colour_scale_names_its_quantity(plotter: Any, pool: Reconstruction) -> None:
    drawing = draws.build_scene(plotter, scene_of(pool))
    for label in ("± (mm)", "height (mm)", "± (mm)"):
        drawing.update(replace(scene_of(pool), label=label))
        screenshot(plotter)
        assert label.replace(" (", "\n(") in drawing.overlay.words


def test_stamp_is_framed_and_apart_from_the_colour_scale(
    plotter: Any, pool: Reconstruction
) -> None:
    drawing = draws.build_scene(plotter, replace(scene_of(pool), stamp="out of date"))
    screenshot(plotter)
    texts = {text.GetInput(): text for text in drawing.overlay._texts if text.GetVisibility()}
    framed = [words for words, text in texts.items() if text.GetTextProperty().GetFrame()]
    assert framed == ["out of date"]
    stamp, title = (texts[words].GetPosition()[1] for words in ("out of date", "height\n(mm)"))
    scale = drawing.overlay._scale(np.array(plotter.window_size, float))
    lowest = min(label.at_px[1] for label in scale)
    assert stamp < lowest - 20 < title


def test_drawing_recovers_from_a_failed_update(
    plotter: Any, pool: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = scene_of(pool)
    drawing = draws.build_scene(plotter, heights)
    expected = screenshot(plotter)

    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("refused")

    with monkeypatch.context() as patched:
        patched.setattr(plotter, "add_mesh", fail)
        with pytest.raises(ValueError, match="refused"):
            drawing.update(replace(heights, colour_map=scenes.ERROR_MAP))
    drawing.update(heights)
    np.testing.assert_allclose(screenshot(plotter), expected, atol=2)


def test_surface_can_follow_a_scene_without_one(plotter: Any, pool: Reconstruction) -> None:
    """For instance in a film whose first frame has no surface."""

    def coloured() -> np.ndarray:
        picture = screenshot(plotter)
        grey = np.ptp(picture, axis=2, keepdims=True) < 40  # axes and their labels
        return np.where(grey, 255, picture)

    drawing = draws.build_scene(plotter, difference_scene(pool, shifted_pool(pool)))
    assert (coloured()[:, :380] == 255).all()
    for scene in (difference_scene(pool, replace(pool, surface=FlatSurface(0.05))), scene_of(pool)):
        drawing.update(scene)
        drawing.look("free")
        after = coloured()
        assert (after[:, :380] != 255).any(axis=2).sum() > 10_000
        plotter.clear()
        drawing = draws.build_scene(plotter, scene)
        np.testing.assert_allclose(after, coloured(), atol=45)


@pytest.mark.parametrize("exaggeration", [1.0, 3.0, 12.0])
@pytest.mark.parametrize("azimuth_deg", range(0, 360, 45))
def test_labels_are_visible_from_every_side_without_overlap(
    plotter: Any, pool: Reconstruction, exaggeration: float, azimuth_deg: float
) -> None:
    scene = replace(scene_of(pool), exaggeration=exaggeration, stamp="out of date")
    drawing = draws.build_scene(plotter, scene)
    plotter.camera.Azimuth(azimuth_deg + 10)
    screenshot(plotter)
    overlay, size = drawing.overlay, np.array(plotter.window_size)
    assert {"X (mm)", "Y, along the weld (mm)"} <= set(overlay.words)
    assert ("Z (mm)" in overlay.words) == (exaggeration > 1)  # too low for numbers
    texts = [text for text in overlay._texts if text.GetVisibility()]
    boxes = []
    for text in texts:
        box = np.zeros(4)
        text.GetBoundingBox(plotter.renderer, box)
        position = np.array(text.GetPosition())
        boxes.append(np.stack([position + box[[0, 2]], position + box[[1, 3]]]))
    assert all((low >= 0).all() and (high <= size).all() for low, high in boxes)
    for k, (low, high) in enumerate(boxes):
        for other in boxes[k + 1 :]:
            assert not ((low < other[1]).all() and (other[0] < high).all())


@pytest.mark.parametrize(
    ("low", "high", "most", "wanted"),
    [
        (0.0, 0.28, 6, ["0.00", "0.05", "0.10", "0.15", "0.20", "0.25"]),
        (-3.0, 4.0, 4, ["−2", "0", "2", "4"]),
        (-0.02, 0.02, 3, ["−0.02", "0.00", "0.02"]),
        (150.0, 1000.0, 5, ["200", "400", "600", "800", "1000"]),
    ],
)
def test_ticks_are_round_numbers(low: float, high: float, most: int, wanted: list[str]) -> None:
    ticks, texts = round_ticks(low, high, most)
    assert texts == wanted
    assert ticks == pytest.approx([float(text.replace("−", "-")) for text in wanted])


def test_contours_lie_on_the_surface_at_round_heights(plotter: Any, pool: Reconstruction) -> None:
    drawing = draws.build_scene(plotter, replace(scene_of(pool), contours=True))
    lines, actor = drawing._parts["contours"]
    heights = np.unique(np.round(lines.points[:, 2] / scenes.EXAGGERATION, 6))
    assert len(heights) >= 3
    assert np.diff(heights) == pytest.approx(0.05)
    drawing.update(scene_of(pool))
    assert not actor.GetVisibility()


def test_work_piece_is_drawn_around_the_pool(plotter: Any, pool: Reconstruction) -> None:
    drawing = draws.build_scene(plotter, scene_of(pool))
    drawing.look("top")
    plate, actor = drawing._parts["plate"]
    assert actor.GetVisibility()
    area = plate.triangulate().compute_cell_sizes()["Area"].sum()
    box, edge = drawing.overlay.box_mm, scene_of(pool).plate_mm
    x, y = edge[:, 0], edge[:, 1]
    hole = 0.5 * abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1)))
    # The tolerance is for the corners, which are cut off between two points of the edge.
    assert area == pytest.approx(np.prod(np.ptp(box, axis=0)[:2]) - hole, rel=0.02)


@pytest.mark.parametrize("colour", ["sigma", "residual"])
def test_errors_have_one_colour_map_from_zero(pool: Reconstruction, colour: scenes.Colour) -> None:
    scene = scene_of(pool, colour)
    assert scene.colour_map == scenes.ERROR_MAP
    assert scene.limits == (0.0, pytest.approx(scene.values.max()))


def test_residuals_at_the_points_are_exact(pool: Reconstruction) -> None:
    lengths = np.linalg.norm(pool.residual_mm, axis=1)
    points = pool.points_mm[np.isfinite(lengths)]
    interpolated = between_points(pool, lengths, *points[:, :2].T)
    assert interpolated == pytest.approx(lengths[np.isfinite(lengths)], abs=1e-9)


def test_steady_axes_change_only_if_necessary(plotter: Any, pool: Reconstruction) -> None:
    def scaled(factor: float) -> scenes.Scene:
        scene = scene_of(pool)
        return replace(scene, vertices_mm=scene.vertices_mm * factor)

    def bounds(drawing: draws.Drawing, factor: float) -> tuple[float, ...]:
        drawing.update(scaled(factor))
        return tuple(drawing.overlay.box_mm.ravel())

    steady = draws.build_scene(plotter, scaled(1.0), steady=True)
    initial = bounds(steady, 1.0)
    assert bounds(steady, 0.9) == initial
    larger = bounds(steady, 1.4)
    assert larger != initial
    assert bounds(steady, 1.0) != larger  # the pool is too small for them
    plotter.clear()
    unsteady = draws.build_scene(plotter, scaled(1.0))
    assert bounds(unsteady, 1.0) == initial
    assert bounds(unsteady, 0.6) != initial


def test_colours_of_a_dark_window_are_used(plotter: Any, pool: Reconstruction) -> None:
    drawing = draws.build_scene(plotter, scene_of(pool))
    assert pixels_of_colour(screenshot(plotter), "#ffffff") > 60_000
    drawing.update(replace(scene_of(pool), background="#202020", foreground="#e0e0e0"))
    picture = screenshot(plotter)
    assert pixels_of_colour(picture, "#202020") > 60_000
    assert 50 < pixels_of_colour(picture, "#e0e0e0") < 10_000


def test_exaggerated_heights_keep_true_axes(plotter: Any, pool: Reconstruction) -> None:
    def extent(exaggeration: float) -> float:
        plotter.clear()
        scene = replace(scene_of(pool), exaggeration=exaggeration, electrode=False)
        drawing = draws.build_scene(plotter, scene)
        drawing.look("front")
        assert drawing.overlay.box_mm[:, 2] == pytest.approx((0.0, 0.3))
        top, bottom = np.nonzero(rows_with_pool(screenshot(plotter)))[0][[0, -1]]
        return float(bottom - top)

    def rows_with_pool(picture: np.ndarray) -> np.ndarray:
        saturated = picture[:, :380].max(axis=2) - picture[:, :380].min(axis=2) > 60
        return np.asarray(saturated.sum(axis=1) > 0)

    height_at_2, height_at_6 = extent(2.0), extent(6.0)
    assert height_at_6 == pytest.approx(3 * height_at_2, rel=0.2)


def test_picture_has_the_given_size(plotter: Any, pool: Reconstruction) -> None:
    picture = Studio((320, 240), "side").draw(scene_of(pool))
    assert picture.shape == (240, 320, 3)
    assert picture.std() > 10
