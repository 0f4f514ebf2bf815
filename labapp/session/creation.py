"""Creation of a session that is complete, or does not exist."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from labapp.session.record import Record
from labapp.session.session import Session


@contextmanager
def new_session(path: str | os.PathLike[str], record: Record | None = None) -> Iterator[Session]:
    """Yield a new session, which stays open; if the block raises, it is closed and deleted.

    Raises
    ------
    InputError
        If the file exists already or cannot be written.
    """
    session = Session.create(path, record)
    try:
        yield session
    except BaseException:
        session.close()
        session.path.unlink()
        raise
