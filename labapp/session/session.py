"""Sessions: one file with an experiment from record to results, for scripts and the app.

Every method that changes something is one transaction: when it returns, the change is on disk; if
it fails or is interrupted, the session is unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from labapp.errors import PATH, InputError, check_positive, require, unknown_name
from labapp.session.contents import SessionContents
from labapp.session.file.schema import NO_FRAME

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from labapp.core.bench_check.check import BenchCheck
    from labapp.core.calibration.board_calibration import BoardCalibration
    from labapp.core.calibration.boards import Board
    from labapp.core.calibration.laser_calibration import (
        LaserCalibration,
        LaserCalibrationSettings,
    )
    from labapp.core.calibration.plane_calibration import PlaneCalibration
    from labapp.core.pipeline import FrameCorrection, Measurement, Settings
    from labapp.export.folder import ExportChoice, ExportedFile
    from labapp.export.frame_result import FrameResult
    from labapp.media import GreyImage
    from labapp.run.limits import Limits
    from labapp.run.runner import Measurer, Sink
    from labapp.session.documents import Change, Key, Kind
    from labapp.session.frames import Progress
    from labapp.session.record import BenchCheckRecord, Entries, Record, Recording
    from labapp.session.signals import Signals


class Session(SessionContents):
    """An open session, returned by `Session.create` or `Session.open`; a context manager."""

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        record: Record | None = None,
        *,
        exist_ok: bool = False,
    ) -> Session:
        """Create a session file, ``….labsession``.

        Parameters
        ----------
        path
            Path of the file.
        record
            The experiment record; None: an empty one, or that of an existing session.
        exist_ok
            Whether to open an existing session, with its contents: an interrupted script can be
            run again, and measures only missing frames.

        Returns
        -------
        Session
            The session, open for writing.

        Raises
        ------
        InputError
            If the file exists already (with ``exist_ok``: and is not a session), or cannot be
            written.
        """
        from labapp.session.file.database import Database

        session = cls.open(path) if exist_ok and Path(path).exists() else cls(Database.create(path))
        if record is not None:
            try:
                session.set_record(record)
            except InputError:
                session.close()
                raise
        return session

    @classmethod
    def open(cls, path: str | os.PathLike[str], read_only: bool = False) -> Session:
        """Open a session file.

        Parameters
        ----------
        path
            Of the file.
        read_only
            Whether to read it only, which is possible while another program writes it.

        Raises
        ------
        OnlyReadable
            If another program has it open for writing (`SessionInUse`), or the file or its folder
            cannot be written; it can still be opened read-only.
        InputError
            If it cannot be read, is not a session, or is of a newer version of labapp.
        """
        from labapp.session.file.database import Database

        return cls(Database.open(path, read_only))

    # --- operator's input; every change can be undone ---------------------------------------

    def set_record(self, record: Record) -> None:
        """Replace the experiment record.

        Parameters
        ----------
        record
            Title, operator, material and welding parameters.
        """
        self._documents.change("experiment record", {("record", NO_FRAME): record})

    def set_setup(self, text: str, label: str = "set-up") -> None:
        """Replace the set-up by the text of a setup file.

        Parameters
        ----------
        text
            Text of the file, not its path.
        label
            Name of the change in the history.

        Raises
        ------
        InputError
            If anything in it is unknown, missing or invalid.
        """
        from labapp.config.setup import parse_setup

        expected = "the text of a setup file: Path(…).read_text()"
        require(text, str, "set_setup", "text", expected)
        if "\n" not in text and text.endswith(".toml"):
            raise InputError("set_setup", "text", repr(text), expected)
        parse_setup(text, self.path, lines=True)
        self._documents.change(label, {("setup", NO_FRAME): text})

    def update_setup(
        self, values: Mapping[str, Mapping[str, object]], label: str = "set-up"
    ) -> None:
        """Set or delete (None) keys of the set-up: section → key → value; it may be incomplete.

        Parameters
        ----------
        values
            As ``{"laser": {"distance_mm": 36.0}}``.
        label
            Name of the change in the history.

        Raises
        ------
        InputError
            If there is no such section; values are checked by `setup`.
        """
        from labapp.config.setup_keys import SECTIONS

        right = 'values by section and key: {"laser": {"distance_mm": 36.0}}'
        require(values, Mapping, "update_setup", "values", right)
        for section, keys in values.items():
            if section not in SECTIONS:
                raise unknown_name("update_setup", "section", section, SECTIONS)
            require(keys, Mapping, "update_setup", section, right)
        self._documents.change(label, {("setup", NO_FRAME): self._updated_setup(values)})

    def set_entries(self, of: Literal["laser", "plane", "bench"], entries: Entries | None) -> None:
        """Store what was entered for a calibration or a bench check, until one is applied.

        Parameters
        ----------
        of
            What it is for: ``laser``, ``plane`` or ``bench``.
        entries
            `LaserEntries`, `PlanePicture` or `BenchEntries`, whose pictures `keep_picture` has
            stored; None deletes what was entered.

        Raises
        ------
        InputError
            If they are for something else.
        """
        kinds: dict[str, tuple[Kind, str]] = {
            "laser": ("laser-entries", "laser readings"),
            "plane": ("plane-entries", "imaging-plane points"),
            "bench": ("bench-entries", "bench-check pictures"),
        }
        if of not in kinds:
            raise unknown_name("set_entries", "of", of, kinds)
        kind, label = kinds[of]
        self._documents.change(label, {(kind, NO_FRAME): entries})

    def keep_picture(self, name: str, image: GreyImage) -> str:
        """Store a picture for a calibration.

        Parameters
        ----------
        name
            Name of the picture.
        image
            Grey levels, shape (rows, columns).

        Returns
        -------
        str
            Its SHA-256, by which entries refer to it, and `picture` returns it.
        """
        return self._pictures.add(name, image)

    def calibrate_laser(
        self,
        l1_mm: Sequence[float],
        l2_mm: Sequence[float],
        l3_mm: Sequence[float],
        fan_angle_deg: float = 10.0,
        picture: GreyImage | None = None,
        settings: LaserCalibrationSettings | None = None,
    ) -> LaserCalibration:
        """Calibrate the laser from its cross-hair (Appendix I), update the rig, store the picture.

        Values, standard uncertainties and their correlation are written to the set-up.

        Parameters
        ----------
        l1_mm, l2_mm, l3_mm
            Half lengths of the cross: laser's side, far side, across; readings of each, mm.
        fan_angle_deg
            Fan angle of the cross-hair lens, degrees.
        picture
            Photograph of the cross, grey levels, shape (rows, columns); it is stored only.
        settings
            Standard uncertainties of the readings and of the fan angle; None: the defaults.

        Raises
        ------
        InputError
            If the readings are not possible.
        """
        from labapp.core.calibration.laser_calibration import (
            LaserCalibrationSettings,
            calibrate_laser,
        )
        from labapp.session.record import LaserReadings

        settings = settings or LaserCalibrationSettings()
        try:
            found = calibrate_laser(l1_mm, l2_mm, l3_mm, fan_angle_deg, settings)
        except (TypeError, ValueError) as error:
            expected = "readings in mm that a laser cross can have, and a fan angle in degrees"
            raise InputError("calibrate_laser", "readings", error, expected) from error
        sha256 = None if picture is None else self._pictures.add("cross-hair", picture)
        lengths = tuple(l1_mm), tuple(l2_mm), tuple(l3_mm)
        known = settings.fan_angle_sigma_deg, settings.resolution_mm
        readings = LaserReadings(*lengths, fan_angle_deg, found, sha256, *known)
        values: dict[Key, Any] = {
            ("laser-entries", NO_FRAME): None,
            ("laser-calibration", NO_FRAME): readings,
            ("setup", NO_FRAME): self._updated_setup({"laser": found.setup_keys}),
        }
        self._documents.change("laser calibration", values)
        return found

    def calibrate_plane(self, picture: str | os.PathLike[str], unit_mm: float) -> PlaneCalibration:
        """Calibrate the imaging plane from a picture of the target (§5.1); store and apply both.

        Parameters
        ----------
        picture
            The calibration picture.
        unit_mm
            Length of a unit of the target's axes, mm.

        Returns
        -------
        PlaneCalibration
            What was found, which has been stored.

        Raises
        ------
        CannotMeasure
            If the target is not found in the picture.
        InputError
            If the picture cannot be read.
        """
        from labapp.config.setup_text import lens_of
        from labapp.core.calibration.plane_calibration import calibrate_plane
        from labapp.media import read_picture

        require(picture, PATH, "calibrate_plane", "picture", "the path of a picture")
        check_positive(unit_mm, "calibrate_plane", "unit_mm", "mm")
        image = read_picture(picture)
        found = calibrate_plane(image, unit_mm, lens_of(self.setup_text))
        self.use_plane(found, unit_mm, image, Path(picture).name)
        return found

    def calibrate_camera(
        self, pictures: Sequence[str | os.PathLike[str]], board: Board | None = None
    ) -> BoardCalibration:
        """Calibrate lens and imaging plane from pictures of a board; store and apply the result.

        Parameters
        ----------
        pictures
            Pictures, the first with the board in the imaging plane.
        board
            The board; None: one of labapp's boards, which is recognised.

        Returns
        -------
        BoardCalibration
            What was found, which has been stored.

        Raises
        ------
        CannotMeasure
            If the board is not found in a picture.
        InputError
            If a picture cannot be read.
        """
        from labapp.core.calibration.board_calibration import calibrate_board
        from labapp.media import read_picture

        right = "paths of 1 to 100 pictures, that of the imaging plane first"
        require(pictures, (list, tuple), "calibrate_camera", "pictures", right)
        images = [read_picture(picture) for picture in pictures]
        try:
            found = calibrate_board(images, board)
        except ValueError as error:
            raise InputError("calibrate_camera", "pictures", error, right) from error
        self.use_plane(found, found.board.square_mm, images[0], Path(pictures[0]).name)
        return found

    def use_plane(
        self,
        found: PlaneCalibration | BoardCalibration,
        unit_mm: float,
        image: GreyImage,
        name: str = "picture",
    ) -> None:
        """Apply an imaging plane found in a picture or marked by hand; store both.

        Parameters
        ----------
        found
            The calibration.
        unit_mm
            Length of a unit of the target's axes, or of a square of the board, mm.
        image
            The picture, grey levels, shape (rows, columns).
        name
            Name of the picture.

        Raises
        ------
        ValueError
            If its three points are collinear, or its marks do not determine its model.
        """
        from labapp.session.record import PlanePicture

        _ = found.image_calibration  # raises ValueError
        readings = PlanePicture(unit_mm, found, self._pictures.add(name, image))
        keys, (height, width) = found.setup_keys, image.shape
        keys["image_calibration"]["frame_px"] = [width, height]
        values: dict[Key, Any] = {
            ("plane-entries", NO_FRAME): None,
            ("plane-calibration", NO_FRAME): readings,
            ("setup", NO_FRAME): self._updated_setup(keys),
        }
        self._documents.change("imaging-plane calibration", values)

    def use_bench_check(
        self, check: BenchCheck, found: BenchCheckRecord, images: Sequence[GreyImage]
    ) -> None:
        """Apply the result of a bench check; store it with its pictures.

        Parameters
        ----------
        check
            The check, made with the set-up before any earlier check (`unchecked_setup`).
        found
            Its record; ``picture_sha256`` of the pictures are filled in.
        images
            Its pictures, grey levels, each of shape (rows, columns).
        """
        from labapp.config.setup import checked_setup, unchecked_setup

        bare = unchecked_setup(self.setup_text, self.path)
        pictures = tuple(
            replace(one, picture_sha256=self._pictures.add(one.name, image))
            for one, image in zip(found.pictures, images, strict=True)
        )
        changed: dict[Key, Any] = {
            ("bench-entries", NO_FRAME): None,
            ("bench-check", NO_FRAME): replace(found, pictures=pictures),
            ("setup", NO_FRAME): checked_setup(bare, self.path, check, found.date),
        }
        self._documents.change("bench check", changed)

    def set_settings(self, settings: Settings, label: str = "settings") -> None:
        """Set the scheme and the settings of every step of the measurement.

        Parameters
        ----------
        settings
            The settings.
        label
            Name of the change in the history.

        Raises
        ------
        InputError
            If a name in them is unknown, an algorithm is chosen that the scheme does not have, or a
            choice in ``match`` or ``irs`` that `Settings` overrides.
        """
        from labapp.config.settings import check_algorithm, check_overridden, check_settings

        check_settings(settings, "set_settings")
        if (settings.match, settings.irs) != (self.settings.match, self.settings.irs):
            check_overridden(settings, "set_settings")
        if settings.algorithm != self.settings.algorithm:  # the former one may remain
            check_algorithm(settings, "set_settings", "settings.algorithm")
        self._documents.change(label, {("settings", NO_FRAME): settings})

    def correct(
        self, corrections: Mapping[int, FrameCorrection | None], label: str = "correction"
    ) -> None:
        """Set the corrections of frames in one change; None deletes the correction of a frame.

        Parameters
        ----------
        corrections
            Correction of each frame (`labapp.core.rows.correction`), or None.
        label
            Name of the change in the history.

        Raises
        ------
        InputError
            If the session has no such frame, or the correction is for another kind of pattern.
        """
        from labapp.core.lines.correction import LineCorrection

        right = "corrections by frame: {5: correction}, or {5: None}"
        require(corrections, Mapping, "correct", "corrections", right)
        other, valid = ("dots", "lines") if self.has_lines else ("lines", "dots")
        for value in corrections.values():
            if value is not None and isinstance(value, LineCorrection) != self.has_lines:
                raise InputError(self.path, "correction", other, f"{valid}, as the pattern has")
        for frame in corrections:
            self._frames.time_s(frame)
        self._documents.change(
            label, {("correction", frame): value for frame, value in corrections.items()}
        )

    def set_signals(self, signals: Signals | None) -> None:
        """Store current and voltage of the weld.

        Parameters
        ----------
        signals
            Those of `labapp.session.signals.read_signals`; None deletes them.
        """
        self._documents.change("current and voltage", {("signals", NO_FRAME): signals})

    def set_limits(self, limits: Limits) -> None:
        """Set the limits of the pool's sizes; a size beyond one raises an alarm.

        Parameters
        ----------
        limits
            Lower and upper limits (`labapp.run.limits`).
        """
        self._documents.change("limits", {("limits", NO_FRAME): limits})

    def undo(self) -> Change | None:
        """Undo the last change and return it; None if there is none."""
        return self._documents.undo()

    def redo(self) -> Change | None:
        """Redo the change that was undone last and return it; None if there is none."""
        return self._documents.redo()

    # --- recording --------------------------------------------------------------------------

    def import_recording(
        self,
        path: str | os.PathLike[str],
        frames: str = ":",
        *,
        frame_rate_hz: float | None = None,
        embed: bool = False,
        progress: Progress | None = None,
    ) -> Recording:
        """Import a recording: read it through, check that it is frame-exact, store both findings.

        Parameters
        ----------
        path
            A video, an image, a folder of images, a stack.
        frames
            Frames that the session uses, ``A:B:STEP``.
        frame_rate_hz
            Frame rate, Hz, where the recording states none or a wrong one.
        embed
            Whether to store the frames in the session.
        progress
            Called with frames done and frames in all.

        Returns
        -------
        Recording
            What was found of it.

        Raises
        ------
        InputError
            If it cannot be read, or frames measured or corrected in this session are not in it.
        """
        return self._frames.import_recording(
            path, frames, frame_rate_hz=frame_rate_hz, embed=embed, progress=progress
        )

    def refuse_another_recording(self) -> None:
        """Refuse a recording other than the session's, if that would end what was made of it.

        Raises
        ------
        InputError
            If frames are measured or corrected.
        """
        self._frames.refuse_another()

    def relink(self, path: str | os.PathLike[str], verify: bool = True) -> None:
        """Set the path of the recording, after it was moved.

        Parameters
        ----------
        path
            Where it is now.
        verify
            Whether to read it through and compare it; else each frame is compared when it is read.

        Raises
        ------
        InputError
            If the file there is another recording.
        """
        self._frames.relink(path, verify)

    # --- results ----------------------------------------------------------------------------

    def measure(
        self, frames: Iterable[int] | None = None, *, warm: bool = False
    ) -> list[tuple[int, Measurement]]:
        """Measure frames and store the results (`measure_each`).

        Parameters
        ----------
        frames
            Which ones; None: those not measured yet, or measured from what was changed since.
        warm
            Whether to measure each frame from the one before.

        Returns
        -------
        list
            Frame and measurement of each, in order, with status and measures only: `result` also
            has dots, rays and surface.
        """
        from labapp.export.frame_result import without_surface

        each = self.measure_each(frames, warm=warm)
        return [(number, without_surface(measurement)) for number, measurement in each]

    def measure_each(
        self,
        frames: Iterable[int] | None = None,
        pool: Executor | None = None,
        *,
        warm: bool = False,
        sinks: Sequence[Sink] = (),
    ) -> Iterator[tuple[int, Measurement]]:
        """Measure frames, store each result, then yield (frame, measurement).

        A frame that could not be read at import is stored with the status ``unreadable``. One that
        can no longer be read is yielded with this status, but its earlier result is retained.

        Parameters
        ----------
        frames
            Frame numbers; None: the frames that are not measured yet or have a stale result.
        pool
            Pool of processes (`run.measurers.measuring_pool`), of one if ``warm``; None: measure in
            this process.
        warm
            Whether to track each frame from the previous one (`WarmChain`).
        sinks
            Further receivers of the stored results (`run.runner.run`).

        Yields
        ------
        tuple
            Frame and measurement.

        Raises
        ------
        InputError
            If the set-up is incomplete, or a result cannot be saved; at the end, if frames have
            changed since the import.
        """
        from labapp.run.line_measurer import LineMeasurer
        from labapp.run.measurers import ColdMeasurer, WarmMeasurer
        from labapp.run.runner import run
        from labapp.session.file.blobs import fingerprint
        from labapp.session.results.measured import Basis

        if frames is not None:
            require(frames, Iterable, "measure", "frames", "frame numbers: [0, 1, 2]")
        chosen = self.stale_frames() if frames is None else frames
        basis = Basis(self.setup, self.settings)
        self._frames.refuse_missing()
        lost: list[int] = []

        def store(result: FrameResult) -> None:
            number, measurement = result.frame, result.measurement
            if measurement.status == "unreadable" and self._frames.was_readable(number):
                lost.append(number)
                return
            # The correction used, which may have been replaced during the measurement.
            used = measurement.correction
            self._results.put(
                number, measurement, basis, None if used is None else fingerprint(used)
            )

        given = (self.frame, basis.setup, basis.settings, self._by_hand)
        rig = basis.setup.line_rig
        lines = rig is not None  # no tracking, and no check of the set-up
        measurer: Measurer = (WarmMeasurer if warm and not lines else ColdMeasurer)(*given, pool)
        if rig is not None and rig.pattern.count == 1:
            measurer = LineMeasurer(*given[:3])
        numbers = (int(number) for number in chosen)
        try:
            for result in run(numbers, measurer, [store, *sinks]):
                yield result.frame, result.measurement
        finally:
            if not lines:
                self._results.judge_setup(basis)
        self._frames.refuse_lost(lost)

    def export(
        self,
        folder: str | os.PathLike[str],
        choice: ExportChoice | None = None,
        *,
        frames: Sequence[int] | None = None,
        scheme: str | None = None,
        report: bool = False,
        progress: Progress | None = None,
    ) -> tuple[ExportedFile, ...]:
        """Export results to a folder atomically: on failure the folder is unchanged.

        Parameters
        ----------
        folder
            A new or empty folder, or an earlier export, which is replaced.
        choice
            Files to write; None: the tables and surfaces that `labapp reconstruct` writes.
        frames
            Measured frames to export; None: all.
        scheme
            ``fit``, ``ers``, ``irs-opa`` …; None: the scheme of the settings.
        report
            Whether to add ``report.pdf``.
        progress
            Called with the number of steps done and the total; may raise to stop.

        Returns
        -------
        tuple
            The files that were written, with their hashes.

        Raises
        ------
        InputError
            If a result is stale, nothing was measured, the folder cannot be written, or anything
            but the usual choice is made for a pattern of lines: all its tables are written.
        """
        from labapp.export.folder import ExportChoice
        from labapp.session.outgoing import export_session

        what = choice or ExportChoice()
        chosen = self._known_scheme(scheme)
        return export_session(self, folder, what, frames, chosen, report, progress)

    def _updated_setup(self, values: Mapping[str, Mapping[str, object]]) -> str:
        """Return the text of the set-up with keys set or deleted; see `update_setup`."""
        from tomlkit.exceptions import ConvertError

        from labapp.config.setup import updated_setup

        try:
            return updated_setup(self.setup_text, self.path, values)
        except ConvertError as error:
            right = "numbers, text, or lists of them"
            raise InputError("update_setup", "values", error, right) from error
