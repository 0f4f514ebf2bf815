from __future__ import annotations

import pickle

from labapp.errors import InputError


def test_message_states_file_field_value_and_expected_value() -> None:
    error = InputError("setup.toml", "laser.distance_mm", -3.5, "a number above 0 (mm)")
    assert str(error) == "setup.toml: laser.distance_mm: -3.5; expected a number above 0 (mm)"


def test_each_problem_is_one_line() -> None:
    error = InputError.gather([InputError("a", "b", 1, "2"), InputError("a", "c", 3, "4")])
    assert str(error).splitlines() == ["a: b: 1; expected 2", "a: c: 3; expected 4"]
    assert [problem.field for problem in error.problems] == ["b", "c"]


def test_long_value_is_shortened() -> None:
    assert len(str(InputError("a", "b", "x" * 5000, "c"))) < 120


def test_error_can_be_pickled() -> None:
    error = InputError("a", "b", "c", "d")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_control_characters_are_not_sent_to_the_terminal() -> None:
    error = InputError("a\x1b[2J.toml", "laser", "1\n\x07", "a number")
    assert str(error) == "a\\x1b[2J.toml: laser: 1\\n\\x07; expected a number"
