"""Pictures for the calibrations, stored in the session as soon as they are loaded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from labapp.media import GreyImage, read_picture
from labapp.session.session import Session


@dataclass(frozen=True, eq=False)
class KeptPicture:
    """A picture and its place in the session."""

    name: str
    """Name of its file."""
    image: GreyImage
    """Grey levels, shape (rows, columns)."""
    sha256: str
    """Its SHA-256 in the session; empty in a session that is open read-only."""


def load_picture(session: Session, path: Path) -> KeptPicture:
    """Read a picture and store it in the session, unless that is open read-only.

    Raises
    ------
    InputError
        If it cannot be read or stored.
    """
    image = read_picture(path)
    sha256 = "" if session.read_only else session.keep_picture(path.name, image)
    return KeptPicture(path.name, image, sha256)
