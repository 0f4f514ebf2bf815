"""Settings of a live camera: fields of the recording page, depending on the camera."""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

from PySide6.QtCore import QObject, Signal

from labapp.errors import InputError
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, Field, FieldForm, NumberField, TextField
from labapp.gui.widgets.labels import selectable_label, show_words
from labapp.gui.widgets.layouts import row_of
from labapp.media.cameras import CameraError, CameraSettings, Feed, Limits, Region
from labapp.session.frame_size import other_size

NUMBERS = {
    "exposure_us": ("Exposure", "µs", 1, 100.0, "How long each frame is exposed"),
    "gain_db": ("Gain", "dB", 1, 1.0, "Amplification: it brightens the noise, too"),
    "rate_hz": ("Rate", "frames/s", 2, 10.0, "Frames per second"),
}
"""Label, unit, decimals, step and tip of the numerical settings."""

TRIGGERS = {
    "free": "free run",
    "software": "by the button Take a frame",
    "line": "external signal",
}

DIFFERS = 1e-3
"""Relative difference above which the camera's value is not the requested one."""

PART_WORDS = (
    "Sizes are right only where the imaging plane was calibrated with a picture of this very "
    "region: dots are counted from its upper left corner"
)

Apply = Callable[[CameraSettings], "Future[CameraSettings] | None"]


class CameraFields(QObject):
    """Exposure, gain, rate, trigger and region, as far as the camera allows setting them."""

    reset = Signal()
    """Rate, trigger or region changed: frames differ from the previous ones."""

    def __init__(self, form: FieldForm, apply: Apply) -> None:
        super().__init__(form)
        self._apply = apply
        self._feed: Feed | None = None
        self._calibrated: tuple[int, int] | None = None
        self._answers: list[tuple[str, object, Future[CameraSettings]]] = []
        self.fields: dict[str, Field] = {}
        for name, (label, unit, decimals, step, tip) in NUMBERS.items():
            self.fields[name] = NumberField(
                label, unit, lowest=0, highest=1e9, decimals=decimals, step=step, tooltip=tip
            )
        self.trigger = self.fields["trigger"] = ChoiceField(
            "Trigger", tooltip="What the camera waits for before it takes a frame"
        )
        self.region = self.fields["region"] = TextField(
            "Region, px",
            tooltip="The part of the sensor that is read: left, top, width, height. A smaller one "
            "lets many cameras be faster",
        )
        for name, field in self.fields.items():
            field.edited.connect(partial(self._set, name))
            form.add(field)
        self._make_buttons(form)

    def _make_buttons(self, form: FieldForm) -> None:
        self.whole_button = button("Full sensor", "Read all of the sensor again", self._set_whole)
        self.shoot_button = button("Take a frame", "Take one frame now", self._take_frame)
        self.part_words = selectable_label()
        form.add(row_of(self.shoot_button, self.whole_button), self.part_words)

    # --- what the camera is set to ------------------------------------------------------------

    def show_camera(self, feed: Feed, calibrated: tuple[int, int] | None = None) -> None:
        """Show the settings of an opened camera, but only those that can be changed.

        Parameters
        ----------
        calibrated
            (rows, columns) of the picture used to calibrate the imaging plane, px; None if unknown.
        """
        self._feed, self._calibrated = feed, calibrated
        self._answers.clear()
        for field in self.fields.values():
            field.refuse("")  # a refusal by another camera
        self.fields["gain_db"].unit.setText(feed.camera.limits.gain_unit)
        self._show(feed.settings, feed.camera.limits)

    def set_calibrated(self, calibrated: tuple[int, int] | None) -> None:
        """Compare the frames with another picture of calibration, see `show_camera`."""
        self._calibrated = calibrated
        if self._feed is not None and not self.waiting:
            self._show(self._feed.settings, self._feed.camera.limits)

    def set_recording(self, recording: bool) -> None:
        """Prevent changes of the frame size during a recording."""
        why = "Not while it records: a recording's frames are of one size"
        for each in (self.region.editor, self.whole_button):
            each.setEnabled(not recording)
        self.region.editor.setToolTip(why if recording else self.region.label.toolTip())

    def _show(self, settings: CameraSettings, limits: Limits) -> None:
        there = {name: getattr(limits, name) is not None for name in NUMBERS}
        there["trigger"] = len(limits.triggers) > 1
        there["region"] = limits.least_region is not None
        for name in NUMBERS:
            field, span = self.fields[name], getattr(limits, name)
            assert isinstance(field, NumberField)
            if span is not None:
                field.lowest, field.highest = span.lowest, span.highest
            field.set_value(getattr(settings, name))
        self.trigger.set_choices([(name, TRIGGERS[name]) for name in limits.triggers])
        self.trigger.set_value(settings.trigger or "free")
        whole = (0, 0, *limits.sensor)
        self.region.set_value(region_text(settings.region or whole))
        for name, field in self.fields.items():
            for part in (field, field.label):
                part.setVisible(there[name])
        is_part = settings.region not in (None, whole)
        self.whole_button.setVisible(there["region"] and is_part)
        _, _, width, height = settings.region or whole
        unlike = other_size(self._calibrated, (height, width))
        if not unlike and is_part:
            unlike = PART_WORDS
        show_words(self.part_words, f"⚠ {unlike}" if unlike else "")
        self.shoot_button.setVisible(settings.trigger == "software")

    # --- to set it ----------------------------------------------------------------------------

    def _set(self, name: str, value: Any) -> None:
        """Request another value; `take_answers` shows the camera's answer."""
        if name == "region":
            try:
                value = region_of(value)
            except InputError as error:
                kept = None if self._feed is None else self._feed.settings.region
                self.region.set_value("" if kept is None else region_text(kept))
                self.region.refuse(f"“{error.value}” is not {error.expected}")
                return
        self._ask(name, value)

    def _set_whole(self) -> None:
        if self._feed is not None:
            self._ask("region", (0, 0, *self._feed.camera.limits.sensor))

    def _ask(self, name: str, value: Any) -> None:
        answer = None if value is None else self._apply(CameraSettings(**{name: value}))
        if answer is not None:
            self._answers.append((name, value, answer))

    def _take_frame(self) -> None:
        if self._feed is not None:
            self._feed.trigger()

    @property
    def waiting(self) -> bool:
        """Whether an answer of the camera is pending."""
        return bool(self._answers)

    def take_answers(self) -> None:
        """Show the values actually set, or why they were refused."""
        for each in [each for each in self._answers if each[2].done()]:
            self._answers.remove(each)
            if self._feed is not None:
                self._take(self._feed, *each)

    def _take(self, feed: Feed, name: str, wanted: object, answer: Future[CameraSettings]) -> None:
        try:
            settings = answer.result()
        except (CameraError, InputError) as error:
            self._show(feed.settings, feed.camera.limits)
            self._refuse(name, error)
            return
        self._show(settings, feed.camera.limits)
        now = getattr(settings, name)
        if isinstance(wanted, float | int) and now is not None:
            differs = abs(now - wanted) > DIFFERS * abs(wanted)
        else:
            differs = now != wanted
        if differs and now is not None:
            words = f"The camera takes {setting_text(now)}, not {setting_text(wanted)}"
            self.fields[name].refuse(words)
        if name in ("rate_hz", "trigger", "region"):
            self.reset.emit()

    def _refuse(self, name: str, error: CameraError | InputError) -> None:
        """Show at each field what is wrong with its value, and what is permitted."""
        if isinstance(error, CameraError):
            self.fields[name].refuse(str(error))
            return
        for problem in error.problems:
            words = f"{setting_text(problem.value)} is refused; it must be {problem.expected}"
            self.fields.get(problem.field, self.fields[name]).refuse(words)


def region_of(text: str) -> Region:
    """The region given by four numbers in a text.

    Raises
    ------
    InputError
        If they are not four whole numbers.
    """
    number = r"(0|[1-9]\d{0,5})"  # "024" is the rest of "1 024"
    found = re.fullmatch(rf"\s*{number}" + rf"[\s,;]+{number}" * 3 + r"\s*", text)
    if found is None:
        expected = "four whole numbers: left, top, width, height (px)"
        raise InputError("camera", "region", text.strip(), expected)
    u, v, width, height = map(int, found.groups())
    return u, v, width, height


def region_text(region: Region) -> str:
    """A region in the form in which it is typed."""
    return ", ".join(map(str, region))


def setting_text(value: object) -> str:
    """A value of a setting as text."""
    if isinstance(value, tuple):
        return region_text(value)
    if isinstance(value, str):
        return f"“{TRIGGERS.get(value, value)}”"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
