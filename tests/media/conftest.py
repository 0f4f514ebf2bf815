from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
import pytest

from labapp.media.cameras import base
from tests.waiting import PATIENCE_S

Pictures = list[npt.NDArray[np.uint8]]
WriteVideo = Callable[[Path, Pictures, str], Path]
Encode = Callable[..., Path]


@pytest.fixture(autouse=True)
def waiting_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffer frames longer, because a reader may be late on a busy machine."""
    monkeypatch.setattr(base, "BUFFERED_S", PATIENCE_S)


@pytest.fixture
def pictures() -> Pictures:
    """A bright blob that moves 4 px per frame over noise; no two frames are equal."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:48, :64]
    return [
        (
            rng.integers(10, 40, x.shape) + 180 * np.exp(-((x - 4 * k) ** 2 + (y - 24) ** 2) / 40)
        ).astype(np.uint8)
        for k in range(16)
    ]


def _write_video(path: Path, pictures: Pictures, codec: str) -> Path:
    rows, columns = pictures[0].shape
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*codec), 60.0, (columns, rows), isColor=False
    )
    assert writer.isOpened(), codec
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


@pytest.fixture
def write_video() -> WriteVideo:
    """Write pictures as a video of 60 frames a second: (path, pictures, codec) -> path."""
    return _write_video


def _encode(
    path: Path, pictures: Sequence[npt.NDArray[Any]], *options: str, levels: str = "gray"
) -> Path:
    rows, columns = pictures[0].shape
    subprocess.run(
        [
            *(imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "rawvideo"),
            *("-pix_fmt", levels, "-s", f"{columns}x{rows}", "-r", "60", "-i", "-"),
            *(*options, str(path)),
        ],
        input=b"".join(picture.tobytes() for picture in pictures),
        check=True,
    )
    return path


@pytest.fixture(scope="session")
def encode() -> Encode:
    """Encode grey pictures with ffmpeg at 60 frames a second: (path, pictures, *options) -> path.

    ``levels`` is the name of their format in ffmpeg: gray, gray10le, … gray16le.
    """
    return _encode
