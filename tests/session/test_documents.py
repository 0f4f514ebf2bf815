from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from labapp.errors import InputError
from labapp.session import documents as module
from labapp.session.documents import Documents
from labapp.session.file.database import Database
from labapp.session.file.schema import NO_FRAME


@pytest.fixture(scope="module", autouse=True)
def plain_values() -> Iterator[None]:
    """Plain values replace the documents in these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CLASSES", dict.fromkeys(module.CLASSES, object))
        yield


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    database = Database.create(tmp_path / "a.labsession")
    yield database
    database.close()


@pytest.fixture
def documents(database: Database) -> Documents:
    return Documents(database)


def note(documents: Documents, text: str | None) -> bool:
    return documents.change(f"note {text}", {("record", NO_FRAME): text})


def test_document_has_the_value_set_last(documents: Documents):
    assert documents.get("record") is None
    note(documents, "a")
    note(documents, "b")
    assert documents.get("record") == "b"
    note(documents, None)
    assert documents.get("record") is None


def test_document_without_a_frame_is_unpacked_once_per_content(documents: Documents):
    documents.change("table", {("signals", NO_FRAME): ["long"]})
    first = documents.get("signals")
    note(documents, "a")
    assert documents.get("signals") is first
    documents.change("table", {("signals", NO_FRAME): ["other"]})
    assert documents.get("signals") == ["other"]
    documents.undo()
    assert documents.get("signals") == ["long"]


def test_change_without_effect_is_no_step(documents: Documents):
    assert note(documents, "a")
    assert not note(documents, "a")
    assert [change.label for change in documents.history()] == ["note a"]


def test_undo_and_redo_move_through_the_history(documents: Documents):
    assert documents.undo() is None
    for text in "abc":
        note(documents, text)
    undone = documents.undo()
    assert undone is not None
    assert (undone.label, undone.undone, undone.keys) == ("note c", True, (("record", NO_FRAME),))
    documents.undo()
    assert documents.get("record") == "a"
    redone = documents.redo()
    assert redone is not None
    assert redone.label == "note b"
    assert documents.get("record") == "b"
    note(documents, "d")
    assert documents.redo() is None
    assert [change.label for change in documents.history()] == ["note a", "note b", "note d"]


def test_change_of_several_documents_is_one_step(documents: Documents):
    note(documents, "a")
    documents.change(
        "both", {("record", NO_FRAME): "b", ("correction", 3): [1], ("setup", NO_FRAME): "x"}
    )
    documents.undo()
    assert documents.get("record") == "a"
    assert documents.get("correction", 3) is None
    assert documents.get("setup") is None


def test_history_is_saved(database: Database, documents: Documents):
    note(documents, "a")
    note(documents, "b")
    documents.undo()
    database.close()
    reopened = Database.open(database.path)
    documents = Documents(reopened)
    assert documents.get("record") == "a"
    assert documents.redo() is not None
    assert documents.get("record") == "b"
    reopened.close()


def test_history_is_limited_in_steps(documents: Documents, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "MAX_CHANGES", 5)
    for number in range(12):
        note(documents, str(number))
    assert [change.label for change in documents.history()] == [f"note {n}" for n in range(7, 12)]
    while documents.undo():
        pass
    assert documents.get("record") == "6"
    assert documents.problems() == []


def test_history_is_limited_in_bytes(documents: Documents, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "MAX_HISTORY_BYTES", 2_000)
    for number in range(50):
        note(documents, f"{number} " + "".join(chr(200 + 7 * k * number % 900) for k in range(300)))
    history = documents.history()
    assert 1 <= len(history) < 5
    documents.undo()
    assert documents.get("record").startswith("48 ")


def test_failed_change_changes_nothing(documents: Documents):
    note(documents, "a")
    with pytest.raises(TypeError):
        documents.change("two", {("setup", NO_FRAME): "x", ("record", NO_FRAME): object()})
    assert documents.get("setup") is None
    assert [change.label for change in documents.history()] == ["note a"]


def test_damaged_document_is_reported(database: Database, documents: Documents):
    note(documents, "a")
    with database.transaction() as connection:
        connection.execute("UPDATE document SET content = x'4c414231'")
    with pytest.raises(InputError, match="record"):
        documents.get("record")
    assert any("record is damaged" in problem for problem in documents.problems())


def test_document_that_contradicts_the_history_is_reported(
    database: Database, documents: Documents
):
    note(documents, "a")
    note(documents, "b")
    with database.transaction() as connection:
        (before,) = connection.execute("SELECT before FROM change_part WHERE change = 2").fetchone()
        connection.execute("UPDATE document SET content = ?", (before,))
    assert any("history" in problem for problem in documents.problems())


@settings(max_examples=40)
@given(
    st.lists(
        st.sampled_from(["undo", "redo"])
        | st.tuples(st.sampled_from([NO_FRAME, 1, 2]), st.none() | st.integers(0, 3)),
        max_size=25,
    )
)
def test_any_sequence_agrees_with_two_stacks(tmp_path_factory, steps):
    folder = tmp_path_factory.mktemp("any")
    database = Database.create(folder / "a.labsession")
    documents = Documents(database)
    state: dict[int, int] = {}
    done: list[dict[int, int]] = []
    undone: list[dict[int, int]] = []
    for step in steps:
        if step == "undo":
            assert (documents.undo() is not None) == bool(done)
            if done:
                undone.append(state)
                state = done.pop()
        elif step == "redo":
            assert (documents.redo() is not None) == bool(undone)
            if undone:
                done.append(state)
                state = undone.pop()
        else:
            frame, value = step
            after = {key: stored for key, stored in state.items() if key != frame}
            after |= {} if value is None else {frame: value}
            assert documents.change("set", {("correction", frame): value}) == (after != state)
            if after != state:
                done.append(state)
                undone.clear()
                state = after
        values = {frame: documents.get("correction", frame) for frame in (NO_FRAME, 1, 2)}
        assert {frame: value for frame, value in values.items() if value is not None} == state
    assert documents.problems() == []
    database.close()
