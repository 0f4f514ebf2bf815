"""Damage sessions, setups, recordings and tables: at worst, an error message may result.

``python tests/fuzz/fuzz.py COUNT SEED [FIRST]`` tries files FIRST … FIRST + COUNT − 1 of a seed's
sequence; each can be repeated alone (COUNT 1). A file that takes more than 10 s or 3 GB, or ends
the process, is a failure.
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
"""Limit of processor time, which is independent of other programs."""

MOST_WAITING_S = 60
"""Limit of wall time, which detects endless waiting."""

MOST_BYTES = 3 << 30


@dataclass
class Outcome:
    """Results of the files."""

    files: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    used: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    slowest: tuple[float, int, str] = (0.0, 0, "")


def kind_of(seed: int, number: int) -> str:
    return random.Random(f"{seed} {number} kind").choice(KINDS)


def _work(originals: Originals, numbers: range, seed: int, folder: Path, pipe: int) -> None:
    """Try files one after the other; write a line with the result of each to a pipe."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    os.environ["XDG_STATE_HOME"] = str(folder / "state")
    known = {}
    for path in originals.sessions:
        with Session.open(path, read_only=True) as session:
            assert session.problems() == [], path
            known[path] = facts(session)
    for number in numbers:
        rng = random.Random(f"{seed} {number}")
        case_folder = folder / "case"
        shutil.rmtree(case_folder, ignore_errors=True)
        case_folder.mkdir()
        start_s = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, MOST_S)  # its signal ends the process
        signal.alarm(MOST_WAITING_S)
        failure = ""
        used = refused = 0
        try:
            tally = try_case(kind_of(seed, number), originals, case_folder, known, rng)
            used, refused = tally.used, tally.refused
        except Exception:
            failure = traceback.format_exc()
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        took_s = time.process_time() - start_s
        os.write(pipe, json.dumps([number, took_s, used, refused, failure]).encode() + b"\n")


def fuzz(count: int, seed: int, folder: Path, first: int = 0) -> Outcome:
    """Try ``count`` files in child processes; a child that ends is reported and replaced."""
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
        if code := os.waitstatus_to_exitcode(status):
            kind = kind_of(seed, number)
            reason = signal.Signals(-code).name if code < 0 else code
            outcome.failures.append(f"seed {seed}, file {number} ({kind}): ended by {reason}")
            outcome.files[kind] += 1
            number += 1
    return outcome


def _note(outcome: Outcome, line: str, seed: int) -> int:
    number: int
    number, took_s, used, refused, failure = json.loads(line)
    kind = kind_of(seed, number)
    outcome.files[kind] += 1
    outcome.used[kind] += used
    outcome.refused[kind] += refused
    outcome.slowest = max(outcome.slowest, (took_s, number, kind))
    if failure:
        where = f"seed {seed}, file {number} ({kind})"
        outcome.failures.append(f"{where}:\n{failure}")
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
    took_s, number, kind = outcome.slowest
    print(f"slowest: file {number} ({kind}), {took_s:.2f} s")
    raise SystemExit(f"{len(outcome.failures)} failures" if outcome.failures else 0)


if __name__ == "__main__":
    main(sys.argv[1:])
