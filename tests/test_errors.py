from __future__ import annotations

import pickle

from labapp.errors import InputError


def test_the_message_names_file_field_value_and_what_would_be_right() -> None:
    error = InputError("setup.toml", "laser.distance_mm", -3.5, "a number above 0 (mm)")
    assert str(error) == "setup.toml: laser.distance_mm: -3.5; expected a number above 0 (mm)"


def test_several_problems_are_one_line_each() -> None:
    error = InputError.gather([InputError("a", "b", 1, "2"), InputError("a", "c", 3, "4")])
    assert str(error).splitlines() == ["a: b: 1; expected 2", "a: c: 3; expected 4"]
    assert [problem.field for problem in error.problems] == ["b", "c"]


def test_a_long_value_is_cut() -> None:
    assert len(str(InputError("a", "b", "x" * 5000, "c"))) < 120


def test_it_crosses_process_borders() -> None:
    error = InputError("a", "b", "c", "d")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
