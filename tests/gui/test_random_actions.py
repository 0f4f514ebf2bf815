"""Random actions, a few: `random_actions.py` by hand plays more of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from PySide6.QtWidgets import QApplication

from tests.gui.random_actions import Player


@pytest.mark.parametrize("seed", [3, 8])
def test_nothing_is_raised_and_no_change_is_lost(
    qapp: QApplication, tmp_path: Path, state: Path, seed: int
) -> None:
    player = Player(seed, tmp_path / "run")
    run = player.play(100)
    run.window.hide()
    assert player.counts.total() == 100
    assert player.changed.total() > 0, "a run that changes nothing shows nothing"
    assert len({page for page, _ in player.counts}) > 3
