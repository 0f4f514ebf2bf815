"""The calibration pictures stored in a session."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import cv2
import numpy as np

from labapp.errors import InputError
from labapp.media import GreyImage
from labapp.media.formats.images import decoded
from labapp.session.file.database import Database


class CalibrationPictures:
    """Calibration pictures by the SHA-256 of their PNG; stored pictures never change."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, name: str, image: GreyImage) -> str:
        """Store a picture, grey levels, shape (rows, columns), and return its SHA-256."""
        _, encoded = cv2.imencode(".png", image)
        content = encoded.tobytes()
        sha256 = hashlib.sha256(content).hexdigest()
        with self._database.transaction() as connection:
            connection.execute(
                "INSERT OR IGNORE INTO picture VALUES (?, ?, ?)", (sha256, name, content)
            )
        return sha256

    def copy_from(self, other: CalibrationPictures) -> None:
        """Also store all pictures of another session."""
        rows = other._database.rows("SELECT * FROM picture")
        with self._database.transaction() as connection:
            connection.executemany("INSERT OR IGNORE INTO picture VALUES (?, ?, ?)", rows)

    def get(self, sha256: str) -> GreyImage:
        """Return a picture, grey levels, shape (rows, columns); see `Session.picture`."""
        content = self._database.value("SELECT content FROM picture WHERE sha256 = ?", sha256)
        image = decoded(content) if _is_intact(content, sha256) else None
        if image is None or image.ndim != 2:
            value = "missing" if content is None else "damaged"
            path = self._database.path
            raise InputError(path, "calibration picture", value, "what was kept there")
        return np.asarray(image)

    def problems(self, used: Mapping[str, str]) -> list[str]:
        """Return sentences about damaged or missing pictures; empty if there are none.

        Parameters
        ----------
        used
            SHA-256 of the pictures that must be there → what they belong to.
        """
        stored = self._database.rows("SELECT * FROM picture")
        missing = used.keys() - {sha256 for sha256, *_ in stored}
        return [
            *(f"the picture of {used[sha256]} is missing" for sha256 in sorted(missing)),
            *(
                f"calibration picture {name} is damaged"
                for sha256, name, content in stored
                if not _is_intact(content, sha256)
            ),
        ]


def _is_intact(content: object, sha256: str) -> bool:
    return isinstance(content, bytes) and hashlib.sha256(content).hexdigest() == sha256
