from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.contract import KINDS
from tests.fuzz.fuzz import fuzz


@pytest.mark.parametrize(
    ("count", "seed"), [(200, 7), pytest.param(5000, 8, marks=pytest.mark.soak)]
)
def test_damaged_files_are_refused_with_a_sentence_or_still_good(
    tmp_path: Path, count: int, seed: int
):
    outcome = fuzz(count, seed, tmp_path)
    assert outcome.failures == []
    assert sum(outcome.files.values()) == count
    # Nothing refused, or everything, would mean that nothing was tried.
    for kind in set(KINDS):
        assert outcome.refused[kind] > 0, kind
    assert all(outcome.used[kind] > 0 for kind in ("session", "setup", "recording", "manifest"))
