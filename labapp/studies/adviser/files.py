"""Output of the adviser: the files of an advice, and the recommended set-up."""

from __future__ import annotations

from typing import Any

from labapp.config.setup import pattern_values, updated_setup
from labapp.studies.adviser.dense_patterns import compare_patterns, pattern_table
from labapp.studies.adviser.report import advice_picture, advice_table, advice_text, cost_table
from labapp.studies.adviser.search import Advice
from labapp.studies.plotting import as_bytes
from labapp.studies.tables import Table

SETUP = "setup.toml"

FILES = ("advice.md", "advice.csv", "advice.png", "patterns.csv", SETUP, "check.txt")
"""Names of all files of an advice; the last one is that of its check."""

HEAD = """\
# Recommended by labapp advise. Set the bench up so, then measure where it really
# stands: labapp calibrate laser and labapp calibrate plane, both with --setup.
# [image_calibration] is missing until calibrate plane writes it.

"""


def advice_files(advice: Advice) -> dict[str, bytes]:
    """Text, tables, picture and, if there is one, the set-up: file name → content."""
    patterns = patterns_of(advice) if advice.possible else None
    tables = [] if patterns is None else [cost_table(advice), patterns]
    words = "\n\n".join([advice_text(advice), *(table.markdown() for table in tables)])
    files = {
        "advice.md": words.encode() + b"\n",
        "advice.csv": advice_table(advice).csv().encode(),
        "advice.png": as_bytes(advice_picture(advice), "png"),
    }
    if patterns is not None:
        files["patterns.csv"] = patterns.csv().encode()
        files[SETUP] = updated_setup(HEAD, SETUP, advised_setup(advice)).encode()
    return files


def patterns_of(advice: Advice) -> Table:
    """Dot patterns with the same fan at the recommended position (`dense_patterns`)."""
    return pattern_table(compare_patterns(advice.expected, advice.limits, advice.best.place))


def advised_setup(advice: Advice) -> dict[str, dict[str, Any]]:
    """The recommended set-up: section → key → value, rounded to 0.01 mm and 0.01°."""
    place, limits = advice.best.place, advice.limits
    return {
        "laser": {
            "projection_angle_deg": round(place.projection_angle_deg, 2),
            "distance_mm": round(place.distance_mm, 2),
        },
        "pattern": pattern_values(limits.pattern),
        "electrode": {"height_mm": limits.electrode_mm},
        "imaging_plane": {
            "distance_mm": round(place.plane_mm, 2),
            "s_mm": round(place.s_mm, 2),
            "h_mm": round(place.h_mm, 2),
            "width_mm": limits.plate_mm[0],
            "height_mm": limits.plate_mm[1],
        },
    }
