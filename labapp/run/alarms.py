"""Alarms of a live measurement: raised, over, and acknowledged by the operator.

An alarm is raised when a size is significantly beyond a limit, when a number of consecutive frames
cannot be measured, or when no frame is measured for long. It is over when its cause has been absent
for a second, so that a pool oscillating about a limit raises one alarm only. It is shown until it
is both over and acknowledged.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from datetime import datetime

from labapp.core.surface.measures import Measures
from labapp.run.limits import NAMES, Limits, Size, Standing, sizes_of, standing
from labapp.text import pluralize

CALM_S = 1.0
"""Time without its cause after which an alarm is over, s by the camera's clock."""

NOT_MEASURED, SILENT, DOUBTFUL = "not-measured", "silent", "setup-doubtful"
"""Codes of the alarms that frames cannot be measured, that none is measured, and that the set-up is
doubtful; the others are ``width-low`` … ``height-high``."""

RAISED = "ALARM: "
"""Begins the text of an event that raises an alarm."""


@dataclass(frozen=True)
class Alarm:
    """A condition that the operator must see."""

    code: str
    """``width-low`` … ``height-high``, ``not-measured``, ``silent`` or ``setup-doubtful``."""
    words: str
    """Description, a sentence without full stop."""
    frame: int
    time_s: float
    """Number of the frame that raised it, and its time by the camera's clock, s."""
    holds: bool = True
    """Whether its condition still holds."""
    acknowledged: bool = False
    """Whether the operator has acknowledged it."""
    at: datetime = field(default_factory=lambda: datetime.now().astimezone())
    """When it was raised."""

    @property
    def description(self) -> str:
        """Description with the frame and the time at which it was raised."""
        return f"{self.words} (frame {self.frame}, {self.at:%H:%M:%S})"


class Alarms:
    """Monitors the sizes of successive frames. May be used from several threads.

    Parameters
    ----------
    limits
        Limits of the sizes; without any, only the set-up is monitored.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        """The limits in use."""
        self._shown: dict[str, Alarm] = {}
        self._held_s: dict[str, float] = {}
        """Last time at which the cause of each alarm was, or may have been, present."""
        self._unmeasured = 0
        self._newest = (0, 0.0)
        """Number and time of the last frame."""
        self._turn = threading.Lock()

    def set_limits(self, limits: Limits) -> list[Alarm]:
        """Replace the limits from the next frame on; returns the alarms that this ends."""
        with self._turn:
            former, self.limits = self.limits, limits
            changed = [name for name in NAMES if former.of(name) != limits.of(name)]
            codes = [f"{name}-{end}" for name in changed for end in ("low", "high")]
            if not limits.are_set:
                self._unmeasured = 0
                codes += [NOT_MEASURED, SILENT]
            return [alarm for code in codes for alarm in self._end(code)]

    @property
    def shown(self) -> tuple[Alarm, ...]:
        """Alarms that hold or were not acknowledged, the oldest first."""
        return tuple(self._shown.values())

    def judge(
        self,
        frame: int,
        time_s: float,
        measures: Measures | None,
        reason: str,
        setup_doubt: str = "",
    ) -> list[Alarm]:
        """Check the next frame.

        Parameters
        ----------
        frame, time_s
            Its number by the camera, and its time, s.
        measures
            Sizes; None if it could not be measured.
        setup_doubt
            Why the set-up is doubtful; empty if it is not.

        Returns
        -------
        list of Alarm
            Alarms that the frame raised, and those that are over (`Alarm.holds` is False).
        """
        with self._turn:
            self._newest = (frame, time_s)
            if measures is not None and self._misses(measures):
                measures, reason = None, "a size with limits is unknown"
            counted = measures is None and self.limits.are_set
            self._unmeasured = self._unmeasured + 1 if counted else 0
            causes = self._causes(measures, reason) if self.limits.are_set else {}
            causes.pop(DOUBTFUL, None)
            if setup_doubt:
                causes[DOUBTFUL] = f"The set-up is doubtful: {setup_doubt}"
            for code, words in causes.items():
                if words is not None or code in self._shown:
                    self._held_s[code] = time_s
            changed = [
                alarm
                for code, words in causes.items()
                if words is not None
                for alarm in self._raise(code, words, frame, time_s)
            ]
            for code in [code for code in self._shown if code not in causes]:
                if time_s - self._held_s[code] >= CALM_S:
                    changed += self._end(code)
            return changed

    def silence(self, words: str) -> list[Alarm]:
        """Raise the alarm that no frame is measured; returns it if it is new."""
        with self._turn:
            if not self.limits.are_set:
                return []
            self._held_s[SILENT] = self._newest[1]
            return self._raise(SILENT, words, *self._newest)

    def acknowledge(self) -> list[Alarm]:
        """Acknowledge all alarms shown; returns those that were not yet acknowledged."""
        with self._turn:
            new = [alarm for alarm in self._shown.values() if not alarm.acknowledged]
            held = (alarm for alarm in self._shown.values() if alarm.holds)
            self._shown = {alarm.code: replace(alarm, acknowledged=True) for alarm in held}
            return new

    def _misses(self, measures: Measures) -> bool:
        """Whether a size with limits is unknown."""
        return any(
            standing(size, self.limits.of(size.name)) == "unknown" for size in sizes_of(measures)
        )

    def _causes(self, measures: Measures | None, reason: str) -> dict[str, str | None]:
        """Return code → description of each alarm cause in a frame; None if it is uncertain."""
        if measures is None:
            unknown: dict[str, str | None] = dict.fromkeys(self._shown)
            unknown.pop(SILENT, None)
            if self._unmeasured < self.limits.unmeasured:
                return unknown
            words = (
                f"{pluralize(self._unmeasured, 'frame')} in a row could not be measured: {reason}"
            )
            return {**unknown, NOT_MEASURED: words}
        found: dict[str, str | None] = {}
        for name, size in zip(NAMES, sizes_of(measures), strict=True):
            stands = standing(size, self.limits.of(name))
            if stands in ("low", "high"):
                found[f"{name}-{stands}"] = in_words(size, stands, self.limits)
            elif stands == "in doubt":
                found |= {f"{name}-low": None, f"{name}-high": None}
        return found

    def _raise(self, code: str, words: str, frame: int, time_s: float) -> list[Alarm]:
        """Raise an alarm; returns none if it holds already."""
        held = self._shown.get(code)
        if held is not None and held.holds:
            return []
        alarm = self._shown[code] = Alarm(code, words, frame, time_s)
        return [alarm]

    def _end(self, code: str) -> list[Alarm]:
        """End an alarm; returns none if it did not hold."""
        held = self._shown.get(code)
        if held is None or not held.holds:
            return []
        over = self._shown[code] = replace(held, holds=False)
        if held.acknowledged:
            del self._shown[code]
        return [over]


def in_words(size: Size, stands: Standing, limits: Limits) -> str:
    """Describe a size beyond its limit: "Width 7.051 ± 0.028 mm is above 6.9 mm"."""
    low, high = limits.of(size.name)
    limit, way = (low, "below") if stands == "low" else (high, "above")
    sigma = f" ± {size.sigma_mm:.3f}" if size.sigma_mm == size.sigma_mm else ""
    return f"{size.name.capitalize()} {size.value_mm:.3f}{sigma} mm is {way} {limit:g} mm"
