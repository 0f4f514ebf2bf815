"""Rays measured individually on flat mirrors, with a simulated lens that stretches the pattern."""

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
from tests.core.test_bench_check import CALIBRATION, RIG, VIEW, picture
from tests.core.test_patterns import bent
from tests.mirrors import FlatMirror
from tests.simulated_benches import SimulatedBench

HEIGHTS_MM = 0.0, 6.0


@pytest.fixture(autouse=True)
def stretching_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PATTERNS, "bent", PatternKind("bent", bent))


def calibrated(true: Rig) -> PatternCalibration:
    """Calibrate from pictures of plates on a true bench, with the setup `RIG`."""
    rng = np.random.default_rng(4)
    bench = SimulatedBench(replace(true, uncertainty=None), VIEW)
    plates = [picture(Plate(z), FlatMirror(z), bench, rng)[0] for z in HEIGHTS_MM]
    return calibrate_pattern(plates, Bench(RIG, CALIBRATION))


@pytest.mark.slow
def test_rays_are_measured_within_their_uncertainty():
    true = DotPattern(kind="bent", rotation_deg=0.4)
    calibration = calibrated(replace(RIG, pattern=true))
    assert len(calibration.ray) > 330
    error = calibration.tangents - true.tangents[tuple(calibration.ray.T - 1)]
    pulls = error / calibration.sigma
    assert 0.85 < np.sqrt(np.mean(pulls**2)) < 1.15
    assert 0.8 < calibration.disagreement < 1.2
    assert calibration.off_deg > 5 * np.degrees(np.sqrt(np.mean(error**2)))


@pytest.mark.slow
def test_two_heights_reveal_a_mirror_at_a_wrong_height():
    rng = np.random.default_rng(4)
    bench = SimulatedBench(replace(RIG, uncertainty=None), VIEW)
    true_mm = {0.0: 0.0, 6.0: 6.1}
    plates = [picture(Plate(z), FlatMirror(at), bench, rng)[0] for z, at in true_mm.items()]
    assert calibrate_pattern(plates, Bench(RIG, CALIBRATION)).disagreement > 2


def test_pictures_without_the_reference_hole_are_rejected():
    bench = SimulatedBench(replace(RIG, uncertainty=None), VIEW)
    without_hole = replace(bench, rig=replace(bench.rig, pattern=DotPattern(absent=frozenset())))
    plate = picture(Plate(), FlatMirror(), without_hole, np.random.default_rng(1))[0]
    with pytest.raises(CannotMeasure):
        calibrate_pattern([plate, plate], Bench(RIG, CALIBRATION))
