from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

import pytest

from labapp.gui.preferences import (
    KEPT_RECENT,
    VERSION,
    Preferences,
    PreferencesStore,
    read_preferences,
    write_preferences,
)

PEDAL = {"device": "05f3:00ff:0", "name": "A pedal", "keyboard": False, "actions": {"0": "mark"}}

SOME = Preferences(("/a b.labsession", "/c.labsession"), "light", "AAA=", "BBB=", "/data", (PEDAL,))


def test_preferences_round_trip(tmp_path: Path):
    file = tmp_path / "new" / "preferences.json"
    assert write_preferences(file, SOME) == ""
    assert read_preferences(file) == (SOME, "")
    assert [path.name for path in file.parent.iterdir()] == ["preferences.json"]


def test_missing_file_gives_the_defaults(tmp_path: Path):
    assert read_preferences(tmp_path / "none.json") == (Preferences(), "")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00\xff\xfe",
        b"{",
        b"[]",
        b"null",
        b"[" * 100_000,
        b'{"version": 1, "theme": "pink"}',
        b'{"version": 1, "recent": "abc"}',
        b'{"version": 1, "recent": [1]}',
        b'{"version": 1, "recent": ["a\\u0000b"]}',
        b'{"version": 1, "geometry": null}',
        b'{"version": 1, "unknown": 2}',
        b'{"version": 1, "foot_switches": {"0": "mark"}}',
        b'{"version": 1, "foot_switches": ["05f3:00ff:0"]}',
        b'{"version": 99, "theme": "dark"}',
        b'{"theme": "dark"}',
        b'{"version": 1, "theme": "dark"}' + b" " * 2_000_000,
    ],
)
def test_invalid_file_is_renamed_and_reported(tmp_path: Path, content: bytes):
    file = tmp_path / "preferences.json"
    file.write_bytes(content)
    preferences, problem = read_preferences(file)
    assert preferences == Preferences()
    renamed = file.with_suffix(".kept.json")
    assert str(renamed) in problem
    assert renamed.read_bytes() == content
    assert not file.exists()


def test_folder_in_place_of_the_file_is_reported(tmp_path: Path):
    (tmp_path / "preferences.json").mkdir()
    preferences, problem = read_preferences(tmp_path / "preferences.json")
    assert preferences == Preferences()
    assert "could not be read" in problem
    assert "could not be saved" in write_preferences(tmp_path / "preferences.json", SOME)


def test_failed_write_keeps_the_existing_file(tmp_path: Path):
    file = tmp_path / "preferences.json"
    assert write_preferences(file, SOME) == ""
    with mock.patch("os.fsync", side_effect=OSError(28, "No space left on device")):
        assert "could not be saved" in write_preferences(file, Preferences())
    assert json.loads(file.read_bytes())["version"] == VERSION
    assert read_preferences(file)[0] == SOME


def test_last_opened_session_is_listed_first_and_once(tmp_path: Path):
    preferences = Preferences()
    for number in range(20):
        preferences = preferences.with_recent(tmp_path / f"{number}.labsession")
    assert len(preferences.recent) == KEPT_RECENT
    preferences = preferences.with_recent(tmp_path / "15.labsession")
    assert preferences.recent[0] == str(tmp_path / "15.labsession")
    assert len(set(preferences.recent)) == KEPT_RECENT
    assert preferences.last_folder == str(tmp_path)
    assert preferences.folder == tmp_path
    assert (
        str(tmp_path / "15.labsession")
        not in preferences.without_recent(tmp_path / "15.labsession").recent
    )


def test_missing_last_folder_is_replaced(tmp_path: Path):
    assert replace(SOME, last_folder=str(tmp_path / "gone")).folder.is_dir()


def test_concurrent_windows_lose_no_preferences(tmp_path: Path):
    file = tmp_path / "preferences.json"
    initial = Preferences(theme="dark")

    def open_three(window: int) -> None:
        for number in range(3):
            path = tmp_path / f"{window}_{number}.labsession"
            PreferencesStore(initial, file).remember(partial(Preferences.with_recent, path=path))

    with ThreadPoolExecutor(4) as windows:
        list(windows.map(open_three, range(4)))
    preferences, problem = read_preferences(file)
    assert problem == ""
    assert (len(set(preferences.recent)), preferences.theme) == (12, "dark")


def test_missing_file_is_written_again(tmp_path: Path):
    file = tmp_path / "preferences.json"
    store = PreferencesStore(SOME, file)
    store.remember(lambda before: before)
    assert store.current == SOME
    assert read_preferences(file) == (SOME, "")


def test_unwritable_preferences_apply_and_are_reported(tmp_path: Path):
    (tmp_path / "file").touch()
    store, problems = PreferencesStore(SOME, tmp_path / "file" / "preferences.json"), []
    store.failed.connect(problems.append)
    store.remember(lambda before: replace(before, theme="dark"))
    assert store.current == replace(SOME, theme="dark")
    assert ["could not be saved" in problem for problem in problems] == [True]
