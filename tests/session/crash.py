"""Changes to a session, interrupted at any moment: run by `test_crash.py`, or by hand for longer.

``python crash.py kill FOLDER KILLS CHANGES SEED`` forks a child that makes random changes and
kills it at random moments; ``disk`` fills its disk instead. After each interruption the session
must open without problems, in the state after the last acknowledged change. A model of plain
values, independent of the code of the session, defines this state. A change that was finished but
not yet acknowledged may be included.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import sys
import time
from pathlib import Path

import numpy as np

from labapp.core.images.dots import Dots
from labapp.core.pipeline import Settings
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Lattice
from labapp.errors import InputError
from labapp.session.record import Record
from labapp.session.session import Session

FRAMES = 40
MOST_CHANGES = 1000
"""In one round: more than the time or the disk allows."""
PLAIN = {"notes": "", "setup": "", "scheme": "fit", "corrections": {}}


def step(number: int, seed: int) -> tuple[str, object]:
    """Change ``number`` of the sequence, counted from 0."""
    rng = random.Random(f"{seed} {number}")
    kind = rng.choice(
        ["notes", "setup", "scheme", "correction", "correction", "several", "undo", "undo", "redo"]
    )
    if kind == "notes":
        return kind, f"note {number} " + "x" * rng.randrange(20_000)
    if kind == "setup":
        return kind, rng.uniform(20, 40)
    if kind == "scheme":
        return kind, rng.choice(["fit", "ers", "irs"])
    if kind == "correction":
        return kind, {rng.randrange(FRAMES): rng.choice([None, number])}
    if kind == "several":
        return kind, dict.fromkeys(rng.sample(range(FRAMES), 8), number)
    return kind, None


class Model:
    """Expected contents of the session, in plain values."""

    def __init__(self) -> None:
        self.state: dict[str, object] = dict(PLAIN)
        self.done: list[dict[str, object]] = []
        self.undone: list[dict[str, object]] = []

    def apply(self, number: int, seed: int) -> None:
        kind, value = step(number, seed)
        before = self.state
        if kind == "undo":
            if self.done:
                self.undone.append(before)
                self.state = self.done.pop()
            return
        if kind == "redo":
            if self.undone:
                self.done.append(before)
                self.state = self.undone.pop()
            return
        if kind in ("correction", "several"):
            assert isinstance(value, dict)
            assert isinstance(before["corrections"], dict)
            merged = {**before["corrections"], **value}
            value = {
                frame: number_of_change
                for frame, number_of_change in merged.items()
                if number_of_change is not None
            }
            kind = "corrections"
        after = {**before, kind: value}
        if after != before:
            self.done.append(before)
            self.undone.clear()
            self.state = after


def correction_of(number: int) -> Correction:
    rng = np.random.default_rng(number)
    dots = Dots(*rng.uniform(0, 400, (7, 120)))
    return Correction(dots, Lattice(np.arange(120), np.arange(120)), np.ones(120, bool))


def apply(session: Session, number: int, seed: int) -> None:
    kind, value = step(number, seed)
    if kind == "notes":
        session.set_record(Record(notes=str(value)))
    elif kind == "setup":
        session.update_setup({"laser": {"distance_mm": value}})
    elif kind == "scheme":
        session.set_settings(Settings(scheme=value))  # type: ignore[arg-type]
    elif kind in ("correction", "several"):
        assert isinstance(value, dict)
        session.correct(
            {
                frame: None if number_of_change is None else correction_of(number_of_change)
                for frame, number_of_change in value.items()
            }
        )
    elif kind == "undo":
        session.undo()
    else:
        session.redo()


def differences(session: Session, state: dict[str, object]) -> list[str]:
    """Names of the values in which the session differs from a state of the model."""
    names = []
    if session.record.notes != state["notes"]:
        names.append("notes")
    text = session.setup_text
    setup = float(text.split("=")[1]) if text else ""
    if setup != state["setup"]:
        names.append("setup")
    if session.settings.scheme != state["scheme"]:
        names.append("scheme")
    assert isinstance(state["corrections"], dict)
    for frame in range(FRAMES):
        stored, number = session.correction(frame), state["corrections"].get(frame)
        expected = None if number is None else correction_of(number)
        if (stored is None) != (expected is None) or not (
            stored is None
            or expected is None
            or np.array_equal(stored.dots.image_px, expected.dots.image_px)
        ):
            names.append(f"correction {frame}")
    return names


def check(path: Path, acknowledged: int, seed: int) -> tuple[int, list[str]]:
    """Return the number of changes in the session, and its problems."""
    problems = []
    with Session.open(path, read_only=True) as session_to_read:
        before = differences_from(session_to_read, acknowledged, seed)
    with Session.open(path) as session:
        problems += session.problems()
        count, differing = differences_from(session, acknowledged, seed)
        problems += differing
    if before != (count, differing):
        problems.append(f"read-only it showed something else: {before}")
    return count, problems


def differences_from(session: Session, acknowledged: int, seed: int) -> tuple[int, list[str]]:
    model = Model()
    for number in range(acknowledged):
        model.apply(number, seed)
    first = differences(session, model.state)
    if not first:
        return acknowledged, []
    model.apply(acknowledged, seed)
    if not differences(session, model.state):
        return acknowledged + 1, []
    return acknowledged, first


def make_changes(path: Path, start: int, seed: int, pipe: int) -> None:
    with Session.open(path) as session:
        for number in range(start, start + MOST_CHANGES):
            apply(session, number, seed)
            os.write(pipe, (number + 1).to_bytes(4, "little"))


def last_acknowledged(pipe: int, before: int, most: int = MOST_CHANGES) -> int:
    """Return the last acknowledged change, after ``most`` changes or the end of the child."""
    last = before
    while last < before + most and (part := os.read(pipe, 4)):
        last = int.from_bytes(part, "little")
    return last


def run_and_kill(path: Path, start: int, seed: int, rng: random.Random) -> int:
    """Start a child that makes changes from ``start`` on, kill it; return the last acknowledged."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            make_changes(path, start, seed, writing)
        finally:
            os._exit(1)
    os.close(writing)
    # After some changes, at a random moment of the next one or of opening the session.
    acknowledged = last_acknowledged(reading, start, rng.randrange(10))
    time.sleep(rng.uniform(0, 0.01))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    acknowledged = last_acknowledged(reading, acknowledged)
    os.close(reading)
    return acknowledged


def run_until_disk_is_full(path: Path, start: int, seed: int, rng: random.Random) -> int:
    """Start a child that makes changes until the disk is full; return the last acknowledged."""
    limit = path.stat().st_size + rng.randrange(400_000)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            make_changes(path, start, seed, writing)
        except InputError as error:
            os._exit(0 if error.field == "disk" else 3)
        finally:
            os._exit(4)
    os.close(writing)
    acknowledged = last_acknowledged(reading, start)
    _, status = os.waitpid(child, 0)
    os.close(reading)
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"the child ended with {os.waitstatus_to_exitcode(status)}, not told why")
    return acknowledged


def main(arguments: list[str]) -> None:
    how, folder, times, changes, seed = arguments[0], Path(arguments[1]), *map(int, arguments[2:])
    path = folder / "crash.labsession"
    rng = random.Random(seed)
    with Session.create(path) as session, session._database.transaction() as connection:
        connection.executemany(
            "INSERT INTO frame (number) VALUES (?)", [(frame,) for frame in range(FRAMES)]
        )
    interrupt = run_and_kill if how == "kill" else run_until_disk_is_full
    done, rounds, unacknowledged = 0, 0, 0
    while rounds < times or done < changes:
        acknowledged = interrupt(path, done, seed, rng)
        done, problems = check(path, acknowledged, seed)
        if problems:
            raise SystemExit(f"round {rounds}, after change {acknowledged}: {problems}")
        unacknowledged += done - acknowledged
        rounds += 1
    print(json.dumps({"rounds": rounds, "changes": done, "unacknowledged": unacknowledged}))


if __name__ == "__main__":
    main(sys.argv[1:])
