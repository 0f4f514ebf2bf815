from __future__ import annotations

import errno
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media import GreyImage, open_source
from labapp.media.recording.nut import Codec, NutWriter
from tests.media.conftest import Encode

LEAST = 100
"""Bytes of headers at the start of a frame, which are not yet a frame."""


def pictures(bits: int, count: int = 12) -> list[GreyImage]:
    """Noise of 48×64 px with all levels, in which any loss is visible."""
    rng = np.random.default_rng(bits)
    kind = np.uint8 if bits <= 8 else np.uint16
    return [rng.integers(0, 2**bits, (48, 64)).astype(kind) for _ in range(count)]


def write(path: Path, frames: list[GreyImage], bits: int, codec: Codec) -> list[int]:
    """Write frames at intervals of 10 ms; return the size of the file after each."""
    writer = NutWriter(path, frames[0].shape, bits, 100, codec)
    sizes = []
    for k, image in enumerate(frames):
        writer.write(image, k * 0.01)
        sizes.append(path.stat().st_size)
    writer.close()
    return sizes


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("codec", ["ffv1", "raw"])
def test_frames_and_times_are_preserved(tmp_path: Path, codec: Codec, bits: int) -> None:
    frames = pictures(bits)
    path = tmp_path / "run.nut"
    write(path, frames, bits, codec)
    with open_source(path) as video:
        assert len(video) == len(frames)
        assert video.frame_rate_hz == 100
        assert not video.warnings
        assert video.bit_depth == (bits if codec == "ffv1" else 8 * frames[0].itemsize)
        for k in (5, 0, 11, *range(12)):
            assert np.array_equal(video.frame(k).image, frames[k])
            assert video.frame(k).time_s == pytest.approx(k * 0.01, abs=1e-9)


def test_times_of_the_camera_are_preserved_to_the_microsecond(tmp_path: Path) -> None:
    times_s = [0.0, 0.000_2, 0.000_4, 0.000_4, 1.5, 3600.000_007]
    frames = pictures(8, len(times_s))
    writer = NutWriter(tmp_path / "run.nut", (48, 64), 8, 5000)
    for image, time_s in zip(frames, times_s, strict=True):
        writer.write(image, time_s)
    writer.close()
    with open_source(tmp_path / "run.nut") as video:
        stored = [video.frame(k).time_s for k in range(len(video))]
    times_s[3] = 0.000_401  # not later than the one before: increased by one microsecond
    assert stored == pytest.approx(times_s, abs=5e-7)


@pytest.mark.parametrize("codec", ["ffv1", "raw"])
def test_truncated_file_has_all_earlier_frames(tmp_path: Path, codec: Codec) -> None:
    frames = pictures(8)
    sizes = write(tmp_path / "run.nut", frames, 8, codec)
    content = (tmp_path / "run.nut").read_bytes()
    assert all(np.diff(sizes) > 0)  # each frame is in the file when it was written
    rng = np.random.default_rng(1)
    cuts = [*sizes, *rng.integers(sizes[0], sizes[-1], 40).tolist()]
    for cut in cuts:
        (tmp_path / "cut.nut").write_bytes(content[:cut])
        complete = int(np.searchsorted(sizes, cut, "right"))
        with open_source(tmp_path / "cut.nut") as video:
            assert len(video) == complete
            for k in range(complete):
                assert np.array_equal(video.frame(k).image, frames[k])
            warning = "cut.nut ends early: its last frame is truncated"
            assert video.warnings in ((), (warning,))
            # After some cuts, too little remains to detect the start of a frame.
            assert video.warnings or cut - sizes[complete - 1] < LEAST


@pytest.mark.parametrize("options", [["ffv1", "-level", "1"], ["libx264", "-bf", "2"]])
def test_last_frame_of_nut_by_other_programs_is_complete(
    tmp_path: Path, encode: Encode, options: list[str]
) -> None:
    path = encode(tmp_path / "run.nut", pictures(8), "-c:v", *options)
    with open_source(path) as video:
        assert (len(video), video.warnings) == (12, ())
        assert video.frame(11).image.shape == (48, 64)


WRITER = """
import sys
import numpy as np
from pathlib import Path
from labapp.media.recording.nut import NutWriter
rng = np.random.default_rng(0)
writer = NutWriter(Path(sys.argv[1]), (240, 320), 8, 1000, sys.argv[2])
for k in range(10**6):
    image = rng.integers(0, 256, (240, 320)).astype(np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(k).tobytes(), np.uint8)
    writer.write(image, k / 1000)
    print(k, flush=True)
"""


@pytest.mark.parametrize("codec", ["ffv1", "raw"])
def test_killed_writer_leaves_every_written_frame(tmp_path: Path, codec: Codec) -> None:
    rng = np.random.default_rng(2)
    for attempt in range(4):
        path = tmp_path / f"run{attempt}.nut"
        command = [sys.executable, "-c", WRITER, str(path), codec]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(float(rng.uniform(0, 0.3)))
            process.kill()
            printed = [int(line) for line in process.stdout.read().split("\n")[:-1]]
        written = max(printed, default=0) + 1
        with open_source(path) as video:
            assert written <= len(video) <= written + 2
            for k in range(written):
                image = video.frame(k).image
                assert np.frombuffer(image[0, :4].tobytes(), np.uint32)[0] == k


def test_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.nut").write_text("mine")
    with pytest.raises(InputError, match="recording: File exists"):
        NutWriter(tmp_path / "run.nut", (48, 64), 8, 100)
    assert (tmp_path / "run.nut").read_text() == "mine"


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((48, 63), np.uint16),
        np.zeros((48, 64), np.uint8),
        np.full((48, 64), 1024, np.uint16),
    ],
)
def test_frame_that_does_not_fit_the_format_is_rejected(tmp_path: Path, image: GreyImage) -> None:
    writer = NutWriter(tmp_path / "run.nut", (48, 64), 10, 100)
    with pytest.raises(ValueError, match="a frame of"):
        writer.write(image, 0.0)
    writer.close()


class FullDisk:
    """A file on a disk with limited space: it accepts what fits, then nothing."""

    def __init__(self, path: Path, room: int) -> None:
        self.file, self.room = path.open("xb", buffering=0), room

    def write(self, content: memoryview) -> int:
        if not self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self.file.write(content[: self.room])
        self.room -= written
        return written

    def close(self) -> None:
        self.file.close()


def test_full_disk_is_reported_and_written_frames_are_complete(tmp_path: Path) -> None:
    frames = pictures(8)
    path = tmp_path / "run.nut"
    writer = NutWriter(path, (48, 64), 8, 100, "raw", file=FullDisk(path, 6 * 48 * 64))
    for k, image in enumerate(frames[:5]):
        writer.write(image, k * 0.01)
    with pytest.raises(OSError, match="No space left") as caught:
        writer.write(frames[5], 0.05)
    assert caught.value.errno == errno.ENOSPC
    with pytest.raises(OSError, match="end of the video"):
        writer.close()
    with open_source(path) as video:
        assert len(video) == writer.frames == 5
        assert all(np.array_equal(video.frame(k).image, frames[k]) for k in range(5))
