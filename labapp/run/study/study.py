"""Studies: running, progress and results (`Study`)."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from labapp.config.setup import read_setup
from labapp.errors import PATH, InputError, os_errors_as_input, require
from labapp.files import as_bytes, is_of_labapp, write_file
from labapp.run.runner import select_frames
from labapp.run.study.plan import StudyPlan, StudyRecording, read_study
from labapp.run.study.status import RecordingStatus, State, StudyProgress, Tasks
from labapp.run.study.stretches import (
    CannotStore,
    found_recording,
    look_at_recording,
    measure_stretch,
    stretches_of,
)
from labapp.run.study.workers import Job, Workers, dask_workers, local_workers, run_jobs
from labapp.version import VERSION

if TYPE_CHECKING:
    from labapp.export.features import FeatureTable
    from labapp.export.tables import Columns
    from labapp.run.study.summary import StudySummary

MARKER = "study.json"
OWN_FOLDER = "a new or empty folder, or one with results of a study"
OLD_S = 3600.0
"""Age at which a temporary file must be from a killed process, s."""


def require_extra() -> None:
    """Check that the packages that write results are installed.

    Raises
    ------
    InputError
        If one is not installed.
    """
    for name in ("pyarrow", "zarr"):
        if find_spec(name) is None:
            expected = "this package: pip install 'labapp[study]'"
            raise InputError("study", name, "is not installed", expected)


class Study:
    """A study: a file that lists recordings, and a folder with their results.

    Parameters
    ----------
    path
        The study file.
    out
        Folder of the results; None: ``NAME_results`` beside the study file.

    Raises
    ------
    InputError
        If the file is not a study file, or the folder has other contents.
    """

    def __init__(self, path: Path, out: Path | None = None) -> None:
        require(path, PATH, "Study", "path", "the path of a study file")
        self.path = Path(path).absolute()
        self.plan: StudyPlan = read_study(self.path)
        folder = out or self.path.with_name(f"{self.path.stem}_results")
        self.folder = Path(folder).absolute()
        """Folder of the results."""
        with os_errors_as_input(self.folder, "folder", OWN_FOLDER):
            has_files = self.folder.exists() and any(self.folder.iterdir())
            if has_files and not is_of_labapp(self.folder / MARKER):
                raise InputError(self.folder, "folder", "holds something else", OWN_FOLDER)

    # --- running --------------------------------------------------------------------------------

    def run(
        self,
        workers: int | None = None,
        scheduler: str | None = None,
        *,
        surfaces: bool = False,
        progress: Callable[[StudyProgress], object] = lambda _: None,
        note: Callable[[str], object] = lambda _: None,
    ) -> list[RecordingStatus]:
        """Measure the frames that are not measured yet; can be repeated after any interruption.

        A recording that cannot be measured does not stop the others: its status gives the reason.

        Parameters
        ----------
        workers
            Number of processes; None: one per core; 0: measure in this process.
        scheduler
            Address of a Dask scheduler, whose workers are used instead of processes. They must see
            recordings and results under the same paths.
        surfaces
            Whether to store surfaces, too.
        progress
            Called regularly; may raise to stop.
        note
            Called with sentences for the user.

        Returns
        -------
        list of RecordingStatus
            What is done of each recording, in the order of the file.

        Raises
        ------
        InputError
            If results cannot be written, the study is being run already, or the connection to the
            scheduler is lost. Finished frames are stored.
        """
        with self._alone():
            left = sum(one.state != "done" for one in self.status(surfaces=surfaces))
            hired = local_workers(workers, left) if scheduler is None else dask_workers(scheduler)
            with hired as team:
                import labapp.run.study.results  # noqa: F401 - while the processes start

                for sentence in (team.dashboard and f"Dashboard: {team.dashboard}", team.warning):
                    if sentence:
                        note(sentence)
                _Run(self, surfaces, progress, note).go(team)
        return self.status(surfaces=surfaces)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Create the folder, lock it against a second run, and delete files of killed runs."""
        with os_errors_as_input(self.folder, "folder", OWN_FOLDER):
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.folder / ".lock")
            try:
                lock.acquire(blocking=False)
            except Timeout as error:
                expected = "the other run to end, or to be stopped"
                raise InputError(self.folder, "study", "is being run", expected) from error
            except NotImplementedError:
                pass  # some network drives do not support locks
        try:
            marker = {"program": "labapp", "version": VERSION, "study": self.path.name}
            write_file(self.folder / MARKER, as_bytes(json.dumps(marker) + "\n"))
            for left in self.folder.glob("*/.*.part"):
                with suppress(OSError):
                    if time.time() - left.stat().st_mtime > OLD_S:
                        left.unlink()
            yield
        finally:
            lock.release()

    # --- what is done ---------------------------------------------------------------------------

    def status(self, *, surfaces: bool = False) -> list[RecordingStatus]:
        """Return the progress of each recording, in the order of the file.

        Parameters
        ----------
        surfaces
            Whether surfaces belong to it.

        Returns
        -------
        list of RecordingStatus
            Of each recording, how many of its frames are measured, and why it failed if it did.
        """
        return [self._status(one, surfaces) for one in self.plan.recordings]

    def _status(self, recording: StudyRecording, surfaces: bool) -> RecordingStatus:
        problem = self._problem(recording)
        try:
            tasks = self.tasks(recording, surfaces)
        except InputError as error:
            return RecordingStatus(recording, "failed", str(error), 0, 0)
        if tasks is None:
            return RecordingStatus(recording, "failed" if problem else "waiting", problem, 0, 0)
        done = [each for each in tasks.stretches if each.done is not None]
        count = sum(len(each.frames) for each in done)
        state: State = "part" if done else "waiting"
        if len(done) == len(tasks.stretches):
            state, problem = "done", ""
        elif problem:
            state = "failed"
        return RecordingStatus(recording, state, problem, len(tasks.frames), count)

    def tasks(self, recording: StudyRecording, surfaces: bool = False) -> Tasks | None:
        """Return the tasks that measure a recording; None if it was not examined yet.

        Parameters
        ----------
        recording
            One of the plan's.
        surfaces
            Whether surfaces are to be kept.

        Raises
        ------
        InputError
            If the recording is missing, or its set-up or frames are invalid.
        """
        setup = read_setup(recording.setup)
        found = found_recording(recording.path, self.folder)
        if found is None:
            return None
        try:
            frames = select_frames(recording.frames, found.frames)
        except InputError as error:
            name = f"{recording.name}.frames"
            raise InputError(self.path, name, error.value, error.expected) from error
        stretches = stretches_of(
            *(self.folder, recording.path, found, setup, recording.settings, frames),
            warm=recording.warm,
            surfaces=surfaces,
        )
        return Tasks(recording, setup, found, frames, stretches)

    def _known_tasks(self, recording: StudyRecording) -> Tasks | None:
        """Return `tasks`; None also if the recording cannot be measured, which its status says."""
        with suppress(InputError):
            return self.tasks(recording)
        return None

    def _problem_file(self, recording: StudyRecording) -> Path:
        return self.folder / "problems" / f"{recording.name}.txt"

    def _problem(self, recording: StudyRecording) -> str:
        """Return why a recording failed in the last run; empty if it did not."""
        try:
            return self._problem_file(recording).read_text("utf-8")[:1000].strip()
        except (OSError, UnicodeDecodeError):
            return ""

    def set_problem(self, recording: StudyRecording, problem: str) -> None:
        """Keep why a recording failed.

        Parameters
        ----------
        recording
            One of the plan's.
        problem
            Why; empty if it did not fail.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        path = self._problem_file(recording)
        with os_errors_as_input(path, "file", "one that can be written"):
            if problem:
                path.parent.mkdir(exist_ok=True)
                write_file(path, as_bytes(problem + "\n"))
            else:
                path.unlink(missing_ok=True)

    # --- results --------------------------------------------------------------------------------

    def tables(self) -> dict[str, Columns]:
        """Return the columns ``plan.COLUMNS`` of each recording that has results.

        Raises
        ------
        InputError
            If the study is being run.
        """
        from labapp.run.study.results import assembled

        with self._alone():
            known = {one.name: self._known_tasks(one) for one in self.plan.recordings}
            found = {name: assembled(tasks)[0] for name, tasks in known.items() if tasks}
        return {name: table for name, table in found.items() if table is not None}

    def features(self, sections: Path | None = None) -> FeatureTable:
        """Return features of all frames, and penetration from sections (`FeatureTable.fit`).

        Parameters
        ----------
        sections
            Table of sections (docs/penetration.md); None: no sections.

        Returns
        -------
        FeatureTable
            A row per measured frame.

        Raises
        ------
        InputError
            If nothing is measured yet, or the table is invalid.
        """
        from labapp.run.study.sections import study_features

        return study_features(
            self.plan, self.tables(), None if sections is None else Path(sections)
        )[0]

    def results(self, *, surfaces: bool = False) -> StudySummary:
        """Write the results so far: tables, a summary, surfaces.

        Parameters
        ----------
        surfaces
            Whether to write `surfaces.zarr`, for recordings that were run with surfaces.

        Returns
        -------
        StudySummary
            Statistics of recordings and of groups.

        Raises
        ------
        InputError
            If it cannot be written, or a package of the extra ``study`` is missing.
        """
        require_extra()
        from labapp.run.study.results import write_results

        with self._alone():
            parts = [(one, self._known_tasks(one.recording)) for one in self.status()]
            return write_results(self.folder, self.plan, parts, surfaces)


class _Run:
    """One run of a study: the remaining tasks and their outcome."""

    def __init__(
        self,
        study: Study,
        surfaces: bool,
        progress: Callable[[StudyProgress], object],
        note: Callable[[str], object],
    ) -> None:
        self._study, self._surfaces, self._note = study, surfaces, note
        self._progress = progress
        self._recordings = study.plan.recordings
        self._left: dict[int, int] = {}
        """Remaining stretches of each examined recording."""
        self._frames: dict[int, int] = {}
        self._done = 0
        self._failed: set[int] = set()

    def go(self, workers: Workers) -> None:
        """Do the remaining tasks."""
        run_jobs(self._first_jobs(), workers, self._finished, self._report)
        self._report()

    def _first_jobs(self) -> Iterator[Job]:
        for number in range(len(self._recordings)):
            yield from self._jobs(number, look=True)

    def _jobs(self, number: int, look: bool) -> list[Job]:
        """Return the remaining jobs of a recording: its stretches, or first its examination."""
        recording = self._recordings[number]
        try:
            tasks = self._study.tasks(recording, self._surfaces)
        except InputError as error:
            self._fail(number, error)
            return []
        if tasks is None:
            if look:
                given = recording.path, self._study.folder
                return [Job(number, look_at_recording, given)]
            expected = (
                "the workers to write where this program reads, and the file to be left alone"
            )
            self._fail(number, InputError(recording.path, "recording", "is not known", expected))
            return []
        left = [each for each in tasks.stretches if each.done is None]
        self._left[number], self._frames[number] = len(left), len(tasks.frames)
        self._done += len(tasks.frames) - sum(len(each.frames) for each in left)
        if not left:
            self._study.set_problem(recording, "")
        return [Job(number, measure_stretch, (each,)) for each in left]

    def _finished(self, job: Job, error: Exception | None) -> Iterable[Job]:
        if isinstance(error, CannotStore):
            raise error
        if error is not None:
            self._fail(job.about, error)
            return []
        if job.work is look_at_recording:
            return self._jobs(job.about, look=False)
        (stretch,) = job.given
        if stretch.done is None:
            expected = "workers that write where this program reads: a folder that all share"
            raise InputError(self._study.folder, "results", "not there", expected)
        self._done += len(stretch.frames)
        self._left[job.about] -= 1
        if not self._left[job.about] and job.about not in self._failed:
            self._study.set_problem(self._recordings[job.about], "")
        return []

    def _fail(self, number: int, error: Exception) -> None:
        """Store why a recording failed, and notify the user once."""
        recording = self._recordings[number]
        text = str(error) if isinstance(error, InputError) else _fault(error)
        self._study.set_problem(recording, text)
        if number not in self._failed:
            self._failed.add(number)
            self._note(f"{recording.name}: {text}")

    def _report(self) -> None:
        count, seen = len(self._recordings), len(self._frames)
        known = sum(self._frames.values())
        unseen = count - seen - len(self._failed - set(self._frames))
        estimated = known + (round(known / seen * unseen) if seen else 0)
        done = sum(left == 0 for left in self._left.values())
        self._progress(StudyProgress(self._done, estimated, done, count, len(self._failed)))


def _fault(error: Exception) -> str:
    """Describe an error that is not an `InputError` in a sentence."""
    name = type(error).__name__
    if name in ("BrokenProcessPool", "KilledWorker"):
        return "the processes that measured it died again and again: is there enough memory?"
    return f"a fault in the program: {name}: {error}"
