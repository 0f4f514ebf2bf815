"""Verdicts on the set-ups of a session by its results, stored with the results' inputs."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from labapp.core.recording.residual_check import MOST, SetupVerdict
from labapp.session.file.blobs import Damaged, damage_as_input, pack, unpack
from labapp.session.file.database import Database


class SetupVerdicts:
    """Verdicts on the set-ups of a session."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def put(self, inputs: tuple[str, bytes, bytes], verdict: SetupVerdict) -> None:
        """Store the verdict for some inputs: version, packed set-up and settings.

        Raises
        ------
        InputError
            If it cannot be saved.
        """
        with self._database.transaction() as connection:
            connection.execute(
                "UPDATE inputs SET verdict = ? WHERE version = ? AND setup = ? AND settings = ?",
                (pack(verdict), *inputs),
            )

    def of(self, setup: bytes) -> SetupVerdict | None:
        """Return the verdict on a packed set-up; None if nothing was measured with it.

        Of several verdicts, with different settings, a doubtful one is preferred.

        Raises
        ------
        InputError
            If it is damaged.
        """
        rows = self._database.rows(
            "SELECT verdict FROM inputs WHERE setup = ? AND verdict IS NOT NULL ORDER BY id", setup
        )
        with damage_as_input(self._database.path, "verdict"):
            found = [_unpacked(verdict) for (verdict,) in rows]
        return max(reversed(found), key=lambda one: one.is_doubtful, default=None)

    def doubt_of(self, setup: bytes) -> str:
        """Return why a packed set-up is doubtful; empty if it is not."""
        verdict = self.of(setup)
        return verdict.reason if verdict is not None and verdict.is_doubtful else ""

    def problems(self) -> list[str]:
        """Return sentences about damaged verdicts; empty if there are none."""
        found = []
        for number, verdict in self._database.rows(
            "SELECT id, verdict FROM inputs WHERE verdict IS NOT NULL"
        ):
            try:
                unpack(verdict, SetupVerdict)
            except Damaged as error:
                found.append(f"the verdict on inputs {number} is damaged: {error}")
        return found


def chosen_evenly(frames: Sequence[int]) -> list[int]:
    """Choose evenly spaced frames, as many as a verdict needs."""
    places = np.linspace(0, len(frames) - 1, min(len(frames), MOST)).round().astype(int)
    return [frames[place] for place in places.tolist()]


@functools.lru_cache(maxsize=64)
def _unpacked(content: bytes) -> SetupVerdict:
    found: SetupVerdict = unpack(content, SetupVerdict)
    return found
