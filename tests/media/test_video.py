from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from labapp.errors import InputError
from labapp.media import open_source
from labapp.media.video import VideoSource

Pictures = list[npt.NDArray[np.uint8]]
WriteVideo = Callable[[Path, Pictures, str], Path]

H264 = Path(__file__).parent / "data" / "h264.mp4"
VARYING = Path(__file__).parent / "data" / "varying_rate.mkv"
GREY_16 = Path(__file__).parent / "data" / "grey16.mkv"

LOSSLESS = [("ffv1.avi", "FFV1"), ("ffv1.mkv", "FFV1"), ("raw.avi", "Y800"), ("png.avi", "MPNG")]
LOSSY = [("mjpg.avi", "MJPG"), ("mpeg4.mp4", "mp4v")]


@pytest.mark.parametrize(("name", "codec"), LOSSLESS)
def test_lossless_video_comes_back_exactly(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo, name: str, codec: str
) -> None:
    with open_source(write_video(tmp_path / name, pictures, codec)) as source:
        assert len(source) == len(pictures)
        assert source.frame_rate_hz == pytest.approx(60)
        assert source.shape == (48, 64)
        assert source.warnings == ()
        for frame, picture in zip(source, pictures, strict=True):
            np.testing.assert_array_equal(frame.image, picture)
            assert frame.time_s == pytest.approx(frame.index / 60)


@pytest.mark.parametrize(("name", "codec"), LOSSY)
def test_lossy_video_comes_back_nearly(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo, name: str, codec: str
) -> None:
    smooth = [cv2.GaussianBlur(picture, (0, 0), 3) for picture in pictures]
    with open_source(write_video(tmp_path / name, smooth, codec)) as source:
        assert len(source) == len(pictures)
        for frame, picture in zip(source, smooth, strict=True):
            assert frame.image.dtype == np.uint8
            assert np.abs(frame.image.astype(float) - picture).mean() < 3


def test_h264_is_read_and_any_frame_can_be_asked_for() -> None:
    """Long groups of pictures with B-frames; frame k has its blob at u = 10 + 3k."""
    with open_source(H264) as source:
        assert len(source) == 40
        in_order = [frame.image for frame in source]
        assert [int(image[60].argmax()) for image in in_order] == pytest.approx(
            [10 + 3 * k for k in range(40)], abs=1
        )
        for index in (39, 0, 20, 3, 38, 37, 37, 12):
            np.testing.assert_array_equal(source.frame(index).image, in_order[index])


def test_frames_of_a_varying_rate_keep_their_times() -> None:
    """Frame k is 10·k everywhere; the camera paused, then hurried."""
    time_s = [0, 0.017, 0.033, 0.05, 0.25, 0.26, 0.3, 0.317, 0.333, 0.35, 0.367, 0.383]
    with open_source(VARYING) as source:
        assert source.warnings == ()
        frames = [*source, source.frame(2), source.frame(10), source.frame(4)]
    expected = [*range(12), 2, 10, 4]
    assert [int(frame.image[0, 0]) for frame in frames] == [10 * k for k in expected]
    assert [frame.time_s for frame in frames] == pytest.approx([time_s[k] for k in expected])


def test_sixteen_bits_are_kept() -> None:
    """Frame k is 1000·k everywhere but for a ramp of 0 … 159 along u."""
    with open_source(GREY_16) as source:
        for frame in source:
            assert frame.image.dtype == np.uint16
            np.testing.assert_array_equal(frame.image[5], 1000 * frame.index + np.arange(160))
        assert frame.index == 4


@pytest.mark.parametrize(("name", "codec"), LOSSLESS)
def test_any_order_gives_the_same_frames(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo, name: str, codec: str
) -> None:
    with open_source(write_video(tmp_path / name, pictures, codec)) as source:
        for index in np.random.default_rng(1).integers(0, len(pictures), 25).tolist():
            np.testing.assert_array_equal(source.frame(index).image, pictures[index])


def test_reading_in_order_neither_seeks_nor_opens_again(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    with VideoSource(write_video(tmp_path / "v.avi", pictures, "FFV1")) as source:
        with mock.patch.object(VideoSource, "_jump") as jump:
            images = [source.frame(index).image for index in (0, 1, 2, 2, 3, 7, 15)]
        jump.assert_not_called()
    np.testing.assert_array_equal(images[-1], pictures[15])


@pytest.mark.parametrize(("name", "codec"), [*LOSSLESS, LOSSY[0]])
@pytest.mark.parametrize("kept", [0.4, 0.75, 0.97])
def test_a_truncated_video_gives_its_whole_frames(
    tmp_path: Path,
    pictures: Pictures,
    write_video: WriteVideo,
    name: str,
    codec: str,
    kept: float,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = write_video(tmp_path / name, pictures, codec)
    with open_source(path) as source:
        whole = [frame.image for frame in source]
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept)])
    with open_source(path) as source:
        images = [frame.image for frame in source]
        assert 0 < len(images) == len(source) < 16
        assert source.warnings == (
            f"{name} ends early: its header says 16 frames, {len(source)} of them whole",
        )
    # Not a frame too few: one more would need more bytes than there are (AVI's header is 5.6 kB).
    for image, picture in zip(images, whole, strict=False):
        np.testing.assert_array_equal(image, picture)
    assert capfd.readouterr() == ("", "")


def test_a_frame_that_was_overwritten_does_not_shift_the_others(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "MJPG")
    with open_source(path) as source:
        whole = [frame.image for frame in source]
    content = path.read_bytes()
    seventh = [match.start() for match in re.finditer(b"\xff\xd8\xff", content)][7]
    path.write_bytes(content[:seventh] + bytes(400) + content[seventh + 400 :])
    with open_source(path) as source:
        assert len(source) == 16
        for index in (*range(7), *range(8, 16), 8, 6):
            np.testing.assert_array_equal(source.frame(index).image, whole[index])
        with pytest.raises(InputError, match="frame 7: cannot be decoded"):
            source.frame(7)
        np.testing.assert_array_equal(source.frame(8).image, whole[8])


@pytest.mark.parametrize(
    "content", [b"frame 1\nframe 2\n" * 100, bytes(5000), b"RIFF\x00\x00\x00\x00AVI LIST"]
)
def test_what_is_no_video_is_refused(
    tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording_001.avi"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"recording_001\.avi: .*expected a video that FFmpeg"):
        open_source(path)
    assert capfd.readouterr() == ("", "")


def test_a_video_without_one_whole_frame_is_refused(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "Y800")
    path.write_bytes(path.read_bytes()[:6500])
    with pytest.raises(InputError, match="not one that is whole"):
        open_source(path)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs Linux's /proc")
def test_no_file_stays_open(tmp_path: Path, pictures: Pictures, write_video: WriteVideo) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "FFV1")
    broken = tmp_path / "broken.avi"
    broken.write_bytes(path.read_bytes()[:5800])

    def held() -> int:
        return sum(
            os.readlink(entry).startswith(str(tmp_path))
            for entry in Path("/proc/self/fd").iterdir()
            if entry.is_symlink()
        )

    with open_source(path) as source:
        source.frame(12)
        source.frame(3)
        assert held() == 1
    assert held() == 0
    with pytest.raises(InputError):
        open_source(broken)
    assert held() == 0
