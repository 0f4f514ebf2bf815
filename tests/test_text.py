"""Words that windows, tables and the report share."""

from __future__ import annotations

import pytest

from labapp.text import SETUP_MARKS, SETUP_WORDS, marked_setup_words, setup_words

CHECK = "2026-01-31T12:00:00+00:00"


@pytest.mark.parametrize("status", SETUP_WORDS)
def test_every_status_of_a_set_up_has_words_and_a_mark(status: str):
    words = setup_words(status)
    assert marked_setup_words(status, words) == f"{SETUP_MARKS[status]} {words}"
    assert len(set(SETUP_MARKS.values())) == len(SETUP_WORDS)


def test_a_set_up_without_a_status_has_no_words():
    assert setup_words("") == setup_words("", was_checked=CHECK) == marked_setup_words("", "") == ""


@pytest.mark.parametrize("status", SETUP_WORDS)
def test_only_one_that_was_changed_after_its_check_is_said_to_be(status: str):
    changed = setup_words(status, was_checked=CHECK) != setup_words(status)
    assert changed == (status in ("entered", "calibrated"))
    assert (CHECK[:10] in setup_words(status, was_checked=CHECK)) == changed
