"""Settings of a live camera and of its recording: available fields and rejected values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from labapp.errors import InputError
from labapp.gui.live import view as live_view
from labapp.gui.live.camera_fields import CameraFields, region_of, region_text
from labapp.gui.live.live import WAITS
from labapp.gui.live.plan_fields import cost_text
from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.fields import Field
from labapp.media import GreyImage, open_source
from labapp.media.cameras import CameraSettings, Limits, Range, SimulatedDevice
from labapp.media.cameras.base import check_settings
from labapp.media.cameras.simulated import SimulatedCamera
from labapp.media.recording.recorder import Plan
from labapp.session.session import Session
from tests.gui.hand import Hand

SHAPE = (48, 64)


def picture(k: int) -> GreyImage:
    """Frame k: the value of each pixel encodes its position."""
    return np.add.outer(2 * np.arange(SHAPE[0]), np.arange(SHAPE[1])).astype(np.uint8)


class Industrial(SimulatedCamera):
    """A camera with an exposure, in steps of 10 µs, a gain, and an input."""

    def __init__(self, device: SimulatedDevice) -> None:
        super().__init__(device)
        self.limits = replace(
            self.limits,
            exposure_us=Range(20.0, 5000.0),
            gain_db=Range(0.0, 24.0),
            triggers=("free", "software", "line"),
        )

    def apply(self, wanted: CameraSettings) -> CameraSettings:
        check_settings(self.info, self.limits, wanted)
        current = self._device.settings
        if wanted.exposure_us is not None:
            current = replace(current, exposure_us=10.0 * round(wanted.exposure_us / 10))
        self._device.settings = replace(current, gain_db=wanted.gain_db or current.gain_db)
        return super().apply(replace(wanted, exposure_us=None, gain_db=None))


class Device(SimulatedDevice):
    def open(self) -> SimulatedCamera:
        return Industrial(self)


@pytest.fixture
def device() -> SimulatedDevice:
    simulated = Device("test", picture, rate_hz=100)
    simulated.settings = replace(simulated.settings, exposure_us=500.0, gain_db=0.0)
    return simulated


@pytest.fixture
def page(
    window: MainWindow,
    tmp_path: Path,
    device: SimulatedDevice,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> CapturePage:
    monkeypatch.setattr(live_view, "pool_camera", lambda *_: device)
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    window.show_step("capture")
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    assert isinstance(window.page, CapturePage)
    window.page.live_view.start_button.click()
    qtbot.waitUntil(lambda: window.page.live_view.updates > 2)
    return window.page


@pytest.fixture
def fields(page: CapturePage) -> CameraFields:
    return page.live_view.camera_fields


def visible_fields(fields: CameraFields) -> set[str]:
    return {name for name, field in fields.fields.items() if not field.isHidden()}


def problem(field: Field) -> str:
    return "" if field.problem.isHidden() else field.problem.text()


def test_only_supported_settings_are_shown(fields: CameraFields):
    assert visible_fields(fields) == {"exposure_us", "gain_db", "rate_hz", "trigger", "region"}
    assert fields.region.value() == "0, 0, 64, 48"
    assert fields.whole_button.isHidden()
    plain = Limits(rate_hz=Range(1, 100), sensor=(64, 48))
    fields._show(CameraSettings(rate_hz=50.0, region=(0, 0, 64, 48), trigger="free"), plain)
    assert visible_fields(fields) == {"rate_hz"}
    fixed = Limits(sensor=(64, 48), triggers=("free", "line"))
    fields._show(CameraSettings(), fixed)
    assert visible_fields(fields) == {"trigger"}
    assert fields.trigger.editor.count() == 2


def test_gain_of_usb_video_has_no_unit(fields: CameraFields, monkeypatch: pytest.MonkeyPatch):
    assert fields.fields["gain_db"].unit.text() == "dB"
    camera = fields._feed.camera
    monkeypatch.setattr(camera, "limits", replace(camera.limits, gain_unit=""))
    fields.show_camera(fields._feed)
    assert fields.fields["gain_db"].unit.text() == ""


def test_value_rounded_by_the_camera_is_reported(page: CapturePage, fields, device, qtbot: QtBot):
    exposure = fields.fields["exposure_us"]
    Hand(page.window()).enter(exposure, "804")
    qtbot.waitUntil(lambda: device.settings.exposure_us == 800 and not fields.waiting)
    assert exposure.value() == 800
    assert problem(exposure) == "⚠ The camera takes 800, not 804"
    Hand(page.window()).enter(exposure, "900")
    qtbot.waitUntil(lambda: device.settings.exposure_us == 900 and not fields.waiting)
    assert problem(exposure) == ""
    Hand(page.window()).enter(exposure, "9000")
    assert problem(exposure) == "⚠ “9000” is not from 20 to 5000 µs; 900.0 stays"
    assert device.settings.exposure_us == 900


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "“” is not four whole numbers: left, top, width, height (px)"),
        ("8 8 16", "“8 8 16” is not four whole numbers"),
        ("-1, 0, 20, 20", "“-1, 0, 20, 20” is not four whole numbers"),
        ("0, 0, 20, 20, 20", "is not four whole numbers"),
        (
            "60, 0, 20, 20",
            "60, 0, 20, 20 is refused; it must be (u, v, width, height) within 64×48",
        ),
        ("0, 0, 20, 3", "at least 16×16 px"),
    ],
)
def test_invalid_region_is_rejected(
    page: CapturePage, fields, device, qtbot: QtBot, text: str, words: str
):
    Hand(page.window()).enter(fields.region, text or " ")
    qtbot.waitUntil(lambda: problem(fields.region) != "" and not fields.waiting)
    assert words in problem(fields.region)
    assert fields.region.value() == "0, 0, 64, 48"
    assert device.settings.region == (0, 0, 64, 48)


def test_region_applies_to_display_and_recording(page: CapturePage, fields, device, qtbot: QtBot):
    view, hand = page.live_view, Hand(page.window())
    hand.enter(fields.region, "8 4 32 20")
    qtbot.waitUntil(lambda: device.settings.region == (8, 4, 32, 20) and not fields.waiting)
    assert fields.region.value() == "8, 4, 32, 20"
    assert fields.part_words.isVisible()
    qtbot.waitUntil(lambda: np.shape(page.picture_view.picture) == (20, 32))
    assert "with a picture of this very region" in fields.part_words.text()
    fields.show_camera(view.live.feed, (20, 32))  # it may have had another position
    assert "with a picture of this very region" in fields.part_words.text()
    fields.show_camera(view.live.feed, SHAPE)
    assert "a picture of 64×48 px, and frames have 32×20 px" in fields.part_words.text()
    # The frames before the trigger have the new size, too.
    view.trigger()
    assert not fields.region.editor.isEnabled()
    assert not fields.whole_button.isEnabled()
    take = view.live.takes[0]
    qtbot.waitUntil(lambda: take.frames > 20)
    view.trigger()
    qtbot.waitUntil(take.finished.is_set)
    assert take.lost == 0
    with open_source(take.path) as video:
        assert np.array_equal(video.frame(0).image, picture(0)[4:24, 8:40])
    qtbot.waitUntil(fields.region.editor.isEnabled)
    hand.click(fields.whole_button)
    qtbot.waitUntil(lambda: device.settings.region == (0, 0, 64, 48) and not fields.waiting)
    assert fields.whole_button.isHidden()
    assert fields.part_words.isHidden()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_software_trigger_takes_single_frames(page: CapturePage, fields, device, qtbot: QtBot):
    view, hand = page.live_view, Hand(page.window())
    assert fields.shoot_button.isHidden()
    hand.choose(fields.trigger, "by the button Take a frame")
    qtbot.waitUntil(lambda: device.settings.trigger == "software" and not fields.waiting)
    qtbot.waitUntil(fields.shoot_button.isVisible)
    qtbot.waitUntil(lambda: view.bar.state.text().startswith(f"● {WAITS['software']}"))
    taken = device.taken
    for count in (1, 2, 3):
        hand.click(fields.shoot_button)
        qtbot.waitUntil(lambda count=count: device.taken == taken + count)
    qtbot.wait(50)
    assert device.taken == taken + 3
    hand.choose(fields.trigger, "free run")
    qtbot.waitUntil(lambda: device.settings.trigger == "free" and not fields.waiting)
    updates = view.updates
    qtbot.waitUntil(lambda: view.updates > updates + 2)
    assert fields.shoot_button.isHidden()


def test_region_text_round_trip():
    assert region_of("1;2, 300  40") == (1, 2, 300, 40)
    assert region_of(region_text((8, 4, 32, 20))) == (8, 4, 32, 20)
    with pytest.raises(InputError, match="four whole numbers"):
        region_of("1.5, 2, 3, 4")
    for thousand in ("1 024", "1,024"):
        with pytest.raises(InputError):
            region_of(f"0, 0, {thousand}")


# --- cost of recording ----------------------------------------------------------------------------


def test_cost_of_raw_and_ffv1_is_shown():
    byte = 640 * 480
    raw, small = Plan(), Plan(codec="ffv1")
    assert cost_text(raw, byte, 200) == "About 61.4 MB a second, 14 % of a core"
    text = cost_text(small, byte, 200)
    assert text.startswith("⚠ About 25.8 MB a second, 92 % of a core: little is left")
    assert text.endswith("Raw takes 14 %")
    assert "frames will be lost" in cost_text(small, byte, 500)
    assert cost_text(replace(small, every=4), byte, 200) == (
        "About 6.5 MB a second, 23 % of a core"
    )


def test_chosen_codec_is_used(page: CapturePage, qtbot: QtBot):
    view = page.live_view
    qtbot.waitUntil(lambda: "a second" in view.plan_fields.cost.text())
    for words, codec in (("FFV1: small, slow", "ffv1"), ("Raw: large, quick", "raw")):
        Hand(page.window()).choose(view.plan_fields.codec, words)
        assert view.live.plan.codec == codec
        view.trigger()
        take = view.live.takes[-1]
        assert not view.plan_fields.codec.editor.isEnabled()
        qtbot.waitUntil(lambda take=take: take.frames > 10)
        view.trigger()
        qtbot.waitUntil(take.finished.is_set)
        with open_source(take.path) as video:
            assert codec in video.description.lower()
            assert np.array_equal(video.frame(0).image, picture(0))
        qtbot.waitUntil(view.plan_fields.codec.editor.isEnabled)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
