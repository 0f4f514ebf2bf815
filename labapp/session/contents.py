"""Reading a session: set-up, calibrations, corrections, frames and results.

Modules for measuring and for reading recordings are imported when a session is opened, not with
this module, so that scripts start fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from labapp.errors import InputError, require, unknown_name

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from labapp.config.setup import Setup
    from labapp.core.lines.correction import LineCorrection
    from labapp.core.pipeline import FrameCorrection, Settings
    from labapp.core.recording.residual_check import SetupVerdict
    from labapp.core.rows.correction import Correction
    from labapp.core.values import IntArray
    from labapp.export.frame_result import FrameResult
    from labapp.media import Frame, GreyImage
    from labapp.run.limits import Limits
    from labapp.session.documents import Change
    from labapp.session.file.database import Database
    from labapp.session.frames import Progress
    from labapp.session.record import (
        BenchCheckRecord,
        BenchEntries,
        LaserEntries,
        LaserReadings,
        PlanePicture,
        Record,
        Recording,
    )
    from labapp.session.results.measured import Basis, Overview, Result
    from labapp.session.signals import Signals


class SessionContents:
    """The contents of a session, read-only; `Session` adds the changes."""

    def __init__(self, database: Database) -> None:
        from labapp.session.calibration_pictures import CalibrationPictures
        from labapp.session.documents import Documents
        from labapp.session.frames import Frames
        from labapp.session.results.measured import StoredResults
        from labapp.session.results.overviews import Overviews

        self.path = database.path
        """The session file."""
        self.read_only = database.read_only
        """Whether the session was opened read-only."""
        self._database = database
        self._frames = Frames(database)
        self._pictures = CalibrationPictures(database)
        self._results = StoredResults(database)
        self._documents = Documents(database, self._results.restore)
        self._overviews = Overviews(database, self._results)

    def __repr__(self) -> str:
        return f"<labapp session {self.path.name}>"

    def close(self) -> None:
        """Close the file. Closing twice does no harm."""
        self._frames.close()
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- operator's input ----------------------------------------------------------------------

    @property
    def record(self) -> Record:
        """The experiment record."""
        from labapp.session.record import Record

        found = self._documents.get("record")
        return Record() if found is None else found

    @property
    def setup_text(self) -> str:
        """The set-up as TOML; it may be incomplete."""
        return self._documents.get("setup") or ""

    @property
    def setup(self) -> Setup:
        """Rig and image calibration.

        Raises
        ------
        InputError
            If it is incomplete; the error names what is missing.
        """
        from labapp.config.setup import parse_setup

        return parse_setup(self.setup_text, self.path, lines=True)

    @property
    def setup_problems(self) -> tuple[InputError, ...]:
        """What is missing or wrong in the set-up; empty if it is complete."""
        try:
            _ = self.setup
        except InputError as error:
            return error.problems
        return ()

    @property
    def has_lines(self) -> bool:
        """Whether the pattern consists of lines rather than dots."""
        from labapp.config.setup_text import pattern_kind

        return pattern_kind(self.setup_text) == "lines"

    @property
    def laser_entries(self) -> LaserEntries | None:
        """Readings of the laser's cross that are not applied yet; None if there are none."""
        found: LaserEntries | None = self._documents.get("laser-entries")
        return found

    @property
    def plane_entries(self) -> PlanePicture | None:
        """An imaging-plane calibration that is not applied yet; None if there is none."""
        found: PlanePicture | None = self._documents.get("plane-entries")
        return found

    @property
    def bench_entries(self) -> BenchEntries | None:
        """Pictures for a bench check that are not applied yet; None if there are none."""
        found: BenchEntries | None = self._documents.get("bench-entries")
        return found

    @property
    def laser_calibration(self) -> LaserReadings | None:
        """The last laser calibration and its readings; None if there is none."""
        found: LaserReadings | None = self._documents.get("laser-calibration")
        return found

    @property
    def plane_calibration(self) -> PlanePicture | None:
        """The last imaging-plane calibration and its picture; None if there is none."""
        found: PlanePicture | None = self._documents.get("plane-calibration")
        return found

    @property
    def bench_check(self) -> BenchCheckRecord | None:
        """The last bench check and its pictures; None if there is none."""
        found: BenchCheckRecord | None = self._documents.get("bench-check")
        return found

    def picture(self, sha256: str) -> GreyImage:
        """Return a stored calibration picture, grey levels, shape (rows, columns).

        Parameters
        ----------
        sha256
            Its hash, as calibrations and bench checks name it.

        Raises
        ------
        InputError
            If it is missing or damaged.
        """
        return self._pictures.get(sha256)

    @property
    def settings(self) -> Settings:
        """Scheme and settings of the measurement."""
        from labapp.core.pipeline import Settings

        found = self._documents.get("settings")
        return Settings() if found is None else found

    def correction(self, frame: int) -> Correction | None:
        """Dots and rows of a frame as they were corrected by hand; None where there are none.

        Parameters
        ----------
        frame
            Number of the frame.
        """
        from labapp.core.rows.correction import Correction

        found = self._by_hand(frame)
        return found if isinstance(found, Correction) else None

    def line_correction(self, frame: int) -> LineCorrection | None:
        """Lines of a frame as they were corrected by hand; None where there are none.

        Parameters
        ----------
        frame
            Number of the frame.
        """
        from labapp.core.lines.correction import LineCorrection

        found = self._by_hand(frame)
        return found if isinstance(found, LineCorrection) else None

    def _by_hand(self, frame: int) -> FrameCorrection | None:
        found: FrameCorrection | None = self._documents.get("correction", frame)
        return found

    @property
    def signals(self) -> Signals | None:
        """Current, voltage and wire feed of the weld; None if none are stored."""
        found: Signals | None = self._documents.get("signals")
        return found

    @property
    def limits(self) -> Limits:
        """Lower and upper limits of the pool's sizes for live measurements."""
        from labapp.run.limits import Limits

        found = self._documents.get("limits")
        return Limits() if found is None else found

    @property
    def history(self) -> tuple[Change, ...]:
        """Changes that can be undone or redone, the oldest first."""
        return self._documents.history()

    # --- recording --------------------------------------------------------------------------

    @property
    def recording(self) -> Recording | None:
        """The recording that the frames come from; None before the import."""
        return self._frames.recording

    @property
    def recording_place(self) -> Path | None:
        """Path of the recording; None before the import."""
        return self._frames.place

    @property
    def missing_recording(self) -> Path | None:
        """Path at which the recording is missing; None if its frames can be read."""
        return self._frames.missing

    @property
    def replaced_recording(self) -> Path | None:
        """Path of a file of another size in place of the recording; None if there is none."""
        return self._frames.replaced

    @property
    def frames(self) -> IntArray:
        """Numbers of the session's frames, ascending, shape (n,)."""
        return self._frames.numbers

    def frame(self, number: int) -> Frame:
        """One frame as it was imported.

        Parameters
        ----------
        number
            Its number in the recording.

        Raises
        ------
        InputError
            If the session does not use it, or it is no longer what was imported.
        """
        return self._frames.read(number)

    # --- results ----------------------------------------------------------------------------

    def result(self, frame: int, scheme: str | None = None) -> Result | None:
        """Return the result of a frame and its inputs; None if it was not measured.

        Parameters
        ----------
        frame
            Number of the frame.
        scheme
            ``fit``, ``ers``, ``irs-opa`` …; None: the scheme of the settings.

        Raises
        ------
        InputError
            If there is no such scheme, or the result is damaged.
        """
        require(frame, (int, np.integer), "result", "frame", "the number of a frame")
        return self._results.get(
            frame,
            self._known_scheme(scheme),
            self._basis(),
            self._documents.fingerprint("correction", frame),
        )

    def frame_results(
        self,
        stale: bool = True,
        *,
        scheme: str | None = None,
        frames: Collection[int] | None = None,
    ) -> Iterator[FrameResult]:
        """Results of the frames that were measured, read one by one.

        Parameters
        ----------
        stale
            Whether to include results that are out of date.
        scheme
            ``fit``, ``ers``, ``irs-opa`` …; None: the scheme of the settings.
        frames
            Numbers of the frames; None: all.

        Raises
        ------
        InputError
            If a result is damaged, or numbers or times of the frames have changed.
        """
        from labapp.export.frame_result import FrameResult

        self._frames.refuse_changed()
        chosen = frozenset(self.frames.tolist() if frames is None else frames)
        times = self.overview(scheme).time_s.tolist()
        for frame, time_s in zip(self.frames.tolist(), times, strict=True):
            found = self.result(frame, scheme) if frame in chosen else None
            if found is not None and (stale or not found.stale):
                time = None if np.isnan(time_s) else time_s
                yield FrameResult(frame, time, found.measurement)

    def overview(self, scheme: str | None = None) -> Overview:
        """Status, correction, staleness and measures of every frame.

        Parameters
        ----------
        scheme
            ``fit``, ``ers``, ``irs-opa`` …; None: the one that the settings choose.
        """
        return self._overviews.get(self._known_scheme(scheme), self._basis())

    @property
    def setup_verdict(self) -> SetupVerdict | None:
        """Check of the present set-up by the frames that were measured with it.

        Without any, a check of its values alone; None if these are usual.
        """
        from labapp.core.recording.residual_check import doubt_of_values
        from labapp.session.file.blobs import pack

        basis = self._basis()
        if basis is None:
            return None
        verdict = self._results.verdicts.of(pack(basis.setup.text))
        return verdict or doubt_of_values(basis.setup.rig)

    @property
    def setup_status(self) -> str:
        """Reliability of the present set-up (`Measurement.setup_status`); empty if incomplete."""
        from labapp.core.recording.residual_check import judged_status

        basis = self._basis()
        return "" if basis is None else judged_status(basis.setup.rig, self.setup_verdict)

    @property
    def setup_words(self) -> str:
        """The set-up's status as a sentence, with the reason for a doubt."""
        from labapp.text import setup_words

        status, verdict, check = self.setup_status, self.setup_verdict, self.bench_check
        checked = self.setup.check_date if status else ""
        was_checked = check.date if check is not None and not checked else ""
        return setup_words(status, checked, verdict.reason if verdict else "", was_checked)

    def corrected_frames(self) -> IntArray:
        """Return the numbers of manually corrected frames, ascending, shape (n,)."""
        return np.array(sorted(self._documents.fingerprints("correction")), np.int64)

    def stale_frames(self) -> IntArray:
        """Return the numbers of the frames without a result or with a stale one, shape (n,)."""
        seen = self.overview()
        missing = np.array([status == "" for status in seen.status], bool)
        return np.asarray(seen.frame[seen.stale | missing], np.int64)

    @property
    def measured_by(self) -> dict[tuple[str, str], int]:
        """Number of results: (scheme, version of labapp) → count."""
        return self._results.counts()

    def problems(self, progress: Progress | None = None, recording: bool = True) -> list[str]:
        """Check the whole session; returns a sentence per problem, empty if it is intact.

        Parameters
        ----------
        progress
            Called with the number of frames done and the total.
        recording
            Whether to read the recording, or the embedded frames, through too.

        Returns
        -------
        list of str
            The problems.
        """
        return self._database.problems() or [
            *self._documents.problems(),
            *self._pictures.problems(self._documents.pictures()),
            *(self._frames.problems(progress) if recording else ()),
            *self._results.problems(),
        ]

    def _known_scheme(self, scheme: str | None) -> str:
        """Check the name of a scheme; None: return that of the settings."""
        from labapp.core.schemes import scheme_words

        if scheme is None:
            return self._scheme()
        known = scheme_words()
        if scheme not in known and scheme not in {name for name, _ in self.measured_by}:
            raise unknown_name(self.path, "scheme", scheme, known)
        return scheme

    def _scheme(self) -> str:
        from labapp.session.results.measured import scheme_name

        return scheme_name(self.settings)

    def _basis(self) -> Basis | None:
        from labapp.session.results.measured import Basis

        try:
            return Basis(self.setup, self.settings)
        except InputError:
            return None
