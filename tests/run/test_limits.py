"""Limits of sizes and alarms: significant, raised once, shown until acknowledged."""

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
    ("value", "sigma", "ends", "expected"),
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
def test_standing_of_a_size(value: float, sigma: float, ends: tuple, expected: str):
    assert standing(Size("width", value, sigma), ends) == expected


def test_depth_of_a_concave_pool_is_monitored():
    hollow = replace(MEASURES, height_mm=0.01, depth_mm=-0.3, depth_sigma_mm=0.004)
    assert sizes_of(hollow)[2] == Size("depth", -0.3, 0.004)
    assert sizes_of(MEASURES)[2] == Size("height", 0.30, 0.003)
    assert all(math.isnan(size.value_mm) for size in sizes_of(None))
    # A concave pool is below the limits of a convex one.
    alarms = Alarms(Limits(height_mm=(0.2, 0.4)))
    assert codes(alarms.judge(1, 0.1, hollow, "")) == [("height-low", True)]
    assert "Depth -0.300 ± 0.004 mm is below 0.2 mm" in alarms.shown[0].description


def test_impossible_limits_are_rejected():
    with pytest.raises(InputError, match="width_mm"):
        Limits(width_mm=(7.0, 6.0))
    with pytest.raises(InputError, match="length_mm"):
        Limits(length_mm=(None, math.nan))
    with pytest.raises(InputError, match="unmeasured"):
        Limits(unmeasured=0)
    assert not Limits().are_set
    assert Limits().words == "none"
    limits = Limits(width_mm=(6, 6.9), length_mm=(None, 8), height_mm=(-0.3, None))
    assert limits.words == "width 6 to 6.9 mm, length to 8 mm, height from -0.3 mm"
    assert Limits(height_mm=(None, 1.0)).are_set


def test_rate_of_alarms_at_and_beyond_a_limit():
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


def test_alarm_is_raised_once_and_shown_until_acknowledged():
    alarms = Alarms(Limits(width_mm=(None, 6.9)))
    assert alarms.judge(1, 1.0, measured(6.8), "") == []
    assert codes(alarms.judge(2, 2.0, measured(7.0), "")) == [("width-high", True)]
    assert alarms.judge(3, 3.0, measured(7.1), "") == []
    # Beyond the limit, but not significantly: neither over nor raised again.
    assert alarms.judge(4, 4.0, measured(6.95), "") == []
    assert codes(alarms.judge(5, 5.0, measured(6.8), "")) == [("width-high", False)]
    assert alarms.judge(6, 6.0, measured(6.8), "") == []
    assert codes(alarms.shown) == [("width-high", False)]
    assert (alarms.shown[0].frame, alarms.shown[0].time_s) == (2, 2.0)
    # It occurs again before it was acknowledged: it is reported again.
    assert codes(alarms.judge(7, 7.0, measured(7.0), "")) == [("width-high", True)]
    assert [alarm.frame for alarm in alarms.shown] == [7]
    assert codes(alarms.acknowledge()) == [("width-high", True)]
    assert alarms.acknowledge() == []
    assert alarms.shown[0].acknowledged
    assert codes(alarms.judge(8, 8.0, measured(6.8), "")) == [("width-high", False)]
    assert alarms.shown == ()
    assert codes(alarms.judge(9, 9.0, measured(7.0), "")) == [("width-high", True)]


def test_pool_oscillating_about_a_limit_is_one_alarm():
    alarms, changed = Alarms(Limits(width_mm=(None, 6.9))), []
    for frame in range(600):
        time_s = frame / 100
        deviation = 0.3 * np.sin(2 * np.pi * 2.7 * time_s) if time_s < 4 else -0.3
        changed += alarms.judge(frame, time_s, measured(6.9 + deviation), "")
    assert codes(changed) == [("width-high", True), ("width-high", False)]
    assert changed[0].time_s < 0.1


def test_pool_changes_from_too_wide_to_too_narrow():
    alarms = Alarms(Limits(width_mm=(6.0, 6.9)))
    alarms.judge(0, 0.0, measured(7.2), "")
    assert codes(alarms.judge(1, 0.5, measured(5.5), "")) == [("width-low", True)]
    assert codes(alarms.judge(2, 1.1, measured(5.5), "")) == [("width-high", False)]


def test_consecutive_unmeasured_frames_are_an_alarm():
    alarms = Alarms(Limits(width_mm=(6.0, 6.9), unmeasured=3))
    alarms.judge(0, 0.0, measured(7.0), "")
    for frame in (1, 2):
        assert alarms.judge(frame, float(frame), None, "no dots") == []
    # An unmeasured frame does not end the alarm of a size.
    assert codes(alarms.shown) == [("width-high", True)]
    assert alarms.judge(3, 3.0, measured(7.0), "") == []
    raised = [alarms.judge(frame, float(frame), None, "no dots") for frame in range(4, 9)]
    assert [codes(alarms_of_frame) for alarms_of_frame in raised] == [
        [],
        [],
        [("not-measured", True)],
        [],
        [],
    ]
    assert alarms.shown[1].words == "3 frames in a row could not be measured: no dots"
    over = alarms.judge(9, 9.0, measured(6.5), "")
    assert codes(over) == [("width-high", False), ("not-measured", False)]


def test_frame_without_a_monitored_size_counts_as_unmeasured():
    alarms = Alarms(Limits(width_mm=(None, 6.9), unmeasured=2))
    alarms.judge(1, 0.1, measured(7.2), "")
    for k in range(2, 40):
        alarms.judge(k, 0.1 * k, measured(math.nan), "")
    assert codes(alarms.shown) == [("width-high", True), ("not-measured", True)]


def test_no_alarms_without_limits():
    alarms = Alarms(Limits())
    for frame in range(20):
        assert alarms.judge(frame, 0.0, None, "no dots") == []


def test_new_limits_end_the_alarms_of_former_limits():
    alarms = Alarms(Limits(width_mm=(None, 6.9), length_mm=(None, 7.0)))
    alarms.judge(0, 0.0, measured(7.2), "")
    assert [code for code, _ in codes(alarms.shown)] == ["width-high", "length-high"]
    alarms.set_limits(Limits(width_mm=(None, 8.0), length_mm=(None, 7.0)))
    assert codes(alarms.shown) == [("width-high", False), ("length-high", True)]
    alarms.acknowledge()
    assert codes(alarms.shown) == [("length-high", True)]
    alarms.set_limits(Limits())
    assert alarms.shown == ()


def test_alarms_are_streamed_by_their_codes():
    alarms = Alarms(Limits(width_mm=(None, 6.9), length_mm=(None, 7.0)))
    alarms.judge(3, 0.0, measured(7.2), "")
    alarms.judge(4, 1.0, measured(6.8), "")
    measured_ok = Measurement("ok", "", "fit", measures=MEASURES)
    values = stream_values(FrameResult(4, 0.0, measured_ok), alarms.shown)
    assert values["alarm"] == "length-high"
    assert values["unacknowledged"] == "width-high length-high"
    assert values["width_mm"] == MEASURES.width_mm
    alarms.acknowledge()
    values = stream_values(FrameResult(5, 0.0, Measurement("ok", "", "fit")), alarms.shown)
    assert (values["alarm"], values["unacknowledged"]) == ("length-high", "")


def test_session_stores_its_limits(tmp_path: Path):
    limits = Limits(width_mm=(6.0, None), height_mm=(-0.4, -0.2), unmeasured=7)
    with Session.create(tmp_path / "a.labsession") as session:
        assert session.limits == Limits()
        session.set_limits(limits)
        session.set_limits(Limits())
        session.undo()
    with Session.open(tmp_path / "a.labsession") as session:
        assert session.limits == limits
        assert session.problems() == []


def test_doubtful_setup_is_an_alarm_even_without_limits():
    alarms = Alarms(Limits())
    assert alarms.judge(1, 1.0, measured(6.8), "") == []
    raised = alarms.judge(2, 2.0, measured(6.8), "", "the laser slipped")
    assert codes(raised) == [("setup-doubtful", True)]
    assert "the laser slipped" in raised[0].words
    assert alarms.judge(3, 3.0, None, "it is dark", "the laser slipped") == []
    assert codes(alarms.judge(4, 5.0, measured(6.8), "")) == [("setup-doubtful", False)]
