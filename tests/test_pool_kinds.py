"""A frame of every kind of pool, by the command line: no label is wrong (Show 5, reduced)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.pool_kinds import OTHERS, judge, scenarios
from tests.conftest import Run

# A frame takes seconds; `tests/benchmarks/pool_kinds.py` measures all kinds, 30 frames each.
# The first frames of `dent_and_wave` and `height_map` are refused, so they would test nothing.
KINDS = sorted(OTHERS.keys() - {"dent_and_wave"} | {"egg", "mode_21", "travelling_21"})


@pytest.mark.parametrize("kind", KINDS)
def test_no_label_is_wrong_for_any_kind_of_pool(kind: str, labapp: Run, tmp_path: Path) -> None:
    out, results = tmp_path / "out", tmp_path / "results"
    scenario = scenarios(tmp_path)[kind]
    assert labapp("simulate", scenario, "--out", out, "--frames", 1)[0] == 0
    code, _, _ = labapp(
        "reconstruct", out / "recording.avi", "--setup", out / "setup.toml", "--out", results,
        "--surfaces", "none",
    )  # fmt: skip
    assert code == 0
    verdict = judge(out, results)
    assert verdict.wrong == []
    assert verdict.statuses["ok"] == 1
    assert verdict.labelled >= 0.85 * verdict.shown
