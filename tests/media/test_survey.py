from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from labapp.media import open_source
from labapp.media.formats.video import VideoSource
from labapp.media.survey import frame_checksum, survey

Pictures = list[npt.NDArray[Any]]
WriteVideo = Callable[[Path, Pictures, str], Path]
Encode = Callable[..., Path]

X264 = "-c:v libx264 -pix_fmt yuv420p -g 10 -bf 2".split()


class WrongAfterSeeking(VideoSource):
    """A source that returns the next frame instead of the requested one after seeking."""

    def _decode_to(self, index: int) -> tuple[int, Any] | None:
        if not self._from_start and index + 1 < len(self):
            decoded = super()._decode_to(index + 1)
            return None if decoded is None else (index, decoded[1])
        return super()._decode_to(index)


def test_every_frame_is_read_once_and_some_again(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    steps: list[tuple[int, int]] = []
    with VideoSource(write_video(tmp_path / "v.avi", pictures, "FFV1")) as source:
        result = survey(source, lambda done, total: steps.append((done, total)))
    assert result.checksum.dtype == np.uint32
    assert result.checksum.tolist() == [frame_checksum(picture) for picture in pictures]
    assert len(set(result.checksum.tolist())) == len(pictures)
    assert result.readable.all()
    assert result.frame_exact
    assert result.checked >= 16
    assert result.warnings == ()
    total = 16 + result.checked
    assert steps == [(done, total) for done in range(1, total + 1)]


def test_repeated_frames_are_named(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    shown = [*pictures[:3], pictures[2], pictures[3], pictures[3], pictures[3]]
    dark = [np.zeros_like(pictures[0])] * 2
    with VideoSource(write_video(tmp_path / "v.avi", shown + dark, "FFV1")) as source:
        (warning,) = survey(source).warnings
    assert re.findall(r"\d+", warning) == ["3", "5", "6"]


def test_checksum_is_of_the_levels_in_little_endian_order() -> None:
    image = np.array([[1, 2], [3, 0x1234]], np.uint16)
    assert frame_checksum(image) == zlib.crc32(bytes([1, 0, 2, 0, 3, 0, 0x34, 0x12]))
    assert frame_checksum(image.astype(">u2")) == frame_checksum(image)
    assert frame_checksum(np.array([list(b"123456789")], np.uint8)) == 0xCBF43926
    assert frame_checksum(image.T) != frame_checksum(image)


@pytest.mark.parametrize("name", ["v.mp4", "v.mkv", "v.avi"])
def test_long_groups_of_pictures_are_frame_exact_after_seeking(
    tmp_path: Path, pictures: Pictures, encode: Encode, name: str
) -> None:
    with VideoSource(encode(tmp_path / name, pictures * 3, *X264)) as source:
        result = survey(source)
        assert result.frame_exact
        assert source.seekable
    assert result.warnings == ()


def test_unreadable_frame_is_named(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "MJPG")
    content = path.read_bytes()
    seventh = [match.start() for match in re.finditer(b"\xff\xd8\xff", content)][7]
    path.write_bytes(content[:seventh] + bytes(400) + content[seventh + 400 :])
    with VideoSource(path) as source:
        result = survey(source)
    assert np.flatnonzero(~result.readable).tolist() == [7]
    assert result.checksum[7] == 0
    assert result.frame_exact
    (warning,) = result.warnings
    assert warning.startswith("1 of 16 frames cannot be read: 7 (")
    assert "v.avi" in warning  # the reason


def test_video_with_wrong_seeking_is_decoded_from_its_start(
    tmp_path: Path, pictures: Pictures, encode: Encode
) -> None:
    path = encode(tmp_path / "v.mkv", pictures * 3, "-c:v", "ffv1", "-g", "4")
    with WrongAfterSeeking(path) as source:
        result = survey(source)
        assert not result.frame_exact
        assert result.warnings == source.warnings
        assert "re-encode" in result.warnings[0]
        assert result.checksum.tolist() == [frame_checksum(picture) for picture in pictures * 3]
        for index in (40, 3, 30, 0):
            np.testing.assert_array_equal(source.frame(index).image, (pictures * 3)[index])
        index_bytes = source.index
    with WrongAfterSeeking(path, index_bytes) as source:
        assert not source.seekable
        assert source.warnings == result.warnings
        np.testing.assert_array_equal(source.frame(40).image, (pictures * 3)[40])
        np.testing.assert_array_equal(source.frame(5).image, (pictures * 3)[5])
        assert survey(source).checked == 0


def test_survey_can_be_stopped(tmp_path: Path, pictures: Pictures, write_video: WriteVideo) -> None:
    class Stopped(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise Stopped

    with VideoSource(write_video(tmp_path / "v.avi", pictures, "MJPG")) as source:
        with pytest.raises(Stopped):
            survey(source, stop)
        assert source.frame(5).index == 5


def test_images_are_surveyed_like_videos(tmp_path: Path, pictures: Pictures) -> None:
    path = tmp_path / "one.png"
    cv2.imwrite(str(path), pictures[0])
    result = survey(open_source(path))
    assert result.checksum.tolist() == [frame_checksum(pictures[0])]
    assert result.frame_exact
