"""The sample sessions: ``python -m tests.samples.sessions [NAME …]`` makes them."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from labapp.core.pipeline import start_correction
from labapp.core.rows.correction import block_row, set_reference
from labapp.session.samples import SAMPLES, begin_session, sample_folder
from labapp.session.session import Session


def correct_frame_2(session: Session) -> None:
    """Set the reference and the blocked rows of frame 2; later frames are not changed."""
    result = session.result(2)
    assert result is not None
    correction = set_reference(start_correction(result.measurement), (6, 8))
    for row in (1, 2, 6, 7, 8):
        correction = block_row(correction, row)
    session.correct({2: correction}, "reference and blocked rows of frame 2")
    for _ in session.measure_each([2]):
        pass


def main(names: Sequence[str]) -> None:
    """Make the named sessions, or all; existing ones are replaced."""
    for name in names or SAMPLES:
        path = sample_folder(name) / f"{name}.labsession"
        path.unlink(missing_ok=True)
        with begin_session(name, path) as session:
            for _ in session.measure_each():
                pass
            if name == "blocked_rows":
                correct_frame_2(session)


if __name__ == "__main__":
    main(sys.argv[1:])
