"""The session file as a database: one writer, atomic transactions, errors a user can act on.

The journal is SQLite's rollback journal (docs/adr/0011): between two changes the file is complete
by itself, so that it can be copied, moved and kept on a network drive.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
from filelock import FileLock, Timeout

from labapp.errors import PATH, InputError, os_errors_as_input, require
from labapp.files import atomic_file
from labapp.session.file.schema import APPLICATION_ID, MIGRATIONS, TABLES, VERSION

SUFFIX = ".labsession"
A_SESSION = f"a labapp session ({SUFFIX})"

INTACT_SESSION = "a whole session: a copy from before"

BUSY_S = 5.0
"""Time that a reader waits for the writer's change to end, and the writer for a reader."""

LARGEST_BLOB = 1 << 30

HEADER_BYTES = 100
SQLITE_MAGIC = b"SQLite format 3\x00"
ROLLBACK_JOURNAL = b"\x01\x01"
"""In the header, of the program that wrote the file last and of those that may read it."""

COUNTERS = "CREATE TABLE sqlite_sequence(name,seq)"
"""SQLite's own table, for AUTOINCREMENT."""

JOURNAL_MAGIC = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
"""A journal begins with it, and ends with it if it names a super-journal before."""

OWN_JOURNAL = "one that labapp wrote, or none: this came from elsewhere"


class SessionInUse(InputError):
    """Another program has the session open for writing; it can still be opened read-only."""


class Database:
    """An open session file.

    Make it with `Database.create` or `Database.open`. It is thread-safe: a transaction excludes
    other threads.
    """

    def __init__(self, path: Path, read_only: bool, lock: FileLock | None) -> None:
        self.path = path
        """The file."""
        self.read_only = read_only
        """Whether it was opened so."""
        self._lock = lock
        self._mutex = threading.RLock()
        self._temporary: Path | None = None
        self._connection = _connect(path, read_only)

    @classmethod
    def create(cls, path: str | os.PathLike[str]) -> Database:
        """Make a new session file.

        Raises
        ------
        InputError
            If there is a file of that name, or it cannot be written.
        """
        path = new_session_path(path)
        lock = _lock(path)
        try:
            # Made beside its place: a crash on the way leaves no session that is none.
            with (
                atomic_file(path) as part,
                _translated_errors(path),
                _closing(_connect(part, read_only=False)) as connection,
            ):
                connection.execute("BEGIN IMMEDIATE")
                for statement in TABLES:
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {VERSION}")
                connection.execute("COMMIT")
            with _translated_errors(path):
                return cls(path, read_only=False, lock=lock)
        except BaseException as error:
            _release(lock)
            if isinstance(error, OSError):
                raise InputError(
                    path, "file", error.strerror, "a folder that can be written"
                ) from error
            raise

    @classmethod
    def open(cls, path: str | os.PathLike[str], read_only: bool = False) -> Database:
        """Open a session file. One of an earlier version is copied, then brought up to date.

        Raises
        ------
        SessionInUse
            If it is to be written and another program has it open for that.
        InputError
            If it cannot be read, is no session, or is one of a newer version.
        """
        require(path, PATH, "session", "path", "the path of a .labsession")
        path = Path(path).absolute()
        _check_header(path)
        _check_journal(path)
        lock = None if read_only else _lock(path)
        try:
            with _translated_errors(path):
                if read_only:
                    return cls._open_to_read(path)
                with _closing(_connect(path, read_only=False)) as connection:
                    _roll_back(connection)
                if (version := _check_header(path)) < VERSION:
                    _migrate(path, version)
                return cls(path, read_only=False, lock=lock)._checked()
        except BaseException:
            _release(lock)
            raise

    @classmethod
    def _open_to_read(cls, path: Path) -> Database:
        """Open without changing the file; a migration or a rollback is done in a copy."""
        if _check_header(path) == VERSION:
            database = cls(path, read_only=True, lock=None)
            try:
                _roll_back(database._connection)
                return database._checked()
            except sqlite3.OperationalError:
                database.close()  # an unfinished change is to be rolled back
            except BaseException:
                database.close()
                raise
        folder = Path(tempfile.mkdtemp(prefix="labapp-"))
        try:
            copy = folder / path.name
            shutil.copyfile(path, copy)
            if (journal := _journal_of(path)).exists():
                shutil.copyfile(journal, _journal_of(copy))
            with _closing(_connect(copy, read_only=False)) as connection:
                _roll_back(connection)
            _apply_migrations(copy, _check_header(copy), path)
            database = cls(copy, read_only=True, lock=None)
            database.path, database._temporary = path, folder
            return database._checked()
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def close(self) -> None:
        """Close the file. Closing twice does no harm."""
        with self._mutex:
            self._connection.close()
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)
        _release(self._lock)

    def rows(self, sql: str, *values: object) -> list[tuple[Any, ...]]:
        """All rows of a query, read at once so that no reader blocks the writer.

        Raises
        ------
        InputError
            If the file cannot be read or is damaged.
        """
        with self._mutex, _translated_errors(self.path):
            return self._connection.execute(sql, values).fetchall()

    def value(self, sql: str, *values: object) -> Any:
        """First value of the first row of a query; None if there is none."""
        found = self.rows(sql, *values)
        return found[0][0] if found else None

    def array(self, values: Sequence[object], kind: type[np.generic]) -> npt.NDArray[Any]:
        """Values of a column as an array; None becomes NaN.

        Raises
        ------
        InputError
            If they are not numbers, which is damage.
        """
        try:
            return np.array(values, kind)
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(self.path, "content", f"damaged ({error})", INTACT_SESSION) from error

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Atomic change of the file; a nested one joins the outer.

        Raises
        ------
        InputError
            If the session is read-only or the file cannot be written; what it held before stands.
        """
        if self.read_only:
            raise InputError(
                self.path, "session", "is open read-only", "a session that is open for writing"
            )
        with self._mutex, _translated_errors(self.path):
            nested = self._connection.in_transaction
            if not nested:
                self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                if not nested:
                    self._connection.execute("COMMIT")
            except BaseException:
                # A full disk may have ended the transaction already.
                if not nested and self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    def problems(self) -> list[str]:
        """SQLite's own findings on the file's integrity; empty if there are none."""
        found = [str(text) for (text,) in self.rows("PRAGMA integrity_check")]
        loose = self.rows("PRAGMA foreign_key_check")
        return [text for text in found if text != "ok"] + [
            f"row {row} of {table} belongs to nothing" for table, row, *_ in loose
        ]

    def _checked(self) -> Database:
        """Refuse a file whose tables are not those of this version."""
        try:
            with _translated_errors(self.path):
                _check_tables(self._connection, self.path)
        except BaseException:
            self.close()
            raise
        return self


def new_session_path(path: str | os.PathLike[str]) -> Path:
    """Absolute path of a session to be created.

    Raises
    ------
    InputError
        If that is no name of a session, or there is a file of that name.
    """
    require(path, PATH, "session", "path", "the path of a .labsession")
    path = Path(path).absolute()
    if path.suffix.lower() != SUFFIX:
        raise InputError(path, "name", path.name, f"a name that ends in {SUFFIX}")
    if path.exists():
        raise InputError(path, "file", "is there already", "a new name, or open it")
    return path


def _check_header(path: Path) -> int:
    """Version of a session file, read without SQLite, whose errors would not say what is wrong."""
    from labapp.media.formats.stored import (
        regular_size,  # late: it loads what reads every recording
    )

    with os_errors_as_input(path, "file", A_SESSION):
        regular_size(path)
        with path.open("rb") as file:
            header = file.read(HEADER_BYTES)
    if len(header) < HEADER_BYTES or not header.startswith(SQLITE_MAGIC):
        raise InputError(path, "content", "not a session" if header else "0 bytes", A_SESSION)
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        raise InputError(path, "content", "a database of another program", A_SESSION)
    if header[18:20] != ROLLBACK_JOURNAL:
        # SQLite would leave files of its own beside it, even to read.
        raise InputError(path, "content", "another kind of journal, or damaged", INTACT_SESSION)
    version = int.from_bytes(header[60:64], "big")
    if version > VERSION:
        raise InputError(
            path,
            "version",
            f"{version}, of a newer labapp",
            f"{VERSION} or less: install the newer labapp; the file was not changed",
        )
    if version < 1:
        raise InputError(path, "version", version, f"1 to {VERSION}")
    return version


def _journal_of(path: Path) -> Path:
    """Where SQLite keeps the journal of a session: beside the file itself, not beside a link."""
    return Path(f"{os.path.realpath(path)}-journal")


def _check_journal(path: Path) -> None:
    """Refuse a journal that is not one of ours, before SQLite sees it.

    A journal that ends with the name of a super-journal has SQLite read that file as a list of
    further journals, and delete it. Only changes over several databases have one: no session's.
    """
    journal = _journal_of(path)
    try:
        if not os.path.lexists(journal):
            return
        if not stat.S_ISREG(journal.lstat().st_mode):
            raise InputError(journal, "journal", "is no file", OWN_JOURNAL)
        with journal.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - len(JOURNAL_MAGIC)))
            names_another = file.read() == JOURNAL_MAGIC
    except FileNotFoundError:
        return  # the change has ended
    except OSError as error:
        raise InputError(journal, "journal", error.strerror, OWN_JOURNAL) from error
    if names_another:
        raise InputError(journal, "journal", "names another file", OWN_JOURNAL)


def _connect(path: Path, read_only: bool) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"file:{quote(str(path))}?mode={'ro' if read_only else 'rwc'}",
        uri=True,
        timeout=BUSY_S,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_BLOB)
        for pragma in (
            "trusted_schema = OFF",
            "cell_size_check = ON",
            "foreign_keys = ON",
            "temp_store = MEMORY",
        ):
            connection.execute(f"PRAGMA {pragma}")
        if not read_only:
            connection.execute("PRAGMA journal_mode = DELETE")
            connection.execute("PRAGMA synchronous = EXTRA")
    except BaseException:
        connection.close()
        raise
    return connection


@contextmanager
def _closing(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    try:
        yield connection
    finally:
        connection.close()


def _roll_back(connection: sqlite3.Connection) -> None:
    """Have SQLite roll back an unfinished change, as it does at the first reading."""
    connection.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _check_tables(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse tables that are not those of this version; ``path`` is for the error."""
    # Every statement counts, whatever the name: a trigger could rewrite results. Without one are
    # the indexes of unique columns only.
    found = connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    if sorted(str(sql) for (sql,) in found) != sorted((*TABLES, COUNTERS)):
        raise InputError(path, "tables", "not those of a session", A_SESSION)


def _migrate(path: Path, version: int) -> None:
    """Migrate a file to the present version; a copy of the former one stays beside it.

    A file that would be refused afterwards is refused before anything is written.
    """
    _apply_migrations(path, version, path, end="ROLLBACK")
    kept = path.with_name(f"{path.stem}.version-{version}{SUFFIX}")
    if not kept.exists():
        with atomic_file(kept) as part:
            shutil.copyfile(path, part)
    _apply_migrations(path, version, path)


def _apply_migrations(file: Path, version: int, path: Path, end: str = "COMMIT") -> None:
    """Migrate a file in a transaction that ends so; errors name ``path``.

    Raises
    ------
    InputError
        If its tables would not be those of a session; the file is unchanged.
    """
    with _closing(_connect(file, read_only=False)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        for earlier in range(version, VERSION):
            for statement in MIGRATIONS[earlier]:
                connection.execute(statement)
        _check_tables(connection, path)  # closing the connection rolls back
        connection.execute(f"PRAGMA user_version = {VERSION}")
        connection.execute(end)


def _lock(path: Path) -> FileLock:
    """Lock the session for writing. The lock ends with the process, however that ends."""
    lock = FileLock(path.with_name(f".{path.name}.lock"))
    try:
        if not path.parent.is_dir():
            raise NotADirectoryError(20, "does not exist")
        lock.acquire(blocking=False)
    except Timeout as error:
        raise SessionInUse(
            path,
            "session",
            "is open in another program",
            "to be closed there first; it can be opened read-only",
        ) from error
    except (OSError, NotImplementedError) as error:
        raise InputError(
            path,
            "folder",
            getattr(error, "strerror", None) or error,
            "a folder that can be written"
            + ("; the session can be opened read-only" if path.exists() else ""),
        ) from error
    return lock


def _release(lock: FileLock | None) -> None:
    if lock is not None:
        lock.release()


SQLITE_ERRORS: Sequence[tuple[tuple[int, ...], str, str, str]] = (
    (
        (sqlite3.SQLITE_FULL,),
        "disk",
        "no space left",
        "room on the disk; everything up to the last finished change is kept",
    ),
    (
        (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED),
        "session",
        "another program is using it and does not let go",
        "to try again, or close it there",
    ),
    (
        (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM),
        "file",
        "cannot be written",
        "a file and a folder that can be written; or open the session read-only",
    ),
    (
        (sqlite3.SQLITE_IOERR,),
        "disk",
        "cannot be read or written",
        "a disk that works and has room; everything up to the last finished change is kept",
    ),
)


@contextmanager
def _translated_errors(path: Path) -> Iterator[None]:
    """Translate SQLite's errors into `InputError`."""
    try:
        yield
    except sqlite3.ProgrammingError:
        raise
    except sqlite3.DatabaseError as error:
        primary = getattr(error, "sqlite_errorcode", 0) & 0xFF
        for codes, field, value, expected in SQLITE_ERRORS:
            if primary in codes:
                raise InputError(path, field, f"{value} ({error})", expected) from error
        raise InputError(
            path,
            "content",
            f"damaged ({error})",
            INTACT_SESSION,
        ) from error
    except (OverflowError, UnicodeDecodeError, sqlite3.InterfaceError) as error:
        raise InputError(path, "content", f"damaged ({error})", INTACT_SESSION) from error
