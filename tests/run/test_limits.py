"""Limits of sizes, and alarms: beyond by more than chance, raised once, shown until seen."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.core.pipeline import Measurement
from labapp.core.surface.measures import Measures
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult
from labapp.run.alarms import Alarm, Alarms
from labapp.run.limits import Limits, Size, sizes_of, standing
from labapp.run.streams import stream_values
from labapp.session.session import Session

MEASURES = Measures(*[0.0] * 4, 6.7, 7.5, 0.30, -0.01, *[0.0] * 6, *[0.03, 0.04, 0.003] * 2)


def measured(width_mm: float, sigma_mm: float = 0.03) -> Measures:
    return replace(MEASURES, width_mm=width_mm, width_sigma_mm=sigma_mm)


def codes(alarms: list[Alarm] | tuple[Alarm, ...]) -> list[tuple[str, bool]]:
    return [(alarm.code, alarm.holds) for alarm in alarms]


@pytest.mark.parametrize(
    ("value", "sigma", "ends", "told"),
    [
        (6.7, 0.03, (None, None), ""),
        (math.nan, math.nan, (6.0, None), "unknown"),
        (math.nan, math.nan, (None, None), ""),
        (6.7, 0.03, (6.0, 7.0), "in order"),
        (6.95, 0.03, (None, 6.9), "in doubt"),
        (6.9601, 0.03, (None, 6.9), "high"),
        (6.45, 0.03, (6.5, None), "in doubt"),
        (6.4399, 0.03, (6.5, None), "low"),
        (6.9001, math.nan, (None, 6.9), "high"),
        (-0.35, 0.003, (-0.3, -0.2), "low"),
    ],
)
def test_how_a_size_stands(value: float, sigma: float, ends: tuple, told: str):
    assert standing(Size("width", value, sigma), ends) == told


def test_of_a_hollow_pool_the_depth_is_watched():
    hollow = replace(MEASURES, height_mm=0.01, depth_mm=-0.3, depth_sigma_mm=0.004)
    assert sizes_of(hollow)[2] == Size("depth", -0.3, 0.004)
    assert sizes_of(MEASURES)[2] == Size("height", 0.30, 0.003)
    assert all(math.isnan(size.value_mm) for size in sizes_of(None))
    # A pool that was to rise and is hollow is too low.
    alarms = Alarms(Limits(height_mm=(0.2, 0.4)))
    assert codes(alarms.judge(1, 0.1, hollow, "")) == [("height-low", True)]
    assert "Depth -0.300 ± 0.004 mm is below 0.2 mm" in alarms.shown[0].description


def test_limits_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="width_mm"):
        Limits(width_mm=(7.0, 6.0))
    with pytest.raises(InputError, match="length_mm"):
        Limits(length_mm=(None, math.nan))
    with pytest.raises(InputError, match="unmeasured"):
        Limits(unmeasured=0)
    assert not Limits().are_set
    assert Limits().words == "none"
    some = Limits(width_mm=(6, 6.9), length_mm=(None, 8), height_mm=(-0.3, None))
    assert some.words == "width 6 to 6.9 mm, length to 8 mm, height from -0.3 mm"
    assert Limits(height_mm=(None, 1.0)).are_set


def test_noise_about_a_limit_is_rarely_an_alarm_and_a_pool_beyond_it_always():
    """A true width at the limit is beyond by 2 σ in one frame of 44 (normal distribution)."""
    rng = np.random.default_rng(5)
    ends = (None, 6.9)
    widths = rng.normal(6.9, 0.03, 20_000)
    beyond = [standing(Size("width", float(w), 0.03), ends) == "high" for w in widths]
    assert 0.0195 < np.mean(beyond) < 0.0260  # 0.0228
    inside = rng.normal(6.84, 0.03, 20_000)
    assert sum(standing(Size("width", float(w), 0.03), ends) == "high" for w in inside) <= 5
    outside = rng.normal(7.1, 0.03, 20_000)
    assert all(standing(Size("width", float(w), 0.03), ends) == "high" for w in outside)


def test_an_alarm_is_raised_once_and_stays_until_it_is_over_and_seen():
    alarms = Alarms(Limits(width_mm=(None, 6.9)))
    assert alarms.judge(1, 1.0, measured(6.8), "") == []
    assert codes(alarms.judge(2, 2.0, measured(7.0), "")) == [("width-high", True)]
    assert alarms.judge(3, 3.0, measured(7.1), "") == []
    # Beyond, but by chance perhaps: neither over nor raised again.
    assert alarms.judge(4, 4.0, measured(6.95), "") == []
    assert codes(alarms.judge(5, 5.0, measured(6.8), "")) == [("width-high", False)]
    assert alarms.judge(6, 6.0, measured(6.8), "") == []
    assert codes(alarms.shown) == [("width-high", False)]
    assert (alarms.shown[0].frame, alarms.shown[0].time_s) == (2, 2.0)
    # Again before it was seen: it is told again.
    assert codes(alarms.judge(7, 7.0, measured(7.0), "")) == [("width-high", True)]
    assert [alarm.frame for alarm in alarms.shown] == [7]
    assert codes(alarms.acknowledge()) == [("width-high", True)]
    assert alarms.acknowledge() == []
    assert alarms.shown[0].acknowledged
    assert codes(alarms.judge(8, 8.0, measured(6.8), "")) == [("width-high", False)]
    assert alarms.shown == ()
    assert codes(alarms.judge(9, 9.0, measured(7.0), "")) == [("width-high", True)]


def test_a_pool_that_swings_about_a_limit_is_one_alarm():
    alarms, changed = Alarms(Limits(width_mm=(None, 6.9))), []
    for frame in range(600):
        time_s = frame / 100
        swing = 0.3 * np.sin(2 * np.pi * 2.7 * time_s) if time_s < 4 else -0.3
        changed += alarms.judge(frame, time_s, measured(6.9 + swing), "")
    assert codes(changed) == [("width-high", True), ("width-high", False)]
    assert changed[0].time_s < 0.1


def test_from_too_wide_to_too_narrow():
    alarms = Alarms(Limits(width_mm=(6.0, 6.9)))
    alarms.judge(0, 0.0, measured(7.2), "")
    assert codes(alarms.judge(1, 0.5, measured(5.5), "")) == [("width-low", True)]
    assert codes(alarms.judge(2, 1.1, measured(5.5), "")) == [("width-high", False)]


def test_frames_in_a_row_that_cannot_be_measured_are_an_alarm():
    alarms = Alarms(Limits(width_mm=(6.0, 6.9), unmeasured=3))
    alarms.judge(0, 0.0, measured(7.0), "")
    for frame in (1, 2):
        assert alarms.judge(frame, float(frame), None, "no dots") == []
    # One that could not be measured does not bring a size back in order.
    assert codes(alarms.shown) == [("width-high", True)]
    assert alarms.judge(3, 3.0, measured(7.0), "") == []
    raised = [alarms.judge(frame, float(frame), None, "no dots") for frame in range(4, 9)]
    assert [codes(each) for each in raised] == [[], [], [("not-measured", True)], [], []]
    assert alarms.shown[1].words == "3 frames in a row could not be measured: no dots"
    over = alarms.judge(9, 9.0, measured(6.5), "")
    assert codes(over) == [("width-high", False), ("not-measured", False)]


def test_a_frame_that_misses_a_watched_size_is_not_in_order():
    alarms = Alarms(Limits(width_mm=(None, 6.9), unmeasured=2))
    alarms.judge(1, 0.1, measured(7.2), "")
    for k in range(2, 40):
        alarms.judge(k, 0.1 * k, measured(math.nan), "")
    assert codes(alarms.shown) == [("width-high", True), ("not-measured", True)]


def test_without_limits_nothing_is_watched():
    alarms = Alarms(Limits())
    for frame in range(20):
        assert alarms.judge(frame, 0.0, None, "no dots") == []


def test_other_limits_end_the_alarms_of_the_former():
    alarms = Alarms(Limits(width_mm=(None, 6.9), length_mm=(None, 7.0)))
    alarms.judge(0, 0.0, measured(7.2), "")
    assert [code for code, _ in codes(alarms.shown)] == ["width-high", "length-high"]
    alarms.set_limits(Limits(width_mm=(None, 8.0), length_mm=(None, 7.0)))
    assert codes(alarms.shown) == [("width-high", False), ("length-high", True)]
    alarms.acknowledge()
    assert codes(alarms.shown) == [("length-high", True)]
    alarms.set_limits(Limits())
    assert alarms.shown == ()


def test_alarms_are_told_by_their_codes():
    alarms = Alarms(Limits(width_mm=(None, 6.9), length_mm=(None, 7.0)))
    alarms.judge(3, 0.0, measured(7.2), "")
    alarms.judge(4, 1.0, measured(6.8), "")
    measured_ok = Measurement("ok", "", "fit", measures=MEASURES)
    told = stream_values(FrameResult(4, 0.0, measured_ok), alarms.shown)
    assert told["alarm"] == "length-high"
    assert told["unacknowledged"] == "width-high length-high"
    assert told["width_mm"] == MEASURES.width_mm
    alarms.acknowledge()
    told = stream_values(FrameResult(5, 0.0, Measurement("ok", "", "fit")), alarms.shown)
    assert (told["alarm"], told["unacknowledged"]) == ("length-high", "")


def test_a_session_keeps_its_limits(tmp_path: Path):
    wanted = Limits(width_mm=(6.0, None), height_mm=(-0.4, -0.2), unmeasured=7)
    with Session.create(tmp_path / "a.labsession") as session:
        assert session.limits == Limits()
        session.set_limits(wanted)
        session.set_limits(Limits())
        session.undo()
    with Session.open(tmp_path / "a.labsession") as session:
        assert session.limits == wanted
        assert session.problems() == []


def test_a_set_up_that_is_doubtful_is_an_alarm_without_limits_too():
    alarms = Alarms(Limits())
    assert alarms.judge(1, 1.0, measured(6.8), "") == []
    raised = alarms.judge(2, 2.0, measured(6.8), "", "the laser slipped")
    assert codes(raised) == [("setup-doubtful", True)]
    assert "the laser slipped" in raised[0].words
    assert alarms.judge(3, 3.0, None, "it is dark", "the laser slipped") == []
    assert codes(alarms.judge(4, 5.0, measured(6.8), "")) == [("setup-doubtful", False)]
