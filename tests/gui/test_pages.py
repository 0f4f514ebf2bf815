"""An added page appears everywhere: in list, menu, keys, window and tour."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from labapp.gui.shell.actions import ACTIONS
from labapp.gui.shell.steps import STEPS
from tests.gui.conftest import SAMPLES

PROGRAM = """
import json, sys, types
from pathlib import Path

from labapp.gui.app import start_app
from labapp.gui.shell import steps

toy = steps.Step("toy", "The toy", "Play with the toy.", "ToyPage")
steps.STEPS = (*steps.STEPS, toy)
app = start_app()

from labapp.gui.pages.page import Page
from labapp.gui.preferences import Preferences
from labapp.gui.shell.commands import make_window
from labapp.gui.shell.help import keys
from labapp.session.session import Session
from tests.tour import way


class ToyPage(Page):
    key = "toy"
    shown = 0

    def refresh(self):
        self.shown += 1


module = types.ModuleType("labapp.gui.pages.toy.page")
module.ToyPage = ToyPage
sys.modules["labapp.gui.pages.toy"] = types.ModuleType("labapp.gui.pages.toy")
sys.modules["labapp.gui.pages.toy.page"] = module

window = make_window(Preferences(theme="light"), Path(sys.argv[1]))
window.show()
window.workspace.show(Session.open(Path(sys.argv[2])))
action = window.menus.actions["step_toy"]
action.trigger()
panel, listed = window.side_panel, window.step_list
told = []
hands = types.SimpleNamespace(
    pages={step.key for step in steps.STEPS} - {"toy"},
    do=told.append,
    picture=lambda: told.append("a picture"),
)
way._other_pages(hands)
found = {
    "listed": [listed.item(row).toolTip() for row in range(listed.count())],
    "keys": [action.shortcut().toString(), "Ctrl+9" in keys()],
    "enabled": action.isEnabled(),
    "told": "Play with the toy." in keys(),
    "in view": [window.page.key, window.page.shown > 0, window.page.accessibleName()],
    "panel": [panel.title.text(), panel.hint.text(), panel.state.text()],
    "tour": told,
}
window.do("previous_step")
found["before"] = window.page.key
window.close()
print(json.dumps(found))
"""


@pytest.mark.slow
def test_added_page_appears_everywhere(tmp_path: Path):
    shutil.copytree(SAMPLES / "gtaw", tmp_path / "gtaw")
    process = subprocess.run(
        [
            *(sys.executable, "-c", PROGRAM),
            *(tmp_path / "preferences.json", tmp_path / "gtaw/gtaw.labsession"),
        ],
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen", "XDG_STATE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    report = json.loads(process.stdout.splitlines()[-1])
    assert [tip.partition(":")[0] for tip in report["listed"]][-2:] == [
        f"{len(STEPS)} {STEPS[-1].title}",
        f"{len(STEPS) + 1} The toy",
    ]
    number = len(STEPS) + 1
    has_key = number <= 10
    assert report["keys"] == [f"Ctrl+{number % 10}" if has_key else "", True]
    assert report["enabled"]
    assert report["told"] == has_key
    assert report["in view"] == ["toy", True, "The toy"]
    assert report["panel"][:2] == ["The toy", "Play with the toy."]
    assert report["panel"][2].endswith("30 frames")
    assert report["tour"] == ["step_toy", "a picture"]
    assert report["before"] == STEPS[-1].key


def test_first_ten_steps_have_digit_shortcuts():
    keys = {action.name: action.key for action in ACTIONS}
    assert [keys[f"step_{step.key}"] for step in STEPS[:10]] == [
        f"Ctrl+{number % 10}" for number, _ in enumerate(STEPS[:10], 1)
    ]
