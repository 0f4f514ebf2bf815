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
def test_damaged_files_are_refused_with_a_sentence_or_still_good(
    tmp_path: Path, count: int, seed: int
):
    # In a new process: one that ran other tests may hold nearly as much as a child is allowed.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as new:
        outcome = new.submit(fuzz, count, seed, tmp_path).result()
    assert outcome.failures == []
    assert sum(outcome.files.values()) == count
    # Nothing refused, or everything, would mean that nothing was tried.
    for kind in set(KINDS):
        assert outcome.refused[kind] > 0, kind
    assert all(outcome.used[kind] > 0 for kind in ("session", "setup", "recording", "manifest"))
