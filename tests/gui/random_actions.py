"""Random actions on the real window: run by `test_random_actions.py`, or by hand for longer.

``python -m tests.gui.random_actions SEED [STEPS] [RUNS]`` plays STEPS actions on all pages, and
prints what each kind did. A fault is reported with its seed and the actions before it; the same
seed plays the same actions, as long as background tasks end in the same order.

A run fails if anything is raised; if Qt or the log reports a fault; if a change that the session
acknowledged, or a number that the set-up page accepted, is not in the file; or if at the end a
session or an export is damaged, or a partly written file is left.
"""

from __future__ import annotations

import os
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

if __name__ == "__main__":
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from PySide6.QtWidgets import QApplication

from labapp.export.folder import verify_export
from labapp.export.formats import MANIFEST
from labapp.log import NAME
from labapp.session.file.database import SUFFIX
from labapp.session.session import Session
from tests.gui.random_hand import BUSY_S, RandomHand, Run, open_window
from tests.gui.watching import Answers, Files, recorded
from tests.gui.witness import Witness

STEPS = 300

LAST_S = 60.0
"""Cancelled tasks end within this time."""


class Fault(Exception):
    """A fault, with the actions that led to it."""


class Player:
    """Plays one run.

    Parameters
    ----------
    seed
        Seed of the actions.
    folder
        For all files of the run; empty.

    Attributes
    ----------
    counts, seen, changed
        How often each (page, kind of action) was played, had a visible effect, and changed a
        session.
    longest
        The slowest action: its duration (s) and its description.
    """

    def __init__(self, seed: int, folder: Path) -> None:
        self.seed, self.folder = seed, folder
        self.counts: Counter[tuple[str, str]] = Counter()
        self.seen: Counter[tuple[str, str]] = Counter()
        self.changed: Counter[tuple[str, str]] = Counter()
        self.longest = (0.0, "")
        self._look: object = None

    def play(self, steps: int) -> Run:
        """Play that many actions, close everything, and check all files.

        Raises
        ------
        Fault
            If any check fails.
        """
        faults: list[str] = []
        files, witness = Files(self.folder / "files"), Witness()
        with recorded(faults), witness.listening():
            run = Run(files, witness, random.Random(self.seed), open_window(files.folder))
            run.faults = faults
            with Answers(files, lambda: run.random, lambda what: note(run, what)).active():
                run.window.files.open(files.sessions[0])
                hand = RandomHand(run)
                for number in range(steps):
                    run.random = random.Random(f"{self.seed} {number}")
                    self._act(run, hand, number)
                    if faults:
                        break
                self._end(run)
        if faults:
            messages, actions = "\n".join(faults), "\n".join(run.played)
            raise Fault(f"{messages}\n\nseed {self.seed}, {len(run.played)} actions:\n{actions}")
        return run

    def _act(self, run: Run, hand: RandomHand, number: int) -> None:
        kind = run.random.choices(list(hand.kinds), [often for often, _ in hand.kinds.values()])[0]
        place, before, began = (run.page, kind), run.witness.changes, time.perf_counter()
        run.played.append(f"{number} {place[0]} {kind}:")
        try:
            note(run, hand.act(kind))
        except Exception:
            run.faults.append(traceback.format_exc())
            return
        run.rest(BUSY_S if run.random.random() < 0.7 else 0.0)
        self.longest = max(self.longest, (time.perf_counter() - began, run.played[-1]))
        previous, self._look = self._look, look(run)
        self.counts[place] += 1
        self.seen[place] += self._look != previous
        self.changed[place] += run.witness.changes != before
        run.check()

    def _end(self, run: Run) -> None:
        """Cancel running tasks, close the window, and check every file."""
        try:
            for task in run.window.workspace.tasks.active:
                task.cancel()
            run.rest(LAST_S)
            run.window.close()
            QApplication.processEvents()
            run.check()
            run.faults += file_problems(run.files)
        except Exception:
            run.faults.append(traceback.format_exc())


def note(run: Run, what: str) -> None:
    """Add to the description of the current action."""
    if run.played:
        run.played[-1] += f" [{what}]"


def look(run: Run) -> object:
    """What the operator sees, in a form that can be compared."""
    window = run.window
    image = window.grab().toImage()  # referenced, because its bits are deleted with it
    return (
        hash(bytes(image.constBits())),
        id(QApplication.focusWidget()),
        len(window.workspace.tasks.active),
        tuple(window.log_panel.texts()[-1:]),
        QApplication.clipboard().text(),
        sum(widget.isVisible() for widget in QApplication.topLevelWidgets()),
    )


def file_problems(files: Files) -> list[str]:
    """Problems of the sessions and exports of a run, and partly written files, one per line."""
    lines = [f"left behind: {path.name}" for path in files.folder.rglob("*.part")]
    for path in sorted(files.folder.rglob(f"*{SUFFIX}")):
        if path.is_file() and path != files.garbage:
            with Session.open(path) as session:
                recording_exists = session.missing_recording is None
                problems = session.problems(recording=recording_exists)
            lines += [f"verify {path.name}: {problem}" for problem in problems]
    for manifest in files.folder.rglob(MANIFEST):
        lines += [
            f"export {manifest.parent.name}: {each}" for each in verify_export(manifest.parent)
        ]
    return lines


def table(players: Sequence[Player]) -> str:
    """How often each kind of action had an effect, per page, over all runs."""
    counts, seen, changed = (
        sum((getattr(player, name) for player in players), Counter())
        for name in ("counts", "seen", "changed")
    )
    lines = [f"{'page':9} {'action':8} {'played':>7} {'seen':>6} {'changed':>8}"]
    lines += [
        f"{page:9} {kind:8} {count:7} {seen[page, kind]:6} {changed[page, kind]:8}"
        for (page, kind), count in sorted(counts.items())
    ]
    return "\n".join(lines)


def main(seed: int, steps: int = STEPS, runs: int = 1) -> int:
    """Play runs with consecutive seeds; return how many failed."""
    warnings.simplefilter("error", RuntimeWarning)
    app = QApplication([NAME])
    app.setQuitOnLastWindowClosed(False)
    players, failed = [], 0
    for number in range(seed, seed + runs):
        with tempfile.TemporaryDirectory() as folder:
            player = Player(number, Path(folder))
            players.append(player)
            began, verdict = time.perf_counter(), "whole"
            try:
                player.play(steps)
            except Fault as fault:
                failed, verdict = failed + 1, f"WRONG\n{fault}"
            summary = f"{player.counts.total()} actions, {player.changed.total()} changed a session"
            took, (longest, action) = time.perf_counter() - began, player.longest
            print(f"seed {number}: {summary}, {took:.0f} s, longest {longest:.1f} s: {action[:90]}")
            print(verdict, flush=True)
    print(table(players), flush=True)
    return failed


if __name__ == "__main__":
    status = main(*(int(word) for word in sys.argv[1:]))
    os._exit(min(status, 1))  # windows with pictures can crash when they are destroyed
