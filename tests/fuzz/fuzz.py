"""Damage sessions, setups, recordings and tables: nothing worse than a sentence may come of it.

``python tests/fuzz/fuzz.py COUNT SEED [FIRST]`` tries files FIRST … FIRST + COUNT − 1 of a seed's
sequence; each can be tried again by itself (COUNT 1). A file that takes more than 10 s, or more
than 3 GB, is a failure, as is one that ends the process.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))

from labapp.session.session import Session
from tests.fuzz.contract import KINDS, facts, try_case
from tests.fuzz.originals import Originals, make_originals

MOST_S = 10
"""Of processor time, so that other programs do not count …"""

MOST_WAITING_S = 60
"""… and by the clock, so that waiting for ever does."""

MOST_BYTES = 3 << 30


@dataclass
class Outcome:
    """What came of the files."""

    files: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    used: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    slowest: tuple[float, int, str] = (0.0, 0, "")


def kind_of(seed: int, number: int) -> str:
    return random.Random(f"{seed} {number} kind").choice(KINDS)


def _work(originals: Originals, numbers: range, seed: int, folder: Path, pipe: int) -> None:
    """Try files one after the other; tells of each what came of it, in a line."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    os.environ["XDG_STATE_HOME"] = str(folder / "state")
    known = {}
    for path in originals.sessions:
        with Session.open(path, read_only=True) as session:
            assert session.problems() == [], path
            known[path] = facts(session)
    for number in numbers:
        rng = random.Random(f"{seed} {number}")
        place = folder / "case"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        began = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, MOST_S)  # its signal ends the process
        signal.alarm(MOST_WAITING_S)
        told = ""
        used = refused = 0
        try:
            tally = try_case(kind_of(seed, number), originals, place, known, rng)
            used, refused = tally.used, tally.refused
        except Exception:
            told = traceback.format_exc()
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        took = time.process_time() - began
        os.write(pipe, json.dumps([number, took, used, refused, told]).encode() + b"\n")


def fuzz(count: int, seed: int, folder: Path, first: int = 0) -> Outcome:
    """Try ``count`` files in child processes; a child that ends is told of and replaced."""
    outcome = Outcome()
    (folder / "originals").mkdir()
    originals = make_originals(folder / "originals")
    number, last = first, first + count
    while number < last:
        reading, writing = os.pipe()
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            os.close(reading)
            try:
                _work(originals, range(number, last), seed, folder, writing)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, encoding="utf-8") as lines:
            for line in lines:
                number = _note(outcome, line, seed) + 1
        _, status = os.waitpid(child, 0)
        if ended := os.waitstatus_to_exitcode(status):
            kind = kind_of(seed, number)
            why = signal.Signals(-ended).name if ended < 0 else ended
            outcome.failures.append(f"seed {seed}, file {number} ({kind}): ended by {why}")
            outcome.files[kind] += 1
            number += 1
    return outcome


def _note(outcome: Outcome, line: str, seed: int) -> int:
    number: int
    number, took, used, refused, told = json.loads(line)
    kind = kind_of(seed, number)
    outcome.files[kind] += 1
    outcome.used[kind] += used
    outcome.refused[kind] += refused
    outcome.slowest = max(outcome.slowest, (took, number, kind))
    if told:
        where = f"seed {seed}, file {number} ({kind})"
        outcome.failures.append(f"{where}:\n{told}")
    return number


def main(arguments: list[str]) -> None:
    count, seed, *more = map(int, arguments)
    with tempfile.TemporaryDirectory() as folder:
        outcome = fuzz(count, seed, Path(folder), *more)
    for failure in outcome.failures:
        print(failure)
    print(f"{'files':>14} {'calls done':>11} {'refused':>8}")
    for kind, files in sorted(outcome.files.items()):
        print(f"{files:5} {kind:<14} {outcome.used[kind]:5} {outcome.refused[kind]:8}")
    took, number, kind = outcome.slowest
    print(f"slowest: file {number} ({kind}), {took:.2f} s")
    raise SystemExit(f"{len(outcome.failures)} failures" if outcome.failures else 0)


if __name__ == "__main__":
    main(sys.argv[1:])
