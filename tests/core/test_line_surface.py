"""The surface from lines, compared with the simulation; its Jacobian, with differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.line_pattern import LinePattern, LineRig, line_directions
from labapp.core.geometry.rig import Electrode, ImagingPlane, Laser
from labapp.core.lines.data import line_data
from labapp.core.lines.detection.find_lines import find_lines
from labapp.core.lines.detection.numbering import number_lines
from labapp.core.lines.fit import fit_lines
from labapp.core.lines.frame import measure_lines
from labapp.core.lines.model import LineData, LineModel
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import CannotMeasure
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import Pool, egg, spherical_cap
from tests.line_truth.frames import LineFrame, LineLook, render_lines

RIG = LineRig(
    Laser(27.0, 90.0),
    LinePattern(5, 0.23, 5.0),
    Electrode(5.0),
    ImagingPlane.vertical(53.6, 32.0, -5.0, 64.0, 84.0),
)
VIEW = CameraView((2.0, 638.0), (452.0, 638.0), 60.0, (2.0, 188.0), 60.0)
CALIBRATION = ImageCalibration.from_three_points(
    VIEW.origin_px, VIEW.x_axis_px, VIEW.x_axis_mm, VIEW.z_axis_px, VIEW.z_axis_mm
)


def rendered(pool: Pool | None, seed: int = 1, look: LineLook | None = None) -> LineFrame:
    return render_lines(pool, RIG, VIEW, look or LineLook(), np.random.default_rng(seed))


def exact_data(frame: LineFrame, sigma_mm: float = 0.01) -> tuple[LineData, np.ndarray]:
    """Return the data of a perfect detector, and the line numbers from the lowest up."""
    lines = sorted(frame.lines, key=lambda one: -float(np.mean(one.image_px[:, 1])))
    places = [VIEW.to_plane(one.image_px) for one in lines]
    tangents = [np.gradient(place, axis=0) for place in places]
    samples = slice(3, -3, 8)
    along = np.concatenate([each[samples] for each in tangents])
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    count = [len(place[samples]) for place in places]
    line = np.repeat(np.arange(len(lines)), count)
    data = LineData(
        line,
        np.concatenate([place[samples] for place in places]),
        np.stack([-along[:, 1], along[:, 0]], axis=-1),
        np.full(len(line), sigma_mm),
        np.repeat(np.arange(len(lines)), 2),
        np.concatenate([place[[0, -1]] for place in places]),
        np.full(2 * len(lines), 0.1),
    )
    return data, np.array([one.number for one in lines], float)


def test_rays_of_a_line_are_in_one_plane():
    fan = np.linspace(-RIG.pattern.half_fan, RIG.pattern.half_fan, 5)
    rays = line_directions(RIG.laser, RIG.pattern, np.full(5, 2.0), fan)
    assert np.linalg.svd(rays)[1][2] == pytest.approx(0.0, abs=1e-12)
    ends = np.degrees(np.arccos(rays[0] @ rays[-1]))
    assert ends == pytest.approx(5.0, abs=0.01)


@pytest.mark.parametrize("peak_mm", [0.25, -0.3])
def test_jacobian_agrees_with_central_differences(peak_mm: float):
    data, numbers = exact_data(rendered(spherical_cap(6.0, peak_mm)))
    basis = SplineBasis.over(np.array([-4.0, -3.0]), np.array([4.0, 3.0]), 1.5)
    model = LineModel(RIG, basis, numbers)
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-4, 4, 20), np.linspace(-3, 3, 20)))
    target = 0.97 * peak_mm * (1 - (x**2 + y**2) / 9.0)
    coefficients = np.linalg.lstsq(basis.matrix(x, y), target, rcond=None)[0]
    linear = model.residuals(coefficients, data)
    rng, step = np.random.default_rng(2), 1e-6
    for _ in range(3):
        direction = rng.normal(size=basis.count)
        ahead, behind = (
            model.residuals(coefficients + sign * step * direction, data).residual
            for sign in (1, -1)
        )
        slope = -(ahead - behind) / (2 * step)  # a residual falls as its prediction rises
        predicted = linear.jacobian @ direction
        error = np.abs(slope - predicted) / np.abs(predicted).max()
        # The Jacobian omits terms of the order of the residual.
        assert np.median(error) < 0.01
        assert np.quantile(error, 0.9) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("peak_mm", [0.25, -0.3])
def test_exact_lines_give_the_surface_and_its_uncertainty(peak_mm: float):
    data, numbers = exact_data(rendered(spherical_cap(6.0, peak_mm)))
    fitted = fit_lines(data, [numbers, numbers[::-1]], RIG)
    assert fitted.status == "ok"
    assert fitted.numbers.tolist() == numbers.tolist()
    error = abs(fitted.height_mm - peak_mm)
    assert error < 0.04 * abs(peak_mm)
    assert error < 3 * fitted.height_sigma_mm
    assert np.sign(fitted.curvature_per_mm) == np.sign(peak_mm)
    assert fitted.margin > 50


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pool", "status"),
    [
        pytest.param(egg(6.51, 3.02, 4.41, -0.25, (-0.27, -0.09)), "ok", id="hollow"),
        pytest.param(egg(6.2, 2.9, 4.71, 0.36, (0.22, -0.39)), "ok", id="long"),
        pytest.param(egg(6.52, 2.32, 3.14, 0.35, (-0.06, 0.04)), None, id="short"),
    ],
)
def test_uncertainties_include_pools_of_other_widths(pool: Pool, status: str | None):
    """The position along the fan is unknown: nearly the same lines come from other widths."""
    frame = rendered(pool)
    data, numbers = exact_data(frame, sigma_mm=0.02)
    fitted = fit_lines(data, [numbers, numbers[::-1]], RIG)
    assert fitted.status == (status or fitted.status)
    points = np.concatenate([one.point_mm for one in frame.lines])
    height = points[np.argmax(np.abs(points[:, 2])), 2]
    assert abs(fitted.height_mm - height) < 2.5 * fitted.height_sigma_mm
    assert abs(fitted.width_mm - np.ptp(points[:, 0])) < 2.5 * fitted.width_sigma_mm


@pytest.mark.slow
def test_uncertainties_include_the_error_of_the_expected_smoothness():
    """The heights at both ends of each line are no better known than the width."""
    height, width = 0.4, 7.2
    frame = rendered(egg(width, 3.2, 3.6, height, (0.4, 0.0)))  # wider than the fan on one side
    data, numbers = exact_data(frame)
    fitted = fit_lines(data, [numbers], RIG)
    assert fitted.status == "ok"
    assert fitted.width_sigma_mm > 0.09 * width
    ends = np.concatenate([one.point_mm[[0, -1]] for one in frame.lines])
    slope = 4 * height / width  # of a parabola at its ends
    assert (fitted.sigma_mm(*ends[:, :2].T) > 0.3 * slope * 0.1 * width).all()


@pytest.mark.slow
def test_width_of_a_pool_as_wide_as_the_fan_has_an_uncertainty():
    """Whether its lines end with the fan or on the boundary is not certain."""
    data, numbers = exact_data(rendered(spherical_cap(9.0, 0.3)), sigma_mm=0.02)
    fitted = fit_lines(data, [numbers], RIG)
    assert fitted.width_mm > 7.5
    assert fitted.width_sigma_mm > 0.3


@pytest.mark.slow
def test_fit_of_a_small_pool_settles():
    """It takes more steps than that of a large one; before, it was 16 % too high."""
    frame = rendered(egg(4.5, 1.395, 2.25, 0.23))
    data, _ = exact_data(frame, sigma_mm=0.02)
    either = [np.array([1.0, 2, 3, 4]), np.array([2.0, 3, 4, 5])]
    fitted = fit_lines(data, either, RIG)
    assert fitted.status == "ok"
    height = np.concatenate([one.point_mm for one in frame.lines])[:, 2].max()
    assert fitted.height_mm == pytest.approx(height, rel=0.05)


def first_lines(data: LineData, count: int) -> LineData:
    """Return the data of the lowest lines."""
    on, ends = data.line < count, data.end_line < count
    return replace(
        data,
        line=data.line[on],
        plane_mm=data.plane_mm[on],
        normal=data.normal[on],
        sigma_mm=data.sigma_mm[on],
        end_line=data.end_line[ends],
        end_mm=data.end_mm[ends],
        end_sigma_mm=data.end_sigma_mm[ends],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("numberings", "status"),
    [
        pytest.param([[1, 2, 3, 4]], "ok", id="known"),
        pytest.param([[5, 4, 3, 2]], "profile", id="wrong-order"),
        pytest.param([[1, 2, 3, 4], [5, 4, 3, 2]], "ok", id="clear-order"),
    ],
)
def test_four_of_five_lines_need_their_order(numberings: list[list[int]], status: str):
    data, _ = exact_data(rendered(egg(6.0, 2.8, 3.2, 0.3)), sigma_mm=0.02)
    four = [np.array(numbers, float) for numbers in numberings]
    fitted = fit_lines(first_lines(data, 4), four, RIG)
    assert fitted.status == status
    assert fitted.numbered


@pytest.mark.slow
def test_numbers_that_give_the_same_height_are_left_open():
    """A surface moved along Y by the distance of the lines reflects nearly the same four lines."""
    frame = rendered(egg(6.0, 2.8, 3.2, 0.3))
    four = first_lines(exact_data(frame, sigma_mm=0.02)[0], 4)
    either = [np.array([1.0, 2, 3, 4]), np.array([2.0, 3, 4, 5])]
    alone = [fit_lines(four, [numbers], RIG) for numbers in either]
    fitted = fit_lines(four, either, RIG)
    assert fitted.status == "ok"
    assert not fitted.numbered
    apart = abs(alone[0].height_mm - alone[1].height_mm)
    own = min(one.height_sigma_mm for one in alone)
    assert fitted.height_sigma_mm > 0.99 * np.hypot(own, apart) > own
    point = np.concatenate([one.point_mm for one in frame.lines if one.number < 5])
    assert abs(fitted.height_mm - point[:, 2].max()) < 2.5 * fitted.height_sigma_mm
    low, high = (one.surface.height(*point[:, :2].T) for one in alone)
    both = np.isfinite(low + high)
    assert both.mean() > 0.8
    sigma = fitted.sigma_mm(*point[both, :2].T)
    assert (sigma > 0.9 * np.abs(low - high)[both]).all()
    assert fitted.curvature_sigma_per_mm > alone[0].curvature_sigma_per_mm


@pytest.mark.slow
@pytest.mark.parametrize(("refined", "status"), [(3, "ok"), (2, "profile")])
def test_all_possible_numbers_must_give_the_same_height(
    refined: int, status: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("labapp.core.lines.fit.MOST_REFINED", refined)
    three = first_lines(exact_data(rendered(egg(4.4, 1.4, 2.2, 0.22)), sigma_mm=0.02)[0], 3)
    numbers = [np.arange(first, first + 3.0) for first in (1, 2, 3)]
    assert fit_lines(three, numbers, RIG).status == status


@pytest.mark.slow
@pytest.mark.parametrize("peak_mm", [0.18, 0.22])
def test_small_steep_pool_bends_more(peak_mm: float):
    frame = rendered(egg(4.4, 1.4, 2.2, peak_mm))
    data, numbers = exact_data(frame, sigma_mm=0.02)
    fitted = fit_lines(data, [numbers, numbers[::-1]], RIG)
    assert fitted.status == "ok"
    height = np.concatenate([one.point_mm for one in frame.lines])[:, 2].max()
    assert abs(fitted.height_mm - height) < 2.5 * fitted.height_sigma_mm


@pytest.mark.slow
def test_numbers_that_give_another_height_leave_a_profile(monkeypatch: pytest.MonkeyPatch):
    four = first_lines(exact_data(rendered(egg(6.0, 2.8, 3.2, 0.3)), sigma_mm=0.02)[0], 4)
    either = [np.array([1.0, 2, 3, 4]), np.array([2.0, 3, 4, 5])]
    monkeypatch.setattr("labapp.core.lines.fit.ALIKE_HEIGHT", (0.0, 0.0))
    monkeypatch.setattr("labapp.core.lines.fit.LEAST_MARGIN", 0.0)  # the height alone decides
    fitted = fit_lines(four, either, RIG)
    assert fitted.status == "profile"
    assert fitted.numbered


def test_single_line_raises_too_few_lines():
    data, numbers = exact_data(rendered(spherical_cap(6.0, 0.25)))
    with pytest.raises(CannotMeasure) as error:
        fit_lines(first_lines(data, 1), [numbers[:1]], RIG)
    assert error.value.status == "too-few-lines"


@pytest.mark.slow
@pytest.mark.parametrize(("peak_mm", "numbers"), [(0.25, [1, 2, 3, 4, 5]), (-0.3, [5, 4, 3, 2, 1])])
def test_frames_give_height_numbers_and_features(peak_mm: float, numbers: list[int]):
    frame = rendered(spherical_cap(6.0, peak_mm), look=LineLook(gaps=1))
    result = measure_lines(frame.image, RIG, CALIBRATION)
    assert result.status == "ok"
    assert result.surface is not None
    assert result.surface.numbers.tolist() == numbers
    assert result.surface.height_mm == pytest.approx(peak_mm, rel=0.08)
    assert result.surface.height_sigma_mm < 0.1 * abs(peak_mm)
    assert result.features.count == 5
    assert result.features.curvature_per_mm > 0
    assert abs(result.features.asymmetry) < 0.1
    plane = VIEW.to_plane(np.concatenate([one.image_px for one in frame.lines]))
    assert result.features.width_mm == pytest.approx(np.ptp(plane[:, 0]), rel=0.1)


def test_ends_of_a_widened_line_are_on_the_edge_of_the_pool():
    """The edge cuts the light of the top line of a small steep pool off obliquely."""
    frame = rendered(egg(4.63, 1.5, 2.25, 0.214))
    top = number_lines(find_lines(frame.image), 5).lines[-1]
    true = max(frame.lines, key=lambda one: one.number).image_px[[0, -1]]
    assert np.abs(top.ends_px - true[np.argsort(true[:, 0])]).max() < 2.0
    sigma = line_data((top,), CALIBRATION).end_sigma_mm
    narrow = line_data((replace(top, width_px=2.0),), CALIBRATION).end_sigma_mm
    assert (sigma > 1.5 * narrow).all()


@pytest.mark.slow
def test_caustic_is_rejected():
    """A pool of this depth focuses each line to a point and must not be measured."""
    frame = rendered(spherical_cap(6.0, -0.138))
    result = measure_lines(frame.image, RIG, CALIBRATION)
    assert result.status != "ok"


def test_solid_metal_shows_no_line():
    result = measure_lines(rendered(None).image, RIG, CALIBRATION)
    assert result.status == "no-lines"
    assert result.features.count == 0
