"""The frames of a session: imported from a recording, and verified whenever they are read.

The recording is not moved; the session stores its relative path. Alternatively the frames are
embedded in the session, lossless.
"""

from __future__ import annotations

import hashlib
import os
import stat
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.values import IntArray
from labapp.errors import PATH, InputError, check_positive, require
from labapp.export.summary import format_ranges
from labapp.files import relative_path
from labapp.media import Frame, FrameSource, GreyImage, open_source
from labapp.media.formats.images import decoded
from labapp.media.identity import identify, may_be
from labapp.media.survey import Survey, frame_checksum, survey
from labapp.run.runner import select_frames
from labapp.session.file.blobs import MAGIC, pack, unpack_from
from labapp.session.file.database import INTACT_SESSION, Database
from labapp.session.file.read_cache import ReadCache
from labapp.session.record import Recording
from labapp.text import now

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the total; may raise to stop."""

SLOWEST_HZ, FASTEST_HZ = 1e-6, 1e8
"""Limits of a given frame rate."""

THE_RECORDING = "the recording; `labapp session relink` sets its new path"


class Frames:
    """The recording of a session and its frames; may be used from several threads."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._mutex = threading.RLock()
        self._source: FrameSource | None = None
        self._cache = ReadCache(database)
        self._compared: tuple[tuple[object, ...], bool] | None = None
        """What `replaced` has compared last, and whether it can be the recording."""

    @property
    def recording(self) -> Recording | None:
        """The recording; None before the import."""
        found: Recording | None = self._cache.get("recording", self._read_recording)
        return found

    def _read_recording(self) -> Recording | None:
        blob = self._database.value("SELECT content FROM recording")
        if blob is None:
            return None
        found: Recording = unpack_from(self._database.path, "recording", blob, Recording)
        return found

    @property
    def numbers(self) -> IntArray:
        """Numbers of the session's frames in the recording, from 0, ascending, shape (n,)."""
        found: IntArray = self._cache.get("numbers", self._read_numbers)
        return found

    def _read_numbers(self) -> IntArray:
        rows = self._database.rows("SELECT number FROM frame")
        found = self._database.array([number for (number,) in rows], np.int64)
        found.flags.writeable = False
        return found

    def time_s(self, number: int) -> float | None:
        """Return the time of a frame, s; None if unknown.

        Raises
        ------
        InputError
            If the session has no such frame.
        """
        found = self._database.rows("SELECT time_s FROM frame WHERE number = ?", number)
        if not found:
            raise InputError(self._database.path, "frame", number, self._which())
        (time_s,) = found[0]
        return None if time_s is None else float(self._database.array(time_s, np.float64))

    def import_recording(
        self,
        path: str | os.PathLike[str],
        frames: str = ":",
        *,
        frame_rate_hz: float | None = None,
        embed: bool = False,
        progress: Progress | None = None,
    ) -> Recording:
        """Import a recording; see `Session.import_recording`."""
        require(path, PATH, "recording", "path", "the path of a recording")
        path = Path(path).absolute()
        if frame_rate_hz is not None:
            check_positive(frame_rate_hz, str(path), "frame rate", "frames a second")
            if not SLOWEST_HZ <= frame_rate_hz <= FASTEST_HZ:
                expected = f"{SLOWEST_HZ:g} to {FASTEST_HZ:g} frames a second"
                raise InputError(path, "frame rate", frame_rate_hz, expected)
        with open_source(path) as source:
            selected = select_frames(frames, len(source), str(path))
            found = survey(source, progress)
            size, sha256 = identify(path)
            recording = Recording(
                path=relative_path(path, self._database.path.parent),
                size=size,
                sha256=sha256,
                description=source.description,
                frames=len(source),
                rows=source.shape[0],
                columns=source.shape[1],
                bit_depth=source.bit_depth,
                frame_rate_hz=frame_rate_hz or source.frame_rate_hz,
                rate_is_given=frame_rate_hz is not None,
                frame_exact=found.frame_exact,
                selected=(selected.start, selected.stop, selected.step),
                embedded=embed,
                warnings=tuple(dict.fromkeys((*source.warnings, *found.warnings))),
                index=source.index,
                imported=now(),
            )
            return self._store(recording, source, selected, found)

    def _store(
        self,
        recording: Recording,
        source: FrameSource,
        selected: range,
        found: Survey,
    ) -> Recording:
        before = self.recording
        time_s = found.time_s
        if recording.rate_is_given:
            assert recording.frame_rate_hz is not None
            time_s = np.arange(recording.frames) / recording.frame_rate_hz
        with self._database.transaction() as connection:
            if before is not None and before.sha256 != recording.sha256:
                self.refuse_another()
            used = self._worked_on()
            if not used <= set(selected):
                raise InputError(
                    self._database.path,
                    "frames",
                    f"frame {min(used - set(selected))} is measured or corrected and left out",
                    "frames that include these",
                )
            connection.executemany(
                "DELETE FROM frame WHERE number = ?",
                [(int(k),) for k in self.numbers if int(k) not in selected],
            )
            connection.execute("DELETE FROM frame_image")
            connection.executemany(
                "INSERT INTO frame VALUES (?, ?, ?) ON CONFLICT (number) DO UPDATE "
                "SET time_s = excluded.time_s, checksum = excluded.checksum",
                [
                    (k, float(time_s[k]), int(found.checksum[k]) if found.readable[k] else None)
                    for k in selected
                ],
            )
            if recording.embedded:
                connection.executemany(
                    "INSERT INTO frame_image VALUES (?, ?)",
                    ((k, _encoded(source.frame(k).image)) for k in selected if found.readable[k]),
                )
            recording = replace(recording, frames_sha256=self._fingerprint())
            connection.execute("INSERT OR REPLACE INTO recording VALUES (1, ?)", (pack(recording),))
        self.close()
        return recording

    def refuse_another(self) -> None:
        """Raise if frames are measured or corrected; see `Session.refuse_another_recording`."""
        recording = self.recording
        if recording is not None and self._worked_on():
            raise InputError(
                self._database.path,
                "recording",
                f"frames of {Path(recording.path).name} are measured or corrected in it",
                "a new session for another recording",
            )

    def _worked_on(self) -> set[int]:
        """Return the frames that are measured or corrected."""
        rows = self._database.rows(
            "SELECT frame FROM result UNION SELECT frame FROM document WHERE frame >= 0"
        )
        return {frame for (frame,) in rows}

    def _fingerprint(self) -> str:
        """Return the SHA-256 of number, time and checksum of all frames."""
        rows = self._database.rows("SELECT number, time_s, checksum FROM frame ORDER BY number")
        return hashlib.sha256(repr(rows).encode()).hexdigest()

    def read(self, number: int) -> Frame:
        """Return a frame as it was imported.

        Raises
        ------
        InputError
            If the session has no such frame, or its recording is missing, cannot be read, or has
            changed since the import.
        """
        time_s = self.time_s(number)
        (checksum,) = self._database.rows("SELECT checksum FROM frame WHERE number = ?", number)[0]
        held = self._database.value("SELECT content FROM frame_image WHERE frame = ?", number)
        with self._mutex:
            image = (
                self._recorded(number)
                if held is None
                else self._decoded(held, f"image of frame {number}")
            )
        if checksum is not None and frame_checksum(image) != checksum:
            raise InputError(
                self._database.path if held is not None else self._place(),
                f"frame {number}",
                "is not the one that was imported",
                "the recording as it was at import",
            )
        return Frame(number, time_s, image)

    def was_readable(self, number: int) -> bool:
        """Whether a frame of the session could be read at import."""
        checksum = self._database.value("SELECT checksum FROM frame WHERE number = ?", number)
        return checksum is not None

    def refuse_lost(self, numbers: Sequence[int]) -> None:
        """Raise if frames that could be read at import can no longer be read.

        Raises
        ------
        InputError
            If ``numbers`` is not empty.
        """
        if numbers:
            raise InputError(
                self._database.path if self._imported().embedded else self._place(),
                f"frame{'s' * (len(numbers) > 1)} {format_ranges(numbers)}",
                "no longer what was imported (what was measured before is kept)",
                "the recording as it was at import",
            )

    def refuse_changed(self) -> None:
        """Raise if the frames' numbers or times have changed since the import.

        Raises
        ------
        InputError
            If they have, or there is no recording to compare them with: the file is damaged.
        """
        if changed := self._change(self.recording):
            raise InputError(self._database.path, "frames", changed, INTACT_SESSION)

    def _change(self, recording: Recording | None) -> str:
        """Return how the frames differ from those of the import; empty if they do not."""
        if recording is None:
            content = self._database.value("SELECT max(coalesce(time_s, checksum)) FROM frame")
            return "" if content is None else "there are frames, but no recording"
        if recording.frames_sha256 == self._fingerprint():
            return ""
        return "the frames' numbers, times or checksums are not those of the import"

    @property
    def missing(self) -> Path | None:
        """Path at which the recording is missing; None if its frames can be read."""
        recording = self.recording
        if recording is None or recording.embedded or self._place().exists():
            return None
        return self._place()

    @property
    def replaced(self) -> Path | None:
        """Path at which there is another recording than the imported one, by size; None if not.

        Frames are compared with the imported ones when read.
        """
        recording = self.recording
        if recording is None or recording.embedded:
            return None
        place = self._place()
        with suppress(OSError):
            about = place.stat()
            if not stat.S_ISDIR(about.st_mode) and not stat.S_ISREG(about.st_mode):
                return None
            # A folder is looked through again only after files were added, renamed or removed.
            key = (place, about.st_mtime_ns, about.st_size, recording.size)
            if self._compared is None or self._compared[0] != key:
                self._compared = key, may_be(place, recording.size, recording.frames)
            return None if self._compared[1] else place
        return None

    def refuse_missing(self) -> None:
        """Raise if the recording is missing.

        Raises
        ------
        InputError
            If it is not where it should be.
        """
        if (missing := self.missing) is not None:
            raise InputError(missing, "recording", "does not exist", THE_RECORDING)

    def relink(self, path: str | os.PathLike[str], verify: bool = True) -> None:
        """Set the path of the recording; see `Session.relink`."""
        require(path, PATH, "recording", "path", "the path of the recording")
        path = Path(path).absolute()
        recording = self._imported()
        if verify and (found := identify(path)) != (recording.size, recording.sha256):
            raise InputError(
                path,
                "content",
                f"another recording ({found[0]} bytes)",
                f"{Path(recording.path).name} as it was imported ({recording.size} bytes)",
            )
        moved = replace(recording, path=relative_path(path, self._database.path.parent))
        with self._database.transaction() as connection:
            connection.execute("UPDATE recording SET content = ?", (pack(moved),))
        self.close()

    def close(self) -> None:
        """Close the recording; it is opened again when needed."""
        self._cache.clear()
        with self._mutex:
            if self._source is not None:
                self._source.close()
            self._source = None

    def problems(self, progress: Progress | None = None) -> list[str]:
        """Return sentences about problems of the recording or the embedded frames."""
        try:
            recording = self.recording
        except InputError as error:
            return [str(error)]
        changed = self._change(recording)
        found = [changed] if changed else []
        if recording is None:
            return found
        if not recording.embedded:
            try:
                if identify(self._place()) != (recording.size, recording.sha256):
                    found.append(f"{self._place().name} is not what was imported")
            except InputError as error:
                found.append(str(error))
            return found
        for done, number in enumerate(self.numbers):
            try:
                self.read(int(number))
            except InputError as error:
                found.append(str(error))
            if progress is not None:
                progress(done + 1, len(self.numbers))
        return found

    def _recorded(self, number: int) -> GreyImage:
        source = self._opened()
        if number >= len(source):
            raise InputError(
                self._database.path, "frame", number, f"one of the recording's {len(source)}"
            )
        return source.frame(number).image

    def _opened(self) -> FrameSource:
        if self._source is None:
            recording, place = self._imported(), self._place()
            if not place.exists():
                raise InputError(place, "recording", "does not exist", THE_RECORDING)
            source = open_source(place, recording.index)
            if (len(source), source.shape) != (
                recording.frames,
                (recording.rows, recording.columns),
            ):
                found = f"{len(source)} frames of {source.shape[1]}×{source.shape[0]} px"
                source.close()
                raise InputError(
                    place,
                    "recording",
                    found,
                    f"{recording.frames} frames of {recording.columns}×{recording.rows} px, "
                    "as they were imported",
                )
            self._source = source
        return self._source

    def _imported(self) -> Recording:
        recording = self.recording
        if recording is None:
            raise InputError(self._database.path, "recording", "none", "one to be imported first")
        return recording

    @property
    def place(self) -> Path | None:
        """Path of the recording; None before the import."""
        return None if self.recording is None else self._place()

    def _place(self) -> Path:
        """Return the path of the recording: as stored, else in the session's folder."""
        recording = self._imported()
        folder = self._database.path.parent
        place = Path(os.path.normpath(folder / recording.path))
        beside = folder / Path(recording.path).name
        return beside if not place.exists() and beside.exists() else place

    def _which(self) -> str:
        numbers = self.numbers
        if not len(numbers):
            return "a recording to be imported first"
        return f"one of the session's {len(numbers)} frames, {numbers[0]} to {numbers[-1]}"

    def _decoded(self, content: object, named: str) -> GreyImage:
        if isinstance(content, bytes) and content.startswith(MAGIC):
            image = unpack_from(self._database.path, named, content, np.ndarray)
        else:
            image = decoded(content) if isinstance(content, bytes) else None
        if image is None or image.ndim != 2:
            raise InputError(self._database.path, named, "damaged", "what was written there")
        return np.asarray(image)


def _encoded(image: npt.NDArray[Any]) -> bytes:
    """Encode a frame losslessly: PNG for 8 and 16 bit, else a packed array."""
    if image.dtype in (np.uint8, np.uint16):
        _, content = cv2.imencode(".png", image)
        return content.tobytes()
    return pack(np.asarray(image))
