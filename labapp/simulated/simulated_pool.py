"""The scene of the simulated camera: an oscillating pool on the session's bench."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomlkit

from labapp.bundled import bundled
from labapp.config.scenario import read_scenario
from labapp.config.setup_keys import SECTIONS
from labapp.errors import InputError
from labapp.media import GreyImage
from labapp.media.cameras import SimulatedDevice, there_and_back
from labapp.session.session import Session


def oscillating_pool(
    frequency_hz: float, wander_percent: float, **recording: float
) -> tomlkit.TOMLDocument:
    """Scenario of an egg-shaped pool on the usual bench that swings up and down.

    Parameters
    ----------
    frequency_hz
        Frequency of the pool's wave.
    wander_percent
        Fluctuation of its sizes.
    recording
        Keys of ``[recording]``.
    """
    path = bundled("resources/simulations/mode_01.toml")
    scenario = tomlkit.parse(path.read_text("utf-8"))
    pool: Any = scenario["pool"]
    pool["wander_percent"] = wander_percent
    pool["wave"][0]["frequency_hz"] = frequency_hz
    table: Any = scenario["recording"]
    table.update(recording)
    return scenario


def camera_pool() -> tomlkit.TOMLDocument:
    """Scenario of the simulated camera on the usual bench."""
    return oscillating_pool(2.727, 0.3, frames=12, seed=4801)


def simulated_pool(session: Session) -> str:
    """Text of a scenario of a pool on the session's bench, or on the usual bench without one."""
    scenario = camera_pool()
    try:
        setup = session.setup.text
    except InputError:
        return tomlkit.dumps(scenario)
    for section in SECTIONS:
        scenario.pop(section, None)
    return f"{tomlkit.dumps(scenario)}\n{setup}"


def pool_camera(text: str, progress: Callable[[int, int], None]) -> SimulatedDevice:
    """Create a camera that films the pool of a scenario endlessly.

    The pool oscillates equally fast at every frame rate: a faster camera repeats some frames.

    Parameters
    ----------
    text
        Text from `simulated_pool`; the usual bench replaces one that cannot be simulated.
    progress
        Called with the number of frames rendered and in total; an exception ends the rendering.
    """
    with tempfile.TemporaryDirectory(prefix="labapp-") as folder:
        path = Path(folder) / "pool.toml"
        path.write_text(text, encoding="utf-8")
        try:
            recording = read_scenario(path).recording
        except InputError:  # a homography
            path.write_text(tomlkit.dumps(camera_pool()), encoding="utf-8")
            recording = read_scenario(path).recording
    images: list[GreyImage] = []
    for number in range(len(recording.pools)):
        progress(number, len(recording.pools))
        images.append(recording.frame(number).image)
    rate_hz, film = recording.frame_rate_hz or 60.0, there_and_back(images)

    def filmed(number: int) -> GreyImage:
        return film(int(number * rate_hz / (device.settings.rate_hz or rate_hz)))

    device = SimulatedDevice("pool", film, rate_hz=rate_hz)
    device.picture = filmed
    return device
