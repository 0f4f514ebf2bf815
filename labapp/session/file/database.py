"""The session file as a database: one writer, atomic transactions, errors for users.

The journal is SQLite's rollback journal (docs/adr/0011): between changes the session is a single
complete file, which can be copied, moved and stored on a network drive.
"""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import stat
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
from filelock import FileLock, Timeout

from labapp.errors import PATH, InputError, os_errors_as_input, require
from labapp.files import acquire, atomic_file, regular_size
from labapp.session.file.schema import APPLICATION_ID, MIGRATIONS, TABLES, VERSION

SUFFIX = ".labsession"
A_SESSION = f"a labapp session ({SUFFIX})"

INTACT_SESSION = "an intact session, such as a backup"

BUSY_S = 5.0
"""Time that readers and the writer wait for each other, s."""

LARGEST_BLOB = 1 << 30

HEADER_BYTES = 100
SQLITE_MAGIC = b"SQLite format 3\x00"
ROLLBACK_JOURNAL = b"\x01\x01"
"""Write and read version of the file format in the header."""

COUNTERS = "CREATE TABLE sqlite_sequence(name,seq)"
"""SQLite's internal table for AUTOINCREMENT."""

JOURNAL_MAGIC = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
"""First bytes of a journal; also its last bytes if it names a super-journal."""

OWN_JOURNAL = "a journal written by labapp, or none: this one is from another program"


class OnlyReadable(InputError):
    """The session cannot be opened for writing; it can still be opened read-only."""


class SessionInUse(OnlyReadable):
    """Another program has the session open for writing."""


class Database:
    """An open session file.

    Make it with `Database.create` or `Database.open`. It is thread-safe: a transaction excludes
    other threads.
    """

    def __init__(self, path: Path, read_only: bool, lock: FileLock | None) -> None:
        self.path = path
        """Path of the file."""
        self.read_only = read_only
        """Whether it was opened read-only."""
        self._lock = lock
        self._mutex = threading.RLock()
        self._temporary: Path | None = None
        self._connection = _connect(path, read_only)

    @classmethod
    def create(cls, path: str | os.PathLike[str]) -> Database:
        """Create a session file.

        Raises
        ------
        InputError
            If the file exists already, or it cannot be written.
        """
        path = new_session_path(path)
        lock = _lock(path)
        try:
            # Created as a temporary file, so that a crash leaves no invalid session.
            with (
                atomic_file(path) as part,
                _translated_errors(path),
                closing(_connect(part, read_only=False)) as connection,
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
        """Open a session file. A file of an earlier version is backed up, then migrated.

        Raises
        ------
        OnlyReadable
            If it is to be opened for writing, and another program has done so (`SessionInUse`), or
            the file or its folder cannot be written.
        InputError
            If it cannot be read, is not a session, or has a newer version.
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
                with closing(_connect(path, read_only=False)) as connection:
                    _roll_back(connection)
                if (version := _check_header(path)) < VERSION:
                    _migrate(path, version)
                return cls(path, read_only=False, lock=lock)._checked()
        except BaseException:
            _release(lock)
            raise

    @classmethod
    def _open_to_read(cls, path: Path) -> Database:
        """Open without changing the file; migration and rollback are done in a copy."""
        if _check_header(path) == VERSION:
            database = cls(path, read_only=True, lock=None)
            try:
                _roll_back(database._connection)
                return database._checked()
            except sqlite3.OperationalError:
                database.close()  # an unfinished change must be rolled back
            except BaseException:
                database.close()
                raise
        folder = Path(tempfile.mkdtemp(prefix="labapp-"))
        try:
            copy = folder / path.name
            shutil.copyfile(path, copy)
            if (journal := _journal_of(path)).exists():
                shutil.copyfile(journal, _journal_of(copy))
            with closing(_connect(copy, read_only=False)) as connection:
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
        """Return all rows of a query, fetched at once so that readers do not block the writer.

        Raises
        ------
        InputError
            If the file cannot be read or is damaged.
        """
        with self._mutex, _translated_errors(self.path):
            return self._connection.execute(sql, values).fetchall()

    def value(self, sql: str, *values: object) -> Any:
        """Return the first value of the first row of a query; None if there is none."""
        found = self.rows(sql, *values)
        return found[0][0] if found else None

    def array(self, values: Sequence[object], kind: type[np.generic]) -> npt.NDArray[Any]:
        """Return the values of a column as an array; None becomes NaN.

        Raises
        ------
        InputError
            If they are not numbers: the file is damaged.
        """
        try:
            return np.array(values, kind)
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(self.path, "content", f"damaged ({error})", INTACT_SESSION) from error

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Change the file atomically; a nested transaction joins the outer one.

        Raises
        ------
        InputError
            If the session is read-only or the file cannot be written; the file is unchanged then.
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
                if not nested:
                    with suppress(sqlite3.Error):  # the error to report is the first one
                        _roll_back(self._connection)
                raise

    def problems(self) -> list[str]:
        """Return problems found by SQLite's integrity checks; empty if there are none."""
        found = [str(text) for (text,) in self.rows("PRAGMA integrity_check")]
        loose = self.rows("PRAGMA foreign_key_check")
        return [text for text in found if text != "ok"] + [
            f"row {row} of {table} belongs to nothing" for table, row, *_ in loose
        ]

    def _checked(self) -> Database:
        """Raise if the tables are not those of this version."""
        try:
            with _translated_errors(self.path):
                _check_tables(self._connection, self.path)
        except BaseException:
            self.close()
            raise
        return self


def new_session_path(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a session to be created.

    Raises
    ------
    InputError
        If the name does not end in `SUFFIX`, or the file exists already.
    """
    require(path, PATH, "session", "path", "the path of a .labsession")
    path = Path(path).absolute()
    if path.suffix.lower() != SUFFIX:
        raise InputError(path, "name", path.name, f"a name that ends in {SUFFIX}")
    if path.exists():
        raise InputError(path, "file", "is there already", "a new name, or open it")
    return path


def _check_header(path: Path) -> int:
    """Return the version of a session file, read without SQLite for more specific errors."""
    with os_errors_as_input(path, "file", A_SESSION):
        regular_size(path)
        with path.open("rb") as file:
            header = file.read(HEADER_BYTES)
    if len(header) < HEADER_BYTES or not header.startswith(SQLITE_MAGIC):
        raise InputError(path, "content", "not a session" if header else "0 bytes", A_SESSION)
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        raise InputError(path, "content", "a database of another program", A_SESSION)
    if header[18:20] != ROLLBACK_JOURNAL:
        # SQLite would create further files beside it, even for reading.
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
    """Return the path of SQLite's journal: beside the file itself, not beside a link to it."""
    return Path(f"{os.path.realpath(path)}-journal")


def _check_journal(path: Path) -> None:
    """Raise if there is a foreign journal, before SQLite reads it.

    If a journal ends with the name of a super-journal, SQLite reads that file as a list of further
    journals, and deletes it. Only changes of several databases have one, never those of a session.
    """
    journal = _journal_of(path)
    try:
        if not os.path.lexists(journal):
            return
        if not stat.S_ISREG(journal.lstat().st_mode):
            raise InputError(journal, "journal", "is not a file", OWN_JOURNAL)
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


def _roll_back(connection: sqlite3.Connection) -> None:
    """Roll back an unfinished change, which SQLite does at the first read."""
    connection.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _check_tables(connection: sqlite3.Connection, path: Path) -> None:
    """Raise if the tables are not those of this version; ``path`` is for the error."""
    # Compare every statement: a trigger could rewrite results. Only the automatic indexes of unique
    # columns have none.
    found = connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    if sorted(str(sql) for (sql,) in found) != sorted((*TABLES, COUNTERS)):
        raise InputError(path, "tables", "not those of a session", A_SESSION)


def _migrate(path: Path, version: int) -> None:
    """Migrate a file to the present version, with a backup beside it.

    A trial migration, rolled back, raises the errors before anything is written.
    """
    _apply_migrations(path, version, path, end="ROLLBACK")
    kept = path.with_name(f"{path.stem}.version-{version}{SUFFIX}")
    if not kept.exists():
        with atomic_file(kept) as part:
            shutil.copyfile(path, part)
    _apply_migrations(path, version, path)


def _apply_migrations(file: Path, version: int, path: Path, end: str = "COMMIT") -> None:
    """Migrate a file in a transaction that ends with ``end``; errors name ``path``.

    Raises
    ------
    InputError
        If the tables would not be those of a session; the file is unchanged then.
    """
    with closing(_connect(file, read_only=False)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        for earlier in range(version, VERSION):
            for statement in MIGRATIONS[earlier]:
                connection.execute(statement)
        _check_tables(connection, path)  # closing the connection rolls back
        connection.execute(f"PRAGMA user_version = {VERSION}")
        connection.execute(end)


def _lock(path: Path) -> FileLock:
    """Lock the session for writing; the operating system releases the lock with the process."""
    path = Path(os.path.realpath(path))  # one lock for a file, and for links to it
    lock = FileLock(path.with_name(f".{path.name}.lock"))
    try:
        if not path.parent.is_dir():
            raise NotADirectoryError(20, "does not exist")
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, "the file cannot be written")
        acquire(lock)
    except Timeout as error:
        raise SessionInUse(
            path,
            "session",
            "is open in another program",
            "a session that no other program writes: close it there, or open it read-only",
        ) from error
    except (OSError, NotImplementedError) as error:
        why = getattr(error, "strerror", None) or error
        if not path.exists():
            raise InputError(path, "folder", why, "a folder that can be written") from error
        expected = "a file and a folder that can be written; the session can be opened read-only"
        raise OnlyReadable(path, "session", why, expected) from error
    return lock


def _release(lock: FileLock | None) -> None:
    if lock is not None:
        lock.release()


SQLITE_ERRORS: Sequence[tuple[tuple[int, ...], str, str, str]] = (
    ((sqlite3.SQLITE_FULL,), "disk", "no space left",
        "room on the disk; everything up to the last finished change is kept"),
    ((sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED), "session", "in use by another program",
        "to try again, or close it there"),
    ((sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM),
        "file", "cannot be written",
        "a file and a folder that can be written; or open the session read-only"),
    ((sqlite3.SQLITE_IOERR,), "disk", "cannot be read or written",
        "a disk that works and has room; everything up to the last finished change is kept"),
)  # fmt: skip
"""Error codes; the field, the value and what would be right."""


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
