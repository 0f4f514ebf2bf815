from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from tests.fuzz.contract import KINDS
from tests.fuzz.fuzz import fuzz


@pytest.mark.parametrize(
    ("count", "seed"), [(200, 7), pytest.param(5000, 8, marks=pytest.mark.soak)]
)
def test_damaged_files_are_rejected_or_still_usable(tmp_path: Path, count: int, seed: int):
    # In a new process, as the memory of one that ran other tests may be close to the limit.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as new:
        outcome = new.submit(fuzz, count, seed, tmp_path).result()
    assert outcome.failures == []
    assert sum(outcome.files.values()) == count
    # If nothing or everything was rejected, nothing was really tested.
    for kind in set(KINDS):
        assert outcome.refused[kind] > 0, kind
    assert all(outcome.used[kind] > 0 for kind in ("session", "setup", "recording", "manifest"))
