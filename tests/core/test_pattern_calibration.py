"""Rays measured one by one on flat mirrors, of a lens that the simulation stretches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.bench_check.mirrors import Plate
from labapp.core.bench_check.pattern_calibration import PatternCalibration, calibrate_pattern
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.patterns import PATTERNS, PatternKind
from labapp.core.geometry.rig import DotPattern, Rig
from labapp.core.values import CannotMeasure
from labapp.simulation.benches import SimulatedBench
from labapp.simulation.calibration.mirrors import FlatMirror
from tests.core.test_bench_check import CALIBRATION, RIG, VIEW, picture
from tests.core.test_patterns import bent

HEIGHTS_MM = 0.0, 6.0


@pytest.fixture(autouse=True)
def stretching_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PATTERNS, "bent", PatternKind("bent", bent))


def calibrated(true: Rig) -> PatternCalibration:
    """What pictures of plates on a true bench give with the set-up `RIG`."""
    rng = np.random.default_rng(4)
    bench = SimulatedBench(replace(true, uncertainty=None), VIEW)
    plates = [picture(Plate(z), FlatMirror(z), bench, rng)[0] for z in HEIGHTS_MM]
    return calibrate_pattern(plates, Bench(RIG, CALIBRATION))


@pytest.mark.slow
def test_rays_are_found_within_their_uncertainty():
    true = DotPattern(kind="bent", rotation_deg=0.4)
    found = calibrated(replace(RIG, pattern=true))
    assert len(found.ray) > 330
    off = found.tangents - true.tangents[tuple(found.ray.T - 1)]
    pulls = off / found.sigma
    assert 0.85 < np.sqrt(np.mean(pulls**2)) < 1.15
    assert 0.8 < found.disagreement < 1.2
    assert found.off_deg > 5 * np.degrees(np.sqrt(np.mean(off**2)))


@pytest.mark.slow
def test_two_heights_contradict_a_mirror_that_is_elsewhere():
    rng = np.random.default_rng(4)
    bench = SimulatedBench(replace(RIG, uncertainty=None), VIEW)
    true_mm = {0.0: 0.0, 6.0: 6.1}
    plates = [picture(Plate(z), FlatMirror(at), bench, rng)[0] for z, at in true_mm.items()]
    assert calibrate_pattern(plates, Bench(RIG, CALIBRATION)).disagreement > 2


def test_pictures_without_the_hole_are_refused():
    bench = SimulatedBench(replace(RIG, uncertainty=None), VIEW)
    whole = replace(bench, rig=replace(bench.rig, pattern=DotPattern(absent=frozenset())))
    made = picture(Plate(), FlatMirror(), whole, np.random.default_rng(1))[0]
    with pytest.raises(CannotMeasure):
        calibrate_pattern([made, made], Bench(RIG, CALIBRATION))
