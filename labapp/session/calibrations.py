"""Whether the calibrations of a session are those of its set-up."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

import numpy as np

from labapp.config.setup_text import lens_of
from labapp.core.geometry.coordinates import Lens
from labapp.core.geometry.uncertainty import ENDINGS
from labapp.session.contents import SessionContents


def calibrations_in_use(session: SessionContents) -> tuple[bool, bool]:
    """Whether the set-up contains the calibrated values of laser and imaging plane, with its lens.

    False without a calibration and if other values were entered after it.
    """
    keys = tomllib.loads(session.setup_text)
    laser, plane = session.laser_calibration, session.plane_calibration
    return (
        laser is not None and _entered(keys.get("laser"), laser.found.setup_keys),
        plane is not None
        and all(_entered(keys.get(name), own) for name, own in plane.found.setup_keys.items())
        and _same(lens_of(session.setup_text), plane.found.image_calibration.plain_lens),
    )


def _entered(keys: Any, found: Mapping[str, Any]) -> bool:
    """Whether a section of the set-up contains the found values, except for rounding."""
    try:
        pairs = [
            (keys[name], value)
            for name, value in found.items()
            if value is not None and not name.endswith(ENDINGS)
        ]
        return all(np.allclose(one, other, rtol=1e-6) for one, other in pairs)
    except (KeyError, TypeError, ValueError):
        return False


def _same(one: Lens | None, other: Lens | None) -> bool:
    """Whether two lenses are equal, except for rounding."""
    if one is None or other is None:
        return one is other
    return np.allclose(np.hstack(astuple(one)), np.hstack(astuple(other)), rtol=1e-6)
