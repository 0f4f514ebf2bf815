from __future__ import annotations

import re
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest

from labapp.core.pipeline import Measurement
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult
from labapp.export.rendering import pictures
from labapp.export.summary import Summary
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.simulated import demo

IMAGE = np.full((40, 60), 20, np.uint8)


@pytest.fixture
def summary(measured: Measurement, unmeasured: Measurement) -> Summary:
    summary = Summary()
    summary.add(FrameResult(0, 0.0, unmeasured))
    summary.add(FrameResult(1, 0.1, measured))
    summary.add(FrameResult(2, 0.2, measured))
    return summary


def test_rings_of_dots_are_coloured_or_grey_if_in_doubt(measured: Measurement) -> None:
    picture = pictures.frame_picture(IMAGE, measured)
    assert picture.shape == (120, 180, 3)
    bright = picture.max(axis=2) > 100
    saturated = picture.max(axis=2) - picture.min(axis=2) > 60
    # Dots 0 and 2 have a ray, dot 1 has none; look at the left of each ring, 4 px from its dot.
    for u, coloured in [(10, True), (30, False), (50, True)]:
        left = np.s_[57:66, 3 * (u - 4) - 2 : 3 * (u - 4) + 5]
        assert bright[left].any()
        assert saturated[left].any() == coloured


def test_frame_without_dots_is_shown_unchanged(unmeasured: Measurement) -> None:
    blank = Measurement(status="no-dots", reason="", scheme="fit")
    picture = pictures.frame_picture(IMAGE, blank)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 1
    assert (pictures.frame_picture(IMAGE, unmeasured) != picture).any()


def test_summary_has_counts_and_means(summary: Summary) -> None:
    first, width, *_ = summary.text().splitlines()
    assert first == "3 frames, 2 with a surface (1 ambiguous-rows)"
    assert width == "width    1.2500 ± 1.2500 mm (mean; standard deviation 0.0000 mm)"
    np.testing.assert_array_equal(summary.series("width_mm"), [np.nan, 1.25, 1.25])


def test_summary_of_one_frame_has_its_uncertainty(measured: Measurement) -> None:
    summary = Summary()
    summary.add(FrameResult(0, None, measured))
    assert summary.text().splitlines()[1] == "width    1.2500 ± 1.2500 mm"


def test_size_rounded_to_zero_has_no_sign(measured: Measurement) -> None:
    assert measured.measures is not None
    summary = Summary()
    for frame in range(2):
        sizes = replace(measured.measures, depth_mm=-1e-9)
        summary.add(FrameResult(frame, None, replace(measured, measures=sizes)))
        assert re.search(r"^depth +0\.0000 ", summary.text(), re.MULTILINE)


def test_surface_is_drawn(measured: Measurement, tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    assert measured.reconstruction is not None
    assert demo.draw_surface(measured.reconstruction, tmp_path / "surface.png") == ""
    surface = cv2.imread(str(tmp_path / "surface.png"))
    # viridis: the top of the pool is yellow, the rim violet.
    blue, green, red = np.moveaxis(surface.astype(int), 2, 0)
    assert ((red > 180) & (green > 150) & (blue < 90)).sum() > 2000
    assert ((red < 110) & (green < 80) & (blue > 60)).sum() > 2000


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        (
            ModuleNotFoundError("No module named 'pyvista'", name="pyvista"),
            "pyvista is not installed (pip install 'labapp[gui]')",
        ),
        (BrokenProcessPool(), "OpenGL cannot be used here"),
        (OSError(28, "disk full"), "disk full"),
    ],
)
def test_failed_drawing_is_reported_without_an_exception(
    measured: Measurement, tmp_path: Path, problem: Exception, message: str
) -> None:
    assert measured.reconstruction is not None
    with mock.patch.object(demo, "write_surface_picture", side_effect=problem):
        assert demo.draw_surface(measured.reconstruction, tmp_path / "surface.png") == message


def test_demo_continues_its_session(tmp_path: Path) -> None:
    with demo.open_demo(tmp_path / "demo") as session:
        assert len(session.frames) == 30
        session.set_record(Record(operator="A. Weld"))
    with demo.open_demo(tmp_path / "demo") as session:
        assert session.record.operator == "A. Weld"


def test_failed_demo_leaves_no_session(tmp_path: Path) -> None:
    (tmp_path / "demo").touch()
    with pytest.raises(InputError, match="one that can be written"):
        demo.open_demo(tmp_path / "demo")
    unreadable = InputError("recording.avi", "content", "damaged", "a video")
    with (
        mock.patch.object(Session, "import_recording", side_effect=unreadable),
        pytest.raises(InputError, match="damaged"),
    ):
        demo.open_demo(tmp_path / "other")
    assert not list((tmp_path / "other").glob("*.labsession"))
