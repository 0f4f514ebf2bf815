"""The export page: its plan, obstacles, and agreement with the export of the session."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import cv2
import pytest
from PySide6.QtWidgets import QAbstractButton
from pytestqt.qtbot import QtBot

from labapp.errors import InputError
from labapp.export.folder import ExportChoice, verify_export
from labapp.export.formats import RUN_FORMATS, SURFACE_FORMATS, RunFormat, SurfaceFormat
from labapp.gui.pages.export.page import ExportPage
from labapp.gui.pages.export.presenter import (
    USUAL,
    ExportRequest,
    Written,
    folder_within,
    groups,
    plan,
    proposed_folder,
    schemes,
    write,
)
from labapp.gui.pages.export.sizes import estimated_bytes
from labapp.gui.pages.surface.presenter import with_scheme
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from labapp.text import SETUP_MARKS
from tests.gui.conftest import KEPT


@pytest.fixture
def gtaw(copy_sample) -> Path:
    return copy_sample("gtaw")


def test_default_choice_is_the_default_export() -> None:
    assert ExportRequest().choice() == ExportChoice()
    keys = {item.key for _, items in groups() for item in items}
    everything = ExportRequest(ticked=frozenset(keys)).choice()
    assert everything.solid
    assert everything.run_formats == list(RUN_FORMATS.values())
    assert set(everything.surfaces) == set(SURFACE_FORMATS)
    assert {"csv", "stl", "stl-ascii", "ply", "vtp"} <= set(everything.surfaces)
    assert "results.h5" in [each.file for each in everything.run_formats]
    assert everything.pictures == {"frames", "surfaces", "trends", "film"}
    assert keys > USUAL
    assert not ExportRequest(ticked=frozenset({"solid", "surfaces:csv"})).choice().solid


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_pictures_of_frames_have_the_chosen_format(gtaw: Path, tmp_path: Path, suffix: str) -> None:
    request = ExportRequest(ticked=frozenset({"pictures:frames"}), picture_format=suffix)
    with Session.open(gtaw) as session:
        assert f"frame_NNNNNN.{suffix} (30 files)" in plan(session, request, 0).files
        written = write(session, request, [0], tmp_path / "out", lambda *_: None)
        rows, columns = session.frame(0).image.shape
    (picture,) = written.files
    assert written.words.startswith("1 file and the manifest")
    assert picture.name == f"frame_000000.{suffix}"
    image = cv2.imread(str(tmp_path / "out" / picture.name))
    assert image.shape == (3 * rows, 3 * columns, 3)
    assert picture.size < 1_000_000 or suffix == "tif"


def test_unknown_picture_format_is_rejected() -> None:
    with pytest.raises(InputError, match="picture_format"):
        ExportChoice(picture_format="bmp")


def test_plan_lists_files_and_frames(gtaw: Path) -> None:
    with Session.open(gtaw) as session:
        every = plan(session, ExportRequest(), 3)
        assert len(every.frames) == 30
        assert every.why_not == ""
        assert every.files[:5] == (
            "measures.csv",
            "dots.csv",
            "points.csv",
            "boundary.csv",
            "surface_NNNNNN.csv (30 files)",
        )
        assert every.files[-1].startswith("manifest.json")
        assert every.notes == (f"{SETUP_MARKS['entered']} {session.setup_words}",)
        assert plan(session, ExportRequest(which="view"), 3).frames.tolist() == [3]
        part = plan(session, ExportRequest(which="part", first=4, last=11, every=3), 0)
        assert part.frames.tolist() == [4, 7, 10]
        none = plan(session, ExportRequest(which="part", first=20, last=3), 0)
        assert none.why_not == "There is no frame from 20 to 3."
        assert plan(session, ExportRequest(ticked=frozenset()), 0).why_not.startswith("Tick what")
        assert "measure them first" in plan(session, ExportRequest(scheme="ers"), 0).why_not
        assert schemes(session) == (("", "fit (as in the settings)"),)


def test_plan_reports_missing_surfaces_and_recording(copy_sample) -> None:
    path = copy_sample("blocked_rows")
    with Session.open(path) as session:
        planned = plan(session, ExportRequest(), 0)
        assert planned.notes[1:] == ("3 frames without a surface: in the tables with the reason.",)
        assert "surface_NNNNNN.stl (3 files)" in planned.files
    (path.parent / "recording.mkv").unlink()
    with Session.open(path) as session:
        assert plan(session, ExportRequest(), 0).why_not == ""
        pictures = ExportRequest(ticked=frozenset({"pictures:frames"}))
        assert "recording.mkv is missing" in plan(session, pictures, 0).why_not


def test_plan_explains_outdated_frames_and_lists_them(gtaw: Path) -> None:
    with Session.open(gtaw) as session:
        session.update_setup({"laser": {"distance_mm": 32.0}})
        planned = plan(session, ExportRequest(which="part", first=0, last=4), 0)
        assert planned.why_not == (
            "5 frames out of date, because the rig or a calibration was changed. "
            "Measure again, or undo the change."
        )
        assert planned.again.tolist() == [0, 1, 2, 3, 4]
        session.undo()
        session.set_settings(replace(session.settings, scheme="ers"))
        planned = plan(session, ExportRequest(which="view"), 7)
        assert planned.again.tolist() == [7]
        assert schemes(session) == (("", "ERS (as in the settings)"), ("fit", "fit"))
        other = plan(session, ExportRequest(scheme="fit"), 0)
        assert (len(other.frames), other.why_not) == (30, "")
        assert len(other.again) == 0


def test_plan_of_lines_lists_what_is_written(copy_sample, tmp_path: Path) -> None:
    everything = ExportRequest(ticked=frozenset({"report", "pictures:film", "together:hdf5"}))
    with Session.open(copy_sample("five_lines"), read_only=True) as session:
        planned = plan(session, everything, 0)
        assert planned.why_not == ""
        assert planned.locked.startswith("Lines")
        assert planned.notes[0] == planned.locked
        assert not any("film" in note for note in planned.notes)
        failed = "21 frames that could not be measured: in features.csv with their status."
        assert failed in planned.notes
        frames = planned.frames.tolist()
        written = write(session, everything, frames, tmp_path / "out", lambda *_: None)
    assert written.problems == ()
    rows = (tmp_path / "out" / "features.csv").read_text("utf-8").splitlines()
    assert len(rows) == 1 + len(frames) == 65
    names = [file.name for file in written.files]
    tables = [name for name in names if not name.startswith("surface_")]
    assert tables == sorted(["features.csv", "lines.csv", "line_points.csv"])
    assert planned.files[:-1] == (
        "features.csv",
        "lines.csv",
        "line_points.csv",
        "edges.csv, if the solid metal shows the ends of lines",
        f"surface_NNNNNN.csv ({len(names) - len(tables)} files)",
    )
    with Session.open(copy_sample("gtaw"), read_only=True) as session:
        assert plan(session, everything, 0).locked == ""


def test_folder_with_other_files_is_not_proposed(gtaw: Path, tmp_path: Path) -> None:
    with Session.open(gtaw, read_only=True) as session:
        assert proposed_folder(session) == gtaw.parent / "gtaw-results"
        empty = tmp_path / "empty"
        empty.mkdir()
        assert folder_within(empty, session) == empty
        assert folder_within(gtaw.parent, session) == gtaw.parent / "gtaw-results"
    bad = Written(tmp_path, (), ("a.csv was changed",))
    assert "a.csv was changed" in bad.words


@pytest.fixture
def page(qtbot: QtBot, gtaw: Path) -> ExportPage:
    workspace = Workspace()
    workspace.show(Session.open(gtaw))
    page = ExportPage(workspace)
    KEPT.extend((workspace, page))
    workspace.changed.connect(lambda: page.refresh() if workspace.session else None)
    workspace.frame_changed.connect(page.refresh)
    page.refresh()
    for widget in (page, page.panel):
        widget.resize(800, 600)
        widget.show()
    yield page
    for widget in (page, page.panel):
        widget.hide()
    workspace.close()


def session_of(page: ExportPage) -> Session:
    assert page.workspace.session is not None
    return page.workspace.session


def test_export_button_equals_the_export_of_a_script(
    page: ExportPage, qtbot: QtBot, tmp_path: Path
) -> None:
    page.workspace.show_frame(6)
    page.which.edited.emit("view")
    page.folder.set_value(str(tmp_path / "out"))
    page.export_button.click()
    assert not page.export_button.isEnabled()
    qtbot.waitUntil(lambda: page.written is not None)
    assert page.answer.text().startswith("✓ 6 files and the manifest")
    assert page.export_button.isEnabled()
    script = tmp_path / "script"
    session_of(page).export(script, frames=[6])
    names = sorted(path.name for path in script.iterdir())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    for name in names:
        if name != "manifest.json":
            assert (tmp_path / "out" / name).read_bytes() == (script / name).read_bytes()
    assert verify_export(tmp_path / "out") == []


@pytest.mark.slow
@pytest.mark.parametrize("spacing_mm", [0.1, 0.05])
def test_size_is_estimated_within_a_third(
    page: ExportPage, tmp_path: Path, spacing_mm: float
) -> None:
    session = session_of(page)
    keys = {key for _, items in groups() for key in (item.key for item in items)}
    ticked = frozenset(key for key in keys if not key.startswith("pictures") and key != "report")
    request = ExportRequest(ticked=ticked, which="part", last=2, spacing_mm=spacing_mm)
    planned = plan(session, request, 0)
    frame_px = session.recording.rows * session.recording.columns
    estimate = estimated_bytes(
        request, len(planned.frames), planned.surfaces, planned.area_mm2, frame_px
    )
    files = write(
        session, request, planned.frames.tolist(), tmp_path / "out", lambda *_: None
    ).files
    assert sum(file.size for file in files) == pytest.approx(estimate, rel=0.33)


def test_select_all_and_none(page: ExportPage) -> None:
    (every,) = [b for b in page.findChildren(QAbstractButton) if b.text() == "Select all"]
    (none,) = [b for b in page.findChildren(QAbstractButton) if b.text() == "Select none"]
    every.click()
    assert page.request.ticked == frozenset(page._boxes)
    none.click()
    assert not page.request.ticked
    assert not page.export_button.isEnabled()


def test_frames_of_a_followed_line_are_not_called_failed(copy_sample) -> None:
    with Session.open(copy_sample("gmaw"), read_only=True) as session:
        assert len(session.overview().frame) == 96
        notes = plan(session, ExportRequest(), 0).notes
    assert not any("could not" in note or "without" in note for note in notes)


def test_choices_are_locked_for_lines(page: ExportPage, copy_sample) -> None:
    box = page._boxes["pictures:film"]
    box.click()
    for name, locked in (("five_lines", True), ("blocked_rows", False)):
        page.workspace.show(Session.open(copy_sample(name)))
        page.refresh()
        assert box.isEnabled() is not locked
        assert box.isChecked() is not locked
        assert box.toolTip().startswith("Lines") is locked
        assert page.view.isEnabled() is not locked
        assert page.spacing.isEnabled() is not locked
        assert page.scheme.isEnabled() is not locked
        assert page.export_button.isEnabled()


def test_cancelled_export_leaves_no_files(
    page: ExportPage, qtbot: QtBot, tmp_path: Path, monkeypatch
) -> None:
    folder = tmp_path / "out"
    page.folder.set_value(str(folder))
    original = Session.export

    def cancelled_midway(session: Session, *args, progress, **kwargs):
        def cancel_at_2(done: int, total: int) -> None:
            if done == 2 and page._writing is not None:
                page._writing.cancel()
            progress(done, total)

        return original(session, *args, progress=cancel_at_2, **kwargs)

    monkeypatch.setattr(Session, "export", cancelled_midway)
    page.export()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.written is None
    assert not folder.exists()
    assert list(tmp_path.glob(".out*")) == []
    assert page.export_button.isEnabled()


def test_folder_with_other_files_is_rejected(
    page: ExportPage, qtbot: QtBot, tmp_path: Path
) -> None:
    messages: list[tuple[str, bool]] = []
    page.workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    page.folder.set_value(str(tmp_path / "mine"))
    page.export()
    qtbot.waitUntil(lambda: bool(messages))
    assert messages[0][1]
    assert "mine" in messages[0][0]
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_export_button_is_disabled_with_the_reason(page: ExportPage) -> None:
    page.workspace.attempt(lambda session: session.update_setup({"laser": {"distance_mm": 32.0}}))
    assert not page.export_button.isEnabled()
    assert "out of date" in page.answer.text()
    assert page.again_button.isVisibleTo(page.panel)
    assert page.again_button.text() == "Measure 30 now"
    page.workspace.undo()
    assert page.export_button.isEnabled()
    assert not page.again_button.isVisibleTo(page.panel)
    for box in page._boxes.values():
        box.setChecked(False)
    assert "Tick what" in page.answer.text()
    assert not page._boxes["solid"].isEnabled()


def test_no_frame_can_be_measured_from_here_without_a_setup(page: ExportPage) -> None:
    page.workspace.attempt(lambda session: session.update_setup({"laser": {"distance_mm": None}}))
    assert page.again_button.isVisibleTo(page.panel)
    assert not page.again_button.isEnabled()
    assert "set-up is not complete" in page.again_button.toolTip()
    page.workspace.attempt(lambda session: session.update_setup({"laser": {"distance_mm": 32.0}}))
    assert page.again_button.isEnabled()


def test_export_is_of_the_scheme_in_view(page: ExportPage, tmp_path: Path) -> None:
    page.workspace.changed.disconnect()  # as if the window delayed the display of a change
    page.folder.set_value(str(tmp_path / "out"))
    session = session_of(page)
    own = session.settings
    session.set_settings(with_scheme(own, "ers"))
    session.measure([0])
    page.export_button.click()
    assert not page.workspace.tasks.active
    assert "scheme" in page.answer.text()
    page.refresh()
    session.undo()
    assert session.settings == own
    page.export_button.click()
    assert not page.workspace.tasks.active


@pytest.mark.parametrize("typed", ["", "   ", "{}", "  {}  "])
def test_folder_without_a_name_is_the_proposed_one(
    page: ExportPage, qtbot: QtBot, tmp_path: Path, typed: str
) -> None:
    page.which.edited.emit("view")
    page.folder.editor.setText(typed.format(tmp_path / "out"))
    page.folder.flush()
    page.export_button.click()
    qtbot.waitUntil(lambda: page.written is not None)
    named = tmp_path / "out" if "{" in typed else proposed_folder(session_of(page))
    assert page.written is not None
    assert page.written.folder == named
    assert page.folder.value().strip() == str(named)


def test_every_control_has_a_tooltip(page: ExportPage) -> None:
    for widget in (page, page.panel):
        for button in widget.findChildren(QAbstractButton):
            if button.text():
                assert button.toolTip(), button.text()


@pytest.mark.parametrize("of", ["nodes", "mesh"])
def test_size_of_an_added_format_is_included(monkeypatch, of: Literal["nodes", "mesh"]) -> None:
    toy = SurfaceFormat(".xyz", "Points", "A toy, mm", of, lambda nodes: b"", bytes_each=10.0)
    run = RunFormat("toy.bin", "Toy", "A toy", "toys:Toy", frame_bytes=5e6, node_bytes=0.0)
    monkeypatch.setitem(SURFACE_FORMATS, "xyz", toy)
    monkeypatch.setitem(RUN_FORMATS, "toy", run)

    def size(*ticked: str) -> float:
        return estimated_bytes(ExportRequest(ticked=frozenset(ticked)), 2, 1, 30.0, 300_000)

    smallest = 30.0 / ExportRequest().spacing_mm ** 2 * 10.0
    assert size("surfaces:xyz") - size() >= smallest
    assert size("together:toy") - size() == pytest.approx(1e7)
    assert size("together:toy", "together:hdf5") > 1e7 + 2 * 80_000.0


def test_added_format_can_be_selected(gtaw: Path, tmp_path: Path, monkeypatch) -> None:
    module = SimpleNamespace(xyz=lambda nodes: b"%d points" % len(nodes))
    monkeypatch.setitem(sys.modules, "labapp.export.toys", module)
    toy = SurfaceFormat(".xyz", "Points", "A toy, mm", "nodes", "toys:xyz")
    monkeypatch.setitem(SURFACE_FORMATS, "xyz", toy)
    monkeypatch.setitem(RUN_FORMATS, "toy", RunFormat("toy.bin", "Toy", "A toy", "toys:Toy"))
    workspace = Workspace()
    workspace.show(Session.open(gtaw))
    page = ExportPage(workspace)
    KEPT.extend((workspace, page))
    page.refresh()
    points, run = page._boxes["surfaces:xyz"], page._boxes["together:toy"]
    assert (points.text(), points.toolTip(), run.text()) == ("Points", "A toy, mm", "Toy")
    for box in page._boxes.values():
        box.setChecked(box in (points, run))
    assert page.files.text().splitlines()[:2] == ["surface_NNNNNN.xyz (30 files)", "toy.bin"]
    run.setChecked(False)
    write(session_of(page), page.request, [3], tmp_path / "out", lambda done, total: None)
    assert (tmp_path / "out/surface_000003.xyz").read_bytes().endswith(b" points")
    workspace.close()
