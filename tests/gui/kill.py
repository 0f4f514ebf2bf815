"""Kill the app while it imports or measures: run by `test_long_work.py`, or by hand.

``python tests/gui/kill.py FOLDER KILLS SEED``: a child process opens the window on a session, and
imports or measures as for an operator; it is killed at random moments. After each kill the session
must open without problems, and contain every result that the operator could see and either all
frames of the recording or none; and no process may be left over.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import labapp
from labapp.session.session import Session

FRAMES = 600
SIDE_PX = 64
SAMPLE = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw" / "setup.toml"
GONE_S = 60.0
NUMBER_BYTES = 4
"""Bytes per number."""


# --- in the process that is killed ------------------------------------------------------------


def work(path: Path, recording: Path, pipe: int) -> None:
    """Import if there are no frames yet, else measure; report each finished frame."""
    from PySide6.QtCore import QTimer

    from labapp.gui.app import start_app
    from labapp.gui.preferences import Preferences
    from labapp.gui.shell.commands import make_window

    def report(number: int) -> None:
        os.write(pipe, number.to_bytes(NUMBER_BYTES, "little"))

    measure_each, import_recording = Session.measure_each, Session.import_recording

    # Passed on unchanged, whatever they are.
    def measured(session, *args, **kwargs):  # type: ignore[no-untyped-def]
        for number, measurement in measure_each(session, *args, **kwargs):
            report(number)
            yield number, measurement

    def imported(session, *args, progress, **kwargs):  # type: ignore[no-untyped-def]
        def step(done: int, total: int) -> None:
            report(done)
            progress(done, total)

        return import_recording(session, *args, progress=step, **kwargs)

    # The process to be killed reports what it does.
    Session.measure_each = measured  # type: ignore[method-assign]
    Session.import_recording = imported  # type: ignore[method-assign]
    app = start_app()
    window = make_window(Preferences(), path.with_name("preferences.json"))
    window.show()
    window.workspace.show(Session.open(path))
    session = window.workspace.session
    assert session is not None

    def begin() -> None:
        page = window.pages["capture"]
        if page.preview is None:  # type: ignore[attr-defined]
            QTimer.singleShot(10, begin)
        else:
            page.import_chosen()  # type: ignore[attr-defined]

    if len(session.frames):
        window.do("measure")
    else:
        window.files.take(recording)
        begin()
    app.exec()


# --- in the process that kills ----------------------------------------------------------------


def run_and_kill(path: Path, recording: Path, rng: random.Random) -> list[int]:
    """Run the app and kill it; return the frames that it reported."""
    reading, writing = os.pipe()
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "XDG_STATE_HOME": str(path.parent)}
    child = subprocess.Popen(
        [sys.executable, __file__, "work", path, recording, str(writing)],
        pass_fds=[writing],
        env=environment,
        start_new_session=True,
    )
    os.close(writing)
    reported: list[int] = []
    try:
        reported += read_numbers(reading, 1 + rng.randrange(40))
        time.sleep(rng.uniform(0, 0.02))
    finally:
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
    reported += read_numbers(reading, FRAMES)
    os.close(reading)
    wait_for_all(child.pid)
    return reported


def read_numbers(pipe: int, count: int) -> list[int]:
    """The next numbers reported, or fewer if the writing process has ended."""
    numbers: list[int] = []
    while len(numbers) < count and (part := os.read(pipe, NUMBER_BYTES)):
        numbers.append(int.from_bytes(part, "little"))
    return numbers


def wait_for_all(group: int) -> None:
    """Wait until the processes that measured have ended as well."""
    ends = time.monotonic() + GONE_S
    try:
        while time.monotonic() < ends:
            os.killpg(group, 0)
            time.sleep(0.05)
    except ProcessLookupError:
        return
    os.killpg(group, signal.SIGKILL)
    raise SystemExit("a process that measured was left over")


def check(path: Path, known: set[int], reported: list[int], importing: bool) -> set[int]:
    """The frames with results; exits if anything is lost or damaged."""
    with Session.open(path) as session:
        problems = session.problems()
        count = len(session.frames)
        has = set(measured_frames(session))
    if problems:
        raise SystemExit(f"not whole: {problems}")
    if count not in (0, FRAMES):
        raise SystemExit(f"{count} of {FRAMES} frames were imported")
    if not importing and not (known | set(reported)) <= has:
        raise SystemExit(f"lost: {sorted((known | set(reported)) - has)}")
    if not importing and len(has - known - set(reported)) > 1:
        raise SystemExit("more than the frame in work was kept and not told")
    return has


def measured_frames(session: Session) -> Iterator[int]:
    overview = session.overview()
    for number, status in zip(overview.frame.tolist(), overview.status, strict=True):
        if status:
            yield number


def main(folder: Path, kills: int, seed: int) -> None:
    rng = random.Random(seed)
    recording = folder / "dark.npy"
    np.save(recording, np.zeros((FRAMES, SIDE_PX, SIDE_PX), np.uint8))
    path = folder / "killed.labsession"
    with Session.create(path) as session:
        session.set_setup(SAMPLE.read_text("utf-8"))
    counts = {"importing": 0, "measuring": 0}
    known: set[int] = set()
    for kill in range(kills):
        importing = kill < kills // 2
        if kill == kills // 2:
            with Session.open(path) as session:
                session.import_recording(recording)
        reported = run_and_kill(path, recording, rng)
        if not reported:
            raise SystemExit("it was killed before it did anything")
        counts["importing" if importing else "measuring"] += len(reported)
        if importing:
            check(path, known, reported, importing)
            with Session.open(path) as session:
                complete = len(session.frames) > 0
            if complete:  # the import finished before the kill: start again without frames
                path.unlink()
                with Session.create(path) as session:
                    session.set_setup(SAMPLE.read_text("utf-8"))
        else:
            known = check(path, known, reported, importing)
    print(json.dumps({"kills": kills, "measured": len(known), **counts}))


if __name__ == "__main__":
    if sys.argv[1] == "work":
        work(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
    else:
        main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
