from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtGui import QColor, QIcon, QImage, QPalette
from PySide6.QtWidgets import QToolButton
from pytestqt.qtbot import QtBot

from labapp.gui.shell.frame_status import TO_CHECK, FrameStatus, frame_statuses, next_frame
from labapp.gui.shell.window import TICKS
from labapp.gui.widgets.scrubber import aggregated
from labapp.gui.widgets.timeline import Timeline
from labapp.session.file.schema import MEASURES
from labapp.session.results.measured import Overview


def overview(status: list[str], corrected: list[bool], stale: list[bool]) -> Overview:
    count = len(status)
    return Overview(
        np.arange(count), np.arange(count) / 60, tuple(status), np.array(corrected),
        np.array(stale), dict.fromkeys(MEASURES, np.full(count, np.nan)),
    )  # fmt: skip


def shown(qtbot: QtBot, kinds: np.ndarray, width: int = 600) -> Timeline:
    timeline = Timeline(TICKS)
    qtbot.addWidget(timeline)
    timeline.resize(width, 80)
    timeline.set_frames(np.arange(10, 10 + len(kinds)), np.arange(len(kinds)) / 60, kinds)
    timeline.set_frame(10)
    timeline.show()
    return timeline


def test_frame_status():
    results = overview(
        ["", "ok", "ok", "ok", "no-dots", "", "no-match"],
        [False, False, True, True, False, True, True],
        [False, False, False, True, False, False, False],
    )
    assert [FrameStatus(kind).name for kind in frame_statuses(results)] == [
        "NOT_MEASURED", "MEASURED", "CORRECTED", "OUT_OF_DATE", "NOT_MEASURABLE", "CORRECTED",
        "NOT_MEASURABLE",
    ]  # fmt: skip


def test_outlying_frame_is_doubtful():
    width = np.full(40, 6.6)
    width[17] = 9.0
    none = np.zeros(40, bool)
    measures = dict.fromkeys(MEASURES, np.full(40, 1.0)) | {"width_mm": width}
    results = Overview(np.arange(40), np.arange(40) / 60, ("ok",) * 40, none, none, measures)
    assert np.flatnonzero(frame_statuses(results) == FrameStatus.DOUBTFUL).tolist() == [17]


def test_results_that_are_out_of_date_are_counted_as_such(qtbot: QtBot):
    kinds = frame_statuses(overview(["ok"] * 30, [False] * 30, [True] * 30))
    timeline = shown(qtbot, kinds, width=1300)
    assert "30&nbsp;out&nbsp;of&nbsp;date" in timeline.counts.text()
    assert "in doubt" not in timeline.counts.toolTip()


def test_next_frame():
    frames = np.array([0, 5, 10, 15])
    wanted = np.array([True, False, False, True])
    assert next_frame(frames, wanted, 0) == 15
    assert next_frame(frames, wanted, 15) is None
    assert next_frame(frames, wanted, 15, forward=False) == 0
    assert next_frame(frames, wanted, 0, forward=False) is None


def test_one_bad_frame_in_ten_thousand_is_visible():
    kinds = np.full(10_000, FrameStatus.MEASURED, np.int64)
    kinds[4321] = FrameStatus.NOT_MEASURABLE
    columns = aggregated(kinds, 700)
    assert (columns == FrameStatus.NOT_MEASURABLE).sum() == 1
    assert columns[4321 * 700 // 10_000] == FrameStatus.NOT_MEASURABLE
    assert aggregated(np.array([1, 2]), 4).tolist() == [1, 1, 2, 2]


@pytest.mark.parametrize("count", [1, 7, 599, 600, 601, 10_000])
def test_pixels_map_to_frames_in_order(qtbot: QtBot, count: int):
    kinds = np.zeros(count, np.int64)
    scrubber = shown(qtbot, kinds).scrubber
    width = scrubber.width()
    positions = [scrubber.position_at(x) for x in range(width)]
    assert positions[0] == 0
    assert positions[-1] >= count - 1 - count // width
    assert (np.diff(positions) >= 0).all()


def test_frame_kinds_differ_in_shape(qtbot: QtBot):
    shapes = set()
    for kind in range(len(TICKS)):
        timeline = shown(qtbot, np.full(1000, kind, np.int64))
        picture = timeline.scrubber._drawn().convertToFormat(QImage.Format.Format_ARGB32)
        column = [picture.pixelColor(300, y).alpha() > 0 for y in range(picture.height())]
        shapes.add(tuple(column))
    assert len(shapes) == len(TICKS)


def test_clicks_keys_and_typing_select_frames(qtbot: QtBot):
    timeline = shown(qtbot, np.zeros(100, np.int64))
    selected: list[int] = []
    timeline.moved.connect(selected.append)
    timeline.moved.connect(timeline.set_frame)
    scrubber = timeline.scrubber
    middle = QPoint(int(scrubber.width() * 0.505), 15)
    qtbot.mouseClick(scrubber, Qt.MouseButton.LeftButton, pos=middle)
    assert selected[-1] == 60
    qtbot.keyClick(scrubber, Qt.Key.Key_PageUp)
    assert selected[-1] == 50
    timeline.step(1)
    assert selected[-1] == 51
    timeline.step(10**9)
    assert selected[-1] == 109
    timeline.number.setValue(12)
    assert selected[-1] == 12
    assert timeline.position_text.text().startswith("3 of 100 · 0.0333 s")
    assert scrubber.accessibleDescription().startswith("Frame 12, 0.0333 s: ")


def test_number_between_frames_selects_the_nearest(qtbot: QtBot):
    timeline = shown(qtbot, np.zeros(3, np.int64))
    timeline.set_frames(np.array([0, 100, 200]), np.full(3, np.nan), np.zeros(3, np.int64))
    timeline.set_frame(0)
    with qtbot.waitSignal(timeline.moved) as signal:
        timeline.number.setValue(90)
    assert signal.args == [100]
    timeline.set_frame(100)
    timeline.number.setValue(101)
    assert timeline.number.value() == 100


def test_playing_shows_every_frame_and_stops_at_the_end(qtbot: QtBot):
    timeline = shown(qtbot, np.zeros(4, np.int64))
    selected: list[int] = []
    timeline.moved.connect(selected.append)
    timeline.moved.connect(timeline.set_frame)
    timeline.set_playing(True)
    assert timeline.play_button.accessibleName() == "Pause"
    qtbot.waitUntil(lambda: not timeline.playing)
    assert selected == [11, 12, 13]
    assert timeline.play_button.accessibleName() == "Play"
    timeline.set_playing(True)
    assert selected[-1] == 10
    timeline.set_playing(False)


def test_empty_timeline_is_harmless(qtbot: QtBot):
    timeline = shown(qtbot, np.zeros(3, np.int64))
    timeline.set_frames(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))
    timeline.set_frame(0)
    timeline.step(1)
    timeline.set_playing(True)
    assert not timeline.playing
    assert not timeline.isEnabled()
    timeline.grab()


def test_buttons_look_usable_only_while_there_are_frames(qtbot: QtBot):
    timeline = shown(qtbot, np.zeros(0, np.int64))
    timeline.take_colours()  # as when the theme is chosen, before a session is open
    timeline.set_frames(np.arange(3), np.arange(3) / 60, np.zeros(3, np.int64))
    text, icons, groups = QPalette.ColorRole.ButtonText, QIcon.Mode, QPalette.ColorGroup
    for mode, group in ((icons.Normal, groups.Active), (icons.Disabled, groups.Disabled)):
        wanted = timeline.palette().color(group, text)
        for button in timeline.findChildren(QToolButton):
            if not button.icon().isNull():
                picture = button.icon().pixmap(button.iconSize(), mode).toImage()
                assert wanted.rgb() in colours(picture), button.accessibleName()


def colours(picture: QImage) -> set[int]:
    """The colours of the opaque pixels."""
    places = [(x, y) for x in range(picture.width()) for y in range(picture.height())]
    seen = (picture.pixelColor(x, y) for x, y in places)
    return {QColor(each).rgb() for each in seen if each.alpha() == 255}


def test_jumps_name_every_state_that_they_stop_at(qtbot: QtBot):
    timeline = shown(qtbot, np.zeros(3, np.int64))
    tips = [button.toolTip() for button in timeline.findChildren(QToolButton)]
    tips = [tip for tip in tips if "F8)" in tip]
    assert len(tips) == 2
    for status in TO_CHECK:
        assert all(TICKS[status].words.partition(":")[0] in tip for tip in tips)
