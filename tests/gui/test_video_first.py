"""Starting from a video: frames first, then set-up and surface; the actions are counted."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest
from PySide6.QtCore import QMimeData, QPointF, Qt, QUrl
from PySide6.QtGui import QDropEvent
from pytestqt.qtbot import QtBot

from labapp.config.setup import update_setup
from labapp.errors import InputError
from labapp.gui import dialogs
from labapp.gui.drafts import drafts, is_draft
from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.pages.export.page import ExportPage
from labapp.gui.pages.laser.page import LaserPage
from labapp.gui.shell.window import MainWindow
from labapp.media import open_source
from labapp.session.copies import move_session, use_setup_of
from labapp.session.record import LaserEntries, Record
from labapp.session.session import Session
from tests.gui.conftest import SAMPLES, CopySample, let_draw
from tests.gui.hand import CONTROL, Hand
from tests.tour.bench import lay_out, places

FRAMES = 2


class CountingHand(Hand):
    """A `Hand` that counts its actions: clicks, answers to a dialog, drops."""

    def __init__(self, window: MainWindow, qtbot: QtBot) -> None:
        super().__init__(window)
        self.qtbot = qtbot
        self.actions = 0

    def press_button(self, words: str) -> None:
        """Click a visible button."""
        self.actions += 1
        self.button(words)
        self.settle()

    def choose_file(self, words: str, path: Path) -> None:
        """Click a button, write a path into the dialog that opens, and press Enter."""
        self.actions += 1
        self.answer(path)
        self.press_button(words)

    def drop(self, path: Path) -> None:
        """Drop a file or a folder on the window."""
        self.actions += 1
        data = QMimeData()
        data.setUrls([QUrl.fromLocalFile(str(path))])
        event = QDropEvent(
            *(QPointF(60, 60), Qt.DropAction.CopyAction, data),
            *(Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier),
        )
        self.window.dropEvent(event)
        let_draw()
        self.settle()

    def settle(self) -> None:
        """Wait until no task is running."""
        tasks = self.window.workspace.tasks
        for _ in range(3):  # a task may start another one when it ends
            self.qtbot.waitUntil(lambda: not tasks.active)
            let_draw()


@pytest.fixture
def hand(window: MainWindow, qtbot: QtBot) -> CountingHand:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    return CountingHand(window, qtbot)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A folder with a short recording (a folder of images) and its setup file."""
    folder = tmp_path / "bench"
    images = folder / "recording"
    images.mkdir(parents=True)
    with open_source(SAMPLES / "gtaw" / "recording.avi") as source:
        for k in range(FRAMES):
            cv2.imwrite(str(images / f"{k}.png"), source.frame(k).image)
    shutil.copyfile(SAMPLES / "gtaw" / "setup.toml", folder / "setup.toml")
    return folder


def surface_is_shown(window: MainWindow) -> bool:
    """Whether the visible page is the surface page and shows the current frame."""
    page, session = window.page, window.workspace.session
    assert session is not None
    result = session.result(window.workspace.frame)
    is_ok = result is not None and result.measurement.status == "ok"
    shown = window.stack.currentWidget()
    return is_ok and page is not None and page is shown and page.key == "surface"


@pytest.mark.slow
def test_from_video_to_surface_in_four_actions_or_two(
    window: MainWindow, hand: CountingHand, bench: Path
):
    hand.choose_file("Open recording…", bench / "recording" / "0.png")
    assert window.page is not None
    assert window.page.key == "dots"
    hand.choose_file("Load set-up…", bench / "setup.toml")
    assert surface_is_shown(window)
    assert hand.actions == 4
    window.do("close")
    hand.settle()
    hand.actions = 0
    hand.drop(bench / "recording")
    hand.press_button("Use last set-up")
    assert surface_is_shown(window)
    assert hand.actions == 2
    assert [path.stem for path in drafts()] == ["recording", "0"]


def test_frames_are_shown_without_a_setup_as_a_draft(
    window: MainWindow,
    hand: CountingHand,
    bench: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    hand.drop(bench / "recording")
    session = window.workspace.session
    assert session is not None
    assert is_draft(session.path)
    assert len(session.frames) == FRAMES
    assert window.workspace.folder == bench
    assert window.page is not None
    dots_page = window.page
    hand.qtbot.waitUntil(
        lambda: dots_page.seen is not None and dots_page.seen.correction is not None
    )
    assert "⚠" not in window.page.dots_panel.seen.text()
    window.workspace.attempt(lambda s: s.set_record(Record(title="Mine")))
    window.workspace.show_frame(1)
    named = tmp_path / "named.labsession"
    monkeypatch.setattr(dialogs, "ask_new_session", lambda *_: named)
    window.do("name_draft")
    hand.settle()
    session = window.workspace.session
    assert session is not None
    assert session.path == named
    assert drafts() == []
    assert session.record.title == "Mine"
    assert session.missing_recording is None
    assert session.frame(0).image.shape == (640, 480)
    assert (window.page.key, window.workspace.frame) == ("dots", 1)
    assert str(named) in window.preferences.current.recent
    assert not window.menus.actions["name_draft"].isEnabled()


def test_draft_that_cannot_be_moved_stays_a_draft(
    window: MainWindow,
    hand: CountingHand,
    bench: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    hand.drop(bench / "recording")
    monkeypatch.setattr(dialogs, "ask_new_session", lambda *_: tmp_path / "no" / "a.labsession")
    window.do("name_draft")
    hand.settle()
    session = window.workspace.session
    assert session is not None
    assert drafts() == [session.path]


def test_drafts_are_listed_and_deleted_only_on_confirmation(
    window: MainWindow, hand: CountingHand, bench: Path, monkeypatch: pytest.MonkeyPatch
):
    hand.drop(bench / "recording")
    window.do("close")
    hand.settle()
    (draft,) = drafts()
    window.preferences.remember(lambda before: before.without_recent(draft))
    window._list_recent()
    hand.settle()
    assert "draft" in window.welcome.list.item(0).text()
    answers = [False, True]
    monkeypatch.setattr(dialogs, "ask_delete_draft", lambda *_: answers.pop(0))
    window._forget(draft)
    assert drafts() == [draft]
    window._forget(draft)
    hand.settle()
    assert drafts() == []
    assert window.welcome.list.count() == 0


def test_missing_recent_setup_is_reported_beside_the_button(
    window: MainWindow, hand: CountingHand, bench: Path
):
    hand.drop(bench / "recording")
    hand.press_button("Use last set-up")
    assert window.page is not None
    assert window.page.key == "dots"
    assert window.page.answer.isVisible()
    assert "complete set-up" in window.page.answer.text()


def test_last_setup_asked_for_twice_is_used_once(
    window: MainWindow, hand: CountingHand, bench: Path, copy_sample: CopySample
):
    window.files.open(copy_sample("gtaw"))
    hand.drop(bench / "recording")
    hand.settle()
    window.files.begin_draft(bench / "recording")
    hand.settle()
    session = window.workspace.session
    assert session is not None
    assert session.setup_problems
    window.setups.use_last()
    window.setups.use_last()
    hand.settle()
    assert not session.setup_problems
    window.workspace.undo()
    assert session.setup_problems


def test_setup_for_another_frame_size_is_used_without_measuring(
    window: MainWindow,
    hand: CountingHand,
    bench: Path,
    copy_sample: CopySample,
    monkeypatch: pytest.MonkeyPatch,
):
    other = copy_sample("gtaw")
    with Session.open(other) as session:
        session.calibrate_plane(other.parent / "calibration.png", 6.35)
    small = bench / "small.png"
    cv2.imwrite(str(small), cv2.imread(str(bench / "recording" / "0.png"))[:, :400])
    hand.drop(small)
    monkeypatch.setattr(dialogs, "ask_session", lambda *_: other)
    window.do("other_setup")
    hand.settle()
    session = window.workspace.session
    assert session is not None
    assert session.setup_problems == ()
    assert session.plane_calibration is not None
    assert session.result(0) is None
    assert window.page is not None
    assert "400×640 px" in window.page.answer.text()


@pytest.mark.parametrize("calibrated", [None, [480, 640]])
def test_setup_file_for_another_frame_size_causes_a_warning(
    window: MainWindow,
    hand: CountingHand,
    bench: Path,
    monkeypatch: pytest.MonkeyPatch,
    calibrated: list[int] | None,
):
    """Without the size in the file, by its points, which would lie outside the frames."""
    if calibrated is not None:
        update_setup(bench / "setup.toml", {"image_calibration": {"frame_px": calibrated}})
    small = bench / "small.png"
    cv2.imwrite(str(small), cv2.imread(str(bench / "recording" / "0.png"))[:320, :240])
    hand.drop(small)
    monkeypatch.setattr(dialogs, "ask_setup", lambda *_: bench / "setup.toml")
    window.do("load_setup")
    hand.settle()
    session, page = window.workspace.session, window.page
    assert session is not None
    assert page is not None
    assert session.setup_problems == ()
    assert session.result(0) is None
    assert "240×320 px" in page.answer.text()
    assert ("480×640 px" in page.answer.text()) == (calibrated is not None)
    if calibrated is not None:
        with pytest.raises(InputError, match="480×640"):
            session.measure([0])


def test_setup_of_another_session_includes_its_calibrations(
    copy_sample: CopySample, tmp_path: Path
):
    other = copy_sample("gtaw")
    with Session.open(other) as session:
        session.calibrate_plane(other.parent / "calibration.png", 6.35)
        text, calibration = session.setup_text, session.plane_calibration
    assert calibration is not None
    with Session.create(tmp_path / "new.labsession") as session:
        entries = LaserEntries((("4.6", "", ""),), 10.0, 0.1, 0.05)
        session.set_entries("laser", entries)
        use_setup_of(session, other)
        assert (session.setup_text, session.plane_calibration) == (text, calibration)
        assert session.picture(calibration.picture_sha256).ndim == 2
        assert session.laser_entries is None  # they are of another bench
        session.undo()
        assert (session.setup_text, session.plane_calibration) == ("", None)
        assert session.laser_entries == entries
    with Session.create(tmp_path / "bare.labsession") as bare, pytest.raises(InputError):
        use_setup_of(bare, tmp_path / "new.labsession")


def test_session_is_not_moved_onto_another(copy_sample: CopySample, tmp_path: Path):
    path, other = copy_sample("gtaw"), tmp_path / "other.labsession"
    Session.create(other).close()
    with pytest.raises(InputError):
        move_session(path, other)
    assert path.exists()


@pytest.mark.parametrize("key", ["dots", "surface", "trends", "export", "capture", "plane"])
def test_empty_page_offers_the_next_action(
    window: MainWindow, hand: CountingHand, tmp_path: Path, key: str
):
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    window.show_step(key)
    hand.settle()
    assert window.stack.currentWidget() is window.empty
    first = window.empty.buttons[0]
    assert first.isVisible()
    assert first.isEnabled()
    assert window.empty.words.height() >= window.empty.words.heightForWidth(
        window.empty.words.width()
    )
    hand.press(Qt.Key.Key_Tab)
    assert window.focusWidget() is first


@pytest.mark.slow
def test_row_correction_and_default_export_take_two_actions(
    window: MainWindow, hand: CountingHand, copy_sample: CopySample
):
    assert window.files.open(copy_sample("gtaw"))
    window.show_step("dots")
    hand.settle()
    page, session = window.page, window.workspace.session
    assert isinstance(page, DotsPage)
    assert session is not None
    assert page.seen is not None
    assert page.seen.correction is not None
    lattice, row = page.seen.correction.lattice, 5
    before = lattice.column[lattice.row == row]
    u, v = page.seen.correction.dots.image_px[lattice.row == row][0]
    hand.click(page.view.canvas, hand.point(page.view, u, v))
    hand.actions += 1
    hand.press_button("Row right")
    correction = session.correction(window.workspace.frame)
    assert correction is not None
    assert (
        correction.lattice.column[correction.lattice.row == row].tolist() == (before + 1).tolist()
    )
    assert hand.actions == 2
    session.undo()
    window.workspace.changed.emit()
    hand.settle()
    hand.actions = 0
    bar = window.step_list
    hand.click(bar.viewport(), bar.visualItemRect(bar.item(bar.count() - 1)).center())
    hand.actions += 1
    hand.press_button("Export")
    export = window.page
    assert isinstance(export, ExportPage)
    assert export.written is not None
    assert hand.actions == 2


def test_calibration_from_pictures_takes_at_most_25_actions(
    window: MainWindow, hand: CountingHand, tmp_path: Path
):
    lay_out(tmp_path / "files")
    pictures = tmp_path / "files" / "measurements"
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    session = window.workspace.session
    assert session is not None
    window.show_step("laser")
    laser = window.page
    assert isinstance(laser, LaserPage)
    hand.choose(laser.way, "from a picture")
    hand.actions += 2  # open the list, choose
    hand.choose_file("Load picture…", pictures / "cross_hair.png")
    for name, place in places().items():
        laser._points[name].set_place(*place)  # as a drag does
        hand.actions += 1
    laser._dragged()
    hand.press_button("Add as a reading")
    hand.press_button("Apply")
    assert session.laser_calibration is not None
    hand.press(Qt.Key.Key_3, CONTROL)
    hand.actions += 1
    hand.choose_file("Load picture…", pictures / "calibration.png")
    hand.press_button("Apply")
    assert session.plane_calibration is not None
    assert hand.actions <= 25
