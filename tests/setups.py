"""Set-ups that are known closely, so that what is off soon contradicts them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from labapp.config.setup import updated_setup
from labapp.core.geometry.uncertainty import QUANTITIES

GTAW = Path(__file__).parents[1] / "sample_sessions" / "gtaw"

OFF: Mapping[str, Mapping[str, object]] = {"laser": {"aim_x_mm": 0.15}}
"""The laser of `GTAW`, which aims at X = 0, taken for one that does not."""


def closely_known(values: Mapping[str, Mapping[str, object]], share: float = 0.02) -> str:
    """The set-up of `GTAW`, each quantity known to a share of what is assumed; some changed."""
    sections: dict[str, dict[str, object]] = {}
    for one in QUANTITIES:
        section, _, key = one.sigma_key.partition(".")
        sections.setdefault(section, {})[key] = share * one.assumed
    for section, keys in values.items():
        sections[section] |= keys
    return updated_setup((GTAW / "setup.toml").read_text("utf-8"), GTAW, sections)
