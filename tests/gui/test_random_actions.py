"""Random actions; `random_actions.py` by hand plays as many as are asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
from PySide6.QtWidgets import QApplication

from tests.gui.random_actions import Player


@pytest.mark.parametrize(
    ("seed", "actions"), [(3, 60), pytest.param(8, 600, marks=pytest.mark.soak)]
)
def test_nothing_is_raised_and_no_change_is_lost(
    qapp: QApplication, tmp_path: Path, state: Path, seed: int, actions: int
) -> None:
    player = Player(seed, tmp_path / "run")
    run = player.play(actions)
    run.window.hide()
    assert player.counts.total() == actions
    assert player.changed.total() > 0, "a run that changes nothing shows nothing"
    assert len({page for page, _ in player.counts}) > 3
