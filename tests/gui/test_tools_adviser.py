"""The adviser window: its request, agreement with the command, undo, cancelling."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QPushButton
from pytestqt.qtbot import QtBot

from labapp.core.geometry.rig import ImagingPlane, Laser
from labapp.gui.pages.setup.page import SetupPage
from labapp.gui.shell.window import MainWindow
from labapp.gui.tools import adviser_presenter
from labapp.gui.tools.adviser import AdviserWindow
from labapp.session.session import Session
from labapp.studies.adviser.keys import parse_request
from tests.conftest import Run
from tests.gui.conftest import CopySample

pytestmark = pytest.mark.usefixtures("little_search")

SMALL = {
    "pools.width_mm": (6.5, 6.5),
    "pools.length_mm": (7.0, 7.0),
    "pools.height_mm": (0.2, 0.21),
    "bench.projection_angle_deg": (26.0, 26.0),
    "bench.distance_mm": (40.0, 40.0),
    "bench.plane_distance_mm": (60.0, 65.0),
}


@pytest.fixture
def adviser(window: MainWindow, copy_sample: CopySample, qtbot: QtBot) -> AdviserWindow:
    """The adviser window with a session and a small request."""
    assert window.files.open(copy_sample("gtaw"))
    window.do("adviser")
    tool = window.findChild(AdviserWindow)
    assert tool is not None
    qtbot.waitUntil(tool.isVisible)
    for key, ends in SMALL.items():
        tool.ranges[key].set_value(ends)
    tool.effort.set_value("quick")
    return tool


def click(button: QPushButton) -> None:
    QTest.mouseClick(button, Qt.MouseButton.LeftButton)


def test_request_has_the_pool_and_rig_of_the_session(copy_sample: CopySample):
    with Session.open(copy_sample("gtaw")) as session:
        session.calibrate_laser([4.64, 4.68], [6.26, 6.21], [2.75, 2.78])
        values = adviser_presenter.question(session)
        expected, limits = parse_request(values, "here")
        known = session.setup.rig.uncertainty
    # The covariance of the session's set-up, including correlations.
    np.testing.assert_allclose(limits.uncertainty.covariance, known.covariance, rtol=1e-9)
    assert expected.width_mm == pytest.approx((0.9 * 6.7, 1.1 * 6.7))
    assert expected.kind == "convex"
    assert limits.angle_deg == (25.0, 35.0)
    assert limits.pattern.rows == 19
    parse_request(adviser_presenter.question(None), "here")


def test_advice_equals_that_of_the_command_and_can_be_undone(
    adviser: AdviserWindow, labapp: Run, qtbot: QtBot, tmp_path: Path
):
    session = adviser.workspace.session
    assert session is not None
    turned = {
        "laser": {"azimuth_deg": 2.0, "aim_x_mm": 0.4, "aim_y_mm": -0.3},
        "imaging_plane": {"pitch_deg": 1.0, "yaw_deg": -2.0, "roll_deg": 3.0},
    }
    session.update_setup(turned, "turned")
    before = session.setup_text
    click(adviser.start_button)
    assert not adviser.start_button.isEnabled()
    qtbot.waitUntil(lambda: adviser.advice is not None)
    adviser.save(tmp_path / "window")
    values = adviser.values()
    lines = []
    for table, keys in values.items():
        lines.append(f"[{table}]")
        lines += [f"{key} = {str(value).replace(chr(39), chr(34))}" for key, value in keys.items()]
    lines = [line if "kind" not in line else 'kind = "convex"' for line in lines]
    question = tmp_path / "question.toml"
    question.write_text("\n".join(lines), "utf-8")
    code, _, err = labapp("advise", question, "--quick", "--out", tmp_path / "command")
    assert code == 0, err
    names = sorted(path.name for path in (tmp_path / "command").iterdir())
    assert sorted(path.name for path in (tmp_path / "window").iterdir()) == names
    names.remove("advise.json")
    assert names == ["advice.csv", "advice.md", "advice.png", "patterns.csv", "setup.toml"]
    for name in names:
        content = (tmp_path / "window" / name).read_bytes()
        assert content == (tmp_path / "command" / name).read_bytes(), name
    (tmp_path / "window" / "setup.toml").write_text("calibrated", "utf-8")
    adviser.save(tmp_path / "window")
    assert (tmp_path / "window" / "setup.toml").read_text("utf-8") == "calibrated"
    assert "setup.toml" in adviser.message.text()
    click(adviser.use_button)
    found, place = session.setup.rig, adviser.advice.best.place
    assert found.laser == Laser(26.0, 40.0)
    position = (round(value, 2) for value in (place.plane_mm, place.s_mm, place.h_mm))
    advised = ImagingPlane.vertical(*position, *adviser.advice.limits.plate_mm)
    for name in ("origin_mm", "normal", "x_axis", "z_axis"):
        ours, theirs = (getattr(plane, name) for plane in (found.imaging_plane, advised))
        np.testing.assert_allclose(ours, theirs, atol=1e-12, err_msg=name)
    assert session.setup_text != before
    adviser.workspace.undo()
    assert session.setup_text == before
    adviser.costs.copy_csv()
    assert QApplication.clipboard().text().startswith("quantity,unit,way")


def test_disabled_buttons_say_why(adviser: AdviserWindow, window: MainWindow, qtbot: QtBot):
    words = [adviser.use_button.toolTip(), adviser.save_button.toolTip()]
    assert words == [adviser_presenter.NO_ADVICE] * 2
    session = adviser.workspace.session
    assert session is not None
    adviser.ranges["pools.height_mm"].set_value((0.5, 0.6))
    adviser.start()
    qtbot.waitUntil(lambda: not adviser.working)
    assert adviser.use_button.toolTip() == adviser_presenter.IMPOSSIBLE
    path = session.path
    window.files.close()
    assert path.stem in adviser.use_button.toolTip()
    with Session.open(path, read_only=True) as locked:
        assert "read-only" in adviser_presenter.why_not_usable(locked, adviser.advice)


def test_impossible_request_is_explained(adviser: AdviserWindow, qtbot: QtBot):
    adviser.ranges["pools.height_mm"].set_value((0.5, 0.6))
    click(adviser.start_button)
    qtbot.waitUntil(lambda: adviser.advice is not None)
    assert "No set-up is possible" in adviser.headline.text()
    assert "dots on the imaging plane" in adviser.headline.text()
    assert not adviser.use_button.isEnabled()


def test_invalid_request_is_rejected(adviser: AdviserWindow):
    adviser.ranges["pools.width_mm"].set_value((8.0, 6.0))
    click(adviser.start_button)
    assert not adviser.working
    assert "pools.width_mm" in adviser.message.text()


@pytest.mark.parametrize("how", ["escape", "close", "app"])
def test_adviser_can_be_stopped(adviser: AdviserWindow, window: MainWindow, qtbot: QtBot, how: str):
    adviser.effort.set_value("thorough")
    click(adviser.start_button)
    qtbot.waitUntil(lambda: adviser.bar.maximum() > 0)
    if how == "escape":
        QTest.keyClick(adviser, Qt.Key.Key_Escape)
        assert adviser.isVisible()
    elif how == "close":
        click(adviser.close_button)
        assert not adviser.isVisible()
    else:
        window.close()
    qtbot.waitUntil(lambda: not adviser.working)
    assert adviser.advice is None
    assert adviser.message.text() == "Stopped"


def test_setup_page_opens_the_adviser(window: MainWindow, copy_sample: CopySample, qtbot: QtBot):
    assert window.files.open(copy_sample("gtaw"))
    window.show_step("setup")
    page = window.page
    assert isinstance(page, SetupPage)
    page.tabs.setCurrentIndex(2)
    button = next(b for b in window.findChildren(QPushButton) if b.text() == "Advise…")
    click(button)
    tool = window.findChild(AdviserWindow)
    assert tool is not None
    qtbot.waitUntil(tool.isVisible)
    click(tool.close_button)
    window.do("adviser")
    assert len(window.findChildren(AdviserWindow)) == 1


def test_advice_belongs_to_the_session_for_which_it_was_sought(
    adviser: AdviserWindow, window: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    click(adviser.start_button)
    qtbot.waitUntil(lambda: adviser.advice is not None and not adviser.working)
    assert adviser.use_button.isEnabled()
    found, gtaw = adviser.headline.text(), adviser.workspace.session.path
    assert window.files.open(copy_sample("thumb_tack"))
    session = adviser.workspace.session
    assert session is not None
    assert adviser.ranges["pools.width_mm"].value() == pytest.approx((8.775, 10.725))
    assert not adviser.use_button.isEnabled()
    reason = "This advice was sought for gtaw: press Advise for thumb_tack."
    assert adviser.use_button.toolTip() == reason
    assert adviser.headline.text() == f"{reason} {found}"
    before = session.setup_text
    adviser.use()
    assert session.setup_text == before
    window.do("close")
    assert not adviser.use_button.isEnabled()
    assert window.files.open(gtaw)
    assert adviser.use_button.isEnabled()
    assert adviser.headline.text() == found
    session = adviser.workspace.session
    assert session is not None
    session.update_setup({"pattern": {"rows": 9, "absent": None}}, "another pattern")
    adviser.workspace.changed.emit()
    assert not adviser.use_button.isEnabled()
    assert "another pattern" in adviser.use_button.toolTip()


def test_advice_asks_for_the_pattern_of_the_open_session(adviser: AdviserWindow):
    session = adviser.workspace.session
    assert session is not None
    session.update_setup({"pattern": {"rows": 9, "absent": None}}, "another pattern")
    assert adviser.values()["pattern"]["rows"] == 9


def test_adviser_says_that_it_does_not_advise_on_lines(
    adviser: AdviserWindow, window: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    click(adviser.start_button)
    qtbot.waitUntil(lambda: adviser.advice is not None and not adviser.working)
    click(adviser.close_button)
    assert window.files.open(copy_sample("five_lines"))
    window.do("adviser")
    session = adviser.workspace.session
    assert session is not None
    before = session.setup_text
    assert adviser.headline.text().startswith("The session is of a line pattern")
    assert "sought for gtaw" in adviser.headline.text()
    assert not adviser.start_button.isEnabled()
    assert not adviser.use_button.isEnabled()
    adviser.start()
    adviser.use()
    assert not adviser.working
    assert session.setup_text == before


def test_unknown_uncertainty_is_not_shown_as_a_number(adviser: AdviserWindow, qtbot: QtBot):
    click(adviser.start_button)
    qtbot.waitUntil(lambda: adviser.advice is not None)
    advice = replace(adviser.advice, sigma_mm=math.nan, random_mm=math.nan, pools=12, lost=3)
    words = adviser_presenter.headline(advice)
    assert "3 of 12 simulated pools gave no surface" in words
    assert "±" not in words.partition(":")[0]
    assert not re.search(r"\b(nan|inf)\b", words)
