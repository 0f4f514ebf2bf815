"""Set-ups with small uncertainties, so that errors soon contradict them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from labapp.config.setup import updated_setup
from labapp.core.geometry.uncertainty import QUANTITIES

GTAW = Path(__file__).parents[1] / "sample_sessions" / "gtaw"

OFF: Mapping[str, Mapping[str, object]] = {"laser": {"aim_x_mm": 0.15}}
"""A wrong aim of the laser of `GTAW`, which aims at X = 0."""


def closely_known(values: Mapping[str, Mapping[str, object]], share: float = 0.02) -> str:
    """The set-up of `GTAW` with a share of the assumed uncertainties, and changed values."""
    sections: dict[str, dict[str, object]] = {}
    for quantity in QUANTITIES:
        section, _, key = quantity.sigma_key.partition(".")
        sections.setdefault(section, {})[key] = share * quantity.assumed
    for section, keys in values.items():
        sections[section] |= keys
    return updated_setup((GTAW / "setup.toml").read_text("utf-8"), GTAW, sections)


FIVE_LINES = """
[laser]
projection_angle_deg = 27.0
distance_mm = 90.0
[pattern]
kind = "lines"
count = 5
interline_angle_deg = 0.23
fan_angle_deg = 5.0
[electrode]
height_mm = 5.0
[imaging_plane]
distance_mm = 53.6
s_mm = 32.0
h_mm = -5.0
width_mm = 64.0
height_mm = 84.0
[image_calibration]
origin_px = [2.0, 638.0]
x_axis_px = [452.0, 638.0]
x_axis_mm = 60.0
z_axis_px = [2.0, 188.0]
z_axis_mm = 60.0
"""
"""The bench of §3.2.1, five lines."""
