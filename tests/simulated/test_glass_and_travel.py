"""Frames of a bench with glass that welds towards −Y, from the scenario to the measures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from labapp.config.scenario import Scenario, read_scenario, shipped_scenarios
from labapp.config.setup import Setup, parse_setup
from labapp.core.geometry.bench import Bench
from labapp.core.pipeline import Settings, measure
from labapp.core.recording.chain import WarmChain
from labapp.errors import InputError

FRAMES = 5


@cache
def scenario_text() -> str:
    path = next(path for path in shipped_scenarios() if path.stem == "egg")
    values = tomlkit.parse(path.read_text("utf-8"))
    values["imaging_plane"]["glass_mm"] = 3.0
    values["torch"] = {"travel": "-y"}
    values["pool"]["center_mm"] = [0.0, 0.6]
    values["pool"]["wander_percent"] = 0.5
    return tomlkit.dumps(values)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "back.toml"
    path.write_text(scenario_text(), "utf-8")
    return read_scenario(path, frames=FRAMES)


@pytest.fixture(scope="module")
def setup(scenario: Scenario) -> Setup:
    return parse_setup(scenario.setup, "back.toml")


def test_scenario_has_its_head_at_minus_y(scenario: Scenario, setup: Setup) -> None:
    assert setup.rig.travel == scenario.recording.rig.travel == "-y"
    assert setup.rig.imaging_plane.glass_mm == 3.0
    foot = scenario.recording.pools[0].footprint
    assert foot.tail_mm == pytest.approx(3.0, rel=0.03)  # towards −Y
    assert foot.head_mm == pytest.approx(4.4, rel=0.03)
    assert scenario.recording.torches == ()


def test_torch_table_contains_shape_and_travel(tmp_path: Path) -> None:
    path = tmp_path / "torch.toml"
    values = tomlkit.parse(scenario_text())
    values["torch"]["tip_mm"] = [0.0, 0.0, 5.0]
    path.write_text(tomlkit.dumps(values), "utf-8")
    scenario = read_scenario(path, frames=1)
    assert len(scenario.recording.torches) == 1
    assert parse_setup(scenario.setup, path).rig.travel == "-y"
    values["torch"]["speed"] = 3.0
    path.write_text(tomlkit.dumps(values), "utf-8")
    with pytest.raises(InputError, match="speed"):
        read_scenario(path)


@pytest.mark.slow
def test_cold_and_followed_frames_have_the_true_sizes(scenario: Scenario, setup: Setup) -> None:
    chain = WarmChain(Bench(setup.rig, setup.calibration), Settings())
    bare = replace(setup.rig.imaging_plane, glass_mm=0.0)
    for n in range(FRAMES):
        frame = scenario.recording.frame(n)
        followed = chain.measure(frame.image)
        assert followed.measures is not None, followed.reason
        if n:
            assert chain.track_lost is None
        true = frame.pool.size
        assert followed.measures.height_mm == pytest.approx(true.height_mm, rel=0.03)
        assert followed.measures.width_mm == pytest.approx(true.width_mm, rel=0.02)
        assert np.sqrt(np.mean(followed.reconstruction.residual_mm**2)) < 0.03
        if n != FRAMES - 1:
            continue
        cold, _ = measure(frame.image, Bench(setup.rig, setup.calibration), Settings())
        assert cold.measures is not None
        difference = cold.measures.height_mm - followed.measures.height_mm
        assert abs(difference) < followed.measures.height_sigma_mm
        # With the glass ignored, the frame is refused or has a larger error.
        wrong = replace(setup.rig, imaging_plane=bare)
        without, _ = measure(frame.image, Bench(wrong, setup.calibration), Settings())
        if without.measures is not None:
            error = without.measures.height_mm - true.height_mm
            assert abs(error) > 3 * abs(cold.measures.height_mm - true.height_mm)
