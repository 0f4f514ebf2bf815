"""Kill a study's workers and the program that runs it, at random moments; nothing may be lost.

``kill.py STUDY KILLS SEED`` runs a study with two processes into a folder beside it; called with a
scheduler, on Dask's workers. At each of the random moments the program (SIGKILL or Ctrl-C) or one
of the processes that measure (SIGKILL) is ended. Then it is run to its end, and the files of the
tasks are held against those of a run that nobody disturbed.
"""

from __future__ import annotations

import hashlib
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import psutil

from labapp import Study
from tests.conftest import HEEDING


def bytes_of(folder: Path) -> dict[str, str]:
    """Digest of each file that tasks wrote."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((folder / "stretches").glob("*.npz"))
    }


def start(study: Path, out: Path, scheduler: str) -> subprocess.Popen[bytes]:
    """The command, heeding Ctrl-C."""
    given = ["study", "run", str(study), "--out", str(out), "--workers", "2"]
    given += ["--scheduler", scheduler] if scheduler else []
    return subprocess.Popen(
        [sys.executable, "-c", HEEDING, *given],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def kill_at_random(
    study: Path, kills: int, seed: int, scheduler: str = "", nannies: Sequence[int] = ()
) -> Counter[str]:
    """Run a study, killed so many times; returns how many of which kind.

    Parameters
    ----------
    scheduler, nannies
        Address of a Dask scheduler, and the processes whose children are its workers; without, the
        program's own processes measure.

    Raises
    ------
    AssertionError
        If anything was lost, or is there twice.
    """
    draw = random.Random(seed)
    alone, out = study.with_name("undisturbed"), study.with_name("disturbed")
    expected = [one.state for one in Study(study, alone).run(2)]
    kinds: Counter[str] = Counter()
    kept: dict[str, str] = {}
    program = start(study, out, scheduler)
    for _ in range(kills):
        count, more = len(bytes_of(out)), draw.choice([0, 0, 1, 1, 2])
        while program.poll() is None and len(bytes_of(out)) < count + more:
            time.sleep(0.02)
        time.sleep(draw.uniform(0, 2.5))
        kind = draw.choice(["program", "worker", "worker", "Ctrl-C"])
        if program.poll() is None:
            if kind == "program":
                program.kill()
            elif kind == "Ctrl-C":
                program.send_signal(signal.SIGINT)
            else:
                workers = [
                    child
                    for parent in nannies or [program.pid]
                    for child in psutil.Process(parent).children(recursive=True)
                ]
                if workers:
                    workers[draw.randrange(len(workers))].kill()
            kinds[kind] += 1
            if kind != "worker":
                program.wait()
        now = bytes_of(out)
        assert kept.items() <= now.items(), "what was done is no longer there"
        kept = now
        if program.poll() is not None:
            program = start(study, out, scheduler)
    program.wait()
    assert [one.state for one in Study(study, out).run(2)] == expected
    assert bytes_of(out) == bytes_of(alone), "results differ from those of an undisturbed run"
    Study(study, out).results()
    rows = pd.read_parquet(out / "measures.parquet", columns=["recording", "frame"])
    assert not rows.astype(str).duplicated().any(), "rows are there twice"
    return kinds


if __name__ == "__main__":
    print(kill_at_random(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))
