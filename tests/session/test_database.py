from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from labapp.errors import InputError
from labapp.session.file import database as module
from labapp.session.file.database import Database, OnlyReadable, SessionInUse
from labapp.session.file.schema import APPLICATION_ID, TABLES, VERSION
from tests.scripts import run_python

DATA = Path(__file__).parent / "data"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A new session file with one document in it."""
    path = tmp_path / "a.labsession"
    database = Database.create(path)
    write(database, "one")
    database.close()
    return path


def write(database: Database, kind: str) -> None:
    with database.transaction() as connection:
        connection.execute(
            "INSERT INTO document (kind, sha256, content) VALUES (?, '', x'00')", (kind,)
        )


def kinds(database: Database) -> list[str]:
    return [kind for (kind,) in database.rows("SELECT kind FROM document ORDER BY kind")]


def test_file_has_application_id_and_version(path: Path):
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA application_id").fetchone() == (APPLICATION_ID,)
    assert connection.execute("PRAGMA user_version").fetchone() == (VERSION,)
    connection.close()


def test_closed_session_is_one_file(path: Path):
    visible = [entry.name for entry in path.parent.iterdir() if not entry.name.startswith(".")]
    assert visible == [path.name]


def test_create_does_not_overwrite_a_file(path: Path):
    before = path.read_bytes()
    with pytest.raises(InputError, match="is there already"):
        Database.create(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", ["a.txt", "nowhere/a.labsession"])
def test_create_rejects_wrong_name_and_missing_folder(tmp_path: Path, name: str):
    with pytest.raises(InputError, match=r"expected (a name|a folder)"):
        Database.create(tmp_path / name)
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize(
    ("content", "value"),
    [
        (b"", "0 bytes"),
        (b"SQLite format 3\x00", "not a session"),
        (b"hello" * 100, "not a session"),
        (b"SQLite format 3\x00" + bytes(200), "a database of another program"),
    ],
)
def test_other_files_are_rejected(tmp_path: Path, content: bytes, value: str):
    path = tmp_path / "a.labsession"
    path.write_bytes(content)
    for read_only in (False, True):
        with pytest.raises(InputError, match=value):
            Database.open(path, read_only)
    assert path.read_bytes() == content


def test_missing_file_and_folder_are_rejected(tmp_path: Path):
    with pytest.raises(InputError, match="No such file"):
        Database.open(tmp_path / "a.labsession")
    with pytest.raises(InputError, match="folder"):
        Database.open(tmp_path)
    assert not list(tmp_path.iterdir())


def test_session_must_be_a_regular_file(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.labsession")
    (tmp_path / "zero.labsession").symlink_to("/dev/zero")
    for name in ("pipe.labsession", "zero.labsession", "a\0b.labsession"):
        script = f"""
            from labapp.errors import InputError
            from labapp.session.file.database import Database
            for read_only in (False, True):
                try:
                    Database.open({str(tmp_path / name)!r}, read_only)
                except InputError as error:
                    print(error.field)
        """
        assert run_python(script).splitlines() == ["file"] * 2


def test_other_tables_are_rejected(path: Path):
    connection = sqlite3.connect(path)
    connection.execute("DROP TABLE detail")
    connection.close()
    with pytest.raises(InputError, match="not those of a session"):
        Database.open(path)


def test_trigger_is_rejected_whatever_its_name(path: Path):
    """LIKE takes an underscore for any letter; names of SQLite itself begin with sqlite_."""
    connection = sqlite3.connect(path)
    connection.execute(
        "CREATE TRIGGER sqliteXevil AFTER INSERT ON document BEGIN DELETE FROM document; END"
    )
    connection.close()
    for read_only in (False, True):
        with pytest.raises(InputError, match="not those of a session"):
            Database.open(path, read_only)


def test_newer_version_is_rejected_and_not_changed(path: Path):
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA user_version = {VERSION + 1}")
    connection.close()
    before = path.read_bytes()
    for read_only in (False, True):
        with pytest.raises(InputError, match=r"of a newer labapp.*install the newer"):
            Database.open(path, read_only)
    assert path.read_bytes() == before


# --- one writer, many readers -----------------------------------------------------------------


def test_second_writer_is_rejected_but_can_read(path: Path):
    first = Database.open(path)
    with pytest.raises(SessionInUse, match=r"another program.*read-only"):
        Database.open(path)
    reader = Database.open(path, read_only=True)
    write(first, "two")
    assert kinds(reader) == ["one", "two"]
    with pytest.raises(InputError, match="read-only"):
        write(reader, "three")
    reader.close()
    first.close()
    Database.open(path).close()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc here")
def test_folder_without_files_is_not_taken_for_another_writer():
    with pytest.raises(InputError) as caught:
        Database.create("/proc/self/a.labsession")
    assert not isinstance(caught.value, SessionInUse)
    assert caught.value.field == "folder"


def test_file_that_cannot_be_written_can_still_be_read(path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # permissions do not bind root
    with pytest.raises(OnlyReadable) as caught:
        Database.open(path)
    assert not isinstance(caught.value, SessionInUse)
    database = Database.open(path, read_only=True)
    assert kinds(database) == ["one"]
    database.close()


def test_second_writer_through_a_link_is_rejected(path: Path, tmp_path: Path):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "link.labsession"
    link.symlink_to(path)
    first = Database.open(link)
    with pytest.raises(SessionInUse):
        Database.open(path)
    first.close()
    Database.open(path).close()


def test_lock_of_a_killed_process_is_released(path: Path):
    script = (
        "import os, sys; from labapp.session.file.database import Database; "
        "d = Database.open(sys.argv[1]); print('open', flush=True); os.kill(os.getpid(), 9)"
    )
    process = subprocess.run(
        [sys.executable, "-c", script, path], capture_output=True, text=True, check=False
    )
    assert process.stdout == "open\n"
    Database.open(path).close()


def test_impossible_lock_is_reported(path: Path):
    lock = path.with_name(f".{path.name}.lock")
    lock.unlink(missing_ok=True)
    lock.mkdir()
    with pytest.raises(InputError, match=r"folder that can be written; .* read-only"):
        Database.open(path)
    Database.open(path, read_only=True).close()


# --- atomic changes ---------------------------------------------------------------------------


def test_failed_change_is_rolled_back(path: Path):
    database = Database.open(path)

    def fail() -> None:
        with database.transaction():
            write(database, "two")  # part of the outer transaction
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert kinds(database) == ["one"]
    write(database, "three")
    database.close()
    with closing(Database.open(path, read_only=True)) as reopened:
        assert kinds(reopened) == ["one", "three"]


def copy_during_change(path: Path) -> Path:
    """Copy the session during a change, when half of the change is in the file."""
    database = Database.open(path)
    with database.transaction() as connection:
        connection.execute("PRAGMA cache_size = 1")
        connection.execute("PRAGMA cache_spill = 1")
        for number in range(40):
            connection.execute(
                "INSERT INTO document (kind, frame, sha256, content) VALUES ('x', ?, '', ?)",
                (number, os.urandom(8000)),
            )
        folder = path.parent / "copy"
        folder.mkdir()
        for entry in path.parent.glob(f"{path.name}*"):
            shutil.copyfile(entry, folder / entry.name)
    database.close()
    copy = folder / path.name
    assert copy.with_name(f"{copy.name}-journal").stat().st_size > 0
    assert copy.stat().st_size > 50_000
    return copy


FULL_DISK = """
    import resource, sys
    from labapp.errors import InputError
    from labapp.session.file.database import Database

    database = Database.open(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
    try:
        with database.transaction() as connection:
            connection.execute("PRAGMA cache_size = 1")
            for number in range(100):
                connection.execute(
                    "INSERT INTO document (kind, frame, sha256, content) VALUES ('x', ?, '', ?)",
                    (number, bytes(8000)),
                )
    except InputError as error:
        print(error.field)
    database.close()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit for the size of a file")
def test_full_disk_leaves_the_file_as_it_was(path: Path):
    before = path.read_bytes()
    assert run_python(FULL_DISK, path).strip() == "disk"
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.glob("*-journal")] == []


def test_interrupted_change_is_rolled_back(path: Path):
    database = Database.open(copy_during_change(path))
    assert kinds(database) == ["one"]
    assert database.problems() == []
    database.close()


def test_read_only_access_does_not_roll_back_an_interrupted_change(path: Path):
    copy = copy_during_change(path)
    before = {entry: entry.read_bytes() for entry in copy.parent.iterdir()}
    database = Database.open(copy, read_only=True)
    assert kinds(database) == ["one"]
    database.close()
    assert {entry: entry.read_bytes() for entry in copy.parent.iterdir()} == before


def with_super_journal(journal: Path, named: Path) -> None:
    """Append to a journal what SQLite writes if a change spans several databases."""
    name = os.fsencode(named)
    with journal.open("ab") as file:
        file.write(b"\xff" * 4 + name)
        file.write(len(name).to_bytes(4, "big") + sum(name).to_bytes(4, "big"))
        file.write(bytes.fromhex("d9d505f920a163d7"))


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize("linked", [False, True])
def test_journal_that_names_another_file_is_rejected(
    path: Path, tmp_path: Path, read_only: bool, linked: bool
):
    copy, victim = copy_during_change(path), tmp_path / "mine.txt"
    victim.write_text("mine")
    with_super_journal(copy.with_name(f"{copy.name}-journal"), victim)
    if linked:
        (tmp_path / "link.labsession").symlink_to(copy)
        copy = tmp_path / "link.labsession"
    with pytest.raises(InputError, match="journal: names another file"):
        Database.open(copy, read_only)
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize("target", ["mine.txt", "/dev/zero"])
def test_journal_that_is_a_link_is_rejected(
    path: Path, tmp_path: Path, target: str, read_only: bool
):
    (tmp_path / "mine.txt").write_text("mine")
    path.with_name(f"{path.name}-journal").symlink_to(target)
    with pytest.raises(InputError, match="journal: is not a file"):
        Database.open(path, read_only)
    assert (tmp_path / "mine.txt").read_text() == "mine"


# --- versions ---------------------------------------------------------------------------------


@pytest.fixture
def next_version(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a newer labapp whose sessions have one more table."""
    added = "CREATE TABLE signal (time_s REAL PRIMARY KEY, current_a REAL)"
    monkeypatch.setattr(module, "VERSION", VERSION + 1)
    monkeypatch.setattr(module, "TABLES", (*TABLES, added))
    monkeypatch.setitem(
        module.MIGRATIONS, VERSION, (added, "UPDATE document SET kind = upper(kind)")
    )


@pytest.mark.usefixtures("next_version")
def test_older_version_is_copied_and_migrated(path: Path):
    before = path.read_bytes()
    database = Database.open(path)
    assert kinds(database) == ["ONE"]
    database.close()
    backup = path.with_name(f"a.version-{VERSION}.labsession")
    assert backup.read_bytes() == before
    with closing(Database.open(path)) as reopened:
        assert kinds(reopened) == ["ONE"]  # migrated only once


def test_link_in_place_of_the_lock_is_rejected(path: Path, tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    path.with_name(f".{path.name}.lock").unlink(missing_ok=True)
    path.with_name(f".{path.name}.lock").symlink_to("mine.txt")
    with pytest.raises(InputError):
        Database.open(path)
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.usefixtures("next_version")
def test_copy_of_an_older_version_follows_no_link(path: Path, tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    path.with_name(f".a.version-{VERSION}.labsession.part").symlink_to("mine.txt")
    Database.open(path).close()
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.usefixtures("next_version")
def test_older_version_is_read_without_a_change(path: Path):
    before = path.read_bytes()
    database = Database.open(path, read_only=True)
    assert kinds(database) == ["ONE"]
    database.close()
    assert path.read_bytes() == before
    assert [entry for entry in path.parent.iterdir() if "version" in entry.name] == []


@pytest.mark.usefixtures("next_version")
def test_failed_migration_leaves_the_file_unchanged(path: Path, monkeypatch: pytest.MonkeyPatch):
    steps = (*module.MIGRATIONS[VERSION], "INSERT INTO nowhere VALUES (1)")
    monkeypatch.setitem(module.MIGRATIONS, VERSION, steps)
    before = path.read_bytes()
    with pytest.raises(InputError, match="nowhere"):
        Database.open(path)
    assert path.read_bytes() == before


@pytest.mark.usefixtures("next_version")
@pytest.mark.parametrize("read_only", [False, True])
def test_older_version_with_other_tables_is_rejected_unchanged(path: Path, read_only: bool):
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE more (text)")
        connection.commit()
    before, files = path.read_bytes(), sorted(path.parent.iterdir())
    with pytest.raises(InputError) as caught:
        Database.open(path, read_only)
    assert (caught.value.field, caught.value.source) == ("tables", str(path))
    assert path.read_bytes() == before
    assert sorted(path.parent.iterdir()) == files


def test_every_earlier_version_has_a_migration():
    assert set(module.MIGRATIONS) == set(range(1, VERSION))
