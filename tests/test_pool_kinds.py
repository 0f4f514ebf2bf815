"""A frame of every kind of pool through the commands: no label is wrong (Show 5, reduced)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.pool_kinds import OTHERS, judge, scenarios
from tests.conftest import Run

# A frame takes seconds; all kinds, 30 frames each, are for `tests/benchmarks/pool_kinds.py`.
# Not `dent_and_wave` and `height_map`, whose first frame is refused: that would hold nothing.
KINDS = sorted(OTHERS.keys() - {"dent_and_wave"} | {"egg", "mode_21", "travelling_21"})


@pytest.mark.parametrize("kind", KINDS)
def test_no_label_of_any_kind_of_pool_is_wrong(kind: str, labapp: Run, tmp_path: Path) -> None:
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
