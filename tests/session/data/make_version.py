"""A small session with every kind of content, as written by labapp of its version.

Run as a program, it writes ``version_N.labsession`` for the present version of the session file:
once a version, before the version is raised, and never again.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import tifffile

import labapp
from labapp.core.pipeline import Settings, start_correction
from labapp.core.rows.correction import set_reference
from labapp.session.file.schema import VERSION
from labapp.session.record import Record
from labapp.session.session import Session

SAMPLE = Path(labapp.__file__).parents[1] / "sample_sessions" / "thumb_tack"


def main() -> None:
    path = Path(__file__).with_name(f"version_{VERSION}.labsession")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frame = tifffile.imread(SAMPLE / "recording.tif", key=0)
        tifffile.imwrite(folder / "one.tif", (frame * (255 / frame.max())).astype("uint8"))
        with Session.create(folder / path.name, Record(operator="A. Weld", notes="µ")) as session:
            session.set_setup((SAMPLE / "setup.toml").read_text("utf-8"))
            session.calibrate_laser([13.676], [18.561], [7.874])
            session.undo()
            session.import_recording(folder / "one.tif", embed=True, frame_rate_hz=25.0)
            ((_, measurement),) = session.measure_each()
            session.set_settings(Settings(scheme="ers"))
            list(session.measure_each())
            session.undo()
            correction = start_correction(measurement)
            session.correct({0: set_reference(correction, None)})
        shutil.copyfile(folder / path.name, path)


if __name__ == "__main__":
    main()
