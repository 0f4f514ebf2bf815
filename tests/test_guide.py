"""The guide agrees with the texts of the app and shows its pictures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from labapp.gui.shell.actions import ACTIONS
from labapp.gui.shell.steps import STEPS, Mark, Step

GUIDE = Path(__file__).resolve().parent.parent / "docs" / "guide"
PAGES = sorted(GUIDE.glob("*.md"))


def one_line(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize("step", STEPS, ids=[step.key for step in STEPS])
def test_every_step_has_a_page_that_begins_with_its_hint(step: Step):
    title, hint = (GUIDE / f"{step.key}.md").read_text("utf-8").split("\n\n")[:2]
    assert title == f"# {STEPS.index(step) + 1} · {step.title}"
    assert one_line(hint) == step.hint


def test_index_lists_every_step_and_the_marks_of_the_steps():
    pytest.importorskip("PySide6")
    from labapp.gui.shell.step_list import SIGNS

    index = one_line((GUIDE / "index.md").read_text("utf-8"))
    for number, step in enumerate(STEPS, 1):
        assert f"| {number} | [{step.title}]({step.key}.md)" in index
    assert ", ".join(f"{SIGNS[mark]} {mark.value}" for mark in Mark) in index


def test_keys_of_the_index_belong_to_actions():
    text = (GUIDE / "index.md").read_text("utf-8").partition("## Keys")[2]
    keys = re.findall(r"(?<![\w+])(?:(?:Ctrl|Shift)\+)*(?:F\d+|(?<=\+)[A-Z.](?!\w))", text)
    assert len(keys) >= 15
    assert set(keys) <= {action.key for action in ACTIONS}


def test_every_picture_is_used_and_small():
    used = {
        name
        for page in PAGES
        for name in re.findall(r"\(pictures/(\S+)\)", page.read_text("utf-8"))
    }
    files = list((GUIDE / "pictures").iterdir())
    assert {path.name for path in files} == used
    assert sum(path.stat().st_size for path in files) < 2_500_000


def test_dialog_buttons_of_the_guide_exist_in_the_window():
    pytest.importorskip("PySide6")
    from tests.gui.words import sentences

    texts = {words.replace("&", "") for _, words in sentences()}
    for page in PAGES:
        named = re.findall(r"(?<!\*)\*([^*]+…)\*(?!\*)", page.read_text("utf-8"))
        assert {one_line(name) for name in named} <= texts, page.name
