"""Kill a study's workers and its program at random moments; no result may be lost.

``kill.py STUDY KILLS SEED`` runs a study with two processes into a folder beside it; called with a
scheduler, on Dask's workers. At each random moment, the program (SIGKILL or Ctrl-C) or one of the
measuring processes (SIGKILL) is stopped. Then the study is run to its end, and the files of the
tasks are compared with those of an undisturbed run.
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
from tests.conftest import INTERRUPTIBLE


def bytes_of(folder: Path) -> dict[str, str]:
    """Digest of each file written by the tasks."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((folder / "stretches").glob("*.npz"))
    }


def start(study: Path, out: Path, scheduler: str) -> subprocess.Popen[bytes]:
    """Start the command so that it reacts to Ctrl-C."""
    arguments = ["study", "run", str(study), "--out", str(out), "--workers", "2"]
    arguments += ["--scheduler", scheduler] if scheduler else []
    return subprocess.Popen(
        [sys.executable, "-c", INTERRUPTIBLE, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def kill_at_random(
    study: Path, kills: int, seed: int, scheduler: str = "", nannies: Sequence[int] = ()
) -> Counter[str]:
    """Run a study, killed a given number of times; return the number of each kind.

    Parameters
    ----------
    scheduler, nannies
        Address of a Dask scheduler, and the processes whose children are its workers; without
        them, the processes of the program itself measure.

    Raises
    ------
    AssertionError
        If any result was lost or duplicated.
    """
    rng = random.Random(seed)
    undisturbed, disturbed = study.with_name("undisturbed"), study.with_name("disturbed")
    expected = [recording.state for recording in Study(study, undisturbed).run(2)]
    kinds: Counter[str] = Counter()
    stored: dict[str, str] = {}
    program = start(study, disturbed, scheduler)
    for _ in range(kills):
        count, more = len(bytes_of(disturbed)), rng.choice([0, 0, 1, 1, 2])
        while program.poll() is None and len(bytes_of(disturbed)) < count + more:
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 2.5))
        kind = rng.choice(["program", "worker", "worker", "Ctrl-C"])
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
                    workers[rng.randrange(len(workers))].kill()
            kinds[kind] += 1
            if kind != "worker":
                program.wait()
        current = bytes_of(disturbed)
        assert stored.items() <= current.items(), "what was done is no longer there"
        stored = current
        if program.poll() is not None:
            program = start(study, disturbed, scheduler)
    program.wait()
    assert [recording.state for recording in Study(study, disturbed).run(2)] == expected
    assert bytes_of(disturbed) == bytes_of(undisturbed), (
        "results differ from those of an undisturbed run"
    )
    Study(study, disturbed).results()
    rows = pd.read_parquet(disturbed / "measures.parquet", columns=["recording", "frame"])
    assert not rows.astype(str).duplicated().any(), "rows are there twice"
    return kinds


if __name__ == "__main__":
    print(kill_at_random(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))
