"""Texts shared by windows, tables and the report."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from labapp.text import (
    SETUP_MARKS,
    SETUP_WORDS,
    capitalized,
    local_time,
    marked_setup_words,
    setup_words,
    split_unit,
)

CHECK = "2026-01-31T12:00:00+00:00"


@pytest.mark.parametrize("status", SETUP_WORDS)
def test_every_setup_status_has_words_and_a_mark(status: str):
    words = setup_words(status)
    assert marked_setup_words(status, words) == f"{SETUP_MARKS[status]} {words}"
    assert len(set(SETUP_MARKS.values())) == len(SETUP_WORDS)


def test_setup_without_a_status_has_no_words():
    assert setup_words("") == setup_words("", was_checked=CHECK) == marked_setup_words("", "") == ""


@pytest.mark.parametrize("status", SETUP_WORDS)
def test_only_a_setup_changed_after_its_check_is_described_so(status: str):
    changed = setup_words(status, was_checked=CHECK) != setup_words(status)
    assert changed == (status in ("entered", "calibrated"))
    assert (CHECK[:10] in setup_words(status, was_checked=CHECK)) == changed


@pytest.mark.parametrize("iso", ["2024-05-01T15:00:59+00:00", "2024-05-01T10:00:59-05:00"])
def test_time_is_shown_in_the_local_time_zone_to_the_minute(iso: str) -> None:
    here = datetime(2024, 5, 1, 15, tzinfo=UTC).astimezone()
    assert local_time(iso) == here.replace(tzinfo=None).isoformat(" ", "minutes")
    assert local_time(here.isoformat()) == local_time(iso)


@pytest.mark.parametrize("text", ["yes", "", "0001-01-01T00:00:00+14:00"])
def test_a_time_that_cannot_be_read_is_shown_as_it_is(text: str) -> None:
    assert local_time(text) == text


@pytest.mark.parametrize(
    ("name", "words", "unit"),
    [
        ("current_a", "current", "A"),
        ("voltage_V", "voltage", "V"),
        ("travel_mm_s", "travel", "mm/s"),
        ("shielding_gas_l_min", "shielding gas", "l/min"),
        ("heat_input_kJ_mm", "heat input", "kJ/mm"),
        ("volume_mm3", "volume", "mm³"),
        ("projection_angle_deg", "projection angle", "°"),
        ("spot_um", "spot", "µm"),
        ("gas_l_per_min", "gas", "l/min"),
        ("kept_to", "kept to", ""),
        ("plate_n", "plate n", ""),
        ("gas", "gas", ""),
        ("a", "a", ""),
        ("more_error_um_per_unit", "more error", "µm per mm or °"),
    ],
)
def test_unit_is_read_from_the_end_of_a_name(name: str, words: str, unit: str) -> None:
    assert split_unit(name) == (words, unit)


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("too few dots", "Too few dots"),
        ("no.", "No."),
        ("recording.avi is missing", "recording.avi is missing"),
        ("", ""),
    ],
)
def test_capital_letters_leave_names_of_files_alone(words: str, shown: str):
    assert capitalized(words) == shown
