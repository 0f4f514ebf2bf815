from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.simulation.calibration.target import Target, TargetLook, render_target, target_svg
from labapp.simulation.render import CameraView

ROOT = Path(__file__).parents[2]


def objects(image):
    """Return areas and centres as in §5.1.2: threshold, median 7 × 7, labels; largest first."""
    binary = cv2.medianBlur((image < 22).astype(np.uint8), 7)
    _, _, stats, centers = cv2.connectedComponentsWithStats(binary)
    order = np.argsort(stats[1:, cv2.CC_STAT_AREA])[::-1] + 1
    return stats[order, cv2.CC_STAT_AREA], centers[order]


@pytest.mark.parametrize("roll_deg", [-2.0, 0.0, 1.5])
@pytest.mark.slow
def test_picture_has_three_objects_at_their_true_positions(roll_deg):
    target, view = Target(), CameraView.rolled(roll_deg=roll_deg)
    look = TargetLook(vignetting=0.0, slope=0.0)
    areas, centers = objects(render_target(target, view, look, np.random.default_rng(1)))
    assert len(areas) == 3
    marks = np.array([[target.x_middle_mm, 0], [0, target.z_middle_mm], [0, 0]])
    np.testing.assert_allclose(centers, view.to_image(marks), atol=0.4)


def test_picture_is_dim_and_has_low_contrast():
    image = render_target(Target(), CameraView.rolled(), TargetLook(), np.random.default_rng(1))
    assert image.shape == (640, 480)
    assert image.mean() < 40
    marks = Target().inked(
        CameraView.rolled().to_plane(
            np.stack(np.meshgrid(np.arange(480.0), np.arange(640.0)), axis=-1)
        )
    )
    assert 5 < np.median(image[~marks]) - np.median(image[marks]) < 30


def test_bar_centres_agree_with_eq_5_6():
    target = Target(unit_mm=2.0)
    assert (target.x_middle_mm, target.z_middle_mm) == (11.0, 5.0)
    x_bar, *_ = target.rectangles_mm()
    assert (x_bar[0] + x_bar[2]) / 2 == pytest.approx(11.0)


def test_marks_are_on_the_plate():
    target = Target()
    reach = target.plate_mm - target.margin_mm
    box = target.rectangles_mm()
    assert box.min() > -target.margin_mm
    assert box.max() < reach


def test_printable_target_is_true_to_size():
    target = Target()
    root = ET.fromstring(target_svg(target))
    assert root.get("width") == root.get("height") == "101.6mm"
    assert root.get("viewBox") == "0 0 101.6 101.6", "so that one user unit is 1 mm"
    space = {"s": "http://www.w3.org/2000/svg"}
    circle = root.find(".//s:circle", space)
    assert circle is not None
    origin = np.array([float(circle.get(key)) for key in ("cx", "cy")])
    drawn = [
        [float(mark.get(key)) for key in ("x", "y", "width", "height")]
        for mark in root.findall("./s:g/s:rect", space)
    ]
    x, y, width, height = np.array(drawn).T
    middles = np.stack([x + width / 2 - origin[0], origin[1] - y - height / 2], axis=-1)
    np.testing.assert_allclose(middles[0], [target.x_middle_mm, 0], atol=2e-3)
    np.testing.assert_allclose(target.inked(middles), True)
    assert len(drawn) == len(target.rectangles_mm()) == 2 + 8 + 2


def test_committed_target_is_up_to_date():
    committed = ROOT / "resources" / "targets" / "imaging_plane_4_inch.svg"
    assert committed.read_text(encoding="utf-8") == target_svg(Target())
