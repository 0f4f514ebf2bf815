"""A complete experiment by mouse and keyboard, from New to the exported files.

Every number is typed, dragged or chosen in the window, and passed to the command line as text; the
files of both are compared byte for byte.
"""

from __future__ import annotations

import csv
import json
import shutil
import tomllib
from pathlib import Path
from typing import TypeVar

import pytest
from PySide6.QtCore import QCoreApplication, Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.pages.export.page import ExportPage
from labapp.gui.pages.laser.page import LaserPage
from labapp.gui.pages.page import Page
from labapp.gui.pages.plane.page import PlanePage
from labapp.gui.pages.setup.page import SetupPage
from labapp.gui.pages.surface.page import SurfacePage
from labapp.gui.shell.window import MainWindow
from tests.conftest import Run
from tests.gui.conftest import SAMPLES
from tests.gui.hand import CONTROL, SHIFT, Hand

SAMPLE = SAMPLES / "gtaw"

P = TypeVar("P", bound=Page)

RECORD = {"title": "Bead 7", "operator": "A. Weld", "current_a": "75", "gas": "Argon"}

RIG = {
    "pattern": {"rows": "19", "columns": "19", "inter_beam_angle_deg": "0.77"},
    "electrode": {"height_mm": "5"},
    "imaging_plane": {
        "distance_mm": "50",
        "s_mm": "45",
        "h_mm": "3",
        "width_mm": "101.6",
        "height_mm": "101.6",
    },
}
"""The sample's set-up as typed, without the laser and the camera, which are calibrated."""

CROSS = (("4.65", "4.66"), ("6.22", "6.23"), ("2.75", "2.76"))
"""Two readings each of l₁, l₂, l₃, for a laser at 31.48 mm and 31.14 degrees."""

UNIT_MM = "6.35"

FRAMES = (4, 6, 2)
"""First, last and step: frames 4 and 6."""

CORRECTED = 6


def place_of(ray: tuple[int, int]) -> tuple[float, float]:
    """True position (u, v) of a ray's dot in the corrected frame, px."""
    with (SAMPLE / "dots_truth.csv").open() as file:
        for line in csv.DictReader(file):
            if (int(line["frame"]), int(line["ray_row"]), int(line["ray_column"])) == (
                CORRECTED,
                *ray,
            ):
                assert line["visible"] == "1"
                return float(line["u_px"]), float(line["v_px"])
    raise AssertionError(f"ray {ray} has no dot in frame {CORRECTED}")


MOVED, DELETED = (8, 9), (12, 11)
"""Rays whose dots are moved (1 px to the right and 2 px down) and deleted."""


@pytest.fixture
def hand(window: MainWindow, qtbot: QtBot) -> Hand:
    """A `Hand` for the window at first start; dialogs are non-native, so that keys work in them."""
    QCoreApplication.setAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    return Hand(window)


def page(hand: Hand, kind: type[P]) -> P:
    """The visible page, which must be of that type."""
    current = hand.window.page
    assert isinstance(current, kind), current
    return current


def settle(hand: Hand, qtbot: QtBot) -> None:
    qtbot.waitUntil(lambda: not hand.window.workspace.tasks.active)
    assert hand.window.status_line.unread == []


def set_up(hand: Hand) -> None:
    setup_page = page(hand, SetupPage)
    for name, text in RECORD.items():
        hand.enter(setup_page.record_fields[name], text)
    hand.tab(setup_page.tabs, "Bench")
    for section, values in RIG.items():
        for key, text in values.items():
            hand.enter(setup_page.rig_fields[f"{section}.{key}"], text)


def calibrate(hand: Hand, qtbot: QtBot) -> None:
    hand.press(Qt.Key.Key_2, CONTROL)
    laser = page(hand, LaserPage)
    for column, readings in enumerate(CROSS):
        for row, text in enumerate(readings):
            hand.cell(laser.table, row, column, text)
    hand.button("Apply")
    hand.press(Qt.Key.Key_PageDown, CONTROL)
    plane = page(hand, PlanePage)
    hand.enter(plane.unit, UNIT_MM)
    hand.answer(SAMPLE / "calibration.png")
    hand.button("Load picture…")
    qtbot.waitUntil(plane.use_button.isEnabled)
    settle(hand, qtbot)
    hand.button("Apply")


def take_frames(hand: Hand, qtbot: QtBot, recording: Path) -> None:
    hand.press(Qt.Key.Key_5, CONTROL)
    capture = page(hand, CapturePage)
    hand.answer(recording)
    hand.button("Choose file…")
    chosen = capture.chosen
    qtbot.waitUntil(chosen.isVisible)
    for field, number in zip((chosen.first, chosen.last, chosen.every), FRAMES, strict=True):
        hand.enter(field, str(number))
    settle(hand, qtbot)
    hand.button("Import")
    settle(hand, qtbot)


def correct(hand: Hand, qtbot: QtBot) -> None:
    """Move a dot with the arrow keys and delete another; the fit follows by itself."""
    hand.press(Qt.Key.Key_6, CONTROL)
    dots = page(hand, DotsPage)
    hand.click(dots.view)
    hand.press(Qt.Key.Key_Escape)  # the click may have selected a dot, which the arrow would move
    hand.press(Qt.Key.Key_Right)
    assert hand.window.workspace.frame == CORRECTED
    qtbot.waitUntil(lambda: dots.reader.frame == CORRECTED and dots.editor.correction is not None)
    port = dots.view.canvas.viewport()
    hand.click(port, hand.point(dots.view, *place_of(MOVED)))
    for key in (Qt.Key.Key_Right, Qt.Key.Key_Down, Qt.Key.Key_Down):
        hand.press(key, SHIFT)
    settle(hand, qtbot)
    QTest.qWait(400)  # otherwise the next click would be a double click
    hand.click(port, hand.point(dots.view, *place_of(DELETED)))
    hand.press(Qt.Key.Key_Delete)
    settle(hand, qtbot)


def export(hand: Hand, qtbot: QtBot, folder: Path, scheme: str) -> None:
    export_page = page(hand, ExportPage)
    hand.choose(export_page.scheme, scheme)
    hand.enter(export_page.folder, str(folder))
    hand.button("Export")
    qtbot.waitUntil(lambda: export_page.written is not None)
    settle(hand, qtbot)


def by_hand(hand: Hand, qtbot: QtBot, recording: Path, folder: Path) -> None:
    """The complete experiment in the window."""
    hand.answer(folder / "by hand")
    hand.press(Qt.Key.Key_N, CONTROL)
    set_up(hand)
    calibrate(hand, qtbot)
    take_frames(hand, qtbot, recording)
    hand.press(Qt.Key.Key_F5)
    settle(hand, qtbot)
    correct(hand, qtbot)
    hand.press(Qt.Key.Key_7, CONTROL)
    hand.choose(page(hand, SurfacePage).side.scheme, "ERS: extrapolation")
    hand.press(Qt.Key.Key_F5)
    settle(hand, qtbot)
    hand.press(Qt.Key.Key_9, CONTROL)
    hand.tick("PLY", True)
    export(hand, qtbot, folder / "ers by hand", "ERS (as in the settings)")
    export(hand, qtbot, folder / "fit by hand", "fit")


def by_command(labapp: Run, recording: Path, folder: Path) -> None:
    """The same experiment on the command line."""

    def run(*arguments: object) -> None:
        code, _, err = labapp(*arguments)
        assert code == 0, err

    setup, session = folder / "setup.toml", folder / "by command.labsession"
    lines = []
    for section, values in RIG.items():
        lines += [f"[{section}]", *(f"{key} = {text}" for key, text in values.items())]
    setup.write_text("\n".join(lines))
    readings = [(f"--l{k}", text) for k, texts in enumerate(CROSS, 1) for text in texts]
    run("calibrate", "laser", *sum(readings, ()), "--setup", setup)
    run("calibrate", "plane", SAMPLE / "calibration.png", "--unit-mm", UNIT_MM, "--setup", setup)
    record = [(f"--{name.replace('_', '-')}", text) for name, text in RECORD.items()]
    run("session", "new", session, "--setup", setup, *sum(record, ()))
    first, last, every = FRAMES
    run("session", "import", session, recording, "--frames", f"{first}:{last + 1}:{every}")
    run("session", "measure", session)
    edits = [
        ("--move", "{:.2f},{:.2f}:1,2".format(*place_of(MOVED))),
        ("--delete", "{:.2f},{:.2f}".format(*place_of(DELETED))),
    ]
    run("session", "correct", session, "--frame", CORRECTED, *sum(edits, ()))
    run("session", "measure", session, "--scheme", "ers")
    for scheme in ("ers", "fit"):
        out = ("--out", folder / f"{scheme} by command", "--surfaces", "csv,stl,ply")
        run("session", "export", session, *out, "--scheme", scheme)


def compare(one: Path, other: Path) -> None:
    """Check that all files are equal, and the manifests except for session name and times."""
    names = sorted(path.name for path in other.iterdir())
    assert sorted(path.name for path in one.iterdir()) == names
    assert {f"surface_{frame:06d}.stl" for frame in (4, 6)} < set(names)
    for name in set(names) - {"manifest.json"}:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    manifest, expected = (
        json.loads((where / "manifest.json").read_text()) for where in (one, other)
    )
    assert manifest["files"] == expected["files"]
    manifest, expected = manifest["provenance"], expected["provenance"]
    for each in (manifest, expected):
        assert each["source"].pop("imported")
    for key in ("record", "source", "settings", "measured_by", "corrected_frames"):
        assert manifest[key] == expected[key], key
    setup, of_command = (tomllib.loads(each["setup"]["toml"]) for each in (manifest, expected))
    assert setup == of_command


@pytest.mark.slow
def test_window_and_command_line_give_the_same_files(
    hand: Hand, labapp: Run, qtbot: QtBot, tmp_path: Path
) -> None:
    recording = tmp_path / "recording.avi"
    shutil.copyfile(SAMPLE / recording.name, recording)
    by_hand(hand, qtbot, recording, tmp_path)
    by_command(labapp, recording, tmp_path)
    for scheme in ("ers", "fit"):
        compare(tmp_path / f"{scheme} by hand", tmp_path / f"{scheme} by command")
