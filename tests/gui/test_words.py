"""No banned wording is left in the texts of the window."""

from __future__ import annotations

import re

import pytest

from labapp.session.checklist import FORMER, SAFETY, tick, ticked
from labapp.session.record import Record
from tests.gui.words import sentences

BANNED = {
    r"III[ab]": "class 3B",
    r"[Ww]elding goggles": "welding helmet",
    r"^Use (these|it)$": "Apply",
    r"^Not this one$": "Discard",
    r"^(lowest|highest)$": "Min., Max.",
    r"^Work out$": "Run",
    r"by itself, at its rate|when told": "Trigger: free run",
    r"^Read$": "Dismiss",
    r"[Ss]ay where": "Locate…",
    r"^Usual values$": "Use defaults",
    r"[Cc]hosen (dot|line|row)|^Choose (all|none|in doubt|a dot|a line|a row)": "select",
    r"keeps from you|let you read|[Oo]ne moment|told apart|out of the noise": "plain words",
    r"^Set-up files": "Setup files",
    r"\bput right\b|\bbears\b|\blets go\b|\bhanded over\b": "a plain verb",
}
"""Banned patterns, and the wording to use instead."""


@pytest.mark.parametrize("pattern", BANNED)
def test_banned_words_are_not_used(pattern: str):
    matches = [(place, words) for place, words in sentences() if re.search(pattern, words)]
    former = set(FORMER)
    assert not [each for each in matches if each[1] not in former], BANNED[pattern]


def test_sentences_include_buttons_and_messages():
    words = {words for _, words in sentences()}
    assert {"Load set-&up…", "Laser points at nobody's eyes", "Frames are being measured"} <= words


def test_ticks_of_renamed_items_still_count():
    (old, new), *_ = FORMER.items()
    assert new in dict(SAFETY)
    record = Record(safety=((old, "then"),))
    assert ticked(record) == ((new, "then"),)
    assert tick(record, new, False, "now").safety == ()
