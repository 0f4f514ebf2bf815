"""Short runs of random actions; run `random_actions.py` by hand for longer ones."""

from __future__ import annotations

from pathlib import Path

import pytest
from PySide6.QtWidgets import QApplication

from tests.gui.random_actions import Player


@pytest.mark.parametrize(
    ("seed", "actions"), [(3, 60), pytest.param(8, 600, marks=pytest.mark.soak)]
)
def test_random_actions_raise_nothing_and_lose_no_change(
    qapp: QApplication, tmp_path: Path, state: Path, seed: int, actions: int
) -> None:
    player = Player(seed, tmp_path / "run")
    run = player.play(actions)
    run.window.hide()
    assert player.counts.total() == actions
    assert player.changed.total() > 0, "a run that changes nothing shows nothing"
    assert len({page for page, _ in player.counts}) > 3
